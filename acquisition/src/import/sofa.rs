//! Import of responses as SOFA files (AES69, convention SingleRoomSRIR), one run per file.
//!
//! Files of `export sofa` are on the time axis of the lake's reference temperature, and say so. Other files are at the
//! room's temperature, which ingest corrects.

#[cfg(test)]
mod tests;

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use echolake_dsp::temperature::{TemperatureCorrection, resampling_ratio};
use echolake_schema::manifest::{Origin, RunEnd};
use echolake_schema::{Celsius, ErrorCause, Grid, Pair, PairId, Rig, SurfaceId, SurfaceRecord, Timestamp};

use super::batch::ImportBatch;
use super::response::ImportedResponse;
use super::sofa_file::{SofaFile, SofaVariable};
use super::{Error, ImportOptions, ImportedRun, RUN_SECS, wrong};
use crate::rig::devices::simulated::TAKE_SECS;
use crate::run::recorder::{LogLevel, RunStart};

/// Source name of the import's log entries.
const NAME: &str = "import sofa";
/// Attribute `APIName` of files of our own export.
const OURS: &str = "echolake";
/// Least interval between two measurements, ns: files count time in seconds, so that two may have the same.
const STEP_NANOS: i64 = 1_000;
const KELVIN: f64 = 273.15;
/// Least distance of two positions, m: nearer ones are the same; a file's own rounding is far below.
const SAME_METRES: f64 = 5e-4;

/// Imports SOFA files; `progress` gets the number of files done and of all. `celsius` is the temperature of files that
/// have none.
///
/// # Errors
/// [`Error`], naming the file and the variable; a refused import leaves nothing behind.
pub fn import_sofa(
    files: &[PathBuf],
    rig: &Rig,
    celsius: Option<Celsius>,
    options: ImportOptions<'_>,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Vec<ImportedRun>, Error> {
    let grid = rig.grid()?;
    let (mut runs, mut batch) = (Vec::new(), ImportBatch::default());
    each(files, rig, &grid, celsius, |sofa, number| {
        runs.push(sofa.record(&SofaImport { rig, grid: &grid, options, number }, &mut batch)?);
        progress(runs.len(), files.len());
        Ok(())
    })?;
    batch.publish()?;
    Ok(runs)
}

/// Checks SOFA files without importing them.
///
/// # Errors
/// As [`import_sofa`].
pub fn check_sofa(files: &[PathBuf], rig: &Rig, celsius: Option<Celsius>) -> Result<(), Error> {
    each(files, rig, &rig.grid()?, celsius, |_, _| Ok(()))
}

// Reads the files, one in memory at a time.
fn each(
    files: &[PathBuf],
    rig: &Rig,
    grid: &Grid,
    celsius: Option<Celsius>,
    mut then: impl FnMut(&Sofa, u16) -> Result<(), Error>,
) -> Result<(), Error> {
    let mut surfaces = HashSet::new();
    for (number, path) in (0u16..).zip(files) {
        let sofa = Sofa::read(path, rig, grid, celsius)?;
        if !surfaces.insert(sofa.surface.clone()) {
            let what = format!("a second file of surface {}", sofa.surface);
            return Err(wrong(path, "Title", what, "one file a surface"));
        }
        then(&sofa, number)?;
    }
    Ok(())
}

struct SofaImport<'a> {
    rig: &'a Rig,
    grid: &'a Grid,
    options: ImportOptions<'a>,
    number: u16,
}

/// Content of a file, checked.
struct Sofa {
    surface: SurfaceId,
    /// In the order of their times.
    measurements: Vec<SofaMeasurement>,
    length: usize,
    samples: Vec<f32>,
    is_corrected: bool,
}

struct SofaMeasurement {
    /// Row of its response.
    row: usize,
    pair: Pair,
    celsius: Celsius,
    /// ns since 1970.
    time: Option<i64>,
}

impl Sofa {
    fn read(path: &Path, rig: &Rig, grid: &Grid, celsius: Option<Celsius>) -> Result<Self, Error> {
        let unread = |source: ErrorCause| Error::Read { path: path.to_owned(), source };
        std::fs::File::open(path).map_err(|e| unread(e.into()))?;
        let file = SofaFile::open(path).map_err(|reason| unread(format!("it is no HDF5 file: {reason}").into()))?;
        let reader = SofaReader { path, file };
        let is_ours = reader.file.text("APIName") == OURS;
        reader.expect_text("SOFAConventions", "SingleRoomSRIR")?;
        reader.expect_text("DataType", "FIR")?;
        let responses = reader.needed("Data.IR")?;
        let &[count, 1, length] = responses.shape.as_slice() else {
            let expected = "measurements x 1 receiver x samples";
            return Err(wrong(path, "Data.IR", format!("{:?}", responses.shape), expected));
        };
        if count == 0 {
            return Err(wrong(path, "Data.IR", "no measurement", "one at least"));
        }
        reader.expect_rate(rig)?;
        for of_device in ["ReceiverPosition", "EmitterPosition", "Data.Delay"] {
            reader.expect_zeros(of_device)?;
        }
        let finite = responses.values.iter().position(|x| !(*x as f32).is_finite());
        if let Some(at) = finite {
            let place = format!("Data.IR[{}, 0, {}]", at / length, at % length);
            return Err(wrong(path, place, format!("{:e}", responses.values[at]), "a finite f32"));
        }
        let celsius = reader.temperatures(count, celsius)?;
        let reference = rig.impulse_response.reference_temperature_c.get();
        let least = celsius.iter().map(|c| least_length(rig, *c, is_ours)).max().unwrap_or(0);
        if length < least {
            let expected = format!("{least} at least, for the lake's responses of {}", rig.impulse_response.length);
            return Err(wrong(path, "Data.IR", format!("{length} samples"), expected));
        }
        let off = celsius.iter().find(|c| is_ours && (c.get() - reference).abs() > 1e-6);
        if let Some(off) = off {
            let actual = format!("responses at {} C", off.get());
            return Err(wrong(path, "RoomTemperature", actual, format!("those at the rig's {reference} C")));
        }
        let pairs = reader.pairs(count, grid)?;
        let times = reader.times(count)?;
        let row = |row: usize| SofaMeasurement {
            row,
            pair: pairs[row],
            celsius: celsius[row],
            time: times.as_ref().map(|times| times[row]),
        };
        let mut measurements: Vec<_> = (0..count).map(row).collect();
        measurements.sort_by_key(|m| m.time);
        Ok(Self {
            surface: reader.surface(is_ours)?,
            measurements,
            length,
            // Ours were singles before they were doubles, so that nothing is lost.
            samples: responses.values.iter().map(|x| *x as f32).collect(),
            is_corrected: is_ours,
        })
    }

    fn record(&self, import: &SofaImport<'_>, batch: &mut ImportBatch) -> Result<ImportedRun, Error> {
        let times = self.times(import.options.started.plus_secs(f64::from(import.number) * RUN_SECS));
        let (started, ended) = (times[0], times[times.len() - 1]);
        let manifest = super::manifest(Origin::ImportedSofa, &self.surface, import.rig, started)?;
        let record = SurfaceRecord { typology: "imported".into(), ..SurfaceRecord::default() };
        let path = import.options.folder.join(format!("{}.mcap", manifest.run_id));
        let start = RunStart { manifest: &manifest, rig: import.rig, surface: &record, relief: None, plan: None };
        let mut recorder = batch.create(&path, &start)?;
        if self.measurements.iter().all(|m| m.time.is_none()) {
            recorder.log(started, LogLevel::Info, NAME, "times are made up: the file has none")?;
        }
        for (measured, at) in self.measurements.iter().zip(times) {
            let samples = self.samples[measured.row * self.length..][..self.length].to_vec();
            let SofaMeasurement { pair, celsius, .. } = *measured;
            let response = ImportedResponse { pair, at, celsius, samples, is_corrected: self.is_corrected };
            response.record(&mut recorder, import.rig, import.grid)?;
        }
        let count = self.measurements.len();
        let end = RunEnd { ended, accepted: count as u64, rejected: 0, attempts: count as u64 };
        batch.seal(recorder, &end)?;
        let (run_id, surface) = (manifest.run_id, manifest.surface_id);
        Ok(ImportedRun { path, run_id, surface, measurements: count, warnings: Vec::new() })
    }

    // Returns the file's times, each later than the one before.
    fn times(&self, fallback: Timestamp) -> Vec<Timestamp> {
        let mut last = i64::MIN;
        let at = |(i, measured): (u32, &SofaMeasurement)| {
            let told = measured.time.map(Timestamp).unwrap_or_else(|| fallback.plus_secs(f64::from(i) * TAKE_SECS));
            last = told.0.max(last.saturating_add(STEP_NANOS));
            Timestamp(last)
        };
        (0u32..).zip(&self.measurements).map(at).collect()
    }
}

/// A reader that checks a file into a [`Sofa`].
struct SofaReader<'a> {
    path: &'a Path,
    file: SofaFile,
}

impl SofaReader<'_> {
    fn variable(&self, name: &str) -> Result<Option<SofaVariable>, Error> {
        self.file.variable(name).map_err(|actual| wrong(self.path, name, actual, "numbers"))
    }

    fn needed(&self, name: &str) -> Result<SofaVariable, Error> {
        let found = self.variable(name)?;
        found.ok_or_else(|| wrong(self.path, name, "it is missing", "what SingleRoomSRIR asks for"))
    }

    fn expect_text(&self, name: &str, expected: &str) -> Result<(), Error> {
        match self.file.text(name) {
            actual if actual == expected => Ok(()),
            actual => Err(wrong(self.path, name, format!("`{actual}`"), format!("`{expected}`"))),
        }
    }

    fn expect_rate(&self, rig: &Rig) -> Result<(), Error> {
        let (rate, expected) = (self.needed("Data.SamplingRate")?, rig.sweep.rate_hz.get());
        match rate.values.iter().find(|x| **x != expected) {
            None => Ok(()),
            Some(actual) => {
                let expected = format!("the rig's {expected} Hz; hint: sweep.rate_hz in the rig file");
                Err(wrong(self.path, "Data.SamplingRate", format!("{actual} Hz"), expected))
            }
        }
    }

    // One microphone and one speaker, each at its listener or source, and nothing delayed.
    fn expect_zeros(&self, name: &str) -> Result<(), Error> {
        let Some(found) = self.variable(name)? else { return Ok(()) };
        match found.values.iter().find(|x| x.is_nan() || x.abs() > SAME_METRES) {
            None => Ok(()),
            Some(actual) => Err(wrong(self.path, name, actual.to_string(), "zeros")),
        }
    }

    // Of each measurement.
    fn temperatures(&self, count: usize, otherwise: Option<Celsius>) -> Result<Vec<Celsius>, Error> {
        let name = "RoomTemperature";
        let Some(found) = self.variable(name)? else {
            let expected = "temperatures; hint: --temperature-c says what it was";
            return otherwise.map(|c| vec![c; count]).ok_or_else(|| wrong(self.path, name, "it is missing", expected));
        };
        let zero = match self.file.text_of(name, "Units").to_ascii_lowercase().as_str() {
            "kelvin" | "k" | "" => KELVIN,
            "celsius" | "degree celsius" | "degrees celsius" | "c" => 0.0,
            other => return Err(wrong(self.path, name, format!("units `{other}`"), "kelvin or degree celsius")),
        };
        let rows = self.rows(name, &found, count, 1)?;
        let celsius = rows.into_iter().map(|row| Celsius::new(to_nano(row[0] - zero)));
        let checked: Result<Vec<_>, _> = celsius.collect();
        checked.map_err(|e| wrong(self.path, name, e.to_string(), "a temperature"))
    }

    // ns since 1970.
    fn times(&self, count: usize) -> Result<Option<Vec<i64>>, Error> {
        let name = "MeasurementDate";
        let Some(found) = self.variable(name)?.filter(|v| v.values.len() == count) else { return Ok(None) };
        if let Some(bad) = found.values.iter().find(|s| !(0.0..4e9).contains(*s)) {
            return Err(wrong(self.path, name, bad.to_string(), "seconds since 1970"));
        }
        // Zeros are how tools say that they know nothing.
        let known = found.values.iter().any(|s| *s > 0.0);
        Ok(known.then(|| found.values.iter().map(|s| (s * 1e9).round() as i64).collect()))
    }

    fn pairs(&self, count: usize, grid: &Grid) -> Result<Vec<Pair>, Error> {
        let [microphones, speakers] = ["ListenerPosition", "SourcePosition"].map(|name| self.positions(name, count));
        let (microphones, speakers) = (microphones?, speakers?);
        let (mut pairs, mut seen) = (Vec::with_capacity(count), HashSet::new());
        for row in 0..count {
            let point = |name: &str, [x, y, z]: [f64; 3]| {
                let found = grid.parse_point(&format!("{x} {y} {z}"));
                found.map_err(|e| wrong(self.path, format!("{name}[{row}]"), e.to_string(), "a point of the rig"))
            };
            let microphone = point("ListenerPosition", microphones[row])?;
            let speaker = point("SourcePosition", speakers[row])?;
            let place = format!("measurement {row}");
            let PairId(id) = grid
                .parse_pair(microphone, speaker)
                .map_err(|e| wrong(self.path, place.clone(), e.to_string(), "a pair of the rig"))?;
            if !seen.insert(id) {
                return Err(wrong(self.path, place, "a second response of its pair", "one of each"));
            }
            pairs.push(grid.pairs()[id as usize]);
        }
        Ok(pairs)
    }

    // Of each measurement, mm.
    fn positions(&self, name: &str, count: usize) -> Result<Vec<[f64; 3]>, Error> {
        let found = self.needed(name)?;
        let kind = self.file.text_of(name, "Type");
        let rows = self.rows(name, &found, count, 3)?;
        let position = |row: &[f64]| -> Option<[f64; 3]> {
            let [a, b, c] = *row.first_chunk()?;
            match kind.as_str() {
                "cartesian" | "" => Some([a, b, c]),
                // Azimuth and elevation in degrees, then the distance.
                "spherical" => {
                    let (azimuth, elevation) = (a.to_radians(), b.to_radians());
                    let flat = c * elevation.cos();
                    Some([flat * azimuth.cos(), flat * azimuth.sin(), c * elevation.sin()])
                }
                _ => None,
            }
        };
        let metres: Option<Vec<_>> = rows.into_iter().map(position).collect();
        let metres =
            metres.ok_or_else(|| wrong(self.path, name, format!("type `{kind}`"), "cartesian or spherical"))?;
        Ok(metres.into_iter().map(|p| p.map(|m| to_nano(m * 1e3))).collect())
    }

    // One row a measurement, or the same for all.
    fn rows<'v>(&self, name: &str, v: &'v SofaVariable, count: usize, width: usize) -> Result<Vec<&'v [f64]>, Error> {
        let rows: Vec<_> = v.values.chunks_exact(width).collect();
        match rows.len() {
            n if n == count && v.values.len() == count * width => Ok(rows),
            1 if v.values.len() == width => Ok(vec![rows[0]; count]),
            _ => Err(wrong(self.path, name, format!("{:?}", v.shape), format!("[{count}, {width}] or [1, {width}]"))),
        }
    }

    // Others' titles are for people; their files' names must do.
    fn surface(&self, is_ours: bool) -> Result<SurfaceId, Error> {
        let stem = self.path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Ok(if is_ours { self.file.text("Title") } else { stem }.parse()?)
    }
}

// What it takes to bring a response to the reference temperature.
fn least_length(rig: &Rig, celsius: Celsius, is_corrected: bool) -> usize {
    let ratio = resampling_ratio(celsius.get(), rig.impulse_response.reference_temperature_c.get());
    match rig.impulse_response.length {
        length if is_corrected || ratio == 1.0 => length,
        length => TemperatureCorrection::<f64>::input_len_for(length, ratio),
    }
}

// What metres or kelvin have behind the ninth place is their conversion's.
fn to_nano(x: f64) -> f64 {
    (x * 1e9).round() / 1e9
}
