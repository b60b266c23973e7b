//! The mapping file of an import: what the datasets of an HDF5 file are.

use std::path::{Path, PathBuf};

use echolake_acquisition::disk::read_text_file;
use echolake_schema::SurfaceId;
use serde::Deserialize;

use crate::{Error, content_error};

/// A mapping file, as TOML has it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Hdf5Mapping {
    /// The HDF5 file; a relative path begins at the mapping's folder.
    pub file: PathBuf,
    /// One per measurement, or a single one.
    pub surfaces: Vec<String>,
    pub responses: ResponseMapping,
    pub sampling_rate: RateMapping,
    pub microphones: PositionMapping,
    pub speakers: PositionMapping,
    pub temperature: Option<TemperatureMapping>,
}

/// The dataset of the responses.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ResponseMapping {
    pub dataset: String,
    pub dimensions: Vec<DatasetDimension>,
}

/// A dimension of a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum DatasetDimension {
    Microphone,
    Speaker,
    Sample,
    /// Each becomes a run.
    Measurement,
}

/// The sampling rate: a number, or the place where the file has it.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
pub(crate) enum RateMapping {
    Hertz(f64),
    Stored(StoredRate),
}

/// A dataset with the sampling rate, or one of its attributes.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct StoredRate {
    pub dataset: String,
    pub attribute: Option<String>,
}

/// A dataset of positions, three numbers each.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PositionMapping {
    pub dataset: String,
    /// By default those of the dataset's attribute `Units`.
    pub units: Option<String>,
    /// Cartesian or spherical; by default that of the dataset's attribute `Type`, or cartesian.
    #[serde(rename = "type")]
    pub kind: Option<String>,
}

/// The temperature of the air: a number, or the dataset that has it.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
pub(crate) enum TemperatureMapping {
    Celsius(f64),
    Stored(StoredTemperatures),
}

/// A dataset of temperatures.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct StoredTemperatures {
    pub dataset: String,
    pub units: TemperatureUnit,
    /// Empty for one temperature of all.
    #[serde(default)]
    pub dimensions: Vec<DatasetDimension>,
}

/// A unit of temperatures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum TemperatureUnit {
    Celsius,
    Kelvin,
}

impl Hdf5Mapping {
    /// Reads a mapping file.
    pub fn from_file(path: &Path) -> Result<Self, Error> {
        let unread = |e: std::io::Error| Error::Read { path: path.to_owned(), source: e.into() };
        let text = read_text_file(path).map_err(unread)?;
        let mut mapping: Self = toml::from_str(&text).map_err(|e| {
            let line = e.span().map_or(0, |span| text[..span.start].lines().count().max(1));
            content_error(path, format!("line {line}"), e.message(), "a mapping; hint: docs/export.md has an example")
        })?;
        mapping.file = path.parent().unwrap_or(Path::new(".")).join(&mapping.file);
        Ok(mapping)
    }

    /// Returns the surfaces' names, checked: one per measurement.
    pub fn parse_surfaces(&self, path: &Path, measurements: usize) -> Result<Vec<SurfaceId>, Error> {
        let place = "surfaces";
        if self.surfaces.len() != measurements {
            let expected = format!("{measurements}, one per measurement of `{}`", self.responses.dataset);
            return Err(content_error(path, place, format!("{} names", self.surfaces.len()), expected));
        }
        let twin = self.surfaces.iter().enumerate().find(|(i, name)| self.surfaces[..*i].contains(name));
        if let Some((_, twin)) = twin {
            return Err(content_error(path, place, format!("`{twin}` twice"), "one run per surface"));
        }
        let parsed: Result<_, _> = self.surfaces.iter().map(|name| name.parse()).collect();
        Ok(parsed?)
    }
}

impl DatasetDimension {
    /// Its name in mapping files.
    pub fn label(self) -> &'static str {
        match self {
            Self::Microphone => "microphone",
            Self::Speaker => "speaker",
            Self::Sample => "sample",
            Self::Measurement => "measurement",
        }
    }
}
