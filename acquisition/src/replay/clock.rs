//! The clock of a replay: runs at its speed, stops, is set.

use std::ops::RangeInclusive;
use std::time::{Duration, Instant};

/// Speeds of a replay, as factors of real time: slower is paused, faster is more than any disk gives.
pub const SPEEDS: RangeInclusive<f32> = 0.01..=1e6;

/// A clock that shows the time of the played messages, ns since 1970.
#[derive(Debug)]
pub(super) struct ReplayClock {
    /// Its time when it was last set, stopped or started.
    shown: u64,
    /// Start of the current run; None while it is stopped.
    since: Option<Instant>,
    speed: f32,
}

impl ReplayClock {
    /// Makes a clock that is stopped at a time.
    pub fn new(at: u64, speed: f32) -> Self {
        Self { shown: at, since: None, speed: speed.clamp(*SPEEDS.start(), *SPEEDS.end()) }
    }

    pub fn now(&self) -> u64 {
        let gone = self.since.map_or(0.0, |since| since.elapsed().as_nanos() as f64 * f64::from(self.speed));
        self.shown.saturating_add(gone as u64)
    }

    pub fn speed(&self) -> f32 {
        self.speed
    }

    /// Sets its time; a running clock goes on running.
    pub fn set_time(&mut self, at: u64) {
        self.shown = at;
        self.since = self.since.map(|_| Instant::now());
    }

    /// Changes its speed; values that are no speed change nothing.
    pub fn set_speed(&mut self, speed: f32) {
        if speed.is_finite() && speed > 0.0 {
            self.set_time(self.now());
            self.speed = speed.clamp(*SPEEDS.start(), *SPEEDS.end());
        }
    }

    /// Starts or stops it.
    pub fn set_running(&mut self, goes: bool) {
        if goes != self.since.is_some() {
            self.shown = self.now();
            self.since = goes.then(Instant::now);
        }
    }

    /// Returns the wait until it shows a time.
    pub fn time_until(&self, at: u64) -> Duration {
        Duration::from_secs_f64(at.saturating_sub(self.now()) as f64 / 1e9 / f64::from(self.speed))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_stands_goes_and_is_put_elsewhere() {
        let mut clock = ReplayClock::new(1_000, 1e9);
        assert_eq!(clock.speed(), *SPEEDS.end());
        assert_eq!(clock.now(), 1_000);
        clock.set_running(true);
        std::thread::sleep(Duration::from_millis(2));
        assert!(clock.now() >= 1_000 + 2_000_000 * 1_000_000);
        clock.set_running(false);
        let stood = clock.now();
        assert_eq!(clock.now(), stood);
        clock.set_time(5);
        for speed in [f32::NAN, f32::INFINITY, 0.0, -1.0] {
            clock.set_speed(speed);
            assert_eq!(clock.speed(), *SPEEDS.end(), "{speed} is no speed");
        }
        clock.set_speed(2.0);
        assert_eq!((clock.now(), clock.time_until(2_000_000_005)), (5, Duration::from_secs(1)));
        assert_eq!(clock.time_until(0), Duration::ZERO);
    }
}
