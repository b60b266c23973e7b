//! Reasons to reject a take, with advice for the rig's operator.

use echolake_dsp::take_analysis::TakeFault;

use crate::rig::AmbientReading;

/// The ratio of signal to noise, as an unknown quantity.
pub(crate) const SIGNAL_TO_NOISE: &str = "signal-to-noise ratio";
/// The arrival of the direct sound, as an unknown quantity.
pub(crate) const ARRIVAL: &str = "arrival of the direct sound";

/// Plausible range of readings in rooms; a value outside is the fault of the sensor or its line.
const TEMPERATURE_C: [f64; 2] = [-20.0, 60.0];
const HUMIDITY_PCT: [f64; 2] = [0.0, 100.0];
const PRESSURE_HPA: [f64; 2] = [300.0, 1_100.0];
const LEVEL_DB: [f64; 2] = [0.0, 150.0];

/// A reason to reject a take. Its text is recorded in the verdict.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TakeObjection {
    /// Samples at full scale.
    #[error("{samples} samples clipped")]
    Clipped {
        /// Number of samples, both channels.
        samples: u32,
    },
    /// Loopback, clocks or samples are not as they should be.
    #[error(transparent)]
    Take(#[from] TakeFault),
    /// Too little signal over too much noise.
    #[error("signal-to-noise ratio {snr_db:.1} dB, expected at least {least_db:.1} dB")]
    Noise {
        /// The ratio, dB.
        snr_db: f64,
        /// The rig's limit.
        least_db: f64,
    },
    /// The direct sound comes at another time than geometry and temperature give.
    #[error("direct sound {off_us:.1} us off, limit {most_us:.1} us")]
    Arrival {
        /// The difference, us.
        off_us: f64,
        /// The rig's limit.
        most_us: f64,
    },
    /// Two takes of the pair differ by more than their noise.
    #[error(
        "two takes differ by {difference_db:.1} dB re the response, of which noise explains {noise_db:.1} dB, limit \
         {most_db:.1} dB"
    )]
    TimeVariance {
        /// Energy of the difference of both responses over that of the first, dB.
        difference_db: f64,
        /// The noise in it, likewise.
        noise_db: f64,
        /// The limit for what noise does not explain, dB.
        most_db: f64,
    },
    /// It is loud outside.
    #[error("outside noise {level_db:.1} dB, limit {most_db:.1} dB")]
    Outside {
        /// Sound pressure level, dB re 20 uPa.
        level_db: f64,
        /// The rig's limit.
        most_db: f64,
    },
    /// A quantity that must be known is not.
    #[error("{what} unknown")]
    Unknown {
        /// The quantity.
        what: &'static str,
    },
    /// The sensor's value is not plausible in a room.
    #[error("{what} of {value} {unit} is not plausible, expected {least} to {most}")]
    Implausible {
        /// The quantity.
        what: &'static str,
        /// The sensor's value.
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
        /// The cause.
        reason: String,
    },
    /// The arms do not go there.
    #[error("{refusal}")]
    Refused {
        /// The robots' error.
        refusal: crate::rig::Error,
    },
}

impl TakeObjection {
    /// Returns advice for an objection that persists.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::Clipped { .. } => "lower the gain, or `sweep.level_dbfs` in the rig file",
            Self::Take(fault) => fault.hint(),
            Self::Broken { .. } => "is the loopback cable in, from the output to the second input?",
            Self::Noise { .. } => "are amplifier and microphone on, and the drives off?",
            Self::Arrival { .. } => "do microphone and speaker stand where the arms say, and is the temperature right?",
            Self::TimeVariance { .. } => {
                "what changes between two takes: an automatic gain, moving air, a clock, something that is loose?"
            }
            Self::Outside { .. } => "wait until it is quiet, or raise `validation.outside_level_db` in the rig file",
            Self::Unknown { what: SIGNAL_TO_NOISE | ARRIVAL } => {
                "are recording and response long enough? See `sweep` and `impulse_response.length` in the rig file"
            }
            Self::Unknown { .. } | Self::Implausible { .. } => "is the ambient sensor plugged in, and the right one?",
            Self::Refused { .. } => "look at the robots' own messages; are they referenced, and is the grid the rig's?",
        }
    }
}

/// Returns objections to values that no room has; values that the reading leaves unknown are not among them.
pub(crate) fn find_implausible(reading: &AmbientReading) -> Vec<TakeObjection> {
    let values = [
        ("a temperature", reading.temperature_c, "C", TEMPERATURE_C),
        ("a humidity", reading.humidity_pct, "%", HUMIDITY_PCT),
        ("a pressure", reading.pressure_hpa, "hPa", PRESSURE_HPA),
        ("a level outside", reading.outside_level_db, "dB", LEVEL_DB),
    ];
    values
        .into_iter()
        .filter(|(_, value, _, [least, most]): &(_, f64, _, [f64; 2])| value < least || value > most)
        .map(|(what, value, unit, [least, most])| TakeObjection::Implausible { what, value, unit, least, most })
        .collect()
}
