//! Numbers that are silently wrong when mixed up: temperature, sampling rate, time.

use std::fmt;

use chrono::{DateTime, SecondsFormat, Utc};
use serde::{Deserialize, Serialize};

use crate::Error;

/// Scale of the panels: models of walls at a tenth of their size, whose wavelengths are a tenth, too.
pub const MODEL_SCALE: f64 = 10.0;

/// Temperature of air in degrees Celsius, -60 to 80: the range of a sensor in a room or a cold store.
///
/// ```
/// use echolake_schema::Celsius;
///
/// assert_eq!(Celsius::new(21.5)?.get(), 21.5);
/// assert!(Celsius::new(294.65).is_err(), "kelvin are refused");
/// # Ok::<(), echolake_schema::Error>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "f64", into = "f64")]
pub struct Celsius(f64);

/// Samples per second, 1 Hz to 10 MHz.
///
/// ```
/// use echolake_schema::SampleRate;
///
/// assert_eq!(SampleRate::new(96e3)?.get(), 96_000.0);
/// assert!(SampleRate::new(0.0).is_err());
/// # Ok::<(), echolake_schema::Error>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "f64", into = "f64")]
pub struct SampleRate(f64);

/// Nanoseconds since 1970-01-01 UTC.
///
/// ```
/// use echolake_schema::Timestamp;
///
/// let start = Timestamp::parse("2026-01-05T09:00:00+01:00")?;
/// assert_eq!((start.compact_text().as_str(), start.micros()), ("20260105T080000Z", 1_767_600_000_000_000));
/// assert_eq!(start.plus_secs(0.5).to_string(), "2026-01-05T08:00:00.500Z");
/// # Ok::<(), echolake_schema::Error>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Timestamp(pub i64);

impl Celsius {
    /// Checks the number.
    ///
    /// # Errors
    /// [`Error::Quantity`] if it is not finite or outside of -60 to 80.
    pub fn new(value: f64) -> Result<Self, Error> {
        if (-60.0..=80.0).contains(&value) {
            return Ok(Self(value));
        }
        Err(Error::Quantity { quantity: "temperature (C)", actual: value.to_string(), expected: "-60 to 80" })
    }

    pub(crate) const fn from_known(value: f64) -> Self {
        Self(value)
    }

    /// Degrees Celsius.
    pub fn get(self) -> f64 {
        self.0
    }
}

impl SampleRate {
    /// Checks the number.
    ///
    /// # Errors
    /// [`Error::Quantity`] if it is not finite or outside of 1 Hz to 10 MHz.
    pub fn new(value: f64) -> Result<Self, Error> {
        if (1.0..=1e7).contains(&value) {
            return Ok(Self(value));
        }
        Err(Error::Quantity { quantity: "sampling rate (Hz)", actual: value.to_string(), expected: "1 to 10 000 000" })
    }

    pub(crate) const fn from_known(value: f64) -> Self {
        Self(value)
    }

    /// Hz.
    pub fn get(self) -> f64 {
        self.0
    }
}

impl TryFrom<f64> for Celsius {
    type Error = Error;
    fn try_from(value: f64) -> Result<Self, Error> {
        Self::new(value)
    }
}

impl TryFrom<f64> for SampleRate {
    type Error = Error;
    fn try_from(value: f64) -> Result<Self, Error> {
        Self::new(value)
    }
}

impl From<Celsius> for f64 {
    fn from(value: Celsius) -> f64 {
        value.0
    }
}

impl From<SampleRate> for f64 {
    fn from(value: SampleRate) -> f64 {
        value.0
    }
}

impl Timestamp {
    /// The time on this machine's clock.
    pub fn now() -> Self {
        Self(Utc::now().timestamp_nanos_opt().unwrap_or(i64::MAX))
    }

    /// Reads an RFC 3339 time.
    ///
    /// # Errors
    /// [`Error::Quantity`] if it is none, or outside of 1678 to 2261.
    pub fn parse(text: &str) -> Result<Self, Error> {
        let wrong = || Error::Quantity {
            quantity: "time",
            actual: format!("`{text}`"),
            expected: "RFC 3339, as 2026-01-05T08:00:00Z, from 1678 to 2261",
        };
        let time = DateTime::parse_from_rfc3339(text).map_err(|_| wrong())?;
        time.timestamp_nanos_opt().map(Self).ok_or_else(wrong)
    }

    /// Later by `secs` seconds.
    pub fn plus_secs(self, secs: f64) -> Self {
        Self(self.0.saturating_add((secs * 1e9) as i64))
    }

    /// Microseconds, rounded down.
    pub fn micros(self) -> i64 {
        self.0.div_euclid(1000)
    }

    /// `20260105T080000Z`, for names.
    pub fn compact_text(self) -> String {
        self.utc_time().format("%Y%m%dT%H%M%SZ").to_string()
    }

    fn utc_time(self) -> DateTime<Utc> {
        DateTime::from_timestamp_nanos(self.0)
    }
}

impl fmt::Display for Timestamp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.utc_time().to_rfc3339_opts(SecondsFormat::AutoSi, true))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nonsense_is_refused() {
        for bad in [f64::NAN, f64::INFINITY, 400.0, -61.0] {
            assert!(Celsius::new(bad).is_err(), "{bad}");
        }
        for bad in [f64::NAN, 0.0, -48_000.0, 1e9] {
            assert!(SampleRate::new(bad).is_err(), "{bad}");
        }
        assert_eq!(Celsius::new(20.0).map(Celsius::get), Ok(20.0));
    }

    #[test]
    fn times_round_trip_to_the_nanosecond() {
        let time = Timestamp::parse("2026-01-05T09:00:00.123456789+01:00").expect("a time");
        assert_eq!(time.to_string(), "2026-01-05T08:00:00.123456789Z");
        assert_eq!(Timestamp::parse(&time.to_string()), Ok(time));
        assert!(Timestamp::parse("yesterday").is_err());
    }
}
