//! Metadata of a run's file: the run's manifest, its end, and the record of its surface.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::{Error, ProjectName, RunId, SurfaceId, Timestamp};

/// Format of run files that this version writes, and the newest that it reads.
pub const RUN_FORMAT: u32 = 1;

/// Metadata `echolake.run`: name, surface, start, software, rig and origin of a run.
///
/// ```
/// use echolake_schema::manifest::{Origin, RunManifest};
/// use echolake_schema::{RunId, Timestamp};
///
/// let manifest = RunManifest {
///     run_id: "20260105T080000Z-flat-7c1e".parse()?,
///     surface_id: "flat".parse()?,
///     started: Timestamp::parse("2026-01-05T08:00:00Z")?,
///     software: "echolake 0.1.0".into(),
///     rig: "paper".into(),
///     origin: Origin::Simulated,
/// };
/// assert_eq!(RunManifest::from_metadata(&manifest.to_metadata()), Ok(manifest));
/// # Ok::<(), echolake_schema::Error>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct RunManifest {
    /// The run's name.
    pub run_id: RunId,
    /// The measured surface.
    pub surface_id: SurfaceId,
    /// Time of its start.
    pub started: Timestamp,
    /// Name and version of the program that wrote it.
    pub software: String,
    /// Name of the rig.
    pub rig: String,
    /// Origin of its signals.
    pub origin: Origin,
}

/// The labels of [`Origin`], for people.
pub(crate) const ORIGINS: &str =
    "measured, simulated, computed, imported_wav, imported_rew, imported_gir, imported_sofa or imported_hdf5";

/// Origin of a run's signals.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Origin {
    /// Measured by a rig.
    Measured,
    /// Computed by the simulated rig.
    Simulated,
    /// Computed by the simulated rig for the heights of a measured surface, to compare both.
    Computed,
    /// Imported from WAV files of other software.
    ImportedWav,
    /// Imported from responses that Room EQ Wizard exported.
    ImportedRew,
    /// Imported from the published GIR data set.
    ImportedGir,
    /// Made of a SOFA file.
    ImportedSofa,
    /// Made of an HDF5 file, by a mapping.
    ImportedHdf5,
}

/// Metadata `echolake.run.end`: time and counts at the end of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RunEnd {
    /// Time of its end.
    pub ended: Timestamp,
    /// Measurements accepted.
    pub accepted: u64,
    /// Pairs given up.
    pub rejected: u64,
    /// Attempts made.
    pub attempts: u64,
}

/// Attachment `surface.json`: description of a surface.
///
/// ```
/// use echolake_schema::SurfaceRecord;
///
/// let record: SurfaceRecord = serde_json::from_str(r#"{"typology": "brick", "flat_reference": "flat"}"#)?;
/// assert_eq!((record.typology.as_str(), record.foam_reference), ("brick", None));
/// # Ok::<(), serde_json::Error>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Default)]
#[serde(default)]
pub struct SurfaceRecord {
    /// Kind of relief, as `stretcher_bond`.
    pub typology: String,
    /// The large shape beneath the relief: the surface that has it alone, or a description.
    pub macrostructure: Option<String>,
    /// The relief's pattern.
    pub mesostructure: Option<String>,
    /// The finish.
    pub microstructure: Option<String>,
    /// Material, as `coated print`.
    pub material: Option<String>,
    /// Its part in the measurement of absorption.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub role: Option<SurfaceRole>,
    /// Pressure reflection factor that a simulation used.
    pub reflection_factor: Option<f64>,
    /// The surface that normalises this one; if none is given, the lake chooses.
    pub flat_reference: Option<SurfaceId>,
    /// The surface whose direct sound is subtracted from this one; if none is given, the lake chooses.
    pub foam_reference: Option<SurfaceId>,
    /// The surface that has its large shape and nothing on it, if there is one.
    pub macro_reference: Option<SurfaceId>,
    /// The project that it belongs to, if it was given one.
    pub project: Option<ProjectName>,
    /// Parameters of the relief's generator.
    pub parameters: serde_json::Value,
    /// Facts about the producer's own mesh file.
    pub mesh: Option<MeshFacts>,
}

/// Purpose of a level surface in the measurement of absorption.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SurfaceRole {
    /// It reflects nearly all, and others' absorption is measured beside it.
    Hard,
    /// Its own absorption is wanted.
    Sample,
}

impl SurfaceRole {
    /// Its name, as manifests and tables spell it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Hard => "hard",
            Self::Sample => "sample",
        }
    }
}

impl std::str::FromStr for SurfaceRole {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self, Error> {
        let role = [Self::Hard, Self::Sample].into_iter().find(|role| role.name() == text);
        role.ok_or_else(|| Error::SurfaceRole { actual: text.to_owned() })
    }
}

/// Facts about a mesh.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MeshFacts {
    /// Name of the attachment that holds it.
    pub file: String,
    /// Triangles.
    pub triangles: u64,
    /// True if every edge has two triangles.
    pub watertight: bool,
    /// Lowest and highest point of the relief, mm.
    pub relief_mm: [f64; 2],
}

impl Origin {
    /// Its name in metadata and tables.
    pub fn label(self) -> &'static str {
        match self {
            Self::Measured => "measured",
            Self::Simulated => "simulated",
            Self::Computed => "computed",
            Self::ImportedWav => "imported_wav",
            Self::ImportedRew => "imported_rew",
            Self::ImportedGir => "imported_gir",
            Self::ImportedSofa => "imported_sofa",
            Self::ImportedHdf5 => "imported_hdf5",
        }
    }

    /// Returns whether the run was made of data of other software, whose times and rigs may differ from ours.
    pub fn is_imported(self) -> bool {
        !matches!(self, Self::Measured | Self::Simulated | Self::Computed)
    }

    fn parse(text: &str) -> Option<Self> {
        let imported =
            [Self::ImportedWav, Self::ImportedRew, Self::ImportedGir, Self::ImportedSofa, Self::ImportedHdf5];
        let all = [Self::Measured, Self::Simulated, Self::Computed].into_iter().chain(imported);
        all.into_iter().find(|o| o.label() == text)
    }
}

/// Error of metadata that is not that of a run.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ManifestError {
    /// A key is missing.
    #[error("its metadata `{record}` has no `{key}`")]
    Missing {
        /// The metadata record.
        record: &'static str,
        /// The key.
        key: &'static str,
    },
    /// A value cannot be read.
    #[error("its metadata `{record}` has `{key}` = `{actual}`, expected {expected}")]
    Value {
        /// The metadata record.
        record: &'static str,
        /// The key.
        key: &'static str,
        /// The value found.
        actual: String,
        /// Description of a valid value.
        expected: &'static str,
    },
    /// Written by a later version.
    #[error("its format is {actual}, the newest that this version reads is {newest}; hint: update echolake")]
    Newer {
        /// The file's format.
        actual: u32,
        /// Ours.
        newest: u32,
    },
    /// A name in it is not valid.
    #[error(transparent)]
    Name(#[from] Error),
}

/// Keys of one metadata record, read with errors that name it.
struct Record<'a> {
    name: &'static str,
    values: &'a BTreeMap<String, String>,
}

impl Record<'_> {
    fn text_value(&self, key: &'static str) -> Result<&str, ManifestError> {
        let value = self.values.get(key).map(String::as_str);
        value.ok_or(ManifestError::Missing { record: self.name, key })
    }

    fn number_value<T: std::str::FromStr>(&self, key: &'static str) -> Result<T, ManifestError> {
        let text = self.text_value(key)?;
        text.parse().map_err(|_| ManifestError::Value {
            record: self.name,
            key,
            actual: text.to_owned(),
            expected: "a whole number",
        })
    }
}

impl RunManifest {
    /// As the metadata record's key and value pairs.
    pub fn to_metadata(&self) -> BTreeMap<String, String> {
        [
            ("format", RUN_FORMAT.to_string()),
            ("run_id", self.run_id.to_string()),
            ("surface_id", self.surface_id.to_string()),
            ("started", self.started.to_string()),
            ("software", self.software.clone()),
            ("rig", self.rig.clone()),
            ("origin", self.origin.label().to_owned()),
        ]
        .map(|(key, value)| (key.to_owned(), value))
        .into()
    }

    /// Returns whether it may be the manifest of a damaged file of this name. It has no CRC of its own: the run's name
    /// must say the same surface and start, and be the file's, or measurements could become those of another run.
    pub fn fits_file_name(&self, name: &str) -> bool {
        let run = self.run_id.as_str();
        let file = name.rsplit(['/', '\\']).next().unwrap_or_default();
        let stem = file.strip_suffix(".partial").unwrap_or(file).trim_end_matches(".mcap");
        let begins = format!("{}-{}-", self.started.compact_text(), self.surface_id);
        // Files may have names of their own; one that is as long as the run's was meant to be it.
        let is_renamed = stem.len() == run.len() && stem != run;
        run.starts_with(&begins) && !is_renamed
    }

    /// Reads the metadata record.
    ///
    /// # Errors
    /// [`ManifestError`], naming the key.
    pub fn from_metadata(values: &BTreeMap<String, String>) -> Result<Self, ManifestError> {
        let record = Record { name: crate::topics::RUN_METADATA, values };
        let format = record.number_value("format")?;
        if format > RUN_FORMAT {
            return Err(ManifestError::Newer { actual: format, newest: RUN_FORMAT });
        }
        let origin = record.text_value("origin")?;
        Ok(Self {
            run_id: record.text_value("run_id")?.parse()?,
            surface_id: record.text_value("surface_id")?.parse()?,
            started: Timestamp::parse(record.text_value("started")?)?,
            software: record.text_value("software")?.to_owned(),
            rig: record.text_value("rig")?.to_owned(),
            origin: Origin::parse(origin).ok_or_else(|| ManifestError::Value {
                record: record.name,
                key: "origin",
                actual: origin.to_owned(),
                expected: ORIGINS,
            })?,
        })
    }
}

impl RunEnd {
    /// As the metadata record's key and value pairs.
    pub fn to_metadata(&self) -> BTreeMap<String, String> {
        [
            ("ended", self.ended.to_string()),
            ("accepted", self.accepted.to_string()),
            ("rejected", self.rejected.to_string()),
            ("attempts", self.attempts.to_string()),
        ]
        .map(|(key, value)| (key.to_owned(), value))
        .into()
    }

    /// Reads the metadata record.
    ///
    /// # Errors
    /// [`ManifestError`], naming the key.
    pub fn from_metadata(values: &BTreeMap<String, String>) -> Result<Self, ManifestError> {
        let record = Record { name: crate::topics::RUN_END_METADATA, values };
        Ok(Self {
            ended: Timestamp::parse(record.text_value("ended")?)?,
            accepted: record.number_value("accepted")?,
            rejected: record.number_value("rejected")?,
            attempts: record.number_value("attempts")?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn manifest() -> RunManifest {
        RunManifest {
            run_id: "20260105T080000Z-flat-7c1e".parse().expect("valid"),
            surface_id: "flat".parse().expect("valid"),
            started: Timestamp(1_767_600_000_000_000_000),
            software: "echolake 0.1.0".into(),
            rig: "paper".into(),
            origin: Origin::Simulated,
        }
    }

    #[test]
    fn metadata_round_trips() {
        let manifest = manifest();
        assert_eq!(RunManifest::from_metadata(&manifest.to_metadata()), Ok(manifest));
        let end = RunEnd { ended: Timestamp(5), accepted: 2951, rejected: 0, attempts: 2960 };
        assert_eq!(RunEnd::from_metadata(&end.to_metadata()), Ok(end));
    }

    #[test]
    fn damaged_metadata_names_the_key() {
        let check = |key: &str, value: Option<&str>, expected: &str| {
            let mut metadata = manifest().to_metadata();
            metadata.remove(key);
            metadata.extend(value.map(|v| (key.to_owned(), v.to_owned())));
            let error = RunManifest::from_metadata(&metadata).expect_err(expected).to_string();
            assert!(error.contains(expected), "{error}");
        };
        check("run_id", None, "no `run_id`");
        check("run_id", Some("../../etc"), "not a valid run id");
        check("format", Some("2"), "update echolake");
        check("format", Some("x"), "whole number");
        check("origin", Some("guessed"), "measured, simulated");
        check("started", Some("noon"), "RFC 3339");
    }
}
