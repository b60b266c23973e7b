//! Alignment common to all audio interfaces, above the system's calls: takes that begin with the output to the sample,
//! detection of gaps, retries. [`AudioDuplex`] is the part of a system.

mod delay;
#[cfg(test)]
pub(super) mod tests;

use echolake_schema::Timestamp;

use crate::rig::{AudioInterface, AudioTake, Error};
use delay::{LoopbackDelay, locate_output};

pub(crate) const DEVICE: &str = "audio interface";
/// Least correlation of loopback and output, -1 to 1: below it the loopback carries something else.
const LIKENESS: f64 = 0.5;
/// Least level of an output whose start can be found, rms re full scale.
const SILENCE: f64 = 1e-5;
/// Shortest part of an output that is searched by itself, samples.
const SHORTEST_PART: usize = 512;

/// Plays and records at the same time; the start of one against the other is not known.
pub trait AudioDuplex: Send {
    /// Sampling rate, Hz.
    fn rate_hz(&self) -> f64;

    /// Plays `output` (1.0 is full scale), then silence, and records `frames` frames, which begin no later than the
    /// output. Returns when the first frame was taken.
    ///
    /// # Errors
    /// [`TransferError`].
    fn transfer(
        &mut self,
        output: &[f32],
        frames: usize,
        recorded: &mut DuplexRecording,
    ) -> Result<Timestamp, TransferError>;
}

/// Two channels, signed 24 bits.
#[derive(Debug, Clone, Default)]
pub struct DuplexRecording {
    /// The microphone.
    pub microphone: Vec<i32>,
    /// The output, looped back.
    pub loopback: Vec<i32>,
}

/// A transfer that gave no complete recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum TransferError {
    /// The computer was too late to fetch or to bring samples; a retry may succeed.
    Transient(String),
    /// The device is gone or refuses, or its loopback does not carry the output.
    Permanent(String),
}

/// An audio interface whose takes begin with the output.
pub struct AlignedAudio<D> {
    duplex: D,
    latency_secs: f64,
    repeats: u32,
    recorded: DuplexRecording,
    /// The last delay that was found, for outputs that are silent.
    delay: usize,
    last: Timestamp,
    notices: Vec<String>,
}

impl<D: AudioDuplex> AlignedAudio<D> {
    /// Over a duplex that records at most `latency_secs` late; takes with a gap are repeated `repeats` times.
    pub fn new(duplex: D, latency_secs: f64, repeats: u32) -> Self {
        let (recorded, last) = (DuplexRecording::default(), Timestamp(i64::MIN));
        Self { duplex, latency_secs, repeats, recorded, delay: 0, last, notices: Vec::new() }
    }

    // One try: the delay, and when the first sample of the take was taken.
    fn attempt(&mut self, output: &[f32]) -> Result<(usize, Timestamp), TransferError> {
        let rate_hz = self.duplex.rate_hz();
        let latency = (self.latency_secs * rate_hz).ceil() as usize;
        let frames = output.len() + latency;
        let began = self.duplex.transfer(output, frames, &mut self.recorded)?;
        let counts = [self.recorded.microphone.len(), self.recorded.loopback.len()];
        if counts != [frames; 2] {
            return Err(TransferError::Transient(format!("{counts:?} frames came, expected {frames}")));
        }
        let delay = self.delay_of(output)?;
        Ok((delay, began.plus_secs(delay as f64 / rate_hz)))
    }

    fn delay_of(&self, output: &[f32]) -> Result<usize, TransferError> {
        if rms(output) < SILENCE {
            return Ok(self.delay);
        }
        let found = locate_output(output, &self.recorded.loopback);
        if found.likeness < LIKENESS {
            return Err(TransferError::Permanent(self.no_loopback(&found)));
        }
        // A gap moves the samples behind it, and the system's counters may miss it.
        let part = output.len() / 3;
        if part >= SHORTEST_PART {
            let ends = [0, output.len() - part].map(|from| {
                let window = from..(from + part + self.recorded.loopback.len() - output.len());
                locate_output(&output[from..from + part], &self.recorded.loopback[window]).at
            });
            if ends[0] != ends[1] {
                let why = format!("{} samples went missing or came twice", ends[1].abs_diff(ends[0]));
                return Err(TransferError::Transient(why));
            }
        }
        Ok(found.at)
    }

    fn no_loopback(&self, found: &LoopbackDelay) -> String {
        let level = 20.0 * rms_24(&self.recorded.loopback).max(1e-9).log10();
        let likeness = found.likeness;
        format!(
            "the loopback does not carry the output (level {level:.0} dBFS, likeness {likeness:.2}); hint: is its \
             cable plugged in, from the output that the rig file names to the input that it names?"
        )
    }
}

impl<D: AudioDuplex> AudioInterface for AlignedAudio<D> {
    fn rate_hz(&self) -> f64 {
        self.duplex.rate_hz()
    }

    fn play_and_record(&mut self, output: &[f32], take: &mut AudioTake) -> Result<(), Error> {
        let failed = |text: String| Err(Error::Device { device: DEVICE, reason: text.into() });
        for attempt in 0..=self.repeats {
            match self.attempt(output) {
                Ok((delay, began)) => {
                    self.delay = delay;
                    self.last = Timestamp(began.0.max(self.last.0.saturating_add(1)));
                    take.started = Some(self.last);
                    let cut = |from: &[i32], to: &mut Vec<i32>| {
                        to.clear();
                        to.extend_from_slice(&from[delay..delay + output.len()]);
                    };
                    cut(&self.recorded.microphone, &mut take.microphone);
                    cut(&self.recorded.loopback, &mut take.loopback);
                    return Ok(());
                }
                Err(TransferError::Transient(why)) if attempt < self.repeats => {
                    self.notices.push(format!("take repeated: {why}"));
                }
                Err(TransferError::Transient(why)) => {
                    let tries = self.repeats + 1;
                    let hint = "a larger `period_frames`, fewer other programs, another USB port";
                    return failed(format!("{tries} takes in a row have gaps, the last: {why}; hint: {hint}"));
                }
                Err(TransferError::Permanent(why)) => return failed(why),
            }
        }
        failed("no take was tried".into())
    }

    fn take_notices(&mut self) -> Vec<String> {
        std::mem::take(&mut self.notices)
    }
}

fn rms(x: &[f32]) -> f64 {
    (x.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / x.len().max(1) as f64).sqrt()
}

fn rms_24(x: &[i32]) -> f64 {
    (x.iter().map(|x| (f64::from(*x) / 8_388_608.0).powi(2)).sum::<f64>() / x.len().max(1) as f64).sqrt()
}
