//! Errors that end a run early.

/// An error that ended a run early. Measurements acknowledged until then are safe, and the run can be resumed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A device failed.
    #[error(transparent)]
    Device(#[from] crate::rig::Error),
    /// The recording cannot be written.
    #[error(transparent)]
    Record(#[from] crate::run::recorder::Error),
    /// The rig's settings make no plan.
    #[error("rig `{rig}` cannot measure: {cause}")]
    Plan {
        /// The rig.
        rig: String,
        /// The cause.
        #[source]
        cause: echolake_dsp::Error,
    },
    /// The rig's grid is not valid.
    #[error(transparent)]
    Schema(#[from] echolake_schema::Error),
    /// The interface runs at another rate than the rig's sweep is made for.
    #[error(
        "rig `{rig}` samples at {expected_hz} Hz, the audio interface at {actual_hz} Hz; hint: set the interface, or \
         `sweep.rate_hz`"
    )]
    Rate {
        /// The rig.
        rig: String,
        /// Its rate, Hz.
        expected_hz: f64,
        /// The interface's, Hz.
        actual_hz: f64,
    },
    /// Too many pairs in a row were given up: continuing would only spoil more.
    #[error("{pairs} pairs in a row were given up, the last because of: {reasons}; hint: {hint}")]
    Lasting {
        /// Number of pairs.
        pairs: usize,
        /// The last one's reasons.
        reasons: String,
        /// Advice.
        hint: &'static str,
    },
    /// The clock went backwards.
    #[error(
        "the clock went back by {back_secs:.1} s, to {now}; hint: set it right (is NTP on?), and resume when it is \
         past {before}"
    )]
    Clock {
        /// Last time before the jump.
        before: echolake_schema::Timestamp,
        /// Time after the jump.
        now: echolake_schema::Timestamp,
        /// The difference, s.
        back_secs: f64,
    },
    /// The disk is nearly full: stopped while all that was measured could still be written.
    #[error(
        "the disk of `{}` is nearly full: {free_mb:.1} MB are left, {needed_mb:.1} are kept free to end the run; hint: \
         make room, and resume",
        folder.display()
    )]
    DiskNearlyFull {
        /// The folder of the recording.
        folder: std::path::PathBuf,
        /// Free space, MB.
        free_mb: f64,
        /// Space to be kept free, MB.
        needed_mb: f64,
    },
}
