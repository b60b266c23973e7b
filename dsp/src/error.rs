//! Errors of the kernels.

/// An invalid setting of a plan, or an invalid input of a kernel.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// A slice has the wrong length.
    #[error("{what} has {actual} samples, expected {expected}")]
    Length {
        /// Name of the slice.
        what: &'static str,
        /// Its length.
        actual: usize,
        /// The expected length.
        expected: usize,
    },
    /// A setting that makes no plan.
    #[error("{what} is {actual}, expected {expected}")]
    Setting {
        /// Name of the setting.
        what: &'static str,
        /// The given value.
        actual: String,
        /// The accepted values.
        expected: &'static str,
    },
    /// The loopback holds nothing to divide by.
    #[error("the loopback has no energy in the sweep's range; hint: is the loopback cable plugged in?")]
    NoLoopback,
    /// A signal with NaN or infinity in it.
    #[error("{what} has samples that are not finite")]
    NotFinite {
        /// Name of the signal.
        what: &'static str,
    },
}

pub(crate) fn check_len(what: &'static str, actual: usize, expected: usize) -> Result<(), Error> {
    if actual == expected { Ok(()) } else { Err(Error::Length { what, actual, expected }) }
}

pub(crate) fn check_finite(what: &'static str, samples: &[f64]) -> Result<(), Error> {
    if samples.iter().all(|x| x.is_finite()) { Ok(()) } else { Err(Error::NotFinite { what }) }
}
