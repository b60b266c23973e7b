//! Import of an HDF5 file of another make, by a mapping of its datasets: one run per measurement, with a response of
//! each microphone and each speaker. The file is read block by block, so that a set may be larger than the memory.

#[cfg(test)]
mod tests;

use std::collections::HashMap;
use std::path::Path;

use echolake_acquisition::disk::open_plain_file;
use echolake_acquisition::run::recorder::{LogLevel, RunStart};
use echolake_schema::manifest::{Origin, RunEnd};
use echolake_schema::{Celsius, ErrorCause, Grid, Pair, PairId, Point, Rig, SurfaceId};

use crate::batch::ImportBatch;
use crate::hdf5_file::{Hdf5Dataset, Hdf5File, Hdf5Variable, place_in_grid};
use crate::hdf5_mapping::{
    DatasetDimension, Hdf5Mapping, PositionMapping, RateMapping, TemperatureMapping, TemperatureUnit,
};
use crate::positions::{CoordinateFrame, to_nano};
use crate::response::{ImportedResponse, least_length, record_unknown_air};
use crate::{Error, ImportOptions, ImportedRun, RUN_SECS, content_error};

/// Source name of the import's log entries.
const NAME: &str = "import hdf5";
/// Interval between two responses, whose times the file does not tell, s.
const RESPONSE_SECS: f64 = 1e-3;
/// Numbers that are read at once: 32 MB of them.
const BLOCK_NUMBERS: usize = 1 << 22;
/// Most numbers that are read at once because each row has as many, or the samples are the rows: 256 MB.
const MOST_BLOCK_NUMBERS: usize = 1 << 25;
const KELVIN: f64 = 273.15;

/// Imports the responses of an HDF5 file; `progress` gets the number of responses done and of all. `celsius` is the
/// temperature, whatever the mapping says of it.
///
/// # Errors
/// [`Error`], naming the file and the dataset; a refused import leaves nothing behind.
pub fn import_hdf5(
    mapping: &Path,
    rig: &Rig,
    celsius: Option<Celsius>,
    options: ImportOptions<'_>,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Vec<ImportedRun>, Error> {
    let grid = rig.build_grid()?;
    let set = ResponseSet::open(mapping, rig, &grid, celsius)?;
    let (mut runs, mut batch) = (Vec::new(), ImportBatch::default());
    let of_each = set.microphones.len() * set.speakers.len();
    let total = of_each * set.surfaces.len();
    for number in 0..set.surfaces.len() {
        let mut step = |done: usize| progress(number * of_each + done, total);
        runs.push(set.record(number, &Hdf5Import { rig, grid: &grid, options }, &mut batch, &mut step)?);
    }
    batch.publish_all()?;
    Ok(runs)
}

/// Checks a mapping and all that it names but the responses' samples, without importing them.
///
/// # Errors
/// As [`import_hdf5`].
pub fn check_hdf5(mapping: &Path, rig: &Rig, celsius: Option<Celsius>) -> Result<(), Error> {
    ResponseSet::open(mapping, rig, &rig.build_grid()?, celsius).map(drop)
}

/// The pair, the temperature, if it is known, and the samples of a response.
type ReadResponse = (Pair, Option<Celsius>, Vec<f32>);

struct Hdf5Import<'a> {
    rig: &'a Rig,
    grid: &'a Grid,
    options: ImportOptions<'a>,
}

/// A mapped file, checked.
struct ResponseSet<'g> {
    mapping: Hdf5Mapping,
    responses: Hdf5Dataset,
    axes: ResponseAxes,
    /// One per measurement.
    surfaces: Vec<SurfaceId>,
    microphones: Vec<&'g Point>,
    speakers: Vec<&'g Point>,
    /// None if they are unknown.
    temperatures: Option<AirTemperatures>,
}

/// The axis of each dimension in the responses' dataset.
struct ResponseAxes {
    microphone: usize,
    speaker: usize,
    sample: usize,
    measurement: Option<usize>,
}

/// Temperatures, and how far apart those of two microphones, speakers and measurements are.
struct AirTemperatures {
    celsius: Vec<Celsius>,
    steps: [usize; 3],
}

/// A dataset of the mapped file, for messages that name it.
struct MappedFile<'a> {
    path: &'a Path,
    file: &'a Hdf5File,
}

impl<'g> ResponseSet<'g> {
    fn open(path: &Path, rig: &Rig, grid: &'g Grid, celsius: Option<Celsius>) -> Result<Self, Error> {
        let mapping = Hdf5Mapping::from_file(path)?;
        let unread = |source: ErrorCause| Error::Read { path: mapping.file.clone(), source };
        open_plain_file(&mapping.file).map_err(|e| unread(e.into()))?;
        let opened = Hdf5File::open(&mapping.file);
        let file = opened.map_err(|reason| unread(format!("it is no HDF5 file: {reason}").into()))?;
        let mapped = MappedFile { path: &mapping.file, file: &file };
        let name = mapping.responses.dataset.as_str();
        let responses = mapped.dataset(name)?;
        let axes = ResponseAxes::find(path, &mapping.responses.dimensions)?;
        if responses.shape.len() != mapping.responses.dimensions.len() || responses.shape.contains(&0) {
            let names: Vec<_> = mapping.responses.dimensions.iter().map(|d| d.label()).collect();
            let expected = format!("one number each of [{}]; hint: responses.dimensions", names.join(", "));
            return Err(content_error(mapped.path, name, format!("shape {:?}", responses.shape), expected));
        }
        let count = |axis: usize| responses.shape[axis];
        mapped.expect_rate(&mapping.sampling_rate, rig)?;
        let microphones = mapped.points(&mapping.microphones, count(axes.microphone), "microphones", name, grid)?;
        let speakers = mapped.points(&mapping.speakers, count(axes.speaker), "speakers", name, grid)?;
        for microphone in &microphones {
            for speaker in &speakers {
                grid.parse_pair(microphone, speaker)
                    .map_err(|e| content_error(mapped.path, name, e.to_string(), "pairs of the rig"))?;
            }
        }
        let measurements = axes.measurement.map_or(1, count);
        let surfaces = mapping.parse_surfaces(path, measurements)?;
        let counts = [microphones.len(), speakers.len(), measurements];
        let temperatures = match celsius {
            Some(given) => Some(AirTemperatures { celsius: vec![given], steps: [0; 3] }),
            None => {
                let mapping = mapping.temperature.as_ref();
                mapping.map(|mapping| mapped.temperatures(path, mapping, counts)).transpose()?
            }
        };
        let length = count(axes.sample);
        let of_air = |celsius| least_length(rig, celsius, false);
        let known = temperatures.iter().flat_map(|known| &known.celsius).map(|celsius| of_air(Some(*celsius)));
        let least = known.max().unwrap_or_else(|| of_air(None));
        if length < least {
            let expected = format!("{least} at least, for the lake's responses of {}", rig.impulse_response.length);
            return Err(content_error(mapped.path, name, format!("{length} samples"), expected));
        }
        Ok(Self { responses, axes, surfaces, microphones, speakers, temperatures, mapping })
    }

    // Writes the run of a measurement.
    fn record(
        &self,
        number: usize,
        import: &Hdf5Import<'_>,
        batch: &mut ImportBatch,
        done: &mut dyn FnMut(usize),
    ) -> Result<ImportedRun, Error> {
        let started = import.options.started.plus_secs(number as f64 * RUN_SECS);
        let manifest = crate::make_manifest(Origin::ImportedHdf5, &self.surfaces[number], import.rig, started)?;
        let record = import.options.surface_record("imported");
        let path = import.options.folder.join(format!("{}.mcap", manifest.run_id));
        let start = RunStart { manifest: &manifest, rig: import.rig, surface: &record, relief: None, plan: None };
        let mut recorder = batch.create_run(&path, &start)?;
        recorder.log(started, LogLevel::Info, NAME, "times are made up: the mapping has none")?;
        let unknown_air = if self.temperatures.is_none() { self.microphones.len() * self.speakers.len() } else { 0 };
        let notes = record_unknown_air(&mut recorder, started, NAME, unknown_air, import.rig)?;
        let shape = &self.responses.shape;
        let block = self.block_shape();
        let mut blocks: Vec<usize> = shape.iter().zip(&block).map(|(n, b)| n.div_ceil(*b)).collect();
        if let Some(axis) = self.axes.measurement {
            blocks[axis] = 1;
        }
        let (mut at, mut measured) = (started, 0usize);
        for index in 0..blocks.iter().product() {
            let mut starts: Vec<usize> = place_in_grid(index, &blocks).iter().zip(&block).map(|(i, b)| i * b).collect();
            if let Some(axis) = self.axes.measurement {
                starts[axis] = number;
            }
            let counts: Vec<usize> =
                starts.iter().zip(&block).zip(shape).map(|((start, b), n)| (*b).min(n - start)).collect();
            for (pair, celsius, samples) in self.read_block(&starts, &counts, number, import.grid)? {
                at = started.plus_secs(measured as f64 * RESPONSE_SECS);
                let response = ImportedResponse { pair, at, celsius, samples, is_corrected: false };
                response.record_response(&mut recorder, import.rig, import.grid)?;
                measured += 1;
            }
            done(measured);
        }
        let count = measured as u64;
        batch.seal_run(recorder, &RunEnd { ended: at, accepted: count, rejected: 0, attempts: count })?;
        let (run_id, surface) = (manifest.run_id, manifest.surface_id);
        Ok(ImportedRun { path, run_id, surface, measurements: measured, rejected: 0, warnings: Vec::new(), notes })
    }

    // Reads a block of the dataset, and tells its responses apart.
    fn read_block(
        &self,
        starts: &[usize],
        counts: &[usize],
        measurement: usize,
        grid: &Grid,
    ) -> Result<Vec<ReadResponse>, Error> {
        let (file, name) = (&self.mapping.file, &self.mapping.responses.dataset);
        let values = self.responses.read_block(starts, counts).map_err(|what| {
            content_error(
                file,
                format!("{name}, {counts:?} numbers from {starts:?} on"),
                what,
                "numbers that can be read",
            )
        })?;
        if let Some(at) = values.iter().position(|x| !(*x as f32).is_finite()) {
            let place: Vec<usize> = place_in_grid(at, counts).iter().zip(starts).map(|(i, start)| i + start).collect();
            return Err(content_error(file, format!("{name}{place:?}"), format!("{:e}", values[at]), "a finite f32"));
        }
        let step = |axis: usize| counts[axis + 1..].iter().product::<usize>();
        let ResponseAxes { microphone, speaker, sample, .. } = self.axes;
        let (of_microphone, of_speaker, of_sample) = (step(microphone), step(speaker), step(sample));
        let mut responses = Vec::with_capacity(counts[microphone] * counts[speaker]);
        for m in 0..counts[microphone] {
            for s in 0..counts[speaker] {
                let (m_of_all, s_of_all) = (starts[microphone] + m, starts[speaker] + s);
                let PairId(id) = grid.parse_pair(self.microphones[m_of_all], self.speakers[s_of_all])?;
                let celsius = self.temperatures.as_ref().map(|known| known.find([m_of_all, s_of_all, measurement]));
                let first = m * of_microphone + s * of_speaker;
                let samples = (0..counts[sample]).map(|n| values[first + n * of_sample] as f32).collect();
                responses.push((grid.pairs()[id as usize], celsius, samples));
            }
        }
        Ok(responses)
    }

    // Returns the shape of the blocks that are read at once: all samples of some responses, in whole rows if they fit.
    fn block_shape(&self) -> Vec<usize> {
        let shape = &self.responses.shape;
        let mut block = vec![1; shape.len()];
        block[self.axes.sample] = shape[self.axes.sample];
        let fixed = [Some(self.axes.sample), self.axes.measurement];
        for axis in (0..shape.len()).rev().filter(|axis| !fixed.contains(&Some(*axis))) {
            let most = if axis == 0 { BLOCK_NUMBERS } else { MOST_BLOCK_NUMBERS };
            let size = block.iter().fold(1usize, |size, n| size.saturating_mul(*n));
            block[axis] = (most / size).clamp(1, shape[axis]);
        }
        let chunk_rows = self.responses.chunk_rows;
        if block[0] > chunk_rows && block[0] < shape[0] {
            block[0] -= block[0] % chunk_rows;
        }
        block
    }
}

impl ResponseAxes {
    fn find(path: &Path, dimensions: &[DatasetDimension]) -> Result<Self, Error> {
        let axis = |wanted| dimensions.iter().position(|d| *d == wanted);
        let (microphone, speaker) = (axis(DatasetDimension::Microphone), axis(DatasetDimension::Speaker));
        let (sample, measurement) = (axis(DatasetDimension::Sample), axis(DatasetDimension::Measurement));
        let count = 3 + usize::from(measurement.is_some());
        match (microphone, speaker, sample) {
            (Some(microphone), Some(speaker), Some(sample)) if dimensions.len() == count => {
                Ok(Self { microphone, speaker, sample, measurement })
            }
            _ => {
                let names: Vec<_> = dimensions.iter().map(|d| d.label()).collect();
                let expected = "microphone, speaker and sample once each, and measurement if the dataset has it";
                Err(content_error(path, "responses.dimensions", format!("[{}]", names.join(", ")), expected))
            }
        }
    }
}

impl AirTemperatures {
    fn find(&self, indices: [usize; 3]) -> Celsius {
        self.celsius[indices.iter().zip(self.steps).map(|(i, step)| i * step).sum::<usize>()]
    }
}

impl MappedFile<'_> {
    fn dataset(&self, name: &str) -> Result<Hdf5Dataset, Error> {
        let found = self
            .file
            .open_dataset(name)
            .map_err(|actual| content_error(self.path, name, actual, "a dataset of numbers"))?;
        found.ok_or_else(|| content_error(self.path, name, "it is missing", self.datasets()))
    }

    fn variable(&self, name: &str) -> Result<Hdf5Variable, Error> {
        let found = self
            .file
            .read_variable(name)
            .map_err(|actual| content_error(self.path, name, actual, "a dataset of numbers"))?;
        found.ok_or_else(|| content_error(self.path, name, "it is missing", self.datasets()))
    }

    // Names those that there are.
    fn datasets(&self) -> String {
        const SHOWN: usize = 20;
        let names = self.file.variable_names();
        let more = if names.len() > SHOWN { ", ..." } else { "" };
        format!("one of {}{more}", names[..names.len().min(SHOWN)].join(", "))
    }

    fn expect_rate(&self, mapping: &RateMapping, rig: &Rig) -> Result<(), Error> {
        let (place, rates) = match mapping {
            RateMapping::Hertz(rate) => ("sampling_rate".to_owned(), vec![*rate]),
            RateMapping::Stored(stored) => match &stored.attribute {
                None => (stored.dataset.clone(), self.variable(&stored.dataset)?.values),
                Some(attribute) => {
                    let place = format!("attribute `{attribute}` of {}", stored.dataset);
                    let found = self.file.number_of(&stored.dataset, attribute);
                    (place.clone(), vec![found.map_err(|actual| content_error(self.path, place, actual, "a number"))?])
                }
            },
        };
        let expected = rig.sweep.rate_hz.get();
        match rates.first() {
            Some(rate) if rates.iter().all(|other| other == rate) && *rate == expected => Ok(()),
            Some(rate) => {
                let actual = rates.iter().find(|other| **other != expected).unwrap_or(rate);
                let expected = format!("the rig's {expected} Hz; hint: sweep.rate_hz in the rig file");
                Err(content_error(self.path, place, format!("{actual} Hz"), expected))
            }
            None => Err(content_error(self.path, place, "no number", "a sampling rate")),
        }
    }

    fn points<'g>(
        &self,
        mapping: &PositionMapping,
        count: usize,
        what: &str,
        responses: &str,
        grid: &'g Grid,
    ) -> Result<Vec<&'g Point>, Error> {
        let name = mapping.dataset.as_str();
        let found = self.variable(name)?;
        // Coordinates may be rows or columns.
        let at = |i: usize, axis: usize| match *found.shape.as_slice() {
            [n, 3] if n == count => Some(found.values[i * 3 + axis]),
            [3, n] if n == count => Some(found.values[axis * count + i]),
            _ => None,
        };
        let units = mapping.units.clone().unwrap_or_else(|| self.file.text_of(name, "Units"));
        let kind = mapping.kind.clone().unwrap_or_else(|| self.file.text_of(name, "Type"));
        if units.trim().is_empty() {
            let expected = format!("units; hint: `units = \"metre\"` under [{what}] in the mapping");
            return Err(content_error(self.path, name, "no attribute `Units`", expected));
        }
        let frame =
            CoordinateFrame::parse(&kind, &units).map_err(|f| content_error(self.path, name, f.actual, f.expected))?;
        let (mut points, mut seen) = (Vec::with_capacity(count), HashMap::new());
        for i in 0..count {
            let [Some(a), Some(b), Some(c)] = [0, 1, 2].map(|axis| at(i, axis)) else {
                let expected = format!(
                    "[{count}, 3], because `{responses}` has {count} {what}; hint: the order in \
                                        responses.dimensions"
                );
                return Err(content_error(self.path, name, format!("shape {:?}", found.shape), expected));
            };
            let [x, y, z] = frame.position_mm([a, b, c]);
            let point = grid
                .parse_point(&format!("{x} {y} {z}"))
                .map_err(|e| content_error(self.path, format!("{name}[{i}]"), e.to_string(), "a point of the rig"))?;
            if let Some(twin) = seen.insert(point.id.0, i) {
                let place = format!("{name}[{i}]");
                return Err(content_error(self.path, place, format!("the point of {name}[{twin}]"), "one of its own"));
            }
            points.push(point);
        }
        Ok(points)
    }

    fn temperatures(
        &self,
        path: &Path,
        mapping: &TemperatureMapping,
        [microphones, speakers, measurements]: [usize; 3],
    ) -> Result<AirTemperatures, Error> {
        let hint = "a temperature; hint: --temperature-c says what it was";
        let stored = match mapping {
            TemperatureMapping::Celsius(celsius) => {
                let celsius =
                    Celsius::new(*celsius).map_err(|e| content_error(path, "temperature", e.to_string(), hint))?;
                return Ok(AirTemperatures { celsius: vec![celsius], steps: [0; 3] });
            }
            TemperatureMapping::Stored(stored) => stored,
        };
        let found = self.variable(&stored.dataset)?;
        let (mut steps, mut expected) = ([0; 3], Vec::new());
        let mut step = 1;
        for dimension in stored.dimensions.iter().rev() {
            let (index, count) = match dimension {
                DatasetDimension::Microphone => (0, microphones),
                DatasetDimension::Speaker => (1, speakers),
                DatasetDimension::Measurement => (2, measurements),
                DatasetDimension::Sample => {
                    let expected = "microphone, speaker or measurement";
                    return Err(content_error(path, "temperature.dimensions", "sample", expected));
                }
            };
            steps[index] = step;
            step *= count;
            expected.insert(0, count);
        }
        let shape: Vec<usize> = found.shape.iter().copied().filter(|n| *n != 1).collect();
        if shape != expected.iter().copied().filter(|n| *n != 1).collect::<Vec<_>>() || found.values.len() != step {
            let expected = format!("{expected:?}; hint: temperature.dimensions");
            return Err(content_error(self.path, &stored.dataset, format!("shape {:?}", found.shape), expected));
        }
        let zero = match stored.units {
            TemperatureUnit::Celsius => 0.0,
            TemperatureUnit::Kelvin => KELVIN,
        };
        let celsius: Result<Vec<_>, _> = found.values.iter().map(|x| Celsius::new(to_nano(x - zero))).collect();
        let celsius = celsius.map_err(|e| content_error(self.path, &stored.dataset, e.to_string(), hint))?;
        Ok(AirTemperatures { celsius, steps })
    }
}
