//! The messages that a run records.

use echolake_schema::Rig;

use crate::run::assessment::response_len;

/// Choice of the messages that a run records.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RecordingMode {
    /// Sweeps and impulse responses.
    Sweeps,
    /// Impulse responses alone.
    ResponsesOnly,
}

impl RecordingMode {
    /// Returns the bytes that one attempt takes at most: two channels of three bytes per sample of each
    /// take, audio of two, the response, and messages of fixed size.
    pub(crate) fn attempt_bytes(self, rig: &Rig) -> u64 {
        const MESSAGES: usize = 8192;
        let sweep = if self == Self::Sweeps { rig.recording_len() * (2 + 6 * rig.sweep.repeat as usize) } else { 0 };
        (sweep + response_len(rig) * 4 + MESSAGES) as u64
    }
}
