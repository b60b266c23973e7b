//! The manifest of an import: a CSV file, checked row by row before anything is written.

use std::collections::BTreeMap;
use std::path::Path;

use csv::StringRecord;
use echolake_acquisition::disk::BoundedFile;
use echolake_schema::interchange::WAV_MANIFEST;
use echolake_schema::messages::SampleFormat;
use echolake_schema::{Celsius, Grid, Pair, PairId, Rig, SurfaceId, SurfaceRecord, SurfaceRole, Timestamp};

use crate::Error;
use crate::wav_file::{WavChannel, common_format};

/// Number of required columns, which come first.
const NEEDED: usize = 5;

/// A row of the manifest, checked.
#[derive(Debug, Clone)]
pub(crate) struct ManifestRow {
    pub line: u64,
    pub recording: WavChannel,
    pub loopback: WavChannel,
    /// True if `loopback` is the sweep's own file, and no recording.
    pub is_sweep: bool,
    pub format: SampleFormat,
    pub pair: Pair,
    /// None if it is unknown: of a room alone.
    pub celsius: Option<Celsius>,
    pub humidity_pct: f64,
    pub pressure_hpa: f64,
    pub recorded_at: Option<Timestamp>,
    pub attempt: u32,
}

/// Columns that a manifest may have.
pub type ManifestColumns = &'static [&'static str];
/// A manifest's rows, and the place of each column.
type OpenManifest = (csv::Reader<BoundedFile>, Vec<Option<usize>>);
/// Rows of a manifest by surface, with what they say of it.
pub(crate) type SurfaceRows<R> = BTreeMap<SurfaceId, (SurfaceFacts, Vec<R>)>;

/// Material and role of a surface, as a manifest says them in one row or more.
#[derive(Debug, Default)]
pub(crate) struct SurfaceFacts {
    material: Option<String>,
    role: Option<SurfaceRole>,
}

impl SurfaceFacts {
    /// Adds what a row says.
    ///
    /// # Errors
    /// [`Error::Row`] if another row says otherwise.
    pub fn add_row(&mut self, cells: &ManifestCells<'_>) -> Result<(), Error> {
        keep_one(&mut self.material, cells.get("material").map(str::to_owned), |other| {
            cells.cell_error("material", format!("another row of this surface has `{other}`"))
        })?;
        let role = cells.get("role").map(|_| cells.parse_cell("role")).transpose()?;
        keep_one(&mut self.role, role, |other: &SurfaceRole| {
            cells.cell_error("role", format!("another row of this surface has `{}`", other.name()))
        })
    }

    /// Fills them into a surface's record.
    pub fn fill_record(&self, record: SurfaceRecord) -> SurfaceRecord {
        SurfaceRecord { material: self.material.clone(), role: self.role, ..record }
    }
}

fn keep_one<T: PartialEq>(
    known: &mut Option<T>,
    said: Option<T>,
    refuse: impl FnOnce(&T) -> Error,
) -> Result<(), Error> {
    match (&known, said) {
        (Some(known), Some(said)) if *known != said => Err(refuse(known)),
        (None, said) => {
            *known = said;
            Ok(())
        }
        _ => Ok(()),
    }
}

/// Returns the scale that a manifest of recordings or of responses says, in one row or more: see [`Rig::known_scale`].
///
/// # Errors
/// [`Error`], naming the row.
pub fn scale_of_manifest(path: &Path, columns: ManifestColumns) -> Result<Option<f64>, Error> {
    let (mut reader, places) = open_manifest(path, columns)?;
    let mut scale = None;
    while let Some(record) = next_record(path, &mut reader)? {
        let cells = ManifestCells { path, columns, places: &places, record: &record };
        keep_one(&mut scale, cells.parse_number("scale")?, |other: &f64| {
            cells.cell_error("scale", format!("another row has {other}"))
        })?;
    }
    Ok(scale)
}

/// Opens a manifest and checks its header; returns the place of each column.
pub(crate) fn open_manifest(path: &Path, columns: ManifestColumns) -> Result<OpenManifest, Error> {
    let unreadable = |e: csv::Error| Error::Read { path: path.to_owned(), source: e.into() };
    let file = BoundedFile::open(path).map_err(|e| unreadable(e.into()))?;
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(file);
    let header = reader.headers().map_err(unreadable)?.clone();
    let wrong = |what| Error::Header { path: path.to_owned(), what, columns };
    if header.is_empty() {
        return Err(wrong("it is empty".into()));
    }
    if let Some(unknown) = header.iter().find(|h| !columns.contains(h)) {
        return Err(wrong(format!("unknown column `{unknown}`")));
    }
    if let Some(twice) = columns.iter().find(|c| header.iter().filter(|h| h == *c).count() > 1) {
        return Err(wrong(format!("column `{twice}` is there twice")));
    }
    let places: Vec<_> = columns.iter().map(|c| header.iter().position(|h| h == *c)).collect();
    match places[..NEEDED].iter().position(Option::is_none) {
        Some(missing) => Err(wrong(format!("column `{}` is missing", columns[missing]))),
        None => Ok((reader, places)),
    }
}

/// The first recording of a manifest.
pub(crate) fn first_recording(path: &Path) -> Result<WavChannel, Error> {
    let (mut reader, places) = open_manifest(path, &WAV_MANIFEST)?;
    let record = next_record(path, &mut reader)?.ok_or_else(|| no_rows(path, &WAV_MANIFEST))?;
    let cells = ManifestCells { path, columns: &WAV_MANIFEST, places: &places, record: &record };
    cells.open_wav("recording")
}

/// Reads and checks all rows.
pub(crate) fn read_manifest(path: &Path, rig: &Rig, grid: &Grid) -> Result<SurfaceRows<ManifestRow>, Error> {
    let (mut reader, places) = open_manifest(path, &WAV_MANIFEST)?;
    let mut manifest = SurfaceRows::new();
    while let Some(record) = next_record(path, &mut reader)? {
        let cells = ManifestCells { path, columns: &WAV_MANIFEST, places: &places, record: &record };
        let surface: SurfaceId = cells.parse_cell("surface")?;
        let row = cells.parse_row(rig, grid)?;
        let (facts, rows): &mut (SurfaceFacts, Vec<ManifestRow>) = manifest.entry(surface).or_default();
        facts.add_row(&cells)?;
        if let Some(twin) = rows.iter().find(|r| r.pair == row.pair && r.attempt == row.attempt) {
            let what = format!(
                "attempt {} at this pair is in line {} already; hint: number the attempts",
                row.attempt, twin.line
            );
            return Err(cells.cell_error("attempt", what));
        }
        rows.push(row);
    }
    if manifest.is_empty() { Err(no_rows(path, &WAV_MANIFEST)) } else { Ok(manifest) }
}

pub(crate) fn next_record(path: &Path, reader: &mut csv::Reader<BoundedFile>) -> Result<Option<StringRecord>, Error> {
    let mut record = StringRecord::new();
    match reader.read_record(&mut record) {
        Ok(true) => Ok(Some(record)),
        Ok(false) => Ok(None),
        Err(e) => Err(Error::Read { path: path.to_owned(), source: e.into() }),
    }
}

pub(crate) fn no_rows(path: &Path, columns: ManifestColumns) -> Error {
    Error::Header { path: path.to_owned(), what: "it has no rows".into(), columns }
}

/// The cells of a row.
pub(crate) struct ManifestCells<'a> {
    pub path: &'a Path,
    pub columns: ManifestColumns,
    pub places: &'a [Option<usize>],
    pub record: &'a StringRecord,
}

impl ManifestCells<'_> {
    fn get(&self, column: &'static str) -> Option<&str> {
        let index = self.columns.iter().position(|c| *c == column)?;
        self.record.get(self.places[index]?).filter(|text| !text.is_empty())
    }

    pub fn line(&self) -> u64 {
        self.record.position().map_or(0, csv::Position::line)
    }

    pub fn cell_error(&self, column: &'static str, what: impl Into<String>) -> Error {
        Error::Row { path: self.path.to_owned(), line: self.line(), column, what: what.into() }
    }

    pub fn needed_text(&self, column: &'static str) -> Result<&str, Error> {
        self.get(column).ok_or_else(|| self.cell_error(column, "it is empty"))
    }

    pub fn parse_cell<T: std::str::FromStr<Err = echolake_schema::Error>>(
        &self,
        column: &'static str,
    ) -> Result<T, Error> {
        self.needed_text(column)?.parse().map_err(|e: T::Err| self.cell_error(column, e.to_string()))
    }

    pub fn parse_number(&self, column: &'static str) -> Result<Option<f64>, Error> {
        let Some(text) = self.get(column) else { return Ok(None) };
        let number = text.parse().ok().filter(|x: &f64| x.is_finite());
        number.map(Some).ok_or_else(|| self.cell_error(column, format!("`{text}` is no number")))
    }

    /// Returns the folder that files are named in.
    pub fn folder(&self) -> &Path {
        self.path.parent().unwrap_or(Path::new("."))
    }

    /// Returns the temperature, if there is one.
    pub fn parse_celsius(&self) -> Result<Option<Celsius>, Error> {
        let column = "temperature_c";
        let celsius = self.parse_number(column)?.map(Celsius::new).transpose();
        celsius.map_err(|e| self.cell_error(column, e.to_string()))
    }

    // A sweep through a model is compared with that of Flat in other air. A room is what it is.
    fn parse_sweep_celsius(&self, rig: &Rig) -> Result<Option<Celsius>, Error> {
        match self.parse_celsius()? {
            None if rig.known_scale() != Some(1.0) => {
                let what = "it is empty, and levels of a model are corrected by it; hint: `scale = 1` in the rig file \
                            of a room or wall";
                Err(self.cell_error("temperature_c", what))
            }
            known => Ok(known),
        }
    }

    /// Returns the time of the recording, if there is one.
    pub fn parse_time(&self) -> Result<Option<Timestamp>, Error> {
        let time = self.get("recorded_at").map(Timestamp::parse).transpose();
        time.map_err(|e| self.cell_error("recorded_at", e.to_string()))
    }

    fn open_wav(&self, column: &'static str) -> Result<WavChannel, Error> {
        WavChannel::open(self.folder(), self.needed_text(column)?).map_err(|what| self.cell_error(column, what))
    }

    fn parse_row(&self, rig: &Rig, grid: &Grid) -> Result<ManifestRow, Error> {
        let recording = self.open_wav("recording")?;
        let loopback = self.open_wav("loopback")?;
        let expected = rig.sweep.rate_hz.get();
        for (column, wav) in [("recording", &recording), ("loopback", &loopback)] {
            let actual = wav.layout.rate_hz;
            if f64::from(actual) != expected {
                let what = format!(
                    "sampled at {actual} Hz, expected the rig's {expected} Hz; hint: sweep.rate_hz in the rig file"
                );
                return Err(self.cell_error(column, what));
            }
        }
        let [actual, expected] = [&loopback, &recording].map(|wav| wav.layout.samples);
        let length = rig.impulse_response.length as u64;
        let is_sweep = actual + length <= expected;
        if actual != expected && !is_sweep {
            let what = format!(
                "{actual} samples, expected the recording's {expected}, or the sweep alone, {length} samples shorter"
            );
            return Err(self.cell_error("loopback", what));
        }
        let format = common_format(recording.sample_format(), loopback.sample_format()).ok_or_else(|| {
            self.cell_error(
                "loopback",
                "one of recording and loopback is float and the other an integer of 32 bits; expected one kind",
            )
        })?;
        let attempt = self.get("attempt").map_or(Ok(1), str::parse).ok().filter(|a| (1..=1000).contains(a));
        Ok(ManifestRow {
            line: self.line(),
            format,
            pair: self.parse_pair(grid)?,
            celsius: self.parse_sweep_celsius(rig)?,
            humidity_pct: self.parse_number("humidity_pct")?.unwrap_or(f64::NAN),
            pressure_hpa: self.parse_number("pressure_hpa")?.unwrap_or(f64::NAN),
            recorded_at: self.parse_time()?,
            attempt: attempt.ok_or_else(|| self.cell_error("attempt", "expected a whole number from 1 to 1000"))?,
            recording,
            loopback,
            is_sweep,
        })
    }

    pub fn parse_pair(&self, grid: &Grid) -> Result<Pair, Error> {
        let point = |column| {
            let found = grid.parse_point(self.needed_text(column)?);
            found.map_err(|e| self.cell_error(column, e.to_string()))
        };
        let microphone = point("microphone")?;
        let speaker = point("speaker")?;
        let PairId(id) = grid.parse_pair(microphone, speaker).map_err(|e| self.cell_error("speaker", e.to_string()))?;
        Ok(grid.pairs()[id as usize])
    }
}
