//! Faults of takes, with advice.

/// A channel of a take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TakeChannel {
    /// The microphone's.
    Recording,
    /// That of the played signal.
    Loopback,
}

impl std::fmt::Display for TakeChannel {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Recording => "recording",
            Self::Loopback => "loopback",
        })
    }
}

/// A fault of a take.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TakeFault {
    /// The loopback is silent, noise, or the microphone's crosstalk.
    #[error("loopback does not match the played sweep: {match_db:.1} dB of it at one delay, expected {least_db:.0} dB")]
    Loopback {
        /// Energy at its peak over that elsewhere, dB.
        match_db: f64,
        /// The limit.
        least_db: f64,
    },
    /// The recording is a response to the loopback, but the loopback is another signal than the sweep.
    #[error(
        "loopback is not the sweep of the rig file ({match_db:.1} dB of it at one delay, expected {least_db:.0} dB): \
         clocks, lost samples and distortion are not checked"
    )]
    UnknownSweep {
        /// Energy at its peak over that elsewhere, dB.
        match_db: f64,
        /// The limit.
        least_db: f64,
    },
    /// Both channels are one signal.
    #[error("recording and loopback are the same signal, {level_db:+.1} dB apart")]
    SameSignal {
        /// Level of the recording over the loopback's, dB.
        level_db: f64,
    },
    /// The recording is the played signal, and the loopback the microphone's.
    #[error("recording and loopback are swapped: the recording comes {:.2} ms before the loopback", 1e3 * early_secs)]
    Swapped {
        /// Time by which the recording precedes the loopback, s.
        early_secs: f64,
    },
    /// Sound arrives before it is played: a response begins later, and lacks its direct sound.
    #[error("sound arrives {:.2} ms before it is played: the direct sound is lost", 1e3 * early_secs)]
    EarlyArrival {
        /// Time by which it arrives too early, s.
        early_secs: f64,
    },
    /// The recording began after the sweep.
    #[error("recording began {:.1} ms after the sweep", 1e3 * lost_secs)]
    CutStart {
        /// The missing time, s.
        lost_secs: f64,
    },
    /// The recording ended before the sweep.
    #[error("recording ended {:.1} ms before the sweep", 1e3 * lost_secs)]
    CutEnd {
        /// The missing time, s.
        lost_secs: f64,
    },
    /// The recording has no response to the sweep.
    #[error(
        "recording holds no response to the sweep: its greatest sample is {peak_db:.1} dB over the mean, expected \
         {least_db:.0} dB"
    )]
    NoResponse {
        /// Power of the response's greatest sample over the mean, dB.
        peak_db: f64,
        /// The limit.
        least_db: f64,
    },
    /// Samples are missing or repeated.
    #[error(
        "{channel} has lost or repeated samples near {at_secs:.3} s: ringing before the arrival is {ringing_db:.0} dB, \
         expected -45 dB at most"
    )]
    Dropout {
        /// The channel.
        channel: TakeChannel,
        /// Time in the recording, s.
        at_secs: f64,
        /// Power of the ringing, dB re the response's.
        ringing_db: f64,
    },
    /// The recording's clock is another than the loopback's.
    #[error("recording's clock drifts by {ppm:+.1} ppm against the loopback's, limit {limit_ppm:.1} ppm")]
    Clock {
        /// Rate of the playing clock over the recording one, less 1, ppm.
        ppm: f64,
        /// The limit.
        limit_ppm: f64,
    },
    /// The recording's clock is another than the loopback's, and its ratio changes during the sweep.
    #[error(
        "recording's clock drifts unevenly: {ppm:+.1} ppm against the loopback's are undone, {left_ppm:+.1} are left"
    )]
    UnevenClock {
        /// Rate of the playing clock over the recording one, less 1, ppm.
        ppm: f64,
        /// The same once the recording is stretched by it.
        left_ppm: f64,
    },
    /// The signal exceeds full scale between its samples.
    #[error("{channel} reaches {peak_dbfs:+.2} dBFS between samples")]
    BetweenSamples {
        /// The channel.
        channel: TakeChannel,
        /// Peak of the signal oversampled by 4, dB re full scale.
        peak_dbfs: f64,
    },
    /// Something precedes the response to a linear sweep.
    #[error("{level_db:.0} dB of the response precede it: distortion or noise, which a linear sweep cannot separate")]
    Distortion {
        /// Its energy, dB re the response's.
        level_db: f64,
    },
}

impl TakeFault {
    /// Returns whether the take's response is spoiled.
    pub fn spoils_response(&self) -> bool {
        !matches!(self, Self::UnknownSweep { .. } | Self::Distortion { .. } | Self::BetweenSamples { .. })
    }

    /// Returns advice for a fault that persists.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::Loopback { .. } => "is the loopback cable in, from the output to the second input?",
            Self::UnknownSweep { .. } => "describe the played sweep under `sweep` in the rig file",
            Self::SameSignal { .. } => "are the inputs summed to mono, or is one of both not plugged in?",
            Self::Swapped { .. } => "exchange recording and loopback",
            Self::EarlyArrival { .. } => {
                "begin both files at the same sample, and leave the microphone's latency as it is"
            }
            Self::CutStart { .. } | Self::CutEnd { .. } => "begin the recording before the sweep, and end it later",
            Self::NoResponse { .. } => "is the microphone on, and are both files of one take and one sampling rate?",
            Self::Dropout { .. } => "use a larger buffer of the audio interface, and record again",
            Self::Clock { .. } | Self::UnevenClock { .. } => "record the loopback by the microphone's interface",
            Self::BetweenSamples { .. } => "lower the gain by as much",
            Self::Distortion { .. } => "lower the level, or play an exponential sweep, which shows harmonics by order",
        }
    }
}
