//! Turns the messages of one chunk into impulse responses, verdicts, readings and log lines.

use std::collections::{HashMap, HashSet};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use echolake_dsp::air::AirState;
use echolake_dsp::chain::{MeasurementParams, MeasurementPlan, MeasurementScratch, ResponseCorrection};
use echolake_dsp::room_parameters::is_long_enough;
use echolake_dsp::rounding::{RESPONSE_BITS, round_samples};
use echolake_dsp::temperature::{ReferenceAir, stretch_recording};
use echolake_lake::{Lake, SamplePrecision};
use echolake_recording::{ChunkMessage, DecodedChunk, list_damage};
use echolake_schema::messages::{
    AmbientSample, ImpulseResponse, Measurement, Message as RunMessage, SampleFormat, SweepRecording,
};
use echolake_schema::{Celsius, Rig, samples, topics};
use prost::Message as _;

use super::run_channels::RunChannels;

/// Memory for a run's messages beyond those that its rig implies, bytes: five readings a second for a day, or 100,000
/// lines of log.
const SPARE_BYTES: u64 = 32 << 20;
/// Maximum samples of a recording, unless the rig's own are longer; also of all recordings whose plans are cached.
const LONGEST_RECORDING: usize = 1 << 22;
/// Memory of an empty chunk with a line about its damage, bytes.
const CHUNK_BYTES: u64 = 512;
/// Memory of one more line, bytes.
const LINE_BYTES: u64 = 256;
/// Memory of a short message, bytes.
const MESSAGE_BYTES: u64 = 64;
/// Growth of a verdict in memory: an empty reason takes 2 bytes in its message and 24 in memory.
const VERDICT_GROWTH: u64 = 12;
/// Memory of a usual verdict, bytes.
const VERDICT_BYTES: u64 = 4 << 10;

/// Turns recordings into responses; one for all chunks of all runs.
pub(crate) struct Measurer {
    rig: Rig,
    pairs: u32,
    /// Cache of plans by recording length: a run has one length, an import may have several.
    plans: Mutex<HashMap<usize, Arc<RecordingPlan>>>,
    correction: ResponseCorrection<f32>,
    precision: SamplePrecision,
    /// True if responses are long enough for parameters of rooms, which need them as measured.
    keeps_measured: bool,
    /// Memory of earlier chunks, as many as were in memory at once.
    idle_memory: Mutex<Vec<Vec<u8>>>,
}

/// Memory that the messages of one run may still take, bytes: the chunks of a hostile file can decompress to thousands
/// of times their size.
#[derive(Debug)]
pub(crate) struct RunBudget(AtomicU64);

impl RunBudget {
    /// Takes the memory of an empty chunk.
    pub fn take_chunk(&self) -> Result<(), String> {
        self.take_bytes(CHUNK_BYTES)
    }

    fn take_bytes(&self, bytes: u64) -> Result<(), String> {
        let taken = self.0.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(bytes));
        taken.map(drop).map_err(|_| "the run holds more than ingest has memory for".to_owned())
    }
}

/// The plan of one recording length, and a pool of idle buffers.
struct RecordingPlan {
    plan: MeasurementPlan<f32>,
    idle: Mutex<Vec<MeasurementBuffers>>,
}

struct MeasurementBuffers {
    microphone: Vec<f32>,
    loopback: Vec<f32>,
    scratch: MeasurementScratch<f32>,
}

impl RecordingPlan {
    fn with_buffers<T>(&self, len: usize, work: impl FnOnce(&mut MeasurementBuffers) -> T) -> T {
        let idle = || self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        let found = idle().pop();
        let mut buffers = found.unwrap_or_else(|| MeasurementBuffers {
            microphone: vec![0.0; len],
            loopback: vec![0.0; len],
            scratch: self.plan.make_scratch(),
        });
        let done = work(&mut buffers);
        idle().push(buffers);
        done
    }
}

/// Results of one chunk.
#[derive(Debug, Default)]
pub(crate) struct ChunkResults {
    pub responses: Vec<Response>,
    pub verdicts: Vec<(i64, Measurement)>,
    pub readings: Vec<(i64, AmbientSample)>,
    pub events: Vec<(i64, Event)>,
    /// Descriptions of what could not be read.
    pub damaged: Vec<String>,
    pub last_time_ns: i64,
}

/// One impulse response at the reference temperature, cropped.
#[derive(Debug, Clone)]
pub(crate) struct Response {
    pub pair: u32,
    pub attempt: u32,
    pub log_time_ns: i64,
    pub chunk_offset: u64,
    pub air: AirState,
    pub source: ResponseSource,
    pub ir: Vec<f32>,
    /// The same without the correction of its temperature, if it is long enough for a room and known.
    pub measured: Option<Vec<f32>>,
}

/// Origin of a response; the greater is preferred.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum ResponseSource {
    Corrected,
    Ir,
    Sweep,
}

impl ResponseSource {
    pub fn label(self) -> &'static str {
        match self {
            Self::Corrected => "corrected",
            Self::Ir => "ir",
            Self::Sweep => "sweep",
        }
    }
}

/// A log line: the fields of foxglove.Log that the tables store, with their field numbers.
#[derive(Clone, PartialEq, prost::Message)]
pub(crate) struct Event {
    #[prost(int32, tag = "2")]
    pub level: i32,
    #[prost(string, tag = "3")]
    pub message: String,
    #[prost(string, tag = "4")]
    pub name: String,
}

impl Event {
    /// Returns the name of the line's foxglove.Log level.
    pub fn level_name(&self) -> &'static str {
        ["unknown", "debug", "info", "warning", "error", "fatal"]
            .get(usize::try_from(self.level).unwrap_or(0))
            .copied()
            .unwrap_or("unknown")
    }
}

impl Measurer {
    pub fn new(lake: &Lake) -> Self {
        let response = &lake.rig().impulse_response;
        Self {
            rig: lake.rig().clone(),
            pairs: lake.grid().pairs().len() as u32,
            plans: Mutex::default(),
            correction: ResponseCorrection::new(ReferenceAir::from_response(response), response.division),
            precision: lake.config().samples,
            keeps_measured: is_long_enough(response.length, lake.rig().sweep.rate_hz.get()),
            idle_memory: Mutex::default(),
        }
    }

    /// Takes memory for a chunk, that of an earlier one if there is any.
    pub fn take_memory(&self) -> Vec<u8> {
        self.idle_memory.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default()
    }

    /// Keeps a chunk's memory for [`Self::take_memory`].
    pub fn return_memory(&self, memory: Vec<u8>) {
        if memory.capacity() > 0 {
            self.idle_memory.lock().unwrap_or_else(PoisonError::into_inner).push(memory);
        }
    }

    /// Returns the budget of one run: every pair may have its attempts, each recorded and as a response.
    pub fn run_budget(&self) -> RunBudget {
        let attempts = u64::from(self.pairs) * u64::from(self.rig.validation.attempts);
        RunBudget(AtomicU64::new(SPARE_BYTES + attempts * (2 * self.response_bytes() + VERDICT_BYTES)))
    }

    fn response_bytes(&self) -> u64 {
        let lists = if self.keeps_measured { 2 } else { 1 };
        2 * MESSAGE_BYTES + lists * 4 * self.rig.impulse_response.length as u64
    }

    /// Reads all messages of a chunk, within the run's budget. A damaged message is reported and skipped.
    pub fn process_chunk(
        &self,
        offset: u64,
        chunk: &DecodedChunk,
        channels: &RunChannels,
        budget: &RunBudget,
    ) -> ChunkResults {
        let mut out = ChunkResults { last_time_ns: i64::MIN, ..ChunkResults::default() };
        if let Err(reason) = chunk.check_records() {
            out.damaged.push(format!("the chunk at byte {offset}: {reason}; what is before it is read"));
        }
        let mut swept = HashSet::new();
        for message in chunk.messages() {
            out.last_time_ns = out.last_time_ns.max(message.log_time_ns);
            let Some(channel) = channels.get(&message.channel) else {
                // Its chunk waited for the summary, which does not have the channel either.
                if out.damaged.is_empty() || budget.take_bytes(LINE_BYTES).is_ok() {
                    list_damage(&mut out.damaged, || {
                        format!("a message of channel {}, which nothing introduces", message.channel)
                    });
                }
                continue;
            };
            let length = message.data.len() as u64;
            let memory = match channel.topic.as_str() {
                topics::SWEEP | topics::IR => self.response_bytes(),
                topics::MEASUREMENT => MESSAGE_BYTES + length * VERDICT_GROWTH,
                topics::ENVIRONMENT => MESSAGE_BYTES,
                topics::LOG => MESSAGE_BYTES + length,
                _ => continue,
            };
            let taken = budget.take_bytes(memory).and_then(|()| match channel.topic.as_str() {
                topics::SWEEP => decode_message::<SweepRecording>(&channel.schema, chunk.share_bytes(message.data))
                    .and_then(|s| self.measure_sweep(offset, &message, &s))
                    .map(|response| {
                        swept.extend(response.iter().map(|r| (r.pair, r.attempt)));
                        out.responses.extend(response);
                    }),
                topics::IR => decode_message::<ImpulseResponse>(&channel.schema, chunk.share_bytes(message.data))
                    .and_then(|i| self.convert_ir(offset, &message, &i, &swept))
                    .map(|r| out.responses.extend(r)),
                topics::MEASUREMENT => decode_message::<Measurement>(&channel.schema, chunk.share_bytes(message.data))
                    .and_then(|m| self.known_pair(m.pair_id).map(|()| m))
                    .map(|m| out.verdicts.push((message.log_time_ns, m))),
                topics::ENVIRONMENT => {
                    decode_message::<AmbientSample>(&channel.schema, chunk.share_bytes(message.data))
                        .map(|a| out.readings.push((message.log_time_ns, a)))
                }
                topics::LOG => Event::decode(message.data)
                    .map_err(|e| e.to_string())
                    .map(|e| out.events.push((message.log_time_ns, e))),
                _ => Ok(()),
            });
            if let Err(reason) = taken
                && (out.damaged.is_empty() || budget.take_bytes(LINE_BYTES).is_ok())
            {
                list_damage(&mut out.damaged, || {
                    format!("a message of `{}` at {} ns: {reason}", channel.topic, message.log_time_ns)
                });
            }
        }
        out
    }

    // None if the loopback is silent: the recording is intact, and its attempt was rejected for the silence.
    fn measure_sweep(
        &self,
        chunk_offset: u64,
        message: &ChunkMessage<'_>,
        sweep: &SweepRecording,
    ) -> Result<Option<Response>, String> {
        self.known_pair(sweep.pair_id)?;
        self.known_rate(sweep.sample_rate_hz)?;
        let air = checked_air(sweep.temperature_c, sweep.humidity_pct, sweep.pressure_hpa)?;
        let format = SampleFormat::try_from(sweep.format).unwrap_or_default();
        let count = sweep.sample_count as usize;
        check_bytes(format, count, &sweep.microphone)?;
        check_bytes(format, count, &sweep.loopback)?;
        let planned = self.recording_plan(count)?;
        let length = self.rig.impulse_response.length;
        let mut ir = vec![0.0; length];
        let mut measured = self.keeps_measured.then(|| vec![0.0; length]);
        let is_measured = planned.with_buffers(count, |buffers| {
            let MeasurementBuffers { microphone, loopback, scratch } = buffers;
            samples::decode_samples(format, &sweep.microphone, microphone).map_err(|e| e.to_string())?;
            samples::decode_samples(format, &sweep.loopback, loopback).map_err(|e| e.to_string())?;
            stretch_recording(microphone, sweep.playing_clock_ppm());
            let of_room = match &mut measured {
                Some(samples) => planned.plan.compute_measured(microphone, loopback, samples, scratch),
                None => Ok(()),
            };
            match of_room.and_then(|()| planned.plan.compute_ir(microphone, loopback, &air, &mut ir, scratch)) {
                Ok(()) => Ok(true),
                Err(echolake_dsp::Error::NoLoopback) => Ok(false),
                Err(e) => Err(e.to_string()),
            }
        });
        if !is_measured? {
            return Ok(None);
        }
        self.round_response(&mut ir);
        measured.iter_mut().for_each(|samples| self.round_response(samples));
        Ok(Some(Response {
            pair: sweep.pair_id,
            attempt: sweep.attempt,
            log_time_ns: message.log_time_ns,
            chunk_offset,
            air,
            source: ResponseSource::Sweep,
            ir,
            measured,
        }))
    }

    // None if the chunk has its recording, too, which is preferred: then the response is only checked.
    fn convert_ir(
        &self,
        chunk_offset: u64,
        message: &ChunkMessage<'_>,
        given: &ImpulseResponse,
        swept: &HashSet<(u32, u32)>,
    ) -> Result<Option<Response>, String> {
        self.known_pair(given.pair_id)?;
        self.known_rate(given.sample_rate_hz)?;
        let air = checked_air(given.temperature_c, given.humidity_pct, given.pressure_hpa)?;
        if let Some(at) = given.samples.iter().position(|x| !x.is_finite()) {
            return Err(format!("sample {at} is {}", given.samples[at]));
        }
        let length = self.rig.impulse_response.length;
        let mut ir = vec![0.0; length];
        let mut measured = None;
        let source = if given.temperature_corrected {
            let kept = given
                .samples
                .get(..length)
                .ok_or_else(|| format!("it has {} samples, the lake's responses have {length}", given.samples.len()))?;
            ir.copy_from_slice(kept);
            ResponseSource::Corrected
        } else if swept.contains(&(given.pair_id, given.attempt)) {
            return Ok(None);
        } else {
            self.correction.correct_response(&given.samples, &air, &mut ir);
            measured = self.keeps_measured.then(|| {
                let mut samples: Vec<f32> = given.samples.iter().copied().take(length).collect();
                samples.resize(length, 0.0);
                samples
            });
            ResponseSource::Ir
        };
        self.round_response(&mut ir);
        measured.iter_mut().for_each(|samples| self.round_response(samples));
        Ok(Some(Response {
            pair: given.pair_id,
            attempt: given.attempt,
            log_time_ns: message.log_time_ns,
            chunk_offset,
            air,
            source,
            ir,
            measured,
        }))
    }

    // Before anything is derived from it, so that what is derived later from the table is the same.
    fn round_response(&self, ir: &mut [f32]) {
        if self.precision == SamplePrecision::Rounded {
            round_samples(ir, RESPONSE_BITS);
        }
    }

    fn recording_plan(&self, recording_len: usize) -> Result<Arc<RecordingPlan>, String> {
        let longest = LONGEST_RECORDING.max(4 * self.rig.recording_len());
        if recording_len > longest {
            return Err(format!("it has {recording_len} samples, more than {longest}"));
        }
        let mut plans = self.plans.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(plan) = plans.get(&recording_len) {
            return Ok(plan.clone());
        }
        if plans.keys().sum::<usize>() + recording_len > longest {
            plans.clear();
        }
        let plan = MeasurementPlan::new(&MeasurementParams {
            recording_len,
            ir_len: self.rig.impulse_response.length,
            rate_hz: self.rig.sweep.rate_hz.get(),
            low_hz: self.rig.sweep.low_hz,
            high_hz: self.rig.sweep.high_hz,
            division: self.rig.impulse_response.division,
            reference: ReferenceAir::from_response(&self.rig.impulse_response),
        });
        let plan = Arc::new(RecordingPlan { plan: plan.map_err(|e| e.to_string())?, idle: Mutex::default() });
        plans.insert(recording_len, plan.clone());
        Ok(plan)
    }

    fn known_pair(&self, pair: u32) -> Result<(), String> {
        if pair < self.pairs { Ok(()) } else { Err(format!("pair {pair}, but the rig has {}", self.pairs)) }
    }

    fn known_rate(&self, rate_hz: f64) -> Result<(), String> {
        let expected = self.rig.sweep.rate_hz.get();
        if rate_hz == expected { Ok(()) } else { Err(format!("sampled at {rate_hz} Hz, the lake's rig at {expected}")) }
    }
}

// Humidity and pressure are those of the reference air if the recorder did not know them.
fn checked_air(celsius: f64, humidity_pct: Option<f64>, pressure_hpa: Option<f64>) -> Result<AirState, String> {
    let celsius = Celsius::new(celsius).map_err(|e| e.to_string())?.get();
    let known = AirState::with_known(celsius, humidity_pct, pressure_hpa);
    let given = AirState {
        temperature_c: celsius,
        humidity_pct: humidity_pct.unwrap_or(known.humidity_pct),
        pressure_hpa: pressure_hpa.unwrap_or(known.pressure_hpa),
    };
    given.check_moisture().map(|()| given).map_err(|e| e.to_string())
}

// Does not copy the samples: they stay in the chunk.
fn decode_message<M: RunMessage>(schema: &str, data: Bytes) -> Result<M, String> {
    if schema != M::FULL_NAME {
        return Err(format!("its schema is `{schema}`, expected `{}`", M::FULL_NAME));
    }
    M::decode(data).map_err(|e| e.to_string())
}

// The count comes from the file: checked against the bytes before anything is allocated for it.
fn check_bytes(format: SampleFormat, count: usize, bytes: &[u8]) -> Result<(), String> {
    let width = format.sample_bytes().ok_or("its sample format is unknown")?;
    match count.checked_mul(width) == Some(bytes.len()) {
        true => Ok(()),
        false => Err(format!("it has {} bytes for {count} samples of {width}", bytes.len())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shared_samples_are_those_of_the_message() {
        let sent = SweepRecording {
            pair_id: 1,
            attempt: 2,
            sample_rate_hz: 96e3,
            sample_count: 3,
            format: SampleFormat::S24le.into(),
            microphone: vec![4; 9].into(),
            loopback: vec![5; 9].into(),
            temperature_c: 6.5,
            ..SweepRecording::default()
        };
        let chunk = Bytes::from(sent.encode_to_vec());
        let received: SweepRecording =
            decode_message(SweepRecording::FULL_NAME, chunk.clone()).expect("the same message");
        assert_eq!(received, sent);
        for samples in [&received.microphone, &received.loopback] {
            assert!(chunk.as_ptr_range().contains(&samples.as_ptr()), "they are copied");
        }
    }

    #[test]
    fn counts_that_the_bytes_do_not_bear_out_are_refused() {
        assert!(check_bytes(SampleFormat::S24le, 2, &[0; 6]).is_ok());
        assert!(check_bytes(SampleFormat::S24le, 2, &[0; 5]).is_err());
        assert!(check_bytes(SampleFormat::S24le, usize::MAX, &[0; 5]).is_err());
        assert!(check_bytes(SampleFormat::Unspecified, 0, &[]).is_err());
    }
}
