//! Why a take is not accepted, and what whoever runs the rig can do about it.

/// Why a take is not accepted. Its text stands in the verdict.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Objection {
    /// Samples at full scale.
    #[error("{samples} samples clipped")]
    Clipped {
        /// How many, both channels.
        samples: u32,
    },
    /// The loopback is too soft.
    #[error("loopback at {dbfs:.1} dBFS, least {least_dbfs:.1}")]
    Loopback {
        /// Its level, dB re full scale.
        dbfs: f64,
        /// The rig's limit.
        least_dbfs: f64,
    },
    /// Too little signal over too much noise.
    #[error("signal-to-noise ratio {snr_db:.1} dB, least {least_db:.1}")]
    Noise {
        /// The ratio, dB.
        snr_db: f64,
        /// The rig's limit.
        least_db: f64,
    },
    /// The direct sound comes at another time than geometry and temperature give.
    #[error("direct sound {off_us:.1} us off, most {most_us:.1}")]
    Arrival {
        /// How far off, us.
        off_us: f64,
        /// The rig's limit.
        most_us: f64,
    },
    /// It is loud outside.
    #[error("{level_db:.1} dB outside, most {most_db:.1}")]
    Outside {
        /// Sound pressure level, dB re 20 uPa.
        level_db: f64,
        /// The rig's limit.
        most_db: f64,
    },
    /// A quantity that must be known is not.
    #[error("{what} unknown")]
    Unknown {
        /// Which.
        what: &'static str,
    },
    /// The sensor says what no room is.
    #[error("{what} of {value} {unit} is not plausible, expected {least} to {most}")]
    Implausible {
        /// Which quantity.
        what: &'static str,
        /// What the sensor says.
        value: f64,
        /// Its unit.
        unit: &'static str,
        /// The lowest that is believed.
        least: f64,
        /// The highest.
        most: f64,
    },
    /// The take cannot be deconvolved.
    #[error("{reason}")]
    Broken {
        /// Why.
        reason: String,
    },
    /// The arms do not go there.
    #[error("{refusal}")]
    Refused {
        /// What the robots say.
        refusal: crate::rig::Error,
    },
}

impl Objection {
    /// What to look at when it stays.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::Clipped { .. } => "lower the gain, or `sweep.level_dbfs` in the rig file",
            Self::Loopback { .. } | Self::Broken { .. } => {
                "is the loopback cable in, from the output to the second input?"
            }
            Self::Noise { .. } => "are amplifier and microphone on, and the drives off?",
            Self::Arrival { .. } => "do microphone and speaker stand where the arms say, and is the temperature right?",
            Self::Outside { .. } => "wait until it is quiet, or raise `validation.outside_level_db` in the rig file",
            Self::Unknown { .. } | Self::Implausible { .. } => "is the ambient sensor plugged in, and the right one?",
            Self::Refused { .. } => "look at the robots' own messages; are they referenced, and is the grid the rig's?",
        }
    }
}
