//! What the store gives out is what files have, and is decoded once.

use std::ops::Range;

use arrow::array::{AsArray as _, Float64Array, Int32Array, StringArray};
use arrow::datatypes::{Field, Int32Type, Schema};
use datafusion::common::Statistics;
use datafusion::execution::runtime_env::RuntimeEnv;
use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_schema::Rig;
use object_store::ObjectStoreExt as _;
use parquet::arrow::ArrowWriter;
use parquet::file::properties::WriterProperties;

use super::*;
use crate::LakeReaderFactory;

/// Rows of a group of rows of the tests' files: no multiple of a piece.
const GROUP_ROWS: usize = 9000;

fn table_schema() -> SchemaRef {
    Arc::new(Schema::new(vec![
        Field::new("run_id", DataType::Utf8, false),
        Field::new("pair_id", DataType::Int32, false),
        Field::new("added", DataType::Utf8, true),
        Field::new("level", DataType::Float64, true),
    ]))
}

/// Rows as files have them, without the column that came later.
fn file_rows(run: &str, pairs: Range<i32>) -> RecordBatch {
    let schema = table_schema().project(&[0, 1, 3]).expect("three columns");
    let levels = pairs.clone().map(|pair| (pair % 7 > 0).then(|| f64::from(pair) / 4.0));
    let columns: Vec<ArrayRef> = vec![
        Arc::new(StringArray::from_iter_values(pairs.clone().map(|_| run))),
        Arc::new(Int32Array::from_iter_values(pairs.clone())),
        Arc::new(levels.collect::<Float64Array>()),
    ];
    RecordBatch::try_new(Arc::new(schema), columns).expect("rows")
}

struct TestFiles {
    lake: Lake,
}

impl TestFiles {
    async fn new() -> Self {
        let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await;
        Self { lake: lake.expect("a lake") }
    }

    fn open_store(&self, bytes: u64) -> ColumnStore {
        self.open_slow_store(None, bytes)
    }

    fn open_slow_store(&self, footer_bytes: Option<usize>, bytes: u64) -> ColumnStore {
        let footers = RuntimeEnv::default().cache_manager.get_file_metadata_cache();
        ColumnStore::new(Arc::new(LakeReaderFactory::new(&self.lake, footers)), footer_bytes, bytes)
    }

    async fn put(&self, name: &str, rows: &RecordBatch) -> PartitionedFile {
        let properties = WriterProperties::builder().set_max_row_group_row_count(Some(GROUP_ROWS)).build();
        let mut writer = ArrowWriter::try_new(Vec::new(), rows.schema(), Some(properties)).expect("a writer");
        writer.write(rows).expect("written");
        let file = writer.into_inner().expect("a file");
        let bytes = file.len() as u64;
        let path = Path::from(format!("tables/events/{name}.parquet"));
        self.lake.store().put(&path, file.into()).await.expect("stored");
        let known = Statistics { num_rows: Precision::Exact(rows.num_rows()), ..Statistics::default() };
        let entry = PartitionedFile::new(path.to_string(), bytes).with_statistics(Arc::new(known));
        assert_eq!(entry.object_meta.location, path);
        entry
    }
}

async fn read(store: &ColumnStore, files: &[PartitionedFile], columns: &[usize]) -> Result<Vec<RecordBatch>> {
    let wanted = WantedColumns::new(&table_schema(), columns)?;
    let metrics = ExecutionPlanMetricsSet::new();
    store.read_files(files, &wanted, ScanMetrics { metrics: &metrics, partition: 0 }).await
}

fn all_rows(batches: &[RecordBatch]) -> RecordBatch {
    concat_batches(&batches[0].schema(), batches).expect("rows of one schema")
}

fn is_shared(before: &[RecordBatch], after: &[RecordBatch]) -> bool {
    let columns = |batches: &[RecordBatch]| batches.iter().flat_map(|b| b.columns().to_vec()).collect::<Vec<_>>();
    let (before, after) = (columns(before), columns(after));
    before.len() == after.len() && before.iter().zip(&after).all(|(a, b)| Arc::ptr_eq(a, b))
}

#[tokio::test]
async fn a_column_is_decoded_once_in_pieces_of_a_batch() {
    let files = TestFiles::new().await;
    let rows = file_rows("r1", 0..20_000);
    let file = [files.put("a", &rows).await];
    let store = files.open_store(64 << 20);
    let first = read(&store, &file, &[1, 3]).await.expect("rows");
    assert_eq!(first.iter().map(RecordBatch::num_rows).collect::<Vec<_>>(), [8192, 808, 8192, 808, 2000]);
    assert_eq!(all_rows(&first), rows.project(&[1, 2]).expect("two columns"));
    let used = store.bytes_used();
    assert!((20_000 * 12..20_000 * 32).contains(&used), "{used}");
    assert!(is_shared(&first, &read(&store, &file, &[1, 3]).await.expect("rows")));

    // Some of the columns are there already.
    let more = read(&store, &file, &[0, 1, 2, 3]).await.expect("rows");
    let narrow: Vec<_> = more.iter().map(|batch| batch.project(&[1, 3]).expect("two columns")).collect();
    assert!(is_shared(&first, &narrow));
    let more = all_rows(&more);
    assert_eq!(more.project(&[0, 1, 3]).expect("three columns"), rows);
    assert_eq!(more.column(2).null_count(), 20_000, "a column that the file lacks");
    let none = read(&store, &file, &[]).await.expect("rows");
    assert_eq!(none.iter().map(RecordBatch::num_rows).sum::<usize>(), 20_000);
}

#[tokio::test]
async fn ranges_of_a_file_have_each_of_its_rows_once() {
    let files = TestFiles::new().await;
    let rows = file_rows("r1", 0..30_000);
    let file = files.put("a", &rows).await;
    let bytes = file.object_meta.size as i64;
    let store = files.open_store(64 << 20);
    for parts in [1, 2, 3, 7, 50] {
        let mut read_rows = Vec::new();
        for part in 0..parts {
            let file = file.clone().with_range(bytes * part / parts, bytes * (part + 1) / parts);
            read_rows.extend(read(&store, &[file], &[0, 1, 3]).await.expect("rows"));
        }
        assert_eq!(all_rows(&read_rows), rows, "{parts}");
    }
}

#[tokio::test]
async fn several_files_are_given_out_in_one_batch() {
    let files = TestFiles::new().await;
    let [a, b, c] = [("r1", 0..3), ("r2", 3..4), ("r3", 4..9)].map(|(run, pairs)| file_rows(run, pairs));
    let parts = [files.put("a", &a).await, files.put("b", &b).await, files.put("c", &c).await];
    let store = files.open_store(1 << 20);
    let expected = all_rows(&[a, b, c]);
    let first = read(&store, &parts, &[0, 1, 3]).await.expect("rows");
    assert_eq!((first.len(), &first[0]), (1, &expected));
    assert!(is_shared(&first, &read(&store, &parts, &[0, 1, 3]).await.expect("rows")));
    // Others, and the same in another order, are other rows.
    let pairs = |batches: &[RecordBatch]| all_rows(batches).column(0).as_primitive::<Int32Type>().values().to_vec();
    let [first, second, third] = parts;
    let other = read(&store, &[second.clone(), first.clone()], &[1]).await.expect("rows");
    assert_eq!(pairs(&other), [3, 0, 1, 2]);
    assert_eq!(pairs(&read(&store, &[first, third], &[1]).await.expect("rows")), [0, 1, 2, 4, 5, 6, 7, 8]);
    assert_eq!(pairs(&read(&store, &[second], &[1]).await.expect("rows")), [3]);
}

#[tokio::test]
async fn of_a_small_file_all_columns_are_decoded_if_a_request_takes_long() {
    let files = TestFiles::new().await;
    for (rows, is_small) in [(5, true), (2000, false)] {
        let expected = file_rows("r1", 0..rows);
        let file = [files.put(&rows.to_string(), &expected).await];
        let store = files.open_slow_store(Some(1 << 16), 1 << 20);
        let pairs = read(&store, &file, &[1]).await.expect("rows");
        assert_eq!(all_rows(&pairs), expected.project(&[1]).expect("a column"));
        let used = store.bytes_used();
        assert_eq!(all_rows(&read(&store, &file, &[3, 0, 1]).await.expect("rows")).num_columns(), 3);
        assert_eq!(store.bytes_used() == used, is_small, "{rows} rows");
    }
}

#[tokio::test]
async fn the_store_keeps_no_more_than_its_bytes() {
    let files = TestFiles::new().await;
    let store = files.open_store(200_000);
    for number in 0..20 {
        let rows = file_rows("r1", number * 1000..(number + 1) * 1000);
        let file = [files.put(&number.to_string(), &rows).await];
        assert_eq!(all_rows(&read(&store, &file, &[0, 1, 3]).await.expect("rows")), rows);
        assert!(store.bytes_used() <= 200_000, "{}", store.bytes_used());
    }
    assert!(store.bytes_used() > 50_000, "{}", store.bytes_used());
    assert!(store.is_kept([DataType::Int32, DataType::Float64].iter(), 8333));
    assert!(!store.is_kept([DataType::Int32, DataType::Float64].iter(), 8334));
    let list = DataType::new_list(DataType::Float32, false);
    assert!(!store.is_kept([DataType::Int32, list].iter(), 1));
}

#[tokio::test]
async fn a_file_with_other_rows_than_its_log_says_is_an_error() {
    let files = TestFiles::new().await;
    let rows = file_rows("r1", 0..5);
    let mut file = files.put("a", &rows).await;
    file.statistics = Some(Arc::new(Statistics { num_rows: Precision::Exact(6), ..Statistics::default() }));
    let store = files.open_store(1 << 20);
    let error = read(&store, &[file], &[0]).await.expect_err("refused").to_string();
    assert!(error.contains("it has 5 rows, its log says 6"), "{error}");
}
