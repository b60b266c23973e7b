//! The simulated room: responses between the two transducers, and that of the take to come, which another thread
//! computes while the last one is judged and recorded.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;

use echolake_dsp::Error;
use echolake_dsp::air::{AirAbsorption, AirState};
use echolake_dsp::geometry::incidence_deg;
use echolake_dsp::kirchhoff::{FacetScattering, KirchhoffPlan, KirchhoffScratch, SoundPath, TransducerPose};
use echolake_dsp::temperature::{ReferenceAir, speed_of_sound};
use echolake_panel::material::{FoamLayer, SurfaceMaterial};
use echolake_panel::relief::HeightField;
use echolake_schema::simulation::SimulationParams;
use echolake_schema::{Grid, Rig};
use realfft::num_complex::Complex;

use crate::rig::devices::transducers;

/// Samples of a response beyond its farthest echo: the band limit rings.
const RINGING: f64 = 32.0;

/// All that a response depends on, apart from the room.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ResponseInputs {
    pub microphone: TransducerPose,
    pub speaker: TransducerPose,
    pub air: AirState,
}

/// Constants of a run.
pub(super) struct SimulatedRoom {
    pub plan: KirchhoffPlan,
    pub reference: ReferenceAir,
    /// Spectra of the direct sound and of the reflection.
    pub direct: Vec<Complex<f32>>,
    pub reflection: Vec<Complex<f32>>,
    /// Foam whose reflection depends on the angle at which a path's mirror image meets its plane.
    pub foam: Option<FoamLayer>,
    /// If true, the air absorbs.
    pub absorbs: bool,
}

impl SimulatedRoom {
    /// The room of a rig with a panel.
    pub fn new(rig: &Rig, grid: &Grid, relief: &HeightField, material: SurfaceMaterial) -> Self {
        let points: Vec<_> = grid.points().iter().map(|p| p.position_mm).collect();
        let rate_hz = rig.sweep.rate_hz.get();
        let effects = &rig.simulation;
        let mut plan = KirchhoffPlan::new(relief, rate_hz, response_len(relief, &points, rate_hz));
        if !effects.steep_facets {
            plan = plan.with_scattering(FacetScattering::FacingTangent);
        }
        if effects.directivity {
            plan = plan.with_directivity(transducers::microphone_directivity, transducers::speaker_directivity);
        }
        let direct = plan.spectrum_at_bins(|hz| {
            let response = if effects.transducer_response { transducers::on_axis_response(hz) } else { 1.0.into() };
            response * resonance_gain(hz, effects)
        });
        let foam =
            FoamLayer { flow_resistivity: effects.foam_flow_resistivity, thickness_mm: effects.foam_thickness_mm };
        let is_foam = material == SurfaceMaterial::MelamineFoam;
        let is_silent = is_foam && !effects.foam_reflection;
        let reflection = plan.spectrum_at_bins(|hz| match effects.material_spectra {
            _ if is_silent => 0.0.into(),
            true => material.reflection_at(hz, 0.0, foam),
            false => material.reflection_factor().into(),
        });
        Self {
            reference: ReferenceAir::from_response(&rig.impulse_response),
            reflection: multiply_spectra(&direct, &reflection),
            direct,
            foam: (is_foam && !is_silent && effects.material_spectra).then_some(foam),
            absorbs: effects.air_absorption,
            plan,
        }
    }

    /// Computes a response.
    ///
    /// # Errors
    /// As [`KirchhoffPlan::compute_response`].
    pub fn compute_response(&self, inputs: &ResponseInputs, scratch: &mut KirchhoffScratch) -> Result<Vec<f32>, Error> {
        let ResponseInputs { microphone, speaker, air } = *inputs;
        let foam = self.foam.map(|foam| {
            let angle_deg = incidence_deg(microphone.position_mm, speaker.position_mm);
            multiply_spectra(&self.direct, &self.plan.spectrum_at_bins(|hz| foam.reflection_at(hz, angle_deg)))
        });
        let absorption = AirAbsorption::new(&air);
        let path = SoundPath {
            microphone,
            speaker,
            speed_of_sound_m_s: self.reference.speed_in(&air),
            absorption_db_per_m: &|hz| if self.absorbs { absorption.db_per_m(hz) } else { 0.0 },
            direct: &self.direct,
            reflection: foam.as_ref().unwrap_or(&self.reflection),
        };
        let mut response = vec![0.0; self.plan.len()];
        self.plan.compute_response(&path, scratch, &mut response)?;
        Ok(response)
    }
}

// A band-pass of second order beside what passes without it.
fn resonance_gain(hz: f64, effects: &SimulationParams) -> Complex<f64> {
    if effects.resonance_hz == 0.0 {
        return 1.0.into();
    }
    let ratio = hz / effects.resonance_hz;
    let damping = Complex::new(0.0, ratio / effects.resonance_q);
    1.0 + 2.0 * damping / (1.0 - ratio * ratio + damping)
}

fn multiply_spectra(a: &[Complex<f32>], b: &[Complex<f32>]) -> Vec<Complex<f32>> {
    a.iter().zip(b).map(|(a, b)| a * b).collect()
}

/// Samples of the longest response. The farthest echo comes by a corner of the panel, between the two points that are
/// farthest from theirs, in air of 0 C at the coldest.
pub(super) fn response_len(relief: &HeightField, points: &[[f64; 3]], rate_hz: f64) -> usize {
    let half = relief.size_mm() / 2.0;
    let lowest = f64::from(relief.extent_mm()[0]);
    let to_corner = |[x, y, z]: [f64; 3]| (x.abs() + half).hypot(y.abs() + half).hypot(z - lowest);
    let farthest = points.iter().map(|p| to_corner(*p)).fold(0.0, f64::max);
    let samples = 2.0 * farthest / 1e3 / speed_of_sound(0.0) * rate_hz + RINGING;
    (samples as usize).next_power_of_two()
}

/// A forecast of the next take's inputs; None if there is no next take.
pub(super) type Forecast = Box<dyn FnOnce() -> Option<ResponseInputs> + Send>;

/// Computes responses ahead, on a thread that ends with this.
pub(super) struct ResponseAhead {
    forecasts: Sender<Forecast>,
    responses: Receiver<Option<(ResponseInputs, Vec<f32>)>>,
    is_pending: bool,
}

impl ResponseAhead {
    /// Starts the thread; None if the system refuses it.
    pub fn start(room: Arc<SimulatedRoom>) -> Option<Self> {
        let (forecasts, received) = channel::<Forecast>();
        let (sender, responses) = channel();
        let work = move || {
            let mut scratch = room.plan.make_scratch();
            for forecast in received {
                let inputs = forecast();
                let response = inputs.and_then(|i| Some((i, room.compute_response(&i, &mut scratch).ok()?)));
                if sender.send(response).is_err() {
                    break;
                }
            }
        };
        thread::Builder::new().name("room".to_owned()).spawn(work).ok()?;
        Some(Self { forecasts, responses, is_pending: false })
    }

    /// Begins the response of the take to come.
    pub fn begin_response(&mut self, forecast: Forecast) {
        self.is_pending = self.forecasts.send(forecast).is_ok();
    }

    /// Waits for the response that was begun; None if it is one of other inputs.
    pub fn take_response(&mut self, inputs: &ResponseInputs) -> Option<Vec<f32>> {
        if !std::mem::take(&mut self.is_pending) {
            return None;
        }
        let (of, response) = self.responses.recv().ok()??;
        (of == *inputs).then_some(response)
    }
}
