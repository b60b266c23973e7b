//! Sounds of surfaces: a dry recording, convolved with responses at full scale.

use std::io::Write as _;
use std::ops::Range;
use std::path::Path;

use echolake_dsp::auralization::{RecordingConvolution, resample_response};
use echolake_dsp::level::power_to_db;
use echolake_schema::ErrorCause;
use echolake_schema::messages::SampleFormat;
use echolake_schema::samples::encode_wav_header;
use serde::Serialize;

use crate::error::{Error, Result};
use crate::output::PendingFolder;

/// Greatest sample of the loudest sound, as a fraction of full scale: -1 dB.
const GREATEST_SAMPLE: f64 = 0.891;

/// Greatest sampling rate of a dry recording, Hz: no converter has more.
const GREATEST_RATE_HZ: u32 = 768_000;
/// Samples that are read at once, at least: 1 MB of them.
const READ_SAMPLES: usize = 1 << 18;

/// A recording without a room. It is read in blocks, and twice for each response.
#[derive(Clone, Copy)]
pub struct DryRecording<'a> {
    /// Reads a range of samples, fractions of full scale.
    pub read_block: &'a dyn Fn(Range<u64>) -> std::result::Result<Vec<f32>, ErrorCause>,
    /// Samples in it.
    pub sample_count: u64,
    /// Sampling rate.
    pub rate_hz: u32,
}

/// A response, and the name of its sound.
#[derive(Debug, Clone, Copy)]
pub struct ListenedResponse<'a> {
    /// Name of the file, without its ending.
    pub name: &'a str,
    /// Response at full scale.
    pub samples: &'a [f32],
    /// Sampling rate at full scale: the rig's over the models' scale.
    pub rate_hz: u32,
}

/// Levels of a sound.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SoundLevel {
    /// Name of the file in the folder.
    pub file: String,
    /// Energy of the response, dB.
    pub response_db: f64,
    /// Energy of the convolved recording before any gain, dB.
    pub sound_db: f64,
    /// Gain of the file, dB.
    pub gain_db: f64,
}

/// Writes a WAV file of 32-bit floats for each response into a new folder, at the recording's rate. All have one gain,
/// by which the greatest sample is -1 dB of full scale; with `match_levels` all have the energy of the first.
///
/// # Errors
/// [`Error::Dry`], [`Error::Nothing`] if a sound is silent, and others; nothing is left behind.
pub fn write_sounds(
    folder: &Path,
    dry: DryRecording<'_>,
    responses: &[ListenedResponse<'_>],
    match_levels: bool,
) -> Result<Vec<SoundLevel>> {
    if dry.rate_hz > GREATEST_RATE_HZ {
        let actual = dry.rate_hz;
        let what = format!(
            "its header says {actual} Hz, expected {GREATEST_RATE_HZ} at most; hint: is it damaged? Export it again"
        );
        return Err(Error::Dry { source: what.into() });
    }
    let mut sounds = Vec::new();
    let mut peak_db = f64::NEG_INFINITY;
    for response in responses {
        let resampled = resample_response(response.samples, response.rate_hz, dry.rate_hz);
        let (mut energy, mut peak) = (0.0, 0.0f32);
        dry.visit_sound(&resampled, &mut |part| {
            energy += signal_energy(part);
            peak = part.iter().fold(peak, |most, x| most.max(x.abs()));
            Ok(())
        })?;
        if energy == 0.0 || !energy.is_finite() {
            return Err(Error::Nothing { reason: format!("the sound of {} has no energy", response.name) });
        }
        let level = SoundLevel {
            file: format!("{}.wav", response.name),
            response_db: power_to_db(signal_energy(response.samples)),
            sound_db: power_to_db(energy),
            gain_db: 0.0,
        };
        let first_db = sounds.first().map_or(level.sound_db, |(first, _): &(SoundLevel, _)| first.sound_db);
        let level = SoundLevel { gain_db: if match_levels { first_db - level.sound_db } else { 0.0 }, ..level };
        peak_db = peak_db.max(power_to_db(f64::from(peak).powi(2)) + level.gain_db);
        sounds.push((level, resampled));
    }
    if sounds.is_empty() {
        return Ok(Vec::new());
    }
    let pending = PendingFolder::create(folder)?;
    let mut levels = Vec::new();
    for (mut level, resampled) in sounds {
        level.gain_db += power_to_db(GREATEST_SAMPLE.powi(2)) - peak_db;
        let gain = 10f64.powf(level.gain_db / 20.0);
        let path = pending.final_path(&level.file);
        let samples = dry.sample_count as usize + resampled.len() - 1;
        let header =
            encode_wav_header(SampleFormat::F32le, dry.rate_hz, 1, samples).map_err(|e| Error::write(&path, e))?;
        let mut file = pending.create_file(&level.file)?;
        file.write_all(&header).map_err(|e| Error::write(&path, e))?;
        dry.visit_sound(&resampled, &mut |part| {
            let bytes: Vec<u8> = part.iter().flat_map(|x| ((f64::from(*x) * gain) as f32).to_le_bytes()).collect();
            file.write_all(&bytes).map_err(|e| Error::write(&path, e))
        })?;
        file.finish()?;
        levels.push(level);
    }
    pending.publish()?;
    Ok(levels)
}

impl DryRecording<'_> {
    // Visits the sound by a response of the same rate, part by part.
    fn visit_sound(&self, response: &[f64], visit: &mut dyn FnMut(&[f32]) -> Result<()>) -> Result<()> {
        let Some(mut convolution) = RecordingConvolution::new(response).filter(|_| self.sample_count > 0) else {
            return Ok(());
        };
        let block = convolution.block_len();
        let step = READ_SAMPLES.next_multiple_of(block) as u64;
        let mut sound = Vec::with_capacity(step as usize);
        for start in (0..self.sample_count).step_by(step as usize) {
            let read = (self.read_block)(start..self.sample_count.min(start + step));
            let part = read.map_err(|source| Error::Dry { source })?;
            sound.clear();
            part.chunks(block).for_each(|dry| convolution.convolve_block(dry, &mut sound));
            visit(&sound)?;
        }
        visit(&convolution.finish())
    }
}

fn signal_energy(signal: &[f32]) -> f64 {
    signal.iter().map(|x| f64::from(*x).powi(2)).sum()
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;

    /// E35: a long recording is read in blocks, and a rate that no converter has is refused before any work.
    #[test]
    fn recordings_are_convolved_in_blocks_at_possible_rates() {
        let home = tempfile::tempdir().expect("a folder");
        let sample_count = 1_000_003u64;
        let dry_sample = |n: u64| ((n * n) % 17) as f32 / 16.0 - 0.5;
        let longest = AtomicU64::new(0);
        let read_block = |range: Range<u64>| {
            longest.fetch_max(range.end - range.start, Ordering::Relaxed);
            Ok(range.map(dry_sample).collect())
        };
        let dry = DryRecording { read_block: &read_block, sample_count, rate_hz: 48_000 };
        let response = ListenedResponse { name: "flat-7", samples: &[1.0, 0.0, 0.5], rate_hz: 48_000 };
        let levels = write_sounds(&home.path().join("sounds"), dry, &[response], false).expect("written");
        assert!(longest.load(Ordering::Relaxed) < 300_000);
        let file = std::fs::read(home.path().join("sounds/flat-7.wav")).expect("a file");
        let sounds: Vec<f32> = file[44..].as_chunks().0.iter().map(|four| f32::from_le_bytes(*four)).collect();
        assert_eq!(sounds.len() as u64, sample_count + 2);
        let gain = 10f64.powf(levels[0].gain_db / 20.0) as f32;
        let at = |n: u64| if n < sample_count { dry_sample(n) } else { 0.0 };
        for (n, sound) in (0..).zip(&sounds) {
            let expected = gain * (at(n) + if n < 2 { 0.0 } else { 0.5 * at(n - 2) });
            assert!((sound - expected).abs() < 1e-5, "{n}: {sound} {expected}");
        }
        let refused = DryRecording { rate_hz: u32::MAX, ..dry };
        let error =
            write_sounds(&home.path().join("bad"), refused, &[response], false).expect_err("a rate").to_string();
        assert!(error.contains("its header says 4294967295 Hz, expected 768000 at most"), "{error}");
        let unread = |_: Range<u64>| Err(ErrorCause::from("cut off"));
        let unread = DryRecording { read_block: &unread, ..dry };
        let error =
            write_sounds(&home.path().join("bad"), unread, &[response], false).expect_err("cut off").to_string();
        assert_eq!(error, "the dry recording: cut off");
        assert!(!home.path().join("bad").exists());
    }
}
