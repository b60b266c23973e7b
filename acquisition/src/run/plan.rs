//! The plan that is needed to resume a run: metadata `echolake.run.plan` of its file.

use std::collections::BTreeMap;

use echolake_panel::PanelSpecimen;
use echolake_panel::mesh::PanelSide;
use echolake_panel::relief::PanelRelief;

use crate::run::controller::RecordingMode;

const KEEP: &str = "keep";
const SEED: &str = "seed";
const RELIEF: &str = "relief";
const MESH: &str = "mesh";
const SIDE: &str = "side";
const GEOMETRY: &str = "geometry";
const NONE: &str = "none";
const SWEEPS: &str = "sweeps";
const RESPONSES: &str = "responses";

/// The plan of a run, apart from the settings in manifest and rig.
#[derive(Debug, Clone, PartialEq)]
pub struct RunPlan {
    /// Recorded messages.
    pub keep: RecordingMode,
    /// Seed of the simulation.
    pub seed: u64,
    /// The measured panel.
    pub specimen: PanelSpecimen,
}

impl RunPlan {
    /// Returns the metadata record's key and value pairs.
    pub fn to_metadata(&self) -> BTreeMap<String, String> {
        let keep = if self.keep == RecordingMode::Sweeps { SWEEPS } else { RESPONSES };
        let mut record = vec![(KEEP, keep.to_owned()), (SEED, self.seed.to_string())];
        match &self.specimen {
            PanelSpecimen::Relief(relief) => record.push((RELIEF, relief.to_json().to_string())),
            PanelSpecimen::Mesh(path, side) => {
                record.extend([(MESH, path.to_string_lossy().into_owned()), (SIDE, side.name().to_owned())]);
            }
            PanelSpecimen::NoGeometry => record.push((GEOMETRY, NONE.to_owned())),
        }
        record.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
    }

    /// Parses the metadata record.
    ///
    /// # Errors
    /// A text that names the wrong or missing key.
    pub fn from_metadata(record: &BTreeMap<String, String>) -> Result<Self, String> {
        let text = |key: &str| record.get(key).map(String::as_str).ok_or_else(|| format!("its plan has no `{key}`"));
        let keep = match text(KEEP)? {
            SWEEPS => RecordingMode::Sweeps,
            RESPONSES => RecordingMode::ResponsesOnly,
            other => return Err(format!("its plan keeps `{other}`, expected `{SWEEPS}` or `{RESPONSES}`")),
        };
        let seed = text(SEED)?;
        let seed = seed.parse().map_err(|_| format!("its plan has the seed `{seed}`, expected a whole number"))?;
        let specimen = match text(RELIEF) {
            Ok(json) => PanelSpecimen::Relief(PanelRelief::from_json(json).map_err(|e| e.to_string())?),
            Err(_) if record.get(GEOMETRY).is_some_and(|geometry| geometry == NONE) => PanelSpecimen::NoGeometry,
            Err(_) => {
                // Earlier plans have no side: there was only the front.
                let side = record.get(SIDE).map_or(PanelSide::Front.name(), String::as_str);
                let side = PanelSide::parse(side)
                    .ok_or_else(|| format!("its plan has the side `{side}`, expected front or back"))?;
                PanelSpecimen::Mesh(text(MESH)?.into(), side)
            }
        };
        Ok(Self { keep, seed, specimen })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_comes_back_as_it_was() {
        let relief = PanelRelief::by_name("stretcher_bond").expect("a relief");
        for (keep, specimen) in [
            (RecordingMode::Sweeps, PanelSpecimen::Relief(relief)),
            (RecordingMode::ResponsesOnly, PanelSpecimen::Mesh("panels/0015.glb".into(), PanelSide::Back)),
            (RecordingMode::Sweeps, PanelSpecimen::NoGeometry),
        ] {
            let plan = RunPlan { keep, seed: u64::MAX, specimen };
            assert_eq!(RunPlan::from_metadata(&plan.to_metadata()), Ok(plan));
        }
        let error = RunPlan::from_metadata(&BTreeMap::new()).expect_err("nothing in it");
        assert!(error.contains("no `keep`"), "{error}");
    }
}
