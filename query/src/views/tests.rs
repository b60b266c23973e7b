//! Views on a lake with a few measurements: their contents, filter pushdown, and past versions.

use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _, Float32Array, Int64Array, ListArray, StringArray};
use arrow::buffer::OffsetBuffer;
use arrow::compute::{cast, concat_batches};
use arrow::datatypes::{DataType, Field, Float32Type, Float64Type, Int32Type, Int64Type};
use arrow::record_batch::RecordBatch;
use echolake_lake::{FileName, Lake, ReferenceSurfaces, RunRowCounts, VisibleRun, encode_batches};
use echolake_schema::tables::{COMMENT, Table, UNIT};
use echolake_schema::{Rig, Symmetry};

use super::LakeView;
use crate::{Error, Session};

/// Pairs that each run of the lake measures.
const PAIRS: usize = 3;
/// Tables with rows in these tests.
pub(crate) const TABLES: [Table; 6] =
    [Table::Surfaces, Table::Measurements, Table::Nce, Table::Tnce, Table::Heightmaps, Table::Runs];

async fn lake() -> (tempfile::TempDir, Lake) {
    let folder = tempfile::tempdir().expect("a folder");
    let url = folder.path().join("lake").display().to_string();
    let lake = Lake::open_or_create(&url, &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
    (folder, lake)
}

fn rows_of(table: Table) -> usize {
    match table {
        Table::Heightmaps => Symmetry::ALL.len(),
        Table::Surfaces | Table::Runs => 1,
        _ => PAIRS,
    }
}

// Integers count up from 0, so that pair_id is the pair; floats are ten times the row, lists hold the row's number.
fn column(table: Table, field: &Field, surface: &str, run: &str) -> ArrayRef {
    let rows = rows_of(table);
    let counted: Int64Array = (0..rows as i64).collect();
    match (field.name().as_str(), field.data_type()) {
        ("surface_id", _) => Arc::new(StringArray::from(vec![surface; rows])),
        ("run_id", _) => Arc::new(StringArray::from(vec![run; rows])),
        ("symmetry", _) => Arc::new(StringArray::from(Symmetry::ALL.map(Symmetry::name).to_vec())),
        // A surface's name may begin with its project's.
        ("project", _) => {
            Arc::new(StringArray::from(vec![surface.split_once('-').map_or("text", |(project, _)| project); rows]))
        }
        (_, DataType::Utf8) => Arc::new(StringArray::from(vec!["text"; rows])),
        (_, DataType::Boolean) => Arc::new(arrow::array::BooleanArray::from(vec![true; rows])),
        (_, DataType::List(child)) => {
            let values: Float32Array = (0..rows).flat_map(|i| [i as f32; 2]).collect();
            Arc::new(ListArray::new(child.clone(), OffsetBuffer::from_lengths(vec![2; rows]), Arc::new(values), None))
        }
        (_, DataType::Float64) => {
            Arc::new((0..rows).map(|i| Some(10f64.powi(i as i32))).collect::<arrow::array::Float64Array>())
        }
        (_, kind) => cast(&counted, kind).expect("numbers"),
    }
}

/// Adds a run to a lake, as ingest does.
pub(crate) async fn put(lake: &Lake, surface: &str, run: &str) {
    put_columns(lake, surface, run, &TABLES, &|table, field| column(table, field, surface, run)).await;
}

/// The same, with these columns of some tables, the last of which is `runs`.
pub(crate) async fn put_columns(
    lake: &Lake,
    surface: &str,
    run: &str,
    tables: &[Table],
    column: &dyn Fn(Table, &Field) -> ArrayRef,
) {
    let pointer = VisibleRun {
        surface: surface.parse().expect("an id"),
        run: run.parse().expect("an id"),
        run_derivation: "ab".into(),
        reference_derivation: Some("ab".into()),
        verdicts: None,
    };
    let rows = FileName::Rows { surface: pointer.surface.clone(), run: pointer.run.clone(), derivation: "ab".into() };
    let mut staged = Vec::new();
    for table in tables.iter().copied() {
        let schema = table.schema(lake.rig());
        let columns = schema.fields().iter().map(|f| column(table, f)).collect();
        let file = encode_batches(table, &schema, &[RecordBatch::try_new(schema.clone(), columns).expect("rows")]);
        let name = if table == Table::Runs { FileName::Pointer(pointer.clone()) } else { rows.clone() };
        let file = lake.stage_file(table, &name, file.expect("encoded")).await.expect("staged");
        // The run has no rows in tables that are not here.
        let counted = if table == Table::Runs { file.with_row_counts(RunRowCounts::default(), &staged) } else { file };
        staged.push(counted);
    }
    lake.commit_staged(&staged).await.expect("committed");
}

async fn rows(session: &Session, sql: &str) -> RecordBatch {
    let mut answer = session.query(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
    let (schema, mut batches) = (answer.schema.clone(), Vec::new());
    while let Some(batch) = answer.next().await.unwrap_or_else(|e| panic!("{sql}: {e}")) {
        batches.push(batch);
    }
    concat_batches(&schema, &batches).expect("one batch")
}

async fn plan(session: &Session, sql: &str) -> String {
    let text = rows(session, &format!("explain {sql}")).await;
    text.column(1).as_string::<i32>().iter().flatten().collect::<Vec<_>>().join("\n")
}

async fn number(session: &Session, sql: &str) -> i64 {
    rows(session, sql).await.column(0).as_primitive::<Int64Type>().value(0)
}

#[tokio::test]
async fn views_are_listed_and_every_column_says_what_it_means() {
    let (_folder, lake) = lake().await;
    let session = Session::new(&lake).expect("a session");
    let listed = "select count(*) from information_schema.tables where table_type = 'VIEW' and table_schema = 'public'";
    assert_eq!(number(&session, listed).await, LakeView::ALL.len() as i64);
    for (name, schema) in session.table_schemas() {
        for field in schema.fields() {
            let metadata = field.metadata();
            assert!(metadata.get(COMMENT).is_some_and(|c| c.len() > 5), "{name}.{}", field.name());
            assert!(metadata.contains_key(UNIT), "{name}.{}", field.name());
        }
    }
    for view in LakeView::ALL {
        let answer = rows(&session, &format!("select * from {}", view.name())).await;
        assert_eq!(answer.num_rows(), 0);
    }
}

#[tokio::test]
async fn ir_shows_geometry_and_reads_one_page_of_one_file() {
    let (_folder, lake) = lake().await;
    put(&lake, "0001_0", "r1").await;
    put(&lake, "0002_0", "r2").await;
    let session = Session::new(&lake).expect("a session");
    let one = "select * from ir where surface_id = '0002_0' and pair_id = 2";
    let answer = rows(&session, one).await;
    assert_eq!(answer.num_rows(), 1);
    let list = |name: &str| answer.column_by_name(name).expect(name).as_list::<i32>().value(0);
    assert_eq!(list("ir").as_primitive::<Float32Type>().values(), &[2.0, 2.0]);
    assert_eq!(list("reflected_ir").as_primitive::<Float32Type>().values(), &[2.0, 2.0]);
    let joined = "select count(*) from ir join pairs p on p.pair_id = ir.pair_id
        where p.incidence_deg = ir.incidence_deg and p.speaker_z_mm = ir.speaker_z_mm and p.direct_mm = ir.direct_mm";
    assert_eq!(number(&session, joined).await, 2 * PAIRS as i64);

    let narrow = plan(&session, "select ir, incidence_deg from ir where surface_id = '0002_0' and pair_id = 2").await;
    assert!(!narrow.contains("Join") && !narrow.contains("/nce/"), "{narrow}");
    assert!(narrow.contains("measurements/0002_0") && !narrow.contains("measurements/0001_0"), "{narrow}");
    let wide = plan(&session, one).await;
    assert!(wide.contains("nce/0002_0") && !wide.contains("nce/0001_0"), "{wide}");
    assert!(!plan(&session, "select count(*) from ir").await.contains("Join"));
}

#[tokio::test]
async fn levels_are_those_of_the_linear_columns() {
    let (_folder, lake) = lake().await;
    put(&lake, "0001_0", "r1").await;
    let session = Session::new(&lake).expect("a session");
    let answer = rows(&session, "select tnce_2500_db, tnce_total_db from tnce_db order by pair_id").await;
    assert_eq!(answer.column(0).as_primitive::<Float64Type>().values(), &[0.0, 10.0, 20.0]);
    assert_eq!(answer.column(1).as_primitive::<Float64Type>().values(), &[0.0, 10.0, 20.0]);
}

#[tokio::test]
async fn augmented_moves_measurements_and_height_maps_alike() {
    let (_folder, lake) = lake().await;
    put(&lake, "0001_0", "r1").await;
    put(&lake, "0002_0", "r2").await;
    let session = Session::new(&lake).expect("a session");
    let all = rows(
        &session,
        "select pair_id, symmetry, d4_pair_id, swapped, ir, heights_mm, microphone_x_mm from augmented
         where surface_id = '0001_0'",
    )
    .await;
    assert_eq!(all.num_rows(), Symmetry::ALL.len() * PAIRS);
    let column = |name: &str| all.column_by_name(name).expect(name).clone();
    for row in 0..all.num_rows() {
        let pair = column("pair_id").as_primitive::<Int32Type>().value(row);
        let name = column("symmetry").as_string::<i32>().value(row).to_owned();
        let symmetry = Symmetry::ALL.into_iter().position(|s| s.name() == name).expect("a symmetry");
        let moved = lake.grid().moved_pairs(Symmetry::ALL[symmetry]).expect("moved")[pair as usize];
        assert_eq!(column("d4_pair_id").as_primitive::<Int32Type>().value(row), moved.pair.id.0 as i32);
        assert_eq!(column("swapped").as_boolean().value(row), moved.swapped);
        let x = lake.grid().point(moved.pair.microphone).expect("a point").position_mm[0];
        assert_eq!(column("microphone_x_mm").as_primitive::<Float64Type>().value(row), x);
        let first = |name: &str| column(name).as_list::<i32>().value(row).as_primitive::<Float32Type>().value(0);
        assert_eq!((first("ir"), first("heights_mm")), (pair as f32, symmetry as f32));
    }
    let turned = plan(&session, "select ir from augmented where surface_id = '0002_0' and symmetry = 'rot90'").await;
    assert!(!turned.contains("HashJoin") && !turned.contains("heightmaps"), "{turned}");
    assert!(!turned.contains("measurements/0001_0"), "{turned}");
    // Flat's energy is 1 everywhere; of the three measured pairs only the identity leads to a measured one.
    let ratios = "select count(flat_ratio_2500), min(flat_ratio_total), max(flat_ratio_40000) from augmented
        where surface_id = '0001_0'";
    let answer = rows(&session, ratios).await;
    assert_eq!(answer.column(0).as_primitive::<Int64Type>().value(0), PAIRS as i64);
    assert_eq!([1, 2].map(|i| answer.column(i).as_primitive::<Float64Type>().value(0)), [1.0; 2]);
}

#[tokio::test]
async fn room_parameters_have_a_row_an_octave_and_say_what_is_missing() {
    let (_folder, lake) = lake().await;
    put(&lake, "0001_0", "r1").await;
    put(&lake, "0002_0", "r2").await;
    let session = Session::new(&lake).expect("a session");
    let one = "select midband_hz, t20_s, d50, reason from room_parameters where surface_id = '0002_0' and pair_id = 2 \
               order by midband_hz nulls first";
    let answer = rows(&session, one).await;
    let bands = answer.column(0).as_primitive::<Float64Type>();
    assert_eq!(bands.iter().collect::<Vec<_>>(), [None, Some(2e3), Some(4e3), Some(8e3), Some(16e3), Some(31.5e3)]);
    assert_eq!((answer.column(1).null_count(), answer.column(2).null_count()), (6, 6));
    let reason = answer.column(3).as_string::<i32>().value(5);
    assert_eq!(reason, "it is 0.0 ms long after its arrival, of at least 50 ms");
    let plan = plan(&session, one).await;
    assert!(plan.contains("measurements/0002_0") && !plan.contains("measurements/0001_0"), "{plan}");
    // In the logical plan and in the physical one.
    assert_eq!(plan.matches("room_parameters(").count(), 4, "once of all frequencies, once of a band: {plan}");
}

#[tokio::test]
async fn the_catalogue_has_a_row_a_surface() {
    let (_folder, lake) = lake().await;
    put(&lake, "0001_0", "r1").await;
    put(&lake, "0001_0", "r2").await;
    put(&lake, "0002_0", "r3").await;
    let session = Session::new(&lake).expect("a session");
    let answer = rows(&session, "select surface_id, runs, run_id, level_total_db from catalogue order by 1").await;
    assert_eq!(answer.num_rows(), 2);
    assert_eq!(answer.column(1).as_primitive::<Int64Type>().values(), &[2, 1]);
    assert_eq!(answer.column(2).as_string::<i32>().value(0), "r2");
    assert!(answer.column(3).is_null(0), "no statistics yet");
}

#[tokio::test]
async fn the_past_is_seen_until_it_is_vacuumed() {
    let (_folder, lake) = lake().await;
    let session = Session::new(&lake).expect("a session");
    let count = async |of: &str| number(&session, &format!("select count(*) from {of}")).await;
    put(&lake, "0001_0", "r1").await;
    assert_eq!(count("runs").await, 1);
    let first = lake.list_versions().await.expect("versions").pop().expect("a version");
    put(&lake, "0002_0", "r2").await;
    assert_eq!(count("runs").await, 2, "what is committed is seen by the next query");
    let (number, then) = (first.version, first.committed.to_rfc3339());
    for of in [
        format!("nce version as of {number}"),
        format!("ir version as of {number}"),
        format!("ir timestamp as of '{then}'"),
    ] {
        assert_eq!(count(&of).await, PAIRS as i64, "{of}");
    }
    let both = format!(
        "select count(*) from nce left join nce version as of {number} old on old.run_id = nce.run_id
         and old.pair_id = nce.pair_id where old.pair_id is null"
    );
    assert_eq!(self::number(&session, &both).await, PAIRS as i64);
    assert_eq!(count(&format!("nce version as of {number} where nce.pair_id = 1")).await, 1);

    let refused = async |of: &str, expected: &str| {
        let error = session.query(&format!("select * from {of}")).await.map(drop).expect_err(of);
        assert!(error.to_string().contains(expected), "{of}: {error}");
        error
    };
    let error = refused("nce version as of 99", "the lake has no version 99").await;
    assert!(matches!(error, Error::Query { .. }));
    refused("nce timestamp as of '2001-01-01'", "the lake has no 2001-01-01").await;
    let error = refused("nce timestamp as of 'yesterday'", "the lake has no tag `yesterday`: it has none").await;
    assert!(matches!(error, Error::Query { .. }));
    refused("nope version as of 1", "no table `nope`").await;
    let snapshot = lake.snapshot().await.expect("a view");
    let file = snapshot.files(Table::Tnce)[0].path.clone();
    object_store::ObjectStoreExt::delete(lake.store().as_ref(), &file).await.expect("deleted");
    refused(&format!("tnce version as of {number}"), "1 of its 1 files then are deleted").await;
}

/// E22: tables that are made again count their versions from 0 again, and a session that has read one of before reads
/// the present one.
#[tokio::test]
async fn a_past_version_is_that_of_the_tables_that_are_there() {
    let (folder, lake) = lake().await;
    let session = Session::new(&lake).expect("a session");
    put(&lake, "0001_0", "r1").await;
    let version = lake.list_versions().await.expect("versions").pop().expect("a version").version;
    let past = format!("select run_id from runs version as of {version}");
    let run = async || rows(&session, &past).await.column(0).as_string::<i32>().value(0).to_owned();
    put(&lake, "0002_0", "r2").await;
    assert_eq!(number(&session, "select count(*) from runs").await, 2);
    assert_eq!(run().await, "r1");
    let url = folder.path().join("lake");
    std::fs::remove_dir_all(url.join("tables")).expect("removed");
    let again = Lake::open(&url.display().to_string()).await.expect("opened");
    again.ensure_tables().await.expect("made again");
    put(&again, "0003_0", "r3").await;
    assert_eq!(again.list_versions().await.expect("versions").pop().expect("a version").version, version);
    assert_eq!(run().await, "r3");
    // As many versions as before, and more: present tables are those that are there, too.
    for surfaces in [&["0004_0"][..], &["0005_0", "0006_0", "0007_0"]] {
        std::fs::remove_dir_all(url.join("tables")).expect("removed");
        let again = Lake::open(&url.display().to_string()).await.expect("opened");
        again.ensure_tables().await.expect("made again");
        for surface in surfaces {
            put(&again, surface, &format!("run_{surface}")).await;
        }
        let seen = rows(&session, "select surface_id from runs order by surface_id").await;
        assert!(seen.column(0).as_string::<i32>().iter().flatten().eq(surfaces.iter().copied()), "{seen:?}");
        assert_eq!(run().await, format!("run_{}", surfaces[0]));
    }
}

#[tokio::test]
async fn pairs_are_looked_up_where_a_measurement_names_them() {
    let (_folder, lake) = lake().await;
    put(&lake, "0001_0", "r1").await;
    let session = Session::new(&lake).expect("a session");
    let looked_up = [
        "select p.pair_id, incidence_deg, microphone_x_mm from tnce t join pairs p on t.pair_id = p.pair_id",
        "select pair_id, incidence_deg, microphone_x_mm from pairs join tnce using (pair_id)",
        "select t.pair_id, incidence_deg, microphone_x_mm from tnce t left join pairs p on p.pair_id = t.pair_id",
        "select n.pair_id, incidence_deg, microphone_x_mm from (select pair_id from nce where pair_id < 9) n, pairs
            where n.pair_id = pairs.pair_id",
    ];
    let own = lake.pair_rows().expect("pairs");
    for sql in looked_up {
        let answer = rows(&session, &format!("{sql} order by 1")).await;
        assert!(!plan(&session, sql).await.contains("Join"), "{sql}");
        assert_eq!(answer.num_rows(), PAIRS, "{sql}");
        for (i, name) in ["pair_id", "incidence_deg", "microphone_x_mm"].into_iter().enumerate() {
            let expected = own.column_by_name(name).expect(name).slice(0, PAIRS);
            assert_eq!(answer.column(i).as_ref(), expected.as_ref(), "{sql}");
            // Table `tnce` has other metadata for its `pair_id`.
            if name != "pair_id" {
                let field = own.schema().field_with_name(name).expect(name).clone();
                assert_eq!(answer.schema().field(i).metadata(), field.metadata(), "{sql}");
            }
        }
    }
    // If pairs are filtered, or the numbers may not be pairs, the join stays.
    let joined = [
        ("select count(*) from tnce t join pairs p using (pair_id) where p.pair_id = 1 and p.direct_mm > 0", 1),
        ("select count(*) from tnce t join pairs p on t.pair_id + 2950 = p.pair_id", 1),
        ("select count(*) from (select attempt as pair_id from measurements) m join pairs p using (pair_id)", 3),
        ("select count(*) from (values (1), (-7)) v(pair_id) join pairs p using (pair_id)", 1),
    ];
    for (sql, expected) in joined {
        assert!(plan(&session, sql).await.contains("Join"), "{sql}");
        assert_eq!(number(&session, sql).await, expected, "{sql}");
    }
}

#[tokio::test]
async fn nulls_that_cannot_be_stand_last() {
    let (_folder, lake) = lake().await;
    put(&lake, "0001_0", "r1").await;
    let session = Session::new(&lake).expect("a session");
    let never = plan(&session, "select pair_id from tnce order by tnce_total desc, pair_id limit 2").await;
    assert!(never.contains("DESC NULLS LAST"), "{never}");
    let may = plan(&session, "select pair_id from measurements order by snr_db desc limit 2").await;
    assert!(!may.contains("DESC NULLS LAST"), "{may}");
    let answer = rows(&session, "select pair_id from tnce order by tnce_total desc, pair_id desc limit 2").await;
    assert_eq!(answer.num_rows(), 2);
}
