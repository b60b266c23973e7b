//! ALSA: one PCM that plays and one that records, started together if the device can link them.
//!
//! PCMs are opened for each take and closed after it: a device that was plugged in again is found, and no buffer holds
//! remains of an earlier take.

use alsa::pcm::{Access, Format, HwParams, PCM};
use alsa::{Direction, ValueOr};
use echolake_schema::Timestamp;
use echolake_schema::devices::{AlsaParams, AudioFormat};

use super::audio::{AudioDuplex, DEVICE, DuplexRecording, TransferError};
use crate::rig::Error;

/// Periods per buffer of the device; one is filled or emptied while the others pass.
const PERIODS: usize = 4;
/// Error numbers of an overrun or underrun: EPIPE and ESTRPIPE.
const LATE: [i32; 2] = [32, 86];
/// Full scale of 24 bits.
const FULL_SCALE: f64 = 8_388_608.0;

/// A device through ALSA.
pub(super) struct AlsaDuplex {
    params: AlsaParams,
    rate_hz: u32,
}

impl AlsaDuplex {
    /// Opens the device once to check that it supports the rate, the format and the channels.
    ///
    /// # Errors
    /// [`Error::Device`] if it is not there, or does not support the rate, the format or the channels.
    pub fn open(params: &AlsaParams, rate_hz: f64) -> Result<Self, Error> {
        let failed = |text: String| Error::Device { device: DEVICE, reason: text.into() };
        if rate_hz.fract() != 0.0 || !(1.0..=1e6).contains(&rate_hz) {
            return Err(failed(format!("{rate_hz} Hz is no whole rate up to 1 MHz")));
        }
        let duplex = Self { params: params.clone(), rate_hz: rate_hz as u32 };
        for direction in [Direction::Playback, Direction::Capture] {
            duplex.pcm(direction).map(drop).map_err(failed)?;
        }
        Ok(duplex)
    }

    fn pcm(&self, direction: Direction) -> Result<PCM, String> {
        let (name, channels) = match direction {
            Direction::Playback => (&self.params.playback, self.params.outputs),
            Direction::Capture => (&self.params.capture, self.params.inputs),
        };
        let hint = "`aplay -L` and `arecord -L` list names";
        let pcm = PCM::new(name, direction, false).map_err(|e| format!("cannot open `{name}`: {e}; hint: {hint}"))?;
        let rate_hz = self.rate_hz;
        self.set(&pcm, channels).map_err(|e| {
            let format = self.params.format;
            format!(
                "`{name}` does not do {channels} channels of {format:?} at {rate_hz} Hz: {e}; hint: a `hw:` name, \
                and its own format"
            )
        })?;
        Ok(pcm)
    }

    fn set(&self, pcm: &PCM, channels: u32) -> alsa::Result<()> {
        let period = self.params.period_frames as alsa::pcm::Frames;
        let hardware = HwParams::any(pcm)?;
        hardware.set_rate_resample(false)?;
        hardware.set_access(Access::RWInterleaved)?;
        hardware.set_format(format_of(self.params.format))?;
        hardware.set_channels(channels)?;
        hardware.set_rate(self.rate_hz, ValueOr::Nearest)?;
        hardware.set_buffer_size_near(PERIODS as alsa::pcm::Frames * period)?;
        hardware.set_period_size_near(period, ValueOr::Nearest)?;
        pcm.hw_params(&hardware)?;
        // Nothing starts by itself: playback is filled first, then both are started.
        let software = pcm.sw_params_current()?;
        software.set_start_threshold(software.get_boundary()?)?;
        pcm.sw_params(&software)
    }

    fn run(&self, played: &[u8], captured: &mut [u8]) -> Result<Timestamp, TransferError> {
        let [player, recorder] = [self.pcm(Direction::Playback), self.pcm(Direction::Capture)];
        let (player, recorder) =
            (player.map_err(TransferError::Permanent)?, recorder.map_err(TransferError::Permanent)?);
        // PCMs that cannot be linked are started one after the other; the loopback shows the difference.
        let linked = recorder.link(&player).is_ok();
        let [out_frame, in_frame] = [self.params.outputs, self.params.inputs].map(|n| n as usize * self.sample_bytes());
        let period = self.params.period_frames as usize;
        let frames = captured.len() / in_frame;

        let mut written = 0;
        while written < frames.min((PERIODS - 1) * period) {
            written += write(&player, &played[written * out_frame..], period * out_frame)?;
        }
        let began = Timestamp::now();
        recorder.start().map_err(trouble)?;
        if !linked {
            player.start().map_err(trouble)?;
        }
        let mut read = 0;
        while read < frames {
            let end = captured.len().min((read + period) * in_frame);
            let part = &mut captured[read * in_frame..end];
            read += recorder.io_bytes().readi(part).map_err(trouble)?;
            if written < frames {
                written += write(&player, &played[written * out_frame..], period * out_frame)?;
            }
        }
        // The rest in the buffers is silence.
        let _ = player.drop();
        let _ = recorder.drop();
        Ok(began)
    }

    fn sample_bytes(&self) -> usize {
        match self.params.format {
            AudioFormat::S32 | AudioFormat::S24 => 4,
            AudioFormat::S24Packed => 3,
        }
    }

    fn channel(&self, bytes: &[u8], channel: u32, out: &mut Vec<i32>) {
        let size = self.sample_bytes();
        let channels = self.params.inputs as usize;
        let at = size * (channel as usize - 1);
        out.clear();
        out.extend(bytes.chunks_exact(size * channels).map(|frame| decoded(&frame[at..at + size], self.params.format)));
    }
}

impl AudioDuplex for AlsaDuplex {
    fn rate_hz(&self) -> f64 {
        self.rate_hz.into()
    }

    fn transfer(
        &mut self,
        output: &[f32],
        frames: usize,
        recorded: &mut DuplexRecording,
    ) -> Result<Timestamp, TransferError> {
        let mut played = Vec::with_capacity(frames * self.params.outputs as usize * self.sample_bytes());
        for n in 0..frames {
            let sample = encoded(output.get(n).copied().unwrap_or(0.0), self.params.format);
            (0..self.params.outputs).for_each(|_| played.extend_from_slice(&sample[..self.sample_bytes()]));
        }
        let mut captured = vec![0; frames * self.params.inputs as usize * self.sample_bytes()];
        let began = self.run(&played, &mut captured)?;
        self.channel(&captured, self.params.microphone, &mut recorded.microphone);
        self.channel(&captured, self.params.loopback, &mut recorded.loopback);
        Ok(began)
    }
}

fn write(player: &PCM, bytes: &[u8], most: usize) -> Result<usize, TransferError> {
    player.io_bytes().writei(&bytes[..bytes.len().min(most)]).map_err(trouble)
}

fn trouble(e: alsa::Error) -> TransferError {
    if LATE.contains(&e.errno().abs()) {
        TransferError::Transient(format!("overrun or underrun ({e})"))
    } else {
        TransferError::Permanent(format!("{e}; hint: is the interface still plugged in?"))
    }
}

fn format_of(format: AudioFormat) -> Format {
    match format {
        AudioFormat::S32 => Format::S32LE,
        AudioFormat::S24 => Format::S24LE,
        AudioFormat::S24Packed => Format::S243LE,
    }
}

// The first three or four bytes count.
fn encoded(sample: f32, format: AudioFormat) -> [u8; 4] {
    let value = (f64::from(sample) * FULL_SCALE).round().clamp(-FULL_SCALE, FULL_SCALE - 1.0) as i32;
    match format {
        AudioFormat::S32 => (value << 8).to_le_bytes(),
        AudioFormat::S24 | AudioFormat::S24Packed => value.to_le_bytes(),
    }
}

fn decoded(bytes: &[u8], format: AudioFormat) -> i32 {
    let word = |a: [u8; 4]| i32::from_le_bytes(a);
    match (format, bytes) {
        (AudioFormat::S32, &[a, b, c, d]) => word([a, b, c, d]) >> 8,
        // The fourth byte is anything.
        (AudioFormat::S24, &[a, b, c, _]) | (AudioFormat::S24Packed, &[a, b, c]) => word([0, a, b, c]) >> 8,
        _ => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_pass_all_formats_unchanged() {
        for format in [AudioFormat::S32, AudioFormat::S24, AudioFormat::S24Packed] {
            let size = if format == AudioFormat::S24Packed { 3 } else { 4 };
            for value in [0, 1, -1, 4_194_303, -8_388_608, 8_388_607] {
                let bytes = encoded((f64::from(value) / FULL_SCALE) as f32, format);
                assert_eq!(decoded(&bytes[..size], format), value, "{format:?}");
            }
            assert_eq!(decoded(&encoded(3.0, format)[..size], format), 8_388_607, "clipped, not wrapped");
        }
    }
}
