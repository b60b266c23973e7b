//! Recordings as WAV files, microphone and loopback in one, with a manifest that `import wav` takes back.

use std::collections::BTreeMap;
use std::path::Path;

use echolake_lake::Lake;
use echolake_schema::interchange::WAV_MANIFEST;
use echolake_schema::messages::{Measurement, SweepRecording};
use echolake_schema::samples::encode_wav;
use echolake_schema::{Timestamp, topics};
use prost::Message as _;

use crate::error::{Error, Result};
use crate::output::PendingFolder;
use crate::slice::{Check, Measured, Taken, open_runs};

/// Writes the recordings of measurements and a `manifest.csv` into a new folder; returns the number of recordings.
/// `progress` is called with the number of recordings done and their total.
///
/// # Errors
/// [`Error::Nothing`] if a run was recorded without sweeps, and others; nothing is left behind.
pub async fn write_wav(
    lake: &Lake,
    folder: &Path,
    taken: &[Taken],
    check: Check,
    progress: &mut (dyn FnMut(usize, usize) + Send),
) -> Result<usize> {
    let mut runs = open_runs(lake, taken, check).await?;
    let pending = PendingFolder::create(folder)?;
    let mut manifest = csv::Writer::from_writer(Vec::new());
    let failed = |e: csv::Error| Error::write(&pending.final_path("manifest.csv"), e);
    manifest.write_record(WAV_MANIFEST).map_err(failed)?;
    let mut done = 0;
    for run in &mut runs {
        while let Some(measured) = run.next().await? {
            let recording = WavRecording::from_measured(&measured)?;
            let name = format!(
                "{}/{}-p{:04}-a{}.wav",
                run.surface(),
                run.run(),
                recording.sweep.pair_id,
                recording.sweep.attempt
            );
            let bytes = recording
                .encode_wav()
                .map_err(|reason| Error::damaged(run.file(), format!("pair {}: {reason}", recording.sweep.pair_id)))?;
            pending.write_file(&name, &bytes)?;
            let row = recording.table_row(lake, run.surface().as_str(), &name).ok_or_else(|| {
                Error::damaged(run.file(), format!("pair {}, which the rig does not have", recording.sweep.pair_id))
            })?;
            manifest.write_record(WAV_MANIFEST.map(|c| row.get(c).map_or("", String::as_str))).map_err(failed)?;
            done += 1;
            progress(done, taken.len());
        }
    }
    let manifest = manifest.into_inner().map_err(|e| Error::write(&pending.final_path("manifest.csv"), e))?;
    pending.write_file("manifest.csv", &manifest)?;
    pending.publish()?;
    Ok(done)
}

/// One measurement's sweep recording and verdict, decoded.
struct WavRecording {
    sweep: SweepRecording,
    verdict: Measurement,
    time_ns: i64,
}

impl WavRecording {
    fn from_measured(measured: &Measured) -> Result<Self> {
        let damaged = |e: prost::DecodeError| Error::damaged(&measured.file, e);
        let Some((time_ns, sweep)) = measured.first_message(topics::SWEEP) else {
            let reason = format!(
                "run {} was recorded without sweeps; hint: export sofa and export npz write its responses",
                measured.run
            );
            return Err(Error::Nothing { reason });
        };
        let verdict =
            measured.first_message(topics::MEASUREMENT).map(|(_, data)| Measurement::decode(data)).transpose();
        let sweep = SweepRecording::decode(sweep).map_err(damaged)?;
        Ok(Self { sweep, verdict: verdict.map_err(damaged)?.unwrap_or_default(), time_ns })
    }

    fn table_row(&self, lake: &Lake, surface: &str, name: &str) -> Option<BTreeMap<&'static str, String>> {
        let pair = lake.grid().pairs().get(self.sweep.pair_id as usize)?;
        let [microphone, speaker] = [pair.microphone, pair.speaker].map(|id| lake.grid().points()[id.index()].label());
        let known = |x: f64| if x.is_finite() { x.to_string() } else { String::new() };
        Some(BTreeMap::from([
            ("surface", surface.to_owned()),
            ("recording", name.to_owned()),
            ("loopback", format!("{name}#2")),
            ("microphone", microphone),
            ("speaker", speaker),
            ("temperature_c", self.sweep.temperature_c.to_string()),
            ("humidity_pct", known(self.verdict.humidity_pct)),
            ("pressure_hpa", known(self.verdict.pressure_hpa)),
            ("recorded_at", Timestamp(self.time_ns).to_string()),
            ("attempt", self.sweep.attempt.to_string()),
        ]))
    }

    // Both channels bit for bit as they were recorded.
    fn encode_wav(&self) -> std::result::Result<Vec<u8>, String> {
        let format = self.sweep.format();
        let width = format.sample_bytes().ok_or("its sample format is unknown")?;
        let count = self.sweep.sample_count as usize;
        for channel in [&self.sweep.microphone, &self.sweep.loopback] {
            if count.checked_mul(width) != Some(channel.len()) {
                return Err(format!("it has {} bytes for {count} samples of {width}", channel.len()));
            }
        }
        let rate_hz = self.sweep.sample_rate_hz.round() as u32;
        encode_wav(format, rate_hz, &[&self.sweep.microphone, &self.sweep.loopback]).map_err(|e| e.to_string())
    }
}

#[cfg(test)]
mod tests {
    use echolake_schema::messages::SampleFormat;

    use super::*;

    #[test]
    fn lengths_that_the_bytes_do_not_bear_out_are_refused() {
        let sweep = SweepRecording {
            sample_count: 9,
            format: SampleFormat::S24le.into(),
            microphone: vec![0; 6].into(),
            ..SweepRecording::default()
        };
        let recording = WavRecording { sweep, verdict: Measurement::default(), time_ns: 0 };
        assert!(recording.encode_wav().is_err_and(|e| e.contains("6 bytes for 9")));
    }
}
