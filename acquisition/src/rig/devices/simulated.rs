//! The simulated rig: computed, never measured, and marked as such in every run it makes ([`Origin::Simulated`]).
//!
//! The room's air drifts over the simulated hours and absorbs; the arms stand beside the points by some hundredths of a
//! millimetre; the panel reflects by Kirchhoff's approximation and its material; the direct sound goes as 1/d; tweeter
//! and microphone have responses and directions; both channels pass the converter; noise is added, and now and then
//! something outside spoils a take. The same seed gives the same bits. [`SimulationParams`] switches effects off.
//! While a take is judged and recorded, another thread computes the response at the next pair, which is used if its
//! inputs are then exactly those that were forecast.

mod panel_reflections;
mod room;

use std::collections::HashMap;
use std::f64::consts::{PI, TAU};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use echolake_dsp::RealSample as _;
use echolake_dsp::air::AirState;
use echolake_dsp::deconvolution::fast_length;
use echolake_dsp::geometry::specular_point;
use echolake_dsp::kirchhoff::{KirchhoffScratch, TransducerPose};
use echolake_panel::material::SurfaceMaterial;
use echolake_panel::relief::HeightField;
use echolake_schema::manifest::Origin;
use echolake_schema::simulation::SimulationParams;
use echolake_schema::{Grid, Pair, PairId, Rig, Timestamp};
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, StandardNormal};
use realfft::num_complex::Complex;
use realfft::{ComplexToReal, RealToComplex};

use crate::rig::robots::{Choreography, Joints, Tool};
use crate::rig::{
    AmbientReading, AmbientSensor, ArmPositions, AudioInterface, AudioTake, DeviceFault, DrivePower, Error, RigDevices,
    RobotArms,
};
pub use panel_reflections::{PairPoses, PanelReflections};
use room::{ResponseAhead, ResponseInputs, SimulatedRoom};

/// Time of one measurement (Rust et al. 2021): moving, settling, sweep.
pub const TAKE_SECS: f64 = 12.3;
/// Gain from pressure at 1 m to full scale: the direct sound at 75 mm stays 9 dB under it.
const MICROPHONE_GAIN: f64 = 0.037;
/// Noise of the channels, rms re full scale: -102 and -108 dB.
const NOISE: [f64; 2] = [8e-6, 4e-6];
/// The drives' noise in the microphone, rms re full scale: 36 dB over its own.
const DRIVES: f64 = 5e-4;
/// Length of the blocks in which an output goes through the room, over that of a response.
const RESPONSES_PER_BLOCK: usize = 8;
/// Samples whose noise is drawn at once.
const NOISE_BLOCK: usize = 256;
/// The converter: a pole above the audio range, and a delay that both channels share.
const CONVERTER_POLE_HZ: f64 = 60_000.0;
const CONVERTER_DELAY: f64 = 37.0;
/// Share of takes that something outside spoils, and how loud it is: dB re 20 uPa outside, rms re full scale inside.
const SPOILED: f64 = 0.004;
const SPOILED_LEVEL_DB: f64 = 78.0;
const SPOILED_NOISE: f64 = 3e-3;
/// Full scale of 24 bits.
const FULL_SCALE: f64 = 8_388_608.0;
/// Seed of the arms' calibration: it is the rig's, not the run's, so that Foam and Flat are measured at the same
/// places.
const CALIBRATION_SEED: u64 = 0xCA11;
/// Told from the seed of noise and air by this.
const PLACES_SEED: u64 = 0x91AC;
/// Standard deviation along each axis of a displacement whose mean length is 1: Maxwell's distribution. Its 90th
/// percentile is 1.57 then; the paper prints 0.17 and 0.28 mm.
const AXIS_PER_MEAN: f64 = 0.626_657;

/// Settings of a simulation.
#[derive(Debug, Clone)]
pub struct RigSimulation<'a> {
    /// The rig.
    pub rig: &'a Rig,
    /// The panel.
    pub relief: &'a HeightField,
    /// Its material.
    pub material: SurfaceMaterial,
    /// Time at which its clock begins.
    pub start: Timestamp,
    /// Seed of drift and noise.
    pub seed: u64,
    /// Joints of the arms at each pair, if a model of them is known.
    pub arms: Option<Arc<Choreography>>,
}

/// State that the devices share. Copies forecast it.
#[derive(Clone)]
struct SimulatedWorld {
    grid: Arc<Grid>,
    arms: Option<Arc<Choreography>>,
    /// The pair after each, in the rig's visiting order.
    followers: Arc<HashMap<PairId, Pair>>,
    /// The pair at which the arms are, if the grid has it in these roles.
    pair: Option<PairId>,
    now: Timestamp,
    start: Timestamp,
    power: DrivePower,
    effects: SimulationParams,
    /// Displacement of the microphone's and the speaker's arm at each point of the grid, mm.
    calibration_mm: Arc<[Vec<[f64; 3]>; 2]>,
    /// Poses of microphone and speaker.
    microphone: TransducerPose,
    speaker: TransducerPose,
    air: Air,
    rng: ChaCha8Rng,
    /// Chance of the arms' places, apart from that of noise and air, so that no effect's switch changes these.
    places: ChaCha8Rng,
    /// Level outside during the last take.
    outside_level_db: f64,
}

/// The air's slow drift.
#[derive(Clone)]
struct Air {
    phase: f64,
    walk: f64,
}

/// The direction of an axis that points at the panel's plane.
const DOWN: [f64; 3] = [0.0, 0.0, -1.0];

type SharedWorld = Arc<Mutex<SimulatedWorld>>;

/// The devices of a simulated rig.
///
/// # Errors
/// [`Error::Device`] if the rig's grid has no points.
pub fn simulated_rig(simulation: &RigSimulation<'_>) -> Result<RigDevices, Error> {
    let failed = |e: echolake_schema::Error| Error::Device {
        device: "simulated rig",
        reason: DeviceFault::with_cause(e.to_string(), e),
    };
    let grid = simulation.rig.build_grid().map_err(failed)?;
    let rate_hz = simulation.rig.sweep.rate_hz.get();
    let room = Arc::new(SimulatedRoom::new(simulation.rig, &grid, simulation.relief, simulation.material));
    let world = Arc::new(Mutex::new(SimulatedWorld::new(simulation, grid)));
    Ok(RigDevices {
        robots: Box::new(SimulatedRobots(world.clone())),
        audio: Box::new(SimulatedAudio {
            world: world.clone(),
            rate_hz,
            scratch: room.plan.make_scratch(),
            ahead: ResponseAhead::start(room.clone()),
            room,
            output: None,
        }),
        sensor: Box::new(SimulatedSensor(world)),
        origin: Origin::Simulated,
    })
}

// Displacements of both arms at each point.
fn draw_calibration(points: usize, mean_mm: f64) -> [Vec<[f64; 3]>; 2] {
    let mut rng = ChaCha8Rng::seed_from_u64(CALIBRATION_SEED);
    let mut axis = || {
        let normal: f64 = StandardNormal.sample(&mut rng);
        AXIS_PER_MEAN * mean_mm * normal
    };
    [(); 2].map(|()| (0..points).map(|_| [axis(), axis(), axis()]).collect())
}

fn lock_world(world: &SharedWorld) -> MutexGuard<'_, SimulatedWorld> {
    world.lock().unwrap_or_else(PoisonError::into_inner)
}

impl SimulatedWorld {
    fn new(simulation: &RigSimulation<'_>, grid: Grid) -> Self {
        let effects = simulation.rig.simulation.clone();
        let mut rng = ChaCha8Rng::seed_from_u64(simulation.seed);
        let mut pairs = grid.pairs().to_vec();
        if let Some(arms) = &simulation.arms {
            arms.sort_pairs(&mut pairs);
        }
        let points = grid.points();
        Self {
            calibration_mm: Arc::new(draw_calibration(points.len(), effects.calibration_mm)),
            effects,
            arms: simulation.arms.clone(),
            followers: Arc::new(pairs.windows(2).map(|pair| (pair[0].id, pair[1])).collect()),
            pair: None,
            now: simulation.start,
            start: simulation.start,
            power: DrivePower::Off,
            microphone: TransducerPose { position_mm: points[0].position_mm, axis: DOWN },
            speaker: TransducerPose { position_mm: points[1].position_mm, axis: DOWN },
            air: Air { phase: rng.random_range(0.0..TAU), walk: 0.0 },
            rng,
            places: ChaCha8Rng::seed_from_u64(simulation.seed ^ PLACES_SEED),
            outside_level_db: 42.0,
            grid: Arc::new(grid),
        }
    }

    fn temperature_c(&self) -> f64 {
        let drift = 0.8 * (TAU * self.elapsed_hours() / 7.0 + self.air.phase).sin() + self.air.walk;
        self.effects.temperature_c + if self.effects.noise_and_drift { drift } else { 0.0 }
    }

    fn humidity_pct(&self) -> f64 {
        self.effects.humidity_pct + 4.0 * (TAU * self.elapsed_hours() / 9.0).sin()
    }

    fn pressure_hpa(&self) -> f64 {
        965.0 + 1.5 * (TAU * self.elapsed_hours() / 20.0).cos()
    }

    fn elapsed_hours(&self) -> f64 {
        (self.now.0 - self.start.0) as f64 / 3.6e12
    }

    fn draw_normal(&mut self) -> f64 {
        if self.effects.noise_and_drift { StandardNormal.sample(&mut self.rng) } else { 0.0 }
    }

    // Where an arm really is that was sent to a point.
    fn displaced_position(&mut self, tool: Tool, point: usize) -> [f64; 3] {
        let told = self.grid.points()[point].position_mm;
        let calibration = self.calibration_mm[tool as usize][point];
        let per_axis = self.effects.repeatability_mm / 3f64.sqrt();
        let mut chance = || -> f64 { StandardNormal.sample(&mut self.places) };
        std::array::from_fn(|i| told[i] + calibration[i] + per_axis * chance())
    }
}

struct SimulatedRobots(SharedWorld);

impl RobotArms for SimulatedRobots {
    fn move_to(&mut self, microphone_mm: [f64; 3], speaker_mm: [f64; 3]) -> Result<ArmPositions, Error> {
        lock_world(&self.0).move_arms(microphone_mm, speaker_mm)
    }

    fn switch_drives(&mut self, power: DrivePower) -> Result<(), Error> {
        lock_world(&self.0).power = power;
        Ok(())
    }
}

impl SimulatedWorld {
    fn move_arms(&mut self, microphone_mm: [f64; 3], speaker_mm: [f64; 3]) -> Result<ArmPositions, Error> {
        let refuse = |reason| Error::Unreachable { microphone_mm, speaker_mm, reason };
        if self.power == DrivePower::Off {
            return Err(refuse("the drives are off"));
        }
        let index = |mm| self.grid.point_at(mm).map(|p| p.id.index());
        let stand = [index(microphone_mm), index(speaker_mm)];
        let [Some(microphone), Some(speaker)] = stand else {
            return Err(refuse("the simulated arms know the grid's points only"));
        };
        let [a, b] = [microphone, speaker].map(|index| self.grid.points()[index].id);
        // The model knows the roles that the grid gives.
        let known = self.grid.pair_id(a, b);
        if known.or_else(|| self.grid.pair_id(b, a)).is_none() {
            return Err(refuse("the arms would touch"));
        }
        let stand = self.arms.as_ref().zip(known).and_then(|(arms, pair)| arms.pose_at(pair).ok());
        let joints = stand.map(|stand| [stand.microphone, stand.speaker]);
        let position_mm =
            [self.displaced_position(Tool::Microphone, microphone), self.displaced_position(Tool::Speaker, speaker)];
        let arms = self.arms.as_deref().zip(joints.as_ref());
        let axes = transducer_axes(arms, microphone_mm, speaker_mm);
        self.pair = known;
        self.microphone = TransducerPose { position_mm: position_mm[0], axis: axes[0] };
        self.speaker = TransducerPose { position_mm: position_mm[1], axis: axes[1] };
        // The encoders' residual, which the controller knows of; of the displacement it does not.
        let mut off = |mm: [f64; 3]| mm.map(|x| x + 0.01 * self.draw_normal().clamp(-2.0, 2.0));
        Ok(ArmPositions { microphone_mm: off(microphone_mm), speaker_mm: off(speaker_mm), joints })
    }
}

// Axes of microphone and speaker: as the arms hold them, or, without a model of the arms, the microphone straight
// down and the speaker at the point that mirrors to it.
fn transducer_axes(
    arms: Option<(&Choreography, &[Joints; 2])>,
    microphone_mm: [f64; 3],
    speaker_mm: [f64; 3],
) -> [[f64; 3]; 2] {
    if let Some((arms, [microphone, speaker])) = arms {
        let cell = arms.cell();
        return [(Tool::Microphone, microphone), (Tool::Speaker, speaker)]
            .map(|(tool, joints)| cell.arm_with_tool(tool).tool_axis(joints));
    }
    let [x, y] = specular_point(microphone_mm, speaker_mm);
    let aim = [x - speaker_mm[0], y - speaker_mm[1], -speaker_mm[2]];
    let length = aim.iter().map(|x| x * x).sum::<f64>().sqrt();
    [DOWN, aim.map(|x| x / length)]
}

struct SimulatedSensor(SharedWorld);

impl AmbientSensor for SimulatedSensor {
    fn read_ambient(&mut self) -> Result<AmbientReading, Error> {
        Ok(lock_world(&self.0).read_air())
    }
}

impl SimulatedWorld {
    fn read_air(&mut self) -> AmbientReading {
        // A resolution of 0.01 C, and as much noise.
        let temperature_c = ((self.temperature_c() + 0.005 * self.draw_normal()) * 100.0).round() / 100.0;
        AmbientReading {
            at: self.now,
            temperature_c,
            humidity_pct: self.humidity_pct() + 0.1 * self.draw_normal(),
            pressure_hpa: self.pressure_hpa() + 0.02 * self.draw_normal(),
            outside_level_db: self.outside_level_db,
        }
    }

    // Whether something outside spoils the take.
    fn begin_take(&mut self) -> bool {
        self.now = self.now.plus_secs(TAKE_SECS);
        self.air.walk += 0.002 * self.draw_normal();
        let is_spoiled = self.effects.noise_and_drift && self.rng.random_bool(SPOILED);
        let level = if is_spoiled { SPOILED_LEVEL_DB } else { 42.0 };
        self.outside_level_db = level + 1.5 * self.draw_normal();
        is_spoiled
    }

    fn response_inputs(&self) -> ResponseInputs {
        let air = AirState {
            temperature_c: self.temperature_c(),
            humidity_pct: self.humidity_pct(),
            pressure_hpa: self.pressure_hpa(),
        };
        ResponseInputs { microphone: self.microphone, speaker: self.speaker, air }
    }

    // The inputs of the next take, if this one is accepted: what the controller does until then, in its order.
    fn forecast_inputs(mut self) -> Option<ResponseInputs> {
        let next = *self.followers.get(&self.pair?)?;
        let [microphone_mm, speaker_mm] =
            [next.microphone, next.speaker].map(|id| self.grid.points()[id.index()].position_mm);
        self.read_air();
        self.power = DrivePower::On;
        self.move_arms(microphone_mm, speaker_mm).ok()?;
        self.begin_take();
        Some(self.response_inputs())
    }
}

struct SimulatedAudio {
    world: SharedWorld,
    rate_hz: f64,
    room: Arc<SimulatedRoom>,
    scratch: KirchhoffScratch,
    /// None if the system gave no thread.
    ahead: Option<ResponseAhead>,
    /// Cache for the last output: a run plays one sweep.
    output: Option<Played>,
}

/// An output, its loopback without noise, and what takes it through the room.
///
/// The loopback is cut into blocks that begin a response's length early: in the product of a block's spectrum and a
/// response's, the rest of the block is what the microphone hears.
struct Played {
    output: Vec<f32>,
    loopback: Vec<f32>,
    /// `[output]`: at the microphone.
    signal: Vec<f32>,
    blocks: Vec<Vec<Complex<f32>>>,
    forward: Arc<dyn RealToComplex<f32>>,
    inverse: Arc<dyn ComplexToReal<f32>>,
    samples: Vec<f32>,
    response: Vec<Complex<f32>>,
    product: Vec<Complex<f32>>,
    work: Vec<Complex<f32>>,
}

impl AudioInterface for SimulatedAudio {
    fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    fn play_and_record(&mut self, output: &[f32], take: &mut AudioTake) -> Result<(), Error> {
        let mut world = lock_world(&self.world);
        let is_spoiled = world.begin_take();
        let inputs = world.response_inputs();
        let failed = |e: echolake_dsp::Error| Error::Device {
            device: "simulated room",
            reason: DeviceFault::with_cause(e.to_string(), e),
        };
        let response = match self.ahead.as_mut().and_then(|ahead| ahead.take_response(&inputs)) {
            Some(response) => response,
            None => self.room.compute_response(&inputs, &mut self.scratch).map_err(failed)?,
        };
        let played = match &mut self.output {
            Some(played) if is_same(&played.output, output) => played,
            other => other.insert(Played::new(output, self.rate_hz, response.len())),
        };
        played.convolve_with(&response);
        let room = if is_spoiled { SPOILED_NOISE } else { NOISE[0] };
        let noise = if world.power == DrivePower::On { room.hypot(DRIVES) } else { room };
        take.started = Some(world.now);
        quantise_signal(&played.signal, MICROPHONE_GAIN, noise, &mut world, &mut take.microphone);
        quantise_signal(&played.loopback, 1.0, NOISE[1], &mut world, &mut take.loopback);
        if let Some(ahead) = &mut self.ahead {
            let world = world.clone();
            ahead.begin_response(Box::new(move || world.forecast_inputs()));
        }
        Ok(())
    }
}

impl Played {
    fn new(output: &[f32], rate_hz: f64, response_len: usize) -> Self {
        // Room for the response and the converter's delay behind the output, so that nothing wraps around.
        let mut converted = convert_output(output, rate_hz, output.len() + response_len + 2 * CONVERTER_DELAY as usize);
        let block_len = RESPONSES_PER_BLOCK * response_len;
        let forward = f32::plan_real_forward(block_len);
        let inverse = f32::plan_real_inverse(block_len);
        let mut work = vec![Complex::default(); forward.get_scratch_len().max(inverse.get_scratch_len())];
        let block = |start: usize| {
            let scale = 1.0 / block_len as f32;
            let early = start + converted.len() - response_len;
            let mut samples: Vec<f32> =
                (early..early + block_len).map(|n| converted[n % converted.len()] * scale).collect();
            let mut spectrum = forward.make_output_vec();
            // Lengths are the plan's own, so the transform cannot refuse.
            let _ = forward.process_with_scratch(&mut samples, &mut spectrum, &mut work);
            spectrum
        };
        let blocks = (0..output.len()).step_by(block_len - response_len).map(block).collect();
        converted.truncate(output.len());
        Self {
            output: output.to_vec(),
            loopback: converted,
            signal: vec![0.0; output.len()],
            blocks,
            samples: forward.make_input_vec(),
            response: forward.make_output_vec(),
            product: inverse.make_input_vec(),
            work,
            forward,
            inverse,
        }
    }

    // `signal` becomes the loopback through this response.
    fn convolve_with(&mut self, response: &[f32]) {
        let Self { signal, blocks, forward, inverse, samples, response: spectrum, product, work, .. } = self;
        samples.fill(0.0);
        samples[..response.len()].copy_from_slice(response);
        // Lengths are the plans' own, so the transforms cannot refuse; they ask for real ends only.
        let _ = forward.process_with_scratch(samples, spectrum, work);
        for (heard, block) in signal.chunks_mut(samples.len() - response.len()).zip(&*blocks) {
            product.iter_mut().zip(block.iter().zip(&*spectrum)).for_each(|(product, (a, b))| *product = a * b);
            product[0].im = 0.0;
            if let Some(last) = product.last_mut() {
                last.im = 0.0;
            }
            let _ = inverse.process_with_scratch(product, samples, work);
            heard.copy_from_slice(&samples[response.len()..][..heard.len()]);
        }
    }
}

// Without an exit at the first difference, so that the loop is compiled into vectors.
fn is_same(a: &[f32], b: &[f32]) -> bool {
    a.len() == b.len() && a.iter().zip(b).fold(true, |is_same, (a, b)| is_same & (a == b))
}

// An output after the converter, with room behind it for `len` samples.
fn convert_output(output: &[f32], rate_hz: f64, len: usize) -> Vec<f32> {
    let len = fast_length(len);
    let mut samples = output.to_vec();
    samples.resize(len, 0.0);
    let forward = f32::plan_real_forward(len);
    let mut spectrum = forward.make_output_vec();
    // Lengths are the plans' own, so the transforms cannot refuse; they ask for real ends only.
    let _ = forward.process(&mut samples, &mut spectrum);
    let last = spectrum.len() - 1;
    for (k, x) in spectrum.iter_mut().enumerate() {
        let hz = k as f64 * rate_hz / len as f64;
        let pole = Complex::new(1.0, hz / CONVERTER_POLE_HZ).inv();
        let delay = Complex::from_polar(1.0, -2.0 * PI * k as f64 * CONVERTER_DELAY / len as f64);
        let response = pole * delay / len as f64;
        *x *= Complex::new(response.re as f32, response.im as f32);
        if k == 0 || k == last {
            x.im = 0.0;
        }
    }
    let _ = f32::plan_real_inverse(len).process(&mut spectrum, &mut samples);
    samples
}

// 24 bits with noise; samples over full scale are clipped. Noise is drawn block by block: the loop behind it has then
// no branches, and is compiled into vectors.
fn quantise_signal(signal: &[f32], gain: f64, noise: f64, world: &mut SimulatedWorld, out: &mut Vec<i32>) {
    out.clear();
    let mut normals = [0.0; NOISE_BLOCK];
    for block in signal.chunks(NOISE_BLOCK) {
        if world.effects.noise_and_drift {
            normals[..block.len()].iter_mut().for_each(|normal| *normal = StandardNormal.sample(&mut world.rng));
        }
        out.extend(block.iter().zip(&normals).map(|(x, normal)| {
            let value = FULL_SCALE * (f64::from(*x) * gain + noise * normal);
            // Rounded: the conversion cuts. `round` is a call for each sample, unless the processor is known.
            (value + 0.5f64.copysign(value)).clamp(-FULL_SCALE, FULL_SCALE - 1.0) as i32
        }));
    }
}

#[cfg(test)]
mod tests {
    use echolake_panel::relief::PanelRelief;

    use super::room::response_len;
    use super::*;
    use crate::rig::conformance;

    fn simulated(seed: u64) -> RigDevices {
        let (rig, relief) = (Rig::paper(), PanelRelief::Flat.height_field(40));
        let start = Timestamp(1_767_600_000_000_000_000);
        let material = SurfaceMaterial::CoatedPrint;
        simulated_rig(&RigSimulation { rig: &rig, relief: &relief, material, start, seed, arms: None })
            .expect("devices")
    }

    #[test]
    fn it_conforms() {
        let mut devices = simulated(1);
        let (near, far) = ([-187.5, -187.5, 124.0], [-187.5, -112.5, 124.0]);
        conformance::check_robots(devices.robots.as_mut(), [near, far], [near, near]);
        conformance::check_robots(devices.robots.as_mut(), [near, far], [near, [0.0, 0.0, 5_000.0]]);
        // One straight over the other: the grid leaves that pair out.
        conformance::check_robots(devices.robots.as_mut(), [near, far], [near, [-187.5, -187.5, 214.0]]);
        conformance::check_audio(devices.audio.as_mut());
        conformance::check_sensor(devices.sensor.as_mut());
        assert_eq!(devices.origin, Origin::Simulated);
    }

    #[test]
    fn drives_are_heard_until_they_are_off() {
        let (mut devices, mut take) = (simulated(1), AudioTake::default());
        let mut noise = |power| {
            devices.robots.switch_drives(power).expect("a switch");
            devices.audio.play_and_record(&[0.0; 4_000], &mut take).expect("a take");
            let sum: f64 = take.microphone.iter().map(|x| (f64::from(*x) / FULL_SCALE).powi(2)).sum();
            (sum / 4_000.0).sqrt()
        };
        // 4,000 samples of white noise tell its rms to about 1 %.
        let (off, on) = (noise(DrivePower::Off), noise(DrivePower::On));
        assert!((off / NOISE[0] - 1.0).abs() < 0.1, "{off}");
        assert!((on / DRIVES - 1.0).abs() < 0.1, "{on}");
    }

    #[test]
    fn responses_hold_the_farthest_echo_at_any_rate() {
        let relief = PanelRelief::Flat.height_field(40);
        let points: Vec<_> =
            Rig::paper().build_grid().expect("a grid").points().iter().map(|p| p.position_mm).collect();
        // From over one corner to the far corner and back, 743.8 mm each way: the third layer's outermost point.
        for rate_hz in [48e3, 96e3, 192e3] {
            let echo = 2.0 * 0.7438 / 331.3 * rate_hz;
            let len = response_len(&relief, &points, rate_hz) as f64;
            assert!(len > echo + 30.0 && len < 2.5 * echo, "{rate_hz}: {len}, {echo}");
        }
    }

    #[test]
    fn the_inputs_of_the_next_take_are_forecast_exactly() {
        let (rig, relief) = (Rig::paper(), PanelRelief::Flat.height_field(40));
        let start = Timestamp(1_767_600_000_000_000_000);
        let material = SurfaceMaterial::CoatedPrint;
        let simulation = RigSimulation { rig: &rig, relief: &relief, material, start, seed: 1, arms: None };
        let grid = rig.build_grid().expect("a grid");
        let mut world = SimulatedWorld::new(&simulation, rig.build_grid().expect("a grid"));
        world.power = DrivePower::On;
        let mut forecast = None;
        for (turn, pair) in grid.pairs()[..3].iter().chain(&grid.pairs()[2..3]).enumerate() {
            let [microphone, speaker] = [pair.microphone, pair.speaker].map(|id| grid.points()[id.index()].position_mm);
            world.move_arms(microphone, speaker).expect("within reach");
            world.begin_take();
            // The third pair is measured again, which nobody expects.
            assert_eq!(forecast == Some(world.response_inputs()), [1, 2].contains(&turn), "{turn}");
            forecast = world.clone().forecast_inputs();
            world.read_air();
        }
    }

    // Each sample as a sum of products, also around the ends of blocks and for outputs that are shorter than one.
    #[test]
    fn an_output_goes_through_the_room_in_blocks() {
        let rate_hz = 96e3;
        let response: Vec<f32> = (0..64).map(|n| ((n * 37) % 19) as f32 / 19.0 - 0.5).collect();
        for len in [100, 448, 449, 1_500] {
            let output: Vec<f32> = (0..len).map(|n| (0.002 * (n * n) as f32).sin()).collect();
            let mut played = Played::new(&output, rate_hz, response.len());
            let converted = convert_output(&output, rate_hz, len + 64 + 2 * CONVERTER_DELAY as usize);
            assert_eq!(played.loopback, converted[..len]);
            for _ in 0..2 {
                played.convolve_with(&response);
                assert_eq!(played.signal.len(), len);
                for (n, heard) in played.signal.iter().enumerate() {
                    let early = |delay: usize| f64::from(converted[(n + converted.len() - delay) % converted.len()]);
                    let terms = response.iter().enumerate().map(|(delay, gain)| f64::from(*gain) * early(delay));
                    let expected = terms.sum::<f64>();
                    assert!((f64::from(*heard) - expected).abs() < 1e-5, "{len}, {n}: {heard}, expected {expected}");
                }
            }
        }
    }

    #[test]
    fn seeds_tell_runs_apart_and_repeat_them() {
        let take = |seed| {
            let (mut devices, mut take) = (simulated(seed), AudioTake::default());
            devices.audio.play_and_record(&[0.5; 500], &mut take).expect("a take");
            take.microphone
        };
        assert_eq!(take(1), take(1));
        assert_ne!(take(1), take(2));
    }
}
