//! What it takes to go on with a run: metadata `echolake.run.plan` of its file.

use std::collections::BTreeMap;
use std::path::PathBuf;

use crate::controller::Keep;
use crate::relief::Relief;

const KEEP: &str = "keep";
const SEED: &str = "seed";
const RELIEF: &str = "relief";
const MESH: &str = "mesh";
const SWEEPS: &str = "sweeps";
const RESPONSES: &str = "responses";

/// What was planned, apart from what manifest and rig say.
#[derive(Debug, Clone, PartialEq)]
pub struct RunPlan {
    /// What is recorded.
    pub keep: Keep,
    /// Seed of the simulation.
    pub seed: u64,
    /// What is measured.
    pub specimen: PlannedSpecimen,
}

/// What is measured.
#[derive(Debug, Clone, PartialEq)]
pub enum PlannedSpecimen {
    /// A generated relief.
    Relief(Relief),
    /// Somebody's mesh, where it was.
    Mesh(PathBuf),
}

impl RunPlan {
    /// As the metadata record's key and value pairs.
    pub fn to_metadata(&self) -> BTreeMap<String, String> {
        let keep = if self.keep == Keep::Sweeps { SWEEPS } else { RESPONSES };
        let (kind, specimen) = match &self.specimen {
            PlannedSpecimen::Relief(relief) => (RELIEF, relief.to_json().to_string()),
            PlannedSpecimen::Mesh(path) => (MESH, path.to_string_lossy().into_owned()),
        };
        [(KEEP, keep.to_owned()), (SEED, self.seed.to_string()), (kind, specimen)]
            .map(|(key, value)| (key.to_owned(), value))
            .into()
    }

    /// From the metadata record.
    ///
    /// # Errors
    /// What is wrong with it, in words.
    pub fn from_metadata(record: &BTreeMap<String, String>) -> Result<Self, String> {
        let text = |key: &str| record.get(key).map(String::as_str).ok_or_else(|| format!("its plan has no `{key}`"));
        let keep = match text(KEEP)? {
            SWEEPS => Keep::Sweeps,
            RESPONSES => Keep::ResponsesOnly,
            other => return Err(format!("its plan keeps `{other}`, expected `{SWEEPS}` or `{RESPONSES}`")),
        };
        let seed = text(SEED)?;
        let seed = seed.parse().map_err(|_| format!("its plan has the seed `{seed}`, expected a whole number"))?;
        let specimen = match text(RELIEF) {
            Ok(json) => PlannedSpecimen::Relief(Relief::from_json(json).map_err(|e| e.to_string())?),
            Err(_) => PlannedSpecimen::Mesh(text(MESH)?.into()),
        };
        Ok(Self { keep, seed, specimen })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_comes_back_as_it_was() {
        let relief = Relief::by_name("brick").expect("a relief");
        for (keep, specimen) in [
            (Keep::Sweeps, PlannedSpecimen::Relief(relief)),
            (Keep::ResponsesOnly, PlannedSpecimen::Mesh("panels/0015.glb".into())),
        ] {
            let plan = RunPlan { keep, seed: u64::MAX, specimen };
            assert_eq!(RunPlan::from_metadata(&plan.to_metadata()), Ok(plan));
        }
        let error = RunPlan::from_metadata(&BTreeMap::new()).expect_err("nothing in it");
        assert!(error.contains("no `keep`"), "{error}");
    }
}
