//! A simulated rig whose takes last a given time: for live views, and to measure the cost of recording at a real rig's
//! pace.

use std::time::{Duration, Instant};

use crate::rig::{AudioInterface, AudioTake, Error, RigDevices};

/// Wraps devices so that takes last at least `secs`.
pub(crate) fn paced_devices(mut devices: RigDevices, secs: f64) -> RigDevices {
    let pace = Duration::try_from_secs_f64(secs).unwrap_or_default();
    devices.audio = Box::new(Paced { inner: devices.audio, pace });
    devices
}

struct Paced {
    inner: Box<dyn AudioInterface>,
    pace: Duration,
}

impl AudioInterface for Paced {
    fn rate_hz(&self) -> f64 {
        self.inner.rate_hz()
    }

    fn play_and_record(&mut self, output: &[f32], take: &mut AudioTake) -> Result<(), Error> {
        let begun = Instant::now();
        self.inner.play_and_record(output, take)?;
        std::thread::sleep(self.pace.saturating_sub(begun.elapsed()));
        Ok(())
    }

    fn take_notices(&mut self) -> Vec<String> {
        self.inner.take_notices()
    }
}
