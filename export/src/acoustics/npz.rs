//! Responses and heights in the layout of the GIR data set: `<surface>.npz`, `<surface>_mat.npz`, `combinations.csv`
//! and `panel_info.csv`.

use std::io::Cursor;

use arrow::array::AsArray as _;
use arrow::datatypes::Float32Type;
use echolake_lake::{Lake, LakeSnapshot, VisibleRun};
use echolake_schema::interchange::{GIR_COMBINATIONS, GIR_PANEL_INFO};
use echolake_schema::tables::Table;
use ndarray::{Array1, Array2};
use ndarray_npy::NpzWriter;

use super::SurfaceResponses;
use crate::error::{Error, Result};
use crate::output::{PendingFolder, WrittenFile};
use crate::rows;

/// Writes a surface's files.
pub(super) async fn write_npz(
    lake: &Lake,
    snapshot: &LakeSnapshot,
    responses: &SurfaceResponses,
    folder: &PendingFolder,
) -> Result<Vec<WrittenFile>> {
    let surface = &responses.run.surface;
    let all = lake.grid().pairs().len();
    if responses.pairs.len() != all {
        let reason = format!(
            "it has {} of the rig's {all} pairs, and a matrix has all; hint: export sofa writes what there is",
            responses.pairs.len()
        );
        return Err(Error::Uncuttable { run: responses.run.run.clone(), reason });
    }
    let samples = responses.samples.iter().map(|x| f64::from(*x)).collect();
    let damaged = |e: ndarray::ShapeError| Error::damaged(&responses.run.run, e);
    let matrix = Array2::from_shape_vec((all, responses.length), samples).map_err(damaged)?;
    let temperatures = Array1::from_vec(responses.celsius.clone());
    let name = format!("{surface}.npz");
    let mut files = vec![
        folder.write_file(
            &name,
            &npz_archive(&[("matrix", &matrix)], &[("temperatures", &temperatures)])
                .map_err(|e| Error::write(&folder.final_path(&name), e))?,
        )?,
    ];
    if let Some(heights) = read_heights(lake, snapshot, responses).await? {
        let name = format!("{surface}_mat.npz");
        files.push(folder.write_file(
            &name,
            &npz_archive(&[("surface", &heights)], &[]).map_err(|e| Error::write(&folder.final_path(&name), e))?,
        )?);
    }
    Ok(files)
}

fn npz_archive(
    matrices: &[(&str, &Array2<f64>)],
    vectors: &[(&str, &Array1<f64>)],
) -> std::result::Result<Vec<u8>, ndarray_npy::WriteNpzError> {
    let mut npz = NpzWriter::new(Cursor::new(Vec::new()));
    for (name, array) in matrices {
        npz.add_array(*name, *array)?;
    }
    for (name, array) in vectors {
        npz.add_array(*name, *array)?;
    }
    Ok(npz.finish()?.into_inner())
}

async fn read_heights(
    lake: &Lake,
    snapshot: &LakeSnapshot,
    responses: &SurfaceResponses,
) -> Result<Option<Array2<f64>>> {
    let run = &responses.run.run;
    let batch = rows::of_run(lake, snapshot, Table::Heightmaps, run, &["symmetry", "heights_mm"]).await?;
    let Some(row) = rows::text_column(&batch, "symmetry").iter().position(|s| *s == "identity") else {
        return Ok(None);
    };
    let list = batch.column(1).as_list::<i32>().value(row);
    let values = list.as_primitive::<Float32Type>().values().iter().map(|h| f64::from(*h)).collect();
    let side = Table::HEIGHTMAP_CELLS;
    Array2::from_shape_vec((side, side), values).map(Some).map_err(|e| Error::damaged(format!("heightmaps, {run}"), e))
}

/// Writes `combinations.csv` (the pair of each matrix row) and `panel_info.csv` (one row per surface).
pub(super) async fn write_descriptions(
    lake: &Lake,
    snapshot: &LakeSnapshot,
    runs: &[VisibleRun],
    folder: &PendingFolder,
) -> Result<Vec<WrittenFile>> {
    let combinations = combinations_csv(lake).map_err(|e| Error::write(&folder.final_path("combinations.csv"), e))?;
    let mut info = csv::Writer::from_writer(Vec::new());
    let failed = |e: csv::Error| Error::write(&folder.final_path("panel_info.csv"), e);
    info.write_record(GIR_PANEL_INFO).map_err(failed)?;
    let columns =
        ["surface_id", "typology", "macrostructure", "material", "flat_reference", "foam_reference", "macro_reference"];
    for run in runs {
        let batch = rows::of_run(lake, snapshot, Table::Surfaces, &run.run, &columns).await?;
        let text = |column| rows::text_column(&batch, column).first().copied().unwrap_or_default();
        let shape = rows::optional_texts(&batch, "macro_reference").first().copied().flatten();
        let (sand, binder) = text("material").split_once("; ").unwrap_or((text("material"), ""));
        let row = [
            run.surface.as_str(),
            text("flat_reference"),
            text("foam_reference"),
            shape.unwrap_or_else(|| text("macrostructure")),
            text("typology"),
            sand,
            binder,
        ];
        info.write_record(row).map_err(failed)?;
    }
    let info = info.into_inner().map_err(|e| Error::write(&folder.final_path("panel_info.csv"), e))?;
    Ok(vec![folder.write_file("combinations.csv", &combinations)?, folder.write_file("panel_info.csv", &info)?])
}

// 1-based, as in the data set.
fn combinations_csv(lake: &Lake) -> std::result::Result<Vec<u8>, csv::Error> {
    let mut csv = csv::Writer::from_writer(Vec::new());
    csv.write_record(GIR_COMBINATIONS)?;
    let points = lake.grid().points();
    for pair in lake.grid().pairs() {
        let m = points[pair.microphone.index()];
        let s = points[pair.speaker.index()];
        let numbers = [pair.id.0 + 1, m.layer, m.gridx, m.gridy, s.layer, s.gridx, s.gridy];
        csv.write_record(numbers.map(|n| n.to_string()))?;
    }
    csv.into_inner().map_err(|e| e.into_error().into())
}
