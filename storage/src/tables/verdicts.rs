//! Verdicts of users on runs, as far as rows follow them: `ingest` writes into the name of a run's row in `runs` which
//! verdicts its rows follow. So every version of the lake tells which run describes a surface, and whether verdicts
//! came since.

use std::collections::BTreeSet;

use echolake_schema::RunId;
use echolake_schema::annotations::RejectedMeasurements;
use sha2::{Digest as _, Sha256};

use crate::tables::file_name::VisibleRun;
use crate::{Lake, LakeSnapshot, Result};

/// The mark of a run all of whose measurements are rejected.
const REJECTED_RUN: &str = "rejected";
/// Number of hex digits of the mark of another run.
const MARK_DIGITS: usize = 12;

/// Returns the mark that a run's row carries once its rows follow these verdicts; None if no measurement is rejected.
///
/// ```
/// use echolake_lake::verdict_mark;
/// use echolake_schema::annotations::RejectedMeasurements;
///
/// assert_eq!(verdict_mark(&RejectedMeasurements::default(), &"r1".parse()?), None);
/// # Ok::<(), echolake_schema::Error>(())
/// ```
pub fn verdict_mark(rejected: &RejectedMeasurements, run: &RunId) -> Option<String> {
    let text = rejected.rejection_text(run.as_str())?;
    if rejected.is_run_rejected(run.as_str()) {
        return Some(REJECTED_RUN.to_owned());
    }
    Some(hex::encode(Sha256::digest(text))[..MARK_DIGITS].to_owned())
}

impl VisibleRun {
    /// Returns whether its rows follow a verdict that rejects all of it: it describes its surface only if each of the
    /// surface's runs is rejected.
    pub fn is_rejected(&self) -> bool {
        self.verdicts.as_deref() == Some(REJECTED_RUN)
    }
}

impl Lake {
    /// The measurements that users reject, as a view of the lake has their verdicts.
    ///
    /// # Errors
    /// What reading annotations fails with.
    pub async fn read_rejections(&self, snapshot: &LakeSnapshot) -> Result<RejectedMeasurements> {
        Ok(RejectedMeasurements::from_annotations(&self.read_annotations(snapshot).await?))
    }
}

impl LakeSnapshot {
    /// The runs whose rows do not follow these verdicts yet: the next ingest derives them again, and what rests on
    /// them.
    pub fn unfollowed_runs<'a>(
        &'a self,
        rejected: &'a RejectedMeasurements,
    ) -> impl Iterator<Item = &'a VisibleRun> + 'a {
        self.runs().filter(move |run| run.verdicts != verdict_mark(rejected, &run.run))
    }

    /// The runs that will describe a surface if these are the rejected ones, and do not now.
    pub fn succeeding_runs(&self, rejected: &RejectedMeasurements) -> BTreeSet<RunId> {
        let later = self.describing_runs(|_| true, |run| rejected.is_run_rejected(run.run.as_str()));
        &later - &self.describing_runs(|_| true, VisibleRun::is_rejected)
    }
}
