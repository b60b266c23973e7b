//! Import of responses as SOFA files (AES69), one run per file.
//!
//! Files of `export sofa` are on the time axis of the lake's reference temperature, and say so. Other files are at the
//! room's temperature, which ingest corrects.

mod spectra;
#[cfg(test)]
mod tests;

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use echolake_acquisition::disk::open_plain_file;
use echolake_acquisition::rig::devices::simulated::TAKE_SECS;
use echolake_acquisition::run::recorder::{LogLevel, RunStart};
use echolake_schema::manifest::{Origin, RunEnd};
use echolake_schema::{Celsius, ErrorCause, Grid, Pair, PairId, Point, Rig, SurfaceId, Timestamp};

use crate::batch::ImportBatch;
use crate::hdf5_file::{Hdf5File, Hdf5Variable, place_in_grid};
use crate::positions::{CoordinateFrame, to_nano};
use crate::response::{ImportedResponse, least_length, record_unknown_air};
use crate::{Error, ImportOptions, ImportedRun, RUN_SECS, content_error};

/// Source name of the import's log entries.
const NAME: &str = "import sofa";
/// Attribute `APIName` of files of our own export.
const OURS: &str = "echolake";
/// Least interval between two measurements, ns: files count time in seconds, so that two may have the same.
const STEP_NANOS: i64 = 1_000;
const KELVIN: f64 = 273.15;
/// Conventions that have responses between points, with their data types. The others have filters, audio or
/// spherical harmonics, or are of headphones, or are superseded.
const CONVENTIONS: [(&str, &str); 8] = [
    ("SingleRoomSRIR", "FIR"),
    ("SingleRoomMIMOSRIR", "FIR-E"),
    ("GeneralFIR", "FIR"),
    ("GeneralFIR-E", "FIR-E"),
    ("GeneralTF", "TF"),
    ("SimpleFreeFieldHRIR", "FIR"),
    ("SimpleFreeFieldHRTF", "TF"),
    ("FreeFieldDirectivityTF", "TF"),
];
/// Greatest delay that is none, in samples.
const NO_DELAY: f64 = 5e-4;

/// Imports SOFA files; `progress` gets the number of files done and of all. `celsius` is the temperature, whatever the
/// files say of it.
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
    let grid = rig.build_grid()?;
    let (mut runs, mut batch) = (Vec::new(), ImportBatch::default());
    each(files, rig, &grid, celsius, |sofa, number| {
        runs.push(sofa.record(&SofaImport { rig, grid: &grid, options, number }, &mut batch)?);
        progress(runs.len(), files.len());
        Ok(())
    })?;
    batch.publish_all()?;
    Ok(runs)
}

/// Checks SOFA files without importing them.
///
/// # Errors
/// As [`import_sofa`].
pub fn check_sofa(files: &[PathBuf], rig: &Rig, celsius: Option<Celsius>) -> Result<(), Error> {
    each(files, rig, &rig.build_grid()?, celsius, |_, _| Ok(()))
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
            return Err(content_error(path, "Title", what, "one file a surface"));
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
    responses: SofaResponses,
    is_corrected: bool,
    warnings: Vec<String>,
}

struct SofaMeasurement {
    /// Row of its response.
    row: usize,
    pair: Pair,
    /// None if it is unknown.
    celsius: Option<Celsius>,
    /// ns since 1970.
    time: Option<i64>,
}

/// Responses, one after the other: of all emitters, of all receivers, of all measurements.
struct SofaResponses {
    count: usize,
    receivers: usize,
    emitters: usize,
    length: usize,
    samples: Vec<f32>,
}

impl Sofa {
    fn read(path: &Path, rig: &Rig, grid: &Grid, celsius: Option<Celsius>) -> Result<Self, Error> {
        let unread = |source: ErrorCause| Error::Read { path: path.to_owned(), source };
        open_plain_file(path).map_err(|e| unread(e.into()))?;
        let file = Hdf5File::open(path).map_err(|reason| unread(format!("it is no HDF5 file: {reason}").into()))?;
        let mut reader = SofaReader { path, convention: file.root_text("SOFAConventions"), file, warnings: Vec::new() };
        let is_ours = reader.file.root_text("APIName") == OURS;
        let data_type = reader.expect_convention()?;
        let responses = match data_type {
            "TF" => reader.read_spectra(rig)?,
            _ => reader.read_responses(data_type == "FIR-E", rig)?,
        };
        let (count, length) = (responses.count, responses.length);
        let celsius = reader.temperatures(count, celsius.filter(|_| !is_ours))?;
        let reference = rig.impulse_response.reference_temperature_c.get();
        let least = celsius.iter().map(|c| least_length(rig, *c, is_ours)).max().unwrap_or(0);
        if length < least {
            let expected = format!("{least} at least, for the lake's responses of {}", rig.impulse_response.length);
            return Err(content_error(path, reader.data_name(), format!("{length} samples"), expected));
        }
        let off = celsius.iter().flatten().find(|c| is_ours && (c.get() - reference).abs() > 1e-6);
        if let Some(off) = off {
            let actual = format!("responses at {} C", off.get());
            return Err(content_error(path, "RoomTemperature", actual, format!("those at the rig's {reference} C")));
        }
        let pairs = reader.pairs(&responses, grid)?;
        let times = reader.times(count)?;
        let of_each = responses.receivers * responses.emitters;
        let row = |(row, pair): (usize, Pair)| SofaMeasurement {
            row,
            pair,
            celsius: celsius[row / of_each],
            time: times.as_ref().map(|times| times[row / of_each]),
        };
        let mut measurements: Vec<_> = pairs.into_iter().enumerate().map(row).collect();
        measurements.sort_by_key(|m| m.time);
        let surface = reader.surface(is_ours)?;
        Ok(Self { surface, measurements, responses, is_corrected: is_ours, warnings: reader.warnings })
    }

    fn record(&self, import: &SofaImport<'_>, batch: &mut ImportBatch) -> Result<ImportedRun, Error> {
        let times = self.times(import.options.started.plus_secs(f64::from(import.number) * RUN_SECS));
        let (started, ended) = (times[0], times[times.len() - 1]);
        let manifest = crate::make_manifest(Origin::ImportedSofa, &self.surface, import.rig, started)?;
        let record = import.options.surface_record("imported");
        let path = import.options.folder.join(format!("{}.mcap", manifest.run_id));
        let start = RunStart { manifest: &manifest, rig: import.rig, surface: &record, relief: None, plan: None };
        let mut recorder = batch.create_run(&path, &start)?;
        if self.measurements.iter().all(|m| m.time.is_none()) {
            recorder.log(started, LogLevel::Info, NAME, "times are made up: the file has none")?;
        }
        let unknown_air = self.measurements.iter().filter(|m| m.celsius.is_none()).count();
        for warning in &self.warnings {
            recorder.log(started, LogLevel::Warning, NAME, warning)?;
        }
        let notes = record_unknown_air(&mut recorder, started, NAME, unknown_air, import.rig)?;
        for (measured, at) in self.measurements.iter().zip(times) {
            let SofaResponses { length, samples, .. } = &self.responses;
            let samples = samples[measured.row * length..][..*length].to_vec();
            let SofaMeasurement { pair, celsius, .. } = *measured;
            let response = ImportedResponse { pair, at, celsius, samples, is_corrected: self.is_corrected };
            response.record_response(&mut recorder, import.rig, import.grid)?;
        }
        let count = self.measurements.len();
        let end = RunEnd { ended, accepted: count as u64, rejected: 0, attempts: count as u64 };
        batch.seal_run(recorder, &end)?;
        let (run_id, surface) = (manifest.run_id, manifest.surface_id);
        Ok(ImportedRun {
            path,
            run_id,
            surface,
            measurements: count,
            warnings: self.warnings.clone(),
            rejected: 0,
            notes,
        })
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
    convention: String,
    file: Hdf5File,
    warnings: Vec<String>,
}

/// Positions of the receivers or emitters, relative to the listener or source and its directions, mm.
struct ElementOffsets {
    /// One row per measurement, or one for all; in each, one position per element.
    rows: Vec<Vec<[f64; 3]>>,
}

impl SofaReader<'_> {
    fn variable(&self, name: &str) -> Result<Option<Hdf5Variable>, Error> {
        self.file.read_variable(name).map_err(|actual| content_error(self.path, name, actual, "numbers"))
    }

    fn needed(&self, name: &str) -> Result<Hdf5Variable, Error> {
        let expected = || format!("what {} asks for", self.convention);
        self.variable(name)?.ok_or_else(|| content_error(self.path, name, "it is missing", expected()))
    }

    // Returns the data type.
    fn expect_convention(&self) -> Result<&'static str, Error> {
        let Some((_, data_type)) = CONVENTIONS.iter().find(|(name, _)| *name == self.convention) else {
            let names = CONVENTIONS.map(|(name, _)| name).join(", ");
            let actual = format!("`{}`", self.convention);
            return Err(content_error(self.path, "SOFAConventions", actual, format!("one of {names}")));
        };
        match self.file.root_text("DataType") {
            actual if actual == *data_type => Ok(data_type),
            actual => Err(content_error(self.path, "DataType", format!("`{actual}`"), format!("`{data_type}`"))),
        }
    }

    fn data_name(&self) -> &'static str {
        if self.file.root_text("DataType") == "TF" { "Data.Real" } else { "Data.IR" }
    }

    fn read_responses(&self, has_emitters: bool, rig: &Rig) -> Result<SofaResponses, Error> {
        let name = "Data.IR";
        let found = self.needed(name)?;
        let (count, receivers, length, emitters) = match *found.shape.as_slice() {
            [count, receivers, length] if !has_emitters => (count, receivers, length, 1),
            [count, receivers, length, emitters] if has_emitters => (count, receivers, length, emitters),
            _ => {
                let emitters = if has_emitters { " x emitters" } else { "" };
                let expected = format!("measurements x receivers x samples{emitters}");
                return Err(content_error(self.path, name, format!("{:?}", found.shape), expected));
            }
        };
        self.expect_any(name, &found)?;
        self.expect_rate(rig)?;
        self.expect_no_delay()?;
        self.expect_finite(name, &found)?;
        // Ours were singles before they were doubles, so that nothing is lost.
        let samples = match emitters {
            1 => found.values.iter().map(|x| *x as f32).collect(),
            _ => {
                let blocks = found.values.chunks_exact(length * emitters);
                let of_block = |block: &[f64]| -> Vec<f32> {
                    let of_emitter = |e: usize| block.iter().skip(e).step_by(emitters).map(|x| *x as f32);
                    (0..emitters).flat_map(of_emitter).collect()
                };
                blocks.flat_map(of_block).collect()
            }
        };
        Ok(SofaResponses { count, receivers, emitters, length, samples })
    }

    fn read_spectra(&self, rig: &Rig) -> Result<SofaResponses, Error> {
        let [real, imaginary] = ["Data.Real", "Data.Imag"].map(|name| self.needed(name));
        let (real, imaginary) = (real?, imaginary?);
        let &[count, receivers, bins] = real.shape.as_slice() else {
            let expected = "measurements x receivers x frequencies";
            return Err(content_error(self.path, "Data.Real", format!("{:?}", real.shape), expected));
        };
        if imaginary.shape != real.shape {
            let expected = format!("{:?}, as Data.Real", real.shape);
            return Err(content_error(self.path, "Data.Imag", format!("{:?}", imaginary.shape), expected));
        }
        self.expect_any("Data.Real", &real)?;
        self.expect_finite("Data.Real", &real)?;
        self.expect_finite("Data.Imag", &imaginary)?;
        let mut frequencies = self.needed("N")?;
        let scale = self.hertz_of("N")?;
        frequencies.values.iter_mut().for_each(|f| *f *= scale);
        if frequencies.values.len() != bins {
            let actual = format!("{} frequencies", frequencies.values.len());
            return Err(content_error(self.path, "N", actual, format!("{bins}, as Data.Real has")));
        }
        let length = spectra::response_length(&frequencies.values, rig.sweep.rate_hz.get())
            .map_err(|(actual, expected)| content_error(self.path, "N", actual, expected))?;
        let samples = spectra::invert_spectra(&real.values, &imaginary.values, length).map_err(|at| {
            let place = format!("Data.Imag{:?}", place_in_grid(at, &imaginary.shape));
            let expected = "0: of a response, the lowest and the highest bin are real";
            content_error(self.path, place, format!("{:e}", imaginary.values[at]), expected)
        })?;
        Ok(SofaResponses { count, receivers, emitters: 1, length, samples })
    }

    fn expect_any(&self, name: &str, found: &Hdf5Variable) -> Result<(), Error> {
        if found.values.is_empty() {
            Err(content_error(self.path, name, "no measurement", "one at least"))
        } else {
            Ok(())
        }
    }

    fn expect_finite(&self, name: &str, found: &Hdf5Variable) -> Result<(), Error> {
        let Some(at) = found.values.iter().position(|x| !(*x as f32).is_finite()) else { return Ok(()) };
        let place = format!("{name}{:?}", place_in_grid(at, &found.shape));
        Err(content_error(self.path, place, format!("{:e}", found.values[at]), "a finite f32"))
    }

    fn expect_rate(&self, rig: &Rig) -> Result<(), Error> {
        let (rate, expected) = (self.needed("Data.SamplingRate")?, rig.sweep.rate_hz.get());
        let scale = self.hertz_of("Data.SamplingRate")?;
        match rate.values.iter().map(|rate| rate * scale).find(|rate| *rate != expected) {
            None => Ok(()),
            Some(actual) => {
                let expected = format!("the rig's {expected} Hz; hint: sweep.rate_hz in the rig file");
                Err(content_error(self.path, "Data.SamplingRate", format!("{actual} Hz"), expected))
            }
        }
    }

    // Returns how many hertz the unit of a variable has.
    fn hertz_of(&self, name: &str) -> Result<f64, Error> {
        match self.file.text_of(name, "Units").trim().to_ascii_lowercase().as_str() {
            "hertz" | "hz" | "" => Ok(1.0),
            "kilohertz" | "khz" => Ok(1e3),
            other => Err(content_error(self.path, name, format!("units `{other}`"), "hertz or kilohertz")),
        }
    }

    fn expect_no_delay(&self) -> Result<(), Error> {
        let name = "Data.Delay";
        let Some(found) = self.variable(name)? else { return Ok(()) };
        match found.values.iter().find(|x| x.is_nan() || x.abs() > NO_DELAY) {
            None => Ok(()),
            Some(actual) => Err(content_error(self.path, name, actual.to_string(), "zeros")),
        }
    }

    // Of each measurement. What is given overrides what the file has.
    fn temperatures(&mut self, count: usize, given: Option<Celsius>) -> Result<Vec<Option<Celsius>>, Error> {
        let Some(given) = given else { return self.temperatures_of_file(count) };
        let of_file = self.temperatures_of_file(count).unwrap_or_default();
        if let Some(other) = of_file.iter().flatten().find(|c| (c.get() - given.get()).abs() > 1e-6) {
            let (other, given) = (other.get(), given.get());
            self.warnings.push(format!("RoomTemperature is {other} C; taken as {given} C by --temperature-c"));
        }
        Ok(vec![Some(given); count])
    }

    // None of each if the file has none.
    fn temperatures_of_file(&self, count: usize) -> Result<Vec<Option<Celsius>>, Error> {
        let name = "RoomTemperature";
        let refused = |actual: String, expected: &str| {
            content_error(self.path, name, actual, format!("{expected}; hint: --temperature-c says what it was"))
        };
        let Some(found) = self.variable(name)? else { return Ok(vec![None; count]) };
        let zero = match self.file.text_of(name, "Units").trim().to_ascii_lowercase().as_str() {
            "kelvin" | "k" | "" => KELVIN,
            "celsius" | "degree celsius" | "degrees celsius" | "c" => 0.0,
            other => return Err(refused(format!("units `{other}`"), "kelvin or degree celsius")),
        };
        // Tools fill what nobody measured with 0 kelvin.
        if zero == KELVIN && found.values.iter().all(|x| *x == 0.0) {
            return Ok(vec![None; count]);
        }
        let rows = self.rows(name, &found, count, 1)?;
        let celsius = |row: &[f64]| Celsius::new(to_nano(row[0] - zero)).map(Some);
        let checked: Result<Vec<_>, _> = rows.into_iter().map(celsius).collect();
        checked.map_err(|e| refused(e.to_string(), "a temperature"))
    }

    // ns since 1970.
    fn times(&self, count: usize) -> Result<Option<Vec<i64>>, Error> {
        let name = "MeasurementDate";
        let Some(found) = self.variable(name)?.filter(|v| v.values.len() == count) else { return Ok(None) };
        if let Some(bad) = found.values.iter().find(|s| !(0.0..4e9).contains(*s)) {
            return Err(content_error(self.path, name, bad.to_string(), "seconds since 1970"));
        }
        // Zeros are how tools say that they know nothing.
        let known = found.values.iter().any(|s| *s > 0.0);
        Ok(known.then(|| found.values.iter().map(|s| (s * 1e9).round() as i64).collect()))
    }

    // Of each response.
    fn pairs(&mut self, responses: &SofaResponses, grid: &Grid) -> Result<Vec<Pair>, Error> {
        let SofaResponses { count, receivers, emitters, .. } = *responses;
        let microphones = self.points(["Listener", "Receiver"], count, receivers, grid)?;
        let speakers = self.points(["Source", "Emitter"], count, emitters, grid)?;
        let (mut pairs, mut seen) = (Vec::with_capacity(count * receivers * emitters), HashSet::new());
        for (row, (microphones, speakers)) in microphones.iter().zip(&speakers).enumerate() {
            for (receiver, microphone) in microphones.iter().enumerate() {
                for (emitter, speaker) in speakers.iter().enumerate() {
                    let place = || match (receivers, emitters) {
                        (1, 1) => format!("measurement {row}"),
                        (_, 1) => format!("measurement {row}, receiver {receiver}"),
                        _ => format!("measurement {row}, receiver {receiver}, emitter {emitter}"),
                    };
                    let PairId(id) = grid
                        .parse_pair(microphone, speaker)
                        .map_err(|e| content_error(self.path, place(), e.to_string(), "a pair of the rig"))?;
                    if !seen.insert(id) {
                        return Err(content_error(self.path, place(), "a second response of its pair", "one of each"));
                    }
                    pairs.push(grid.pairs()[id as usize]);
                }
            }
        }
        Ok(pairs)
    }

    // Returns the points of all elements of each measurement.
    fn points<'g>(
        &mut self,
        [object, element]: [&str; 2],
        count: usize,
        elements: usize,
        grid: &'g Grid,
    ) -> Result<Vec<Vec<&'g Point>>, Error> {
        let name = format!("{object}Position");
        let origins = self.positions(&name, count)?;
        let offsets = self.offsets(&format!("{element}Position"), elements, count)?;
        let turns = if offsets.is_zero() { None } else { Some(self.axes(object, count)?) };
        let mut points = Vec::with_capacity(count);
        for (row, origin) in origins.iter().enumerate() {
            let of_element = |(number, offset): (usize, &[f64; 3])| {
                let [x, y, z] = match &turns {
                    None => *origin,
                    Some(axes) => [0, 1, 2].map(|i| {
                        let turned: f64 = axes[row].iter().zip(offset).map(|(axis, along)| axis[i] * along).sum();
                        to_nano(origin[i] + turned)
                    }),
                };
                let place = || match &turns {
                    None => format!("{name}[{row}]"),
                    Some(_) => format!("{name}[{row}] and {element}Position[{number}]"),
                };
                let found = grid.parse_point(&format!("{x} {y} {z}"));
                found.map_err(|e| content_error(self.path, place(), e.to_string(), "a point of the rig"))
            };
            let of_row = offsets.of_row(row).iter().enumerate().map(of_element);
            points.push(of_row.collect::<Result<_, _>>()?);
        }
        Ok(points)
    }

    // Returns type and units of positions; directions along y or z take those along x.
    fn frame(&mut self, name: &str, of: &str) -> Result<CoordinateFrame, Error> {
        let [kind, units] = ["Type", "Units"].map(|attribute| self.file.text_of(of, attribute));
        let frame = CoordinateFrame::parse(&kind, &units)
            .map_err(|fault| content_error(self.path, format!("{of}, its attributes"), fault.actual, fault.expected))?;
        if units.trim().is_empty() && name.ends_with("Position") {
            self.warnings.push(format!("{name} has no attribute Units: taken as metres"));
        }
        Ok(frame)
    }

    // Of each measurement, mm.
    fn positions(&mut self, name: &str, count: usize) -> Result<Vec<[f64; 3]>, Error> {
        let found = self.needed(name)?;
        let frame = self.frame(name, name)?;
        let rows = self.rows(name, &found, count, 3)?;
        Ok(rows.into_iter().map(|row| frame.position_mm([row[0], row[1], row[2]])).collect())
    }

    // Of the elements of each measurement, mm.
    fn offsets(&mut self, name: &str, elements: usize, count: usize) -> Result<ElementOffsets, Error> {
        let Some(found) = self.variable(name)?.filter(|v| !v.values.is_empty()) else {
            return match elements {
                1 => Ok(ElementOffsets { rows: vec![vec![[0.0; 3]]] }),
                _ => Err(content_error(self.path, name, "it is missing", format!("positions of all {elements}"))),
            };
        };
        // Zeros need neither units nor a shape.
        if found.values.iter().all(|x| *x == 0.0) {
            return Ok(ElementOffsets { rows: vec![vec![[0.0; 3]; elements]] });
        }
        let (given, rows) = match *found.shape.as_slice() {
            [given, 3] if given == 1 || given == elements => (given, 1),
            [given, 3, rows] if (given == 1 || given == elements) && (rows == 1 || rows == count) => (given, rows),
            _ => {
                let expected = format!("[{elements}, 3, {count}] or [{elements}, 3, 1]");
                return Err(content_error(self.path, name, format!("{:?}", found.shape), expected));
            }
        };
        let frame = self.frame(name, name)?;
        let offset = |row: usize, element: usize| {
            let first = element % given * 3;
            frame.position_mm([0, 1, 2].map(|i| found.values[(first + i) * rows + row]))
        };
        let of_row = |row: usize| (0..elements).map(|element| offset(row, element)).collect();
        Ok(ElementOffsets { rows: (0..rows).map(of_row).collect() })
    }

    // Returns the directions x, y and z of the listener or the source at each measurement: to its front, its left, up.
    fn axes(&mut self, object: &str, count: usize) -> Result<Vec<[[f64; 3]; 3]>, Error> {
        let (view, up) = (format!("{object}View"), format!("{object}Up"));
        let fronts = self.directions(&view, &view, [1.0, 0.0, 0.0], count)?;
        let ups = self.directions(&up, &view, [0.0, 0.0, 1.0], count)?;
        let up_name = &up;
        let axes = |(row, (front, up)): (usize, (&[f64; 3], &[f64; 3]))| {
            let front = unit_vector(*front);
            let along = |front: &[f64; 3]| (0..3).map(|i| front[i] * up[i]).sum::<f64>();
            let up = front.and_then(|x| unit_vector([0, 1, 2].map(|i| up[i] - along(&x) * x[i])));
            let axes = front.zip(up).map(|(x, z)| [x, cross_product(z, x), z]);
            let place = format!("{view}[{row}]");
            axes.ok_or_else(|| {
                content_error(self.path, place, format!("no direction, or that of {up_name}"), "a direction")
            })
        };
        fronts.iter().zip(&ups).enumerate().map(axes).collect()
    }

    fn directions(&mut self, name: &str, of: &str, otherwise: [f64; 3], count: usize) -> Result<Vec<[f64; 3]>, Error> {
        let Some(found) = self.variable(name)? else { return Ok(vec![otherwise; count]) };
        let frame = self.frame(name, of)?;
        let rows = self.rows(name, &found, count, 3)?;
        Ok(rows.into_iter().map(|row| frame.position_mm([row[0], row[1], row[2]])).collect())
    }

    // One row a measurement, or the same for all.
    fn rows<'v>(&self, name: &str, v: &'v Hdf5Variable, count: usize, width: usize) -> Result<Vec<&'v [f64]>, Error> {
        let rows: Vec<_> = v.values.chunks_exact(width).collect();
        match rows.len() {
            n if n == count && v.values.len() == count * width => Ok(rows),
            1 if v.values.len() == width => Ok(vec![rows[0]; count]),
            _ => Err(content_error(
                self.path,
                name,
                format!("{:?}", v.shape),
                format!("[{count}, {width}] or [1, {width}]"),
            )),
        }
    }

    // Others' titles are for people; their files' names must do.
    fn surface(&self, is_ours: bool) -> Result<SurfaceId, Error> {
        let stem = self.path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Ok(if is_ours { self.file.root_text("Title") } else { stem }.parse()?)
    }
}

impl ElementOffsets {
    fn is_zero(&self) -> bool {
        self.rows.iter().flatten().flatten().all(|x| *x == 0.0)
    }

    fn of_row(&self, row: usize) -> &[[f64; 3]] {
        &self.rows[row % self.rows.len()]
    }
}

// None if it has no direction.
fn unit_vector(vector: [f64; 3]) -> Option<[f64; 3]> {
    let length = vector.iter().map(|x| x * x).sum::<f64>().sqrt();
    (length > 1e-9 && length.is_finite()).then(|| vector.map(|x| x / length))
}

fn cross_product([a, b, c]: [f64; 3], [x, y, z]: [f64; 3]) -> [f64; 3] {
    [b * z - c * y, c * x - a * z, a * y - b * x]
}
