//! Preflight checks before a run begins: room on the disk, the air, and a take at the first pair.

use std::path::Path;

use echolake_schema::{Pair, Rig};

use crate::disk::free_bytes;
use crate::run::assessment::{quiet_range, response_len};
use crate::run::controller::RunController;
use crate::run::objection::find_implausible;
use crate::run::recording_mode::RecordingMode;

/// Bytes per recorded sample of both channels and audio, compressed: 4.92 in a simulated run with sweeps of 0.5 s.
const SWEEP_BYTES_A_SAMPLE: f64 = 5.0;
/// Bytes per sample of an impulse response, which hardly compresses.
const RESPONSE_BYTES_A_SAMPLE: f64 = 4.0;
/// Bytes per pair of poses, readings and verdict, compressed, with their indexes.
const PAIR_BYTES: f64 = 600.0;
/// Bytes per run of panel, heights, summary.
const RUN_BYTES: f64 = 2.5e6;
/// Bytes that are kept free at the end of a run, so that it can be ended whatever was not foreseen.
const KEPT_FREE: u64 = 4 << 20;
/// Attempts per pair: a rig that needs more needs maintenance.
const REPEATS: f64 = 1.1;

/// A preflight check that failed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PreflightFinding {
    /// The problem.
    pub what: String,
    /// Advice.
    pub hint: String,
}

impl PreflightFinding {
    /// Makes a finding of a problem and advice.
    pub fn new(what: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { what: what.into(), hint: hint.into() }
    }
}

impl std::fmt::Display for PreflightFinding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}; hint: {}", self.what, self.hint)
    }
}

/// Estimates the file size of a run of so many pairs, bytes.
pub fn expected_bytes(rig: &Rig, keep: RecordingMode, pairs: usize) -> u64 {
    let response = response_len(rig) as f64 * RESPONSE_BYTES_A_SAMPLE;
    let sweep = match keep {
        RecordingMode::Sweeps => rig.recording_len() as f64 * SWEEP_BYTES_A_SAMPLE * f64::from(rig.sweep.repeat),
        RecordingMode::ResponsesOnly => 0.0,
    };
    (RUN_BYTES + (sweep + response + PAIR_BYTES) * REPEATS * pairs as f64) as u64
}

/// Checks that the disk has room for a run of so many pairs.
pub fn check_disk(folder: &Path, rig: &Rig, keep: RecordingMode, pairs: usize) -> Option<PreflightFinding> {
    // A file system that does not report its free space is no reason to refuse.
    let free = free_bytes(folder).ok()?;
    check_free_space(folder, free, expected_bytes(rig, keep, pairs) + keep.attempt_bytes(rig) + KEPT_FREE)
}

fn check_free_space(folder: &Path, free: u64, needed: u64) -> Option<PreflightFinding> {
    let megabytes = |bytes: u64| bytes as f64 / 1e6;
    (free < needed).then(|| {
        let what = format!(
            "the disk of `{}` is nearly full: {:.1} MB are left, the run needs about {:.1}",
            folder.display(),
            megabytes(free),
            megabytes(needed)
        );
        PreflightFinding::new(what, "make room, or record impulse responses alone (--ir-only)")
    })
}

/// Checks that recordings have a quiet part behind the response, from which their noise is known.
pub fn quiet_part(rig: &Rig) -> Option<PreflightFinding> {
    let recorded = rig.recording_len();
    let response = response_len(rig);
    if !quiet_range(recorded, response).is_empty() {
        return None;
    }
    let secs = |samples: usize| samples as f64 / rig.sweep.rate_hz.get();
    let needed = (response + 1).div_ceil(3) * 4;
    let what = format!(
        "rig `{}`: a recording of {:.2} s is too short to tell the noise behind a response of {:.2} s, expected at \
         least {:.2} s",
        rig.name,
        secs(recorded),
        secs(response),
        secs(needed)
    );
    let hint = "raise `sweep.duration_secs` or `sweep.tail_secs` in the rig file, or lower `impulse_response.length`";
    Some(PreflightFinding::new(what, hint))
}

/// Checks sensor, loopback, level and room: a reading, and a take at a pair that is not recorded. A single take may be
/// spoiled, so it is repeated as often as the rig allows.
pub fn check_devices(controller: &mut RunController<'_>, pair: Pair) -> Vec<PreflightFinding> {
    let failed = |error: crate::rig::Error| {
        vec![PreflightFinding::new(
            error.to_string(),
            "is it plugged in, switched on, and named rightly in the rig file?",
        )]
    };
    let reading = match controller.read_ambient() {
        Ok(reading) => reading,
        Err(error) => return failed(error),
    };
    let nonsense = find_implausible(&reading);
    if !nonsense.is_empty() {
        return nonsense
            .iter()
            .map(|o| PreflightFinding::new(format!("the ambient sensor says {o}"), o.hint()))
            .collect();
    }
    let mut objections = Vec::new();
    for _ in 0..controller.rig().validation.attempts {
        match controller.try_pair(pair) {
            Ok((_, found)) if found.is_empty() => return Vec::new(),
            Ok((_, found)) => objections = found,
            Err(error) => return failed(error),
        }
    }
    objections.iter().map(|o| PreflightFinding::new(format!("a take at pair {}: {o}", pair.id.0), o.hint())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_s_size_is_known_beforehand() {
        let rig = Rig::paper();
        let megabytes = |keep| expected_bytes(&rig, keep, 2951) as f64 / 1e6;
        // A simulated run with the paper's rig has 723 MB with sweeps, 8.7 without.
        assert!((650.0..1_000.0).contains(&megabytes(RecordingMode::Sweeps)), "{}", megabytes(RecordingMode::Sweeps));
        assert!(
            (8.0..16.0).contains(&megabytes(RecordingMode::ResponsesOnly)),
            "{}",
            megabytes(RecordingMode::ResponsesOnly)
        );
    }

    #[test]
    fn a_rig_whose_noise_cannot_be_told_is_refused_with_what_it_needs() {
        assert_eq!(quiet_part(&Rig::paper()), None);
        let room = |secs: f64| {
            let text = format!("sweep = {{ rate_hz = 48000, high_hz = 20000, duration_secs = {secs}, tail_secs = 0 }}");
            Rig::from_toml(&format!("{text}\nimpulse_response.length = 48000\nbands.centres_hz = [1000]"))
                .expect("a rig")
        };
        let finding = quiet_part(&room(0.5)).expect("too short").to_string();
        assert!(finding.contains("of 0.50 s") && finding.contains("sweep.duration_secs"), "{finding}");
        let needed = finding.split("at least ").nth(1).and_then(|rest| rest.split(' ').next());
        let needed: f64 = needed.and_then(|secs| secs.parse().ok()).expect("seconds");
        assert_eq!(quiet_part(&room(needed + 0.01)), None);
        assert!(quiet_part(&room(needed - 0.01)).is_some());
    }

    #[test]
    fn a_full_disk_is_told_before_there_is_a_file() {
        let folder = Path::new("/data");
        assert_eq!(check_free_space(folder, 100, 100), None);
        let finding = check_free_space(folder, 99_000_000, 700_000_000).expect("a finding").to_string();
        assert!(
            finding.contains("99.0 MB are left") && finding.contains("about 700.0") && finding.contains("--ir-only")
        );
    }
}
