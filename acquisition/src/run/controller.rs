//! The run controller: moves, powers off, plays, records, reads the air, validates, and tries again.

mod attempt;
mod error;
#[cfg(test)]
mod fault_tests;
#[cfg(test)]
mod tests;
pub(crate) mod watch;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use echolake_dsp::chain::raw_len;
use echolake_dsp::deconvolution::{DeconvolutionParams, TransformLength};
use echolake_dsp::response_deconvolution::{ResponseDeconvolution, ResponseScratch};
use echolake_dsp::sweep::SineSweep;
use echolake_dsp::temperature::ReferenceAir;
use echolake_schema::manifest::{Origin, RunEnd};
use echolake_schema::messages::{Measurement, Verdict};
use echolake_schema::{Grid, Pair, Rig, Timestamp};

use crate::rig::{AudioTake, DrivePower, RigDevices};
use crate::run::assessment::TakeAssessor;
use crate::run::recorder::{LogLevel, PairAttempts, Recorder};
pub use crate::run::recording_mode::RecordingMode;
pub use error::Error;
use watch::RunMonitor;

/// Source name of the controller's log entries.
const NAME: &str = "controller";
/// Interval at which a paused run checks whether to continue.
const PAUSE_LOOKS: Duration = Duration::from_millis(50);

/// Recording settings of a run.
#[derive(Debug, Clone, Copy)]
pub struct RunOptions {
    /// Recorded messages.
    pub keep: RecordingMode,
    /// Pairs between two checkpoints: a power cut may cost these. A real rig takes 1, 12 s each.
    pub checkpoint_every: usize,
}

/// Pairs and settings of a run.
#[derive(Debug, Clone, Copy)]
pub struct RunWorkload<'a> {
    /// The pairs, in their order.
    pub pairs: &'a [Pair],
    /// Earlier attempts by pair id, if the run is resumed: accepted pairs are skipped.
    pub before: &'a BTreeMap<u32, PairAttempts>,
    /// Recording settings.
    pub options: RunOptions,
}

/// Flags with which any thread can stop or pause a run.
#[derive(Debug, Default)]
pub struct RunControl {
    /// The run ends after the current pair.
    pub stop: AtomicBool,
    /// The run waits after the current pair, for as long as this is true.
    pub pause: AtomicBool,
}

/// An event in a run, as the observer gets it.
#[derive(Debug, Clone, Copy)]
pub enum RunEvent<'a> {
    /// The arms go to a pair.
    Pair(Pair),
    /// An attempt was made; it is not on the disk yet.
    Attempt(&'a Measurement),
    /// These verdicts are on the disk, with all they rest on: they survive a power cut. A measurement may be
    /// acknowledged only from here on.
    Safe {
        /// The verdicts since the checkpoint before.
        verdicts: &'a [Measurement],
        /// Pairs with an accepted measurement, those from before among them.
        accepted: u64,
        /// Cost of recording so far.
        cost: crate::run::recorder::Cost,
    },
    /// The run is paused.
    Paused,
    /// The run continues.
    Continued,
}

/// Result of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RunOutcome {
    /// Counts and end time, as written to its file.
    pub end: RunEnd,
    /// Pairs that were not tried, because it was stopped.
    pub left: usize,
}

/// Measures runs with one rig.
pub struct RunController<'a> {
    rig: &'a Rig,
    grid: Grid,
    devices: RigDevices,
    output: Vec<f32>,
    deconvolution: ResponseDeconvolution<f32>,
    scratch: ResponseScratch<f32>,
    assessor: TakeAssessor,
    take: AudioTake,
    /// The second take of the pair, if the rig makes two.
    repeat: AudioTake,
    /// The whole response of the first one.
    first_response: Vec<f32>,
    microphone: Vec<f32>,
    loopback: Vec<f32>,
    ir: Vec<f32>,
}

/// State of a run in progress.
struct RunProgress<'r> {
    recorder: &'r mut Recorder,
    options: RunOptions,
    tried: BTreeMap<u32, PairAttempts>,
    attempts: u64,
    ended: Timestamp,
    watch: RunMonitor,
    /// Verdicts since the last checkpoint.
    unsafe_verdicts: Vec<Measurement>,
    /// Pairs since the last checkpoint.
    unsafe_pairs: usize,
}

impl<'a> RunController<'a> {
    /// Plans for this rig.
    ///
    /// # Errors
    /// [`Error::Plan`] if its settings contradict each other, [`Error::Rate`] if the interface's rate is not the rig's.
    pub fn new(rig: &'a Rig, devices: RigDevices) -> Result<Self, Error> {
        let failed = |cause| Error::Plan { rig: rig.name.clone(), cause };
        let (sweep, recording_len) = (&rig.sweep, rig.recording_len());
        let (expected_hz, actual_hz) = (sweep.rate_hz.get(), devices.audio.rate_hz());
        if actual_hz != expected_hz {
            return Err(Error::Rate { rig: rig.name.clone(), expected_hz, actual_hz });
        }
        let reference = ReferenceAir::from_response(&rig.impulse_response);
        let deconvolution = ResponseDeconvolution::new(DeconvolutionParams {
            recording_len,
            output_len: raw_len(rig.impulse_response.length, &reference).min(recording_len),
            rate_hz: sweep.rate_hz.get(),
            low_hz: sweep.low_hz,
            high_hz: sweep.high_hz,
            division: rig.impulse_response.division,
            taper_hz: rig.taper_hz(),
            length: TransformLength::Fast,
        })
        .map_err(failed)?;
        let gain = 10f64.powf(sweep.level_dbfs / 20.0);
        let mut output: Vec<f32> =
            SineSweep::from_rig(sweep).samples().into_iter().map(|x| (gain * x) as f32).collect();
        output.resize(recording_len, 0.0);
        Ok(Self {
            rig,
            grid: rig.build_grid()?,
            devices,
            output,
            scratch: deconvolution.make_scratch(),
            ir: vec![0.0; deconvolution.output_len()],
            deconvolution,
            assessor: TakeAssessor::new(rig, recording_len).map_err(failed)?,
            take: AudioTake::default(),
            repeat: AudioTake::default(),
            first_response: Vec::new(),
            microphone: Vec::new(),
            loopback: Vec::new(),
        })
    }

    /// The rig.
    pub fn rig(&self) -> &'a Rig {
        self.rig
    }

    /// Returns the origin of the devices' data: measured or simulated.
    pub fn origin(&self) -> Origin {
        self.devices.origin
    }

    /// Measures the pairs in their order, and passes events to `observe`. On a request through `control` the run pauses
    /// or ends after the current pair; all that was measured is on the disk then. Finishing the recording is the
    /// caller's.
    ///
    /// # Errors
    /// [`Error`]; what was recorded before is kept, the log says at which pair it broke off, and the drives are off if
    /// they can be.
    pub fn run(
        &mut self,
        recorder: &mut Recorder,
        work: &RunWorkload<'_>,
        control: &RunControl,
        observe: &mut dyn FnMut(RunEvent<'_>),
    ) -> Result<RunOutcome, Error> {
        let begun = self.read_ambient()?;
        let watch = RunMonitor::new(recorder.partial(), begun.at);
        let (tried, options) = (work.before.clone(), work.options);
        let attempts = tried.values().map(|t| u64::from(t.attempts)).sum();
        let (unsafe_verdicts, unsafe_pairs) = (Vec::new(), 0);
        let mut run =
            RunProgress { recorder, options, tried, attempts, ended: begun.at, watch, unsafe_verdicts, unsafe_pairs };
        let todo: Vec<Pair> = work.pairs.iter().filter(|p| !run.is_accepted(p.id.0)).copied().collect();
        let (left_out, of) = (work.pairs.len() - todo.len(), work.pairs.len());
        let what = if work.before.is_empty() {
            format!("{of} pairs with rig {}, {}", self.rig.name, self.devices.origin.label())
        } else {
            format!("resumed: {left_out} of {of} pairs are measured already")
        };
        run.say(LogLevel::Info, &what)?;
        for (done, pair) in todo.iter().enumerate() {
            if self.is_to_stop(&mut run, control, observe)? {
                let left = todo.len() - done;
                run.say(LogLevel::Warning, &format!("stopped by hand with {left} of {of} pairs left"))?;
                run.checkpoint(observe)?;
                return Ok(RunOutcome { end: run.end(), left });
            }
            observe(RunEvent::Pair(*pair));
            let measured = self.measure(&mut run, *pair, observe);
            if let Err(error) = measured.and_then(|()| run.pair_done(observe)) {
                return Err(self.broken_off(&mut run, *pair, error, observe));
            }
        }
        let end = run.end();
        let RunEnd { accepted, rejected, attempts, .. } = end;
        run.say(LogLevel::Info, &format!("{accepted} pairs accepted, {rejected} given up, {attempts} attempts"))?;
        run.checkpoint(observe)?;
        Ok(RunOutcome { end, left: 0 })
    }

    // Waits while the run is paused.
    fn is_to_stop(
        &mut self,
        run: &mut RunProgress<'_>,
        control: &RunControl,
        observe: &mut dyn FnMut(RunEvent<'_>),
    ) -> Result<bool, Error> {
        let is_set = |flag: &AtomicBool| flag.load(Ordering::Relaxed);
        if is_set(&control.pause) && !is_set(&control.stop) {
            run.say(LogLevel::Info, "paused by hand")?;
            run.checkpoint(observe)?;
            observe(RunEvent::Paused);
            while is_set(&control.pause) && !is_set(&control.stop) {
                std::thread::sleep(PAUSE_LOOKS);
            }
            observe(RunEvent::Continued);
            run.ended = run.ended.max(self.read_ambient()?.at);
            run.say(LogLevel::Info, "continued by hand")?;
        }
        Ok(is_set(&control.stop))
    }

    fn broken_off(
        &mut self,
        run: &mut RunProgress<'_>,
        pair: Pair,
        error: Error,
        observe: &mut dyn FnMut(RunEvent<'_>),
    ) -> Error {
        // The caller must get the first failure; that these fail after it too would only hide it.
        let _ = self.devices.robots.switch_drives(DrivePower::Off);
        let told = run.say(LogLevel::Error, &format!("broken off at pair {}: {error}", pair.id.0));
        let _ = told.and_then(|()| run.checkpoint(observe));
        error
    }

    fn measure(
        &mut self,
        run: &mut RunProgress<'_>,
        pair: Pair,
        observe: &mut dyn FnMut(RunEvent<'_>),
    ) -> Result<(), Error> {
        let before = run.tried.get(&pair.id.0).map_or(0, |t| t.attempts);
        let mut objections = Vec::new();
        for attempt in 1..=self.rig.validation.attempts {
            // What is not on the disk yet must fit, and the attempt that is made next.
            run.watch.check_disk(run.recorder.bytes_to_end() + run.options.keep.attempt_bytes(self.rig))?;
            let is_last = attempt == self.rig.validation.attempts;
            let mut made = self.attempt_pair(run, pair, before + attempt, is_last)?;
            run.watch.note_time(made.at)?;
            self.record_attempt(run, &made)?;
            run.attempts += 1;
            run.ended = made.at.plus_secs(self.output.len() as f64 / self.rig.sweep.rate_hz.get());
            observe(RunEvent::Attempt(&made.measurement));
            let verdict = made.measurement.verdict();
            objections = std::mem::take(&mut made.objections);
            let accepted = verdict == Verdict::Accepted;
            run.tried.insert(pair.id.0, PairAttempts { attempts: before + attempt, accepted });
            run.unsafe_verdicts.push(made.measurement);
            if accepted {
                run.watch.note_accepted();
                return Ok(());
            }
            if verdict == Verdict::Rejected {
                break;
            }
        }
        run.watch.given_up(&objections)
    }
}

impl RunProgress<'_> {
    fn is_accepted(&self, pair: u32) -> bool {
        self.tried.get(&pair).is_some_and(|t| t.accepted)
    }

    fn end(&self) -> RunEnd {
        let accepted = self.tried.values().filter(|t| t.accepted).count();
        let rejected = (self.tried.len() - accepted) as u64;
        RunEnd { ended: self.ended, accepted: accepted as u64, rejected, attempts: self.attempts }
    }

    fn say(&mut self, level: LogLevel, what: &str) -> Result<(), Error> {
        Ok(self.recorder.log(self.ended, level, NAME, what)?)
    }

    fn pair_done(&mut self, observe: &mut dyn FnMut(RunEvent<'_>)) -> Result<(), Error> {
        self.unsafe_pairs += 1;
        if self.unsafe_pairs < self.options.checkpoint_every {
            return Ok(());
        }
        self.checkpoint(observe)
    }

    // A verdict is reported only after the disk has it.
    fn checkpoint(&mut self, observe: &mut dyn FnMut(RunEvent<'_>)) -> Result<(), Error> {
        self.recorder.checkpoint()?;
        self.unsafe_pairs = 0;
        let verdicts = std::mem::take(&mut self.unsafe_verdicts);
        let accepted = self.tried.values().filter(|t| t.accepted).count() as u64;
        observe(RunEvent::Safe { verdicts: &verdicts, accepted, cost: self.recorder.cost() });
        Ok(())
    }
}
