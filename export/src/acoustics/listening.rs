//! Sounds of surfaces: a dry recording, convolved with responses at full scale.

use std::path::Path;

use echolake_dsp::auralization::{convolve_recording, resample_response};
use echolake_dsp::level::power_to_db;
use echolake_schema::messages::SampleFormat;
use echolake_schema::samples::encode_wav;
use serde::Serialize;

use crate::error::{Error, Result};
use crate::output::PendingFolder;

/// Greatest sample of the loudest sound, as a fraction of full scale: -1 dB.
const GREATEST_SAMPLE: f64 = 0.891;

/// A recording without a room.
#[derive(Debug, Clone, Copy)]
pub struct DryRecording<'a> {
    /// Fractions of full scale.
    pub samples: &'a [f32],
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
/// [`Error::Nothing`] if a sound is silent, and others; nothing is left behind.
pub fn write_sounds(
    folder: &Path,
    dry: DryRecording<'_>,
    responses: &[ListenedResponse<'_>],
    match_levels: bool,
) -> Result<Vec<SoundLevel>> {
    let mut sounds = Vec::new();
    for response in responses {
        let resampled = resample_response(response.samples, response.rate_hz, dry.rate_hz);
        let sound = convolve_recording(dry.samples, &resampled);
        let energy = signal_energy(&sound);
        if energy == 0.0 || !energy.is_finite() {
            return Err(Error::Nothing { reason: format!("the sound of {} has no energy", response.name) });
        }
        let level = SoundLevel {
            file: format!("{}.wav", response.name),
            response_db: power_to_db(signal_energy(response.samples)),
            sound_db: power_to_db(energy),
            gain_db: 0.0,
        };
        sounds.push((level, sound));
    }
    let Some(first_db) = sounds.first().map(|(level, _)| level.sound_db) else { return Ok(Vec::new()) };
    let mut peak_db = f64::NEG_INFINITY;
    for (level, sound) in &mut sounds {
        level.gain_db = if match_levels { first_db - level.sound_db } else { 0.0 };
        let peak = sound.iter().fold(0.0f32, |most, x| most.max(x.abs()));
        peak_db = peak_db.max(power_to_db(f64::from(peak).powi(2)) + level.gain_db);
    }
    let pending = PendingFolder::create(folder)?;
    let mut levels = Vec::new();
    for (mut level, sound) in sounds {
        level.gain_db += power_to_db(GREATEST_SAMPLE.powi(2)) - peak_db;
        let gain = 10f64.powf(level.gain_db / 20.0);
        let bytes: Vec<u8> = sound.iter().flat_map(|x| ((f64::from(*x) * gain) as f32).to_le_bytes()).collect();
        let path = pending.final_path(&level.file);
        let file = encode_wav(SampleFormat::F32le, dry.rate_hz, &[&bytes]).map_err(|e| Error::write(&path, e))?;
        pending.write_file(&level.file, &file)?;
        levels.push(level);
    }
    pending.publish()?;
    Ok(levels)
}

fn signal_energy(signal: &[f32]) -> f64 {
    signal.iter().map(|x| f64::from(*x).powi(2)).sum()
}
