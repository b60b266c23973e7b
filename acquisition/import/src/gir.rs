//! Import of a folder of the published GIR data set, one run per surface. Its responses are temperature-corrected
//! already, and are recorded as such.

#[cfg(test)]
mod tests;

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use echolake_acquisition::disk::{BoundedFile, open_plain_file};
use echolake_acquisition::rig::devices::simulated::TAKE_SECS;
use echolake_acquisition::run::recorder::{LogLevel, Relief, RunStart};
use echolake_panel::mesh::{BACK_MM, FACETS, Mesh};
use echolake_panel::relief::HeightField;
use echolake_schema::interchange::{GIR_COMBINATIONS, GIR_PANEL_INFO};
use echolake_schema::manifest::{MeshFacts, Origin, RunEnd};
use echolake_schema::{Celsius, Grid, Pair, PairId, Rig, SurfaceId, SurfaceRecord};
use ndarray::{Array1, Array2, Ix1, Ix2};
use ndarray_npy::{NpzReader, ReadableElement};

use crate::batch::ImportBatch;
use crate::response::ImportedResponse;
use crate::{Error, ImportOptions, ImportedRun, RUN_SECS, content_error};

/// Samples of the published responses.
pub const GIR_IR_LEN: usize = 400;
/// Source name of the import's log entries.
const NAME: &str = "import gir";

/// Imports every `<surface>.npz` of a folder; `progress` gets the number of surfaces done and of all.
///
/// # Errors
/// [`Error`], naming the file and the place; a refused import leaves nothing behind.
pub fn import_gir(
    folder: &Path,
    rig: &Rig,
    options: ImportOptions<'_>,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Vec<ImportedRun>, Error> {
    let grid = rig.build_grid()?;
    let order = visiting_order(&folder.join("combinations.csv"), &grid)?;
    let info = panel_info(&folder.join("panel_info.csv"))?;
    let files = surfaces(folder)?;
    let (mut runs, mut batch) = (Vec::new(), ImportBatch::default());
    for (number, file) in (0u16..).zip(&files) {
        let surface: SurfaceId = file.file_stem().unwrap_or_default().to_string_lossy().parse()?;
        let import = GirImport { rig, order: order.as_ref(), grid: &grid, options, number };
        runs.push(import.surface(file, surface.clone(), info.get(&surface), &mut batch)?);
        progress(runs.len(), files.len());
    }
    batch.publish_all()?;
    Ok(runs)
}

struct GirImport<'a> {
    rig: &'a Rig,
    order: Option<&'a Vec<Pair>>,
    grid: &'a Grid,
    options: ImportOptions<'a>,
    number: u16,
}

impl GirImport<'_> {
    fn surface(
        &self,
        file: &Path,
        surface: SurfaceId,
        info: Option<&SurfaceRecord>,
        batch: &mut ImportBatch,
    ) -> Result<ImportedRun, Error> {
        let pairs = self.order.map_or(self.grid.pairs(), Vec::as_slice);
        let matrix = self.matrix(file, pairs.len())?;
        let temperatures = temperatures(file, pairs.len())?;
        let heights = self.heights(file, &surface)?;
        let mesh = heights.as_ref().map(|h| Mesh::from_height_field(&smaller(h), BACK_MM));
        let mut record = info.cloned().unwrap_or_else(|| self.options.surface_record("unknown"));
        record.project = self.options.project.cloned();
        record.mesh = heights.as_ref().zip(mesh.as_ref()).map(|(h, m)| MeshFacts {
            file: echolake_schema::topics::MESH_ATTACHMENT.into(),
            triangles: m.triangles.len() as u64,
            watertight: true,
            relief_mm: h.extent_mm().map(f64::from),
        });
        let started = self.options.started.plus_secs(f64::from(self.number) * RUN_SECS);
        let manifest = crate::make_manifest(Origin::ImportedGir, &surface, self.rig, started)?;
        let path = self.options.folder.join(format!("{}.mcap", manifest.run_id));
        let relief =
            heights.as_ref().zip(mesh.as_ref()).map(|(heights, mesh)| Relief { heights, mesh, original: None });
        let start = RunStart { manifest: &manifest, rig: self.rig, surface: &record, relief, plan: None };
        let mut recorder = batch.create_run(&path, &start)?;
        if self.order.is_none() {
            let what = "no combinations.csv: rows are taken in the order of the rig's pairs";
            recorder.log(started, LogLevel::Warning, NAME, what)?;
        }
        let what = "times are made up: the data set has none; temperatures are those of the correction";
        recorder.log(started, LogLevel::Info, NAME, what)?;
        let mut at = started;
        for ((row, pair), celsius) in pairs.iter().enumerate().zip(&temperatures) {
            at = at.plus_secs(TAKE_SECS);
            let samples = matrix.row(row).iter().map(|x| *x as f32).collect();
            let response = ImportedResponse { pair: *pair, at, celsius: Some(*celsius), samples, is_corrected: true };
            response.record_response(&mut recorder, self.rig, self.grid)?;
        }
        let count = pairs.len() as u64;
        batch.seal_run(recorder, &RunEnd { ended: at, accepted: count, rejected: 0, attempts: count })?;
        Ok(ImportedRun {
            path,
            run_id: manifest.run_id,
            surface,
            measurements: pairs.len(),
            warnings: Vec::new(),
            rejected: 0,
            notes: Vec::new(),
        })
    }

    fn matrix(&self, file: &Path, rows: usize) -> Result<Array2<f64>, Error> {
        let matrix: Array2<f64> = array::<Ix2>(file, "matrix")?;
        let (actual, least) = (matrix.dim(), self.rig.impulse_response.length);
        if actual.0 != rows || actual.1 < least {
            let expected = format!("{rows} rows of at least {least} samples, the lake's response length");
            return Err(content_error(file, "matrix", format!("{} x {}", actual.0, actual.1), expected));
        }
        // Responses are recorded in single precision.
        if let Some(((row, column), x)) = matrix.indexed_iter().find(|(_, x)| !(**x as f32).is_finite()) {
            return Err(content_error(file, format!("matrix[{row}, {column}]"), format!("{x:e}"), "a finite f32"));
        }
        Ok(matrix)
    }

    // Heights in the file may count from any level, in mm, or in m if all are under 1; their mean becomes 0.
    fn heights(&self, file: &Path, surface: &SurfaceId) -> Result<Option<HeightField>, Error> {
        let file = file.with_file_name(format!("{surface}_mat.npz"));
        if !file.exists() {
            return Ok(None);
        }
        let heights: Array2<f64> = array::<Ix2>(&file, "surface")?;
        let (rows, columns) = heights.dim();
        if rows != columns || rows < 2 || heights.iter().any(|h| !h.is_finite()) {
            let actual = format!("{rows} x {columns}, or numbers that are not finite");
            return Err(content_error(&file, "surface", actual, "a square of finite heights"));
        }
        let mean = heights.mean().unwrap_or(0.0);
        let span = heights.iter().fold(0.0f64, |m, h| m.max((h - mean).abs()));
        let scale = if span < 1.0 && span > 0.0 { 1e3 } else { 1.0 };
        let mut values = heights.iter().map(|h| (h - mean) * scale);
        Ok(Some(HeightField::from_fn(self.rig.panel.size_mm, rows, |_, _| values.next().unwrap_or(0.0))))
    }
}

fn smaller(heights: &HeightField) -> HeightField {
    HeightField::from_fn(heights.size_mm(), heights.cells().min(FACETS), |x, y| heights.height_at(x, y))
}

// One per row of the matrix.
fn temperatures(file: &Path, rows: usize) -> Result<Vec<Celsius>, Error> {
    let values: Array1<f64> = array::<Ix1>(file, "temperatures")?;
    if values.len() != rows {
        return Err(content_error(file, "temperatures", format!("{} values", values.len()), rows.to_string()));
    }
    let checked = values.iter().enumerate().map(|(row, celsius)| {
        let place = format!("temperatures[{row}]");
        Celsius::new(*celsius).map_err(|e| content_error(file, place, e.to_string(), "a temperature"))
    });
    checked.collect()
}

// Every .npz that is no height map.
fn surfaces(folder: &Path) -> Result<Vec<PathBuf>, Error> {
    let unreadable = |e: std::io::Error| Error::Read { path: folder.to_owned(), source: e.into() };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(unreadable)? {
        let path = entry.map_err(unreadable)?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if name.ends_with(".npz") && !name.ends_with("_mat.npz") {
            files.push(path.clone());
        }
    }
    files.sort();
    if files.is_empty() {
        Err(content_error(folder, "the folder", "no .npz file", "<surface>.npz files"))
    } else {
        Ok(files)
    }
}

// An array of floats of either width, by its name.
fn array<D: ndarray::Dimension>(path: &Path, name: &str) -> Result<ndarray::Array<f64, D>, Error> {
    match typed::<f64, D>(path, name) {
        Ok(array) => Ok(array),
        Err(first) => match typed::<f32, D>(path, name) {
            Ok(array) => Ok(array.mapv(f64::from)),
            Err(_) => Err(content_error(path, format!("array `{name}`"), first, "an array of f32 or f64")),
        },
    }
}

fn typed<T: ReadableElement, D: ndarray::Dimension>(path: &Path, name: &str) -> Result<ndarray::Array<T, D>, String> {
    let file = open_plain_file(path).map_err(|e| e.to_string())?;
    let mut npz = NpzReader::new(file).map_err(|e| e.to_string())?;
    npz.by_name::<ndarray::OwnedRepr<T>, D>(name).map_err(|e| e.to_string())
}

// The pairs in the order in which the robots visited them: the order of the matrix's rows.
fn visiting_order(path: &Path, grid: &Grid) -> Result<Option<Vec<Pair>>, Error> {
    if !path.exists() {
        return Ok(None);
    }
    let mut pairs: Vec<Option<Pair>> = vec![None; grid.pairs().len()];
    for (line, cells) in table(path, &GIR_COMBINATIONS)? {
        let place = format!("line {line}");
        let numbers: Option<Vec<usize>> = cells.iter().map(|c| c.parse().ok()).collect();
        let n = numbers.ok_or_else(|| content_error(path, place.clone(), cells.join(","), "whole numbers"))?;
        let point = |l: usize, x: usize, y: usize| grid.parse_point(&format!("{l}/{x}/{y}"));
        let PairId(id) = point(n[1], n[2], n[3])
            .and_then(|m| Ok((m, point(n[4], n[5], n[6])?)))
            .and_then(|(m, s)| grid.parse_pair(m, s))
            .map_err(|e| content_error(path, place.clone(), e.to_string(), "a pair of the rig"))?;
        let slot = n[0].checked_sub(1).and_then(|i| pairs.get_mut(i));
        *slot.ok_or_else(|| content_error(path, place, n[0].to_string(), format!("1 to {}", grid.pairs().len())))? =
            Some(grid.pairs()[id as usize]);
    }
    let count = pairs.iter().flatten().count();
    let whole: Option<Vec<Pair>> = pairs.into_iter().collect();
    let expected = grid.pairs().len();
    whole
        .map(Some)
        .ok_or_else(|| content_error(path, "its rows", format!("{count} combinations"), expected.to_string()))
}

// Reads the facts of each surface.
fn panel_info(path: &Path) -> Result<HashMap<SurfaceId, SurfaceRecord>, Error> {
    if !path.exists() {
        return Ok(HashMap::new());
    }
    let mut info = HashMap::new();
    for (line, c) in table(path, &GIR_PANEL_INFO)? {
        let id = |text: &str| {
            text.parse::<SurfaceId>()
                .map_err(|e| content_error(path, format!("line {line}"), e.to_string(), "a surface id"))
        };
        let some = |text: &str| (!text.is_empty()).then(|| text.to_owned());
        let record = SurfaceRecord {
            typology: c[4].to_ascii_lowercase(),
            macrostructure: some(&c[3]),
            mesostructure: some(&c[4]),
            material: some(&[c[5].as_str(), c[6].as_str()].join("; ")),
            flat_reference: Some(id(&c[1])?),
            foam_reference: Some(id(&c[2])?),
            macro_reference: c[3].parse().ok().filter(|_| c[3] != c[0]),
            ..SurfaceRecord::default()
        };
        info.insert(id(&c[0])?, record);
    }
    // The column may describe the large shape instead of naming the panel that has it.
    let known: HashSet<SurfaceId> = info.keys().cloned().collect();
    for record in info.values_mut() {
        record.macro_reference = record.macro_reference.take().filter(|reference| known.contains(reference));
    }
    Ok(info)
}

// The named columns of a CSV file, with the number of each line.
fn table(path: &Path, names: &[&str]) -> Result<Vec<(u64, Vec<String>)>, Error> {
    let unreadable = |e: csv::Error| Error::Read { path: path.to_owned(), source: e.into() };
    let file = BoundedFile::open(path).map_err(|e| unreadable(e.into()))?;
    let mut reader = csv::Reader::from_reader(file);
    let header = reader.headers().map_err(unreadable)?.clone();
    let place = |name: &&str| {
        if header.iter().filter(|h| h == name).count() > 1 {
            return Err(content_error(path, "its header", format!("column `{name}` twice"), "one of each"));
        }
        let found = header.iter().position(|h| h == *name);
        found.ok_or_else(|| content_error(path, "its header", format!("no column `{name}`"), names.join(", ")))
    };
    let places: Vec<usize> = names.iter().map(place).collect::<Result<_, _>>()?;
    let mut rows = Vec::new();
    for record in reader.records() {
        let record = record.map_err(unreadable)?;
        let line = record.position().map_or(0, csv::Position::line);
        rows.push((line, places.iter().map(|p| record.get(*p).unwrap_or_default().to_owned()).collect()));
    }
    Ok(rows)
}
