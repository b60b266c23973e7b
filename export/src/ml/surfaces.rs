//! The surfaces of a lake that a training set can have.

use std::collections::{BTreeMap, HashSet};

use echolake_lake::{Lake, LakeSnapshot, VisibleRun};
use echolake_schema::SurfaceId;
use echolake_schema::tables::Table;

use crate::error::{Error, Result};
use crate::rows;

/// A surface, and its runs that are derived.
#[derive(Debug, Clone)]
pub(super) struct TrainingSurface {
    pub id: SurfaceId,
    pub typology: String,
    pub macrostructure: Option<String>,
    pub origin: String,
    /// True if other surfaces name it as their Flat or Foam, or its typology is `reference`.
    pub reference: bool,
    pub runs: Vec<TrainingRun>,
}

/// A run and the digest of its file.
#[derive(Debug, Clone)]
pub(super) struct TrainingRun {
    pub visible: VisibleRun,
    pub file_sha256: String,
}

/// Reads all surfaces that have a derived run, sorted by name, and the number of runs that wait for references.
pub(super) async fn read_surfaces(lake: &Lake, snapshot: &LakeSnapshot) -> Result<(Vec<TrainingSurface>, usize)> {
    let mut surfaces = BTreeMap::new();
    let mut references = HashSet::new();
    let columns = ["surface_id", "typology", "macrostructure", "origin", "flat_reference", "foam_reference"];
    for file in snapshot.files(Table::Surfaces) {
        let batch = rows::of_file(lake, Table::Surfaces, file, &columns).await?;
        for column in ["flat_reference", "foam_reference"] {
            references.extend(rows::text_column(&batch, column).into_iter().map(str::to_owned));
        }
        let typologies = rows::text_column(&batch, "typology");
        let origins = rows::text_column(&batch, "origin");
        let macrostructures = rows::optional_texts(&batch, "macrostructure");
        for (row, id) in rows::text_column(&batch, "surface_id").into_iter().enumerate() {
            let surface = TrainingSurface {
                id: id.parse()?,
                typology: typologies[row].to_owned(),
                macrostructure: macrostructures[row].map(str::to_owned),
                origin: origins[row].to_owned(),
                reference: false,
                runs: Vec::new(),
            };
            surfaces.insert(surface.id.clone(), surface);
        }
    }
    let mut waiting = 0;
    for visible in snapshot.runs() {
        let Some(surface) = surfaces.get_mut(&visible.surface) else { continue };
        if visible.reference_derivation.is_none() {
            waiting += 1;
            continue;
        }
        let row = rows::of_run(lake, snapshot, Table::Runs, &visible.run, &["file_sha256"]).await?;
        let file_sha256 = rows::text_column(&row, "file_sha256").first().copied().unwrap_or_default().to_owned();
        surface.runs.push(TrainingRun { visible: visible.clone(), file_sha256 });
    }
    let mut surfaces: Vec<_> = surfaces.into_values().filter(|s| !s.runs.is_empty()).collect();
    surfaces.iter_mut().for_each(|s| s.reference = s.typology == "reference" || references.contains(s.id.as_str()));
    if surfaces.is_empty() {
        let reason = match waiting {
            0 => "the lake has no runs; hint: `echolake ingest`".to_owned(),
            runs => format!("{runs} runs wait for their references; hint: `echolake doctor` says which"),
        };
        return Err(Error::Nothing { reason });
    }
    Ok((surfaces, waiting))
}
