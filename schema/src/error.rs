//! What can be wrong with a value that somebody gave us.

/// A value that is not what its type promises.
#[derive(Debug, thiserror::Error, Clone, PartialEq)]
pub enum Error {
    /// Not a name that a surface, run or file can have.
    #[error("`{value}` is not a valid {kind}: {reason}")]
    Id {
        /// What it was to be.
        kind: &'static str,
        /// What was given.
        value: String,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// A number outside of what is physically sensible.
    #[error("{quantity} is {actual}, expected {expected}")]
    Quantity {
        /// Which quantity, with its unit.
        quantity: &'static str,
        /// What was given.
        actual: String,
        /// The range that is taken.
        expected: &'static str,
    },
    /// A rig description that contradicts itself.
    #[error("rig `{rig}`: `{field}` {reason}")]
    Rig {
        /// The rig's name.
        rig: String,
        /// The field, as in the TOML.
        field: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// Text that is no rig description.
    #[error("not a rig description: {message}")]
    RigSyntax {
        /// The parser's message, with line and column.
        message: String,
    },
    /// A point that the rig's grid does not have.
    #[error("{given} is not a point of the rig's grid ({expected}){}", nearest.as_deref().map(|n| format!("; the nearest is {n}")).unwrap_or_default())]
    Point {
        /// What was given.
        given: String,
        /// What points there are.
        expected: String,
        /// The nearest point, where there is one.
        nearest: Option<String>,
    },
    /// Two points that the rig does not measure as a pair.
    #[error("microphone {microphone} with speaker {speaker} is none of the rig's {pairs} pairs{hint}")]
    Pair {
        /// Microphone point.
        microphone: String,
        /// Speaker point.
        speaker: String,
        /// How many pairs there are.
        pairs: usize,
        /// What would be one.
        hint: &'static str,
    },
    /// Samples in a format that this version does not know.
    #[error("its sample format is unknown; hint: a newer version may have written it")]
    SampleFormat,
    /// Bytes that are not the samples they should be.
    #[error("it has {actual} bytes for {samples} samples of {width}")]
    SampleBytes {
        /// How many bytes there are.
        actual: usize,
        /// How many samples there should be.
        samples: usize,
        /// Bytes of one sample.
        width: usize,
    },
    /// A sample that is no number.
    #[error("sample {index} is {value}")]
    Sample {
        /// Which, 0-based.
        index: usize,
        /// What it is.
        value: f32,
    },
}
