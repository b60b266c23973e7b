//! The simulated room: responses between the two transducers, and that of the take to come, which another thread
//! computes while the last one is judged and recorded.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;

use echolake_dsp::Error;
use echolake_dsp::air::{AirAbsorption, AirState};
use echolake_dsp::geometry::incidence_deg;
use echolake_dsp::kirchhoff::{KirchhoffPlan, KirchhoffScratch, SoundPath, TransducerPose};
use echolake_dsp::temperature::ReferenceAir;
use echolake_panel::material::FoamLayer;
use realfft::num_complex::Complex;

use super::multiply_spectra;

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
