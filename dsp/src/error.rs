//! Why a kernel refuses.

/// What is wrong with a plan's settings or a kernel's input.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// A slice has the wrong length.
    #[error("{what} has {actual} samples, expected {expected}")]
    Length {
        /// Which slice.
        what: &'static str,
        /// Its length.
        actual: usize,
        /// The plan's.
        expected: usize,
    },
    /// A setting that makes no plan.
    #[error("{what} is {actual}, expected {expected}")]
    Setting {
        /// Which setting.
        what: &'static str,
        /// What was given.
        actual: String,
        /// What is taken.
        expected: &'static str,
    },
    /// The loopback holds nothing to divide by.
    #[error("the loopback has no energy in the sweep's range; hint: is the loopback cable plugged in?")]
    NoLoopback,
    /// A signal with NaN or infinity in it.
    #[error("{what} has samples that are not finite")]
    NotFinite {
        /// Which signal.
        what: &'static str,
    },
}

pub(crate) fn check_len(what: &'static str, actual: usize, expected: usize) -> Result<(), Error> {
    if actual == expected { Ok(()) } else { Err(Error::Length { what, actual, expected }) }
}
