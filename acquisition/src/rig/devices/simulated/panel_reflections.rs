//! Reflections of a panel at the pairs of a grid, as the simulated rig computes them: without direct sound and noise,
//! in the reference air, with the arms exactly at the points.

use echolake_dsp::Error;
use echolake_dsp::air::AirState;
use echolake_dsp::kirchhoff::{KirchhoffScratch, TransducerPose};
use echolake_panel::material::SurfaceMaterial;
use echolake_panel::relief::HeightField;
use echolake_schema::{Grid, Pair, Rig};

use super::room::{ResponseInputs, SimulatedRoom};
use super::transducer_axes;
use crate::rig::robots::Choreography;

/// A panel in the simulated room, of which only the reflection is computed.
pub struct PanelReflections {
    room: SimulatedRoom,
    air: AirState,
}

/// Poses of microphone and speaker at a pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairPoses {
    microphone: TransducerPose,
    speaker: TransducerPose,
}

impl PairPoses {
    /// Returns the poses at a pair, as a model of the arms has them if there is one.
    pub fn from_pair(grid: &Grid, pair: &Pair, arms: Option<&Choreography>) -> Self {
        let [microphone_mm, speaker_mm] =
            [pair.microphone, pair.speaker].map(|point| grid.points()[point.index()].position_mm);
        let joints = arms.and_then(|arms| arms.pose_at(pair.id).ok()).map(|pose| [pose.microphone, pose.speaker]);
        let [microphone, speaker] = transducer_axes(arms.zip(joints.as_ref()), microphone_mm, speaker_mm);
        Self {
            microphone: TransducerPose { position_mm: microphone_mm, axis: microphone },
            speaker: TransducerPose { position_mm: speaker_mm, axis: speaker },
        }
    }
}

impl PanelReflections {
    /// A relief of a material, over which the grid of a rig lies.
    pub fn new(rig: &Rig, grid: &Grid, relief: &HeightField, material: SurfaceMaterial) -> Self {
        let mut room = SimulatedRoom::new(rig, grid, relief, material);
        room.direct.fill(0.0.into());
        let air = room.reference.air();
        Self { room, air }
    }

    /// Buffers for [`Self::compute_reflection`]; one per thread.
    pub fn make_scratch(&self) -> KirchhoffScratch {
        self.room.plan.make_scratch()
    }

    /// Computes the reflection at a pair; samples at the rig's rate, from the time of the emission on.
    ///
    /// # Errors
    /// As [`echolake_dsp::kirchhoff::KirchhoffPlan::compute_response`]: `scratch` is of another panel.
    pub fn compute_reflection(&self, poses: &PairPoses, scratch: &mut KirchhoffScratch) -> Result<Vec<f32>, Error> {
        let PairPoses { microphone, speaker } = *poses;
        self.room.compute_response(&ResponseInputs { microphone, speaker, air: self.air }, scratch)
    }
}
