//! The messages that viewers show: frames, poses, the panel, its points, audio and log. Metres and quaternions.

use echolake_panel::relief::HeightField;
use echolake_schema::Timestamp;
use foxglove::messages::{
    Color, FrameTransform, FrameTransforms, JointState, JointStates, Log, ModelPrimitive, PackedElementField,
    PointCloud, Pose, PoseInFrame, Quaternion, RawAudio, SceneEntity, SceneUpdate, Timestamp as FoxgloveTime, Vector3,
    log, packed_element_field::NumericType,
};

use super::LogLevel;
use crate::rig::robots::{Cell, Joints, PANEL_M, Tool, frame_names, joint_names};

/// Length of the holders between flange and microphone or speaker, m.
const HOLDER_M: f64 = 0.15;
/// Points along each side of `/panel/points`.
const POINTS_A_SIDE: usize = 137;

/// Fields of a point's colour, as rerun, Foxglove and Lichtblick know them.
const COLOURS: [&str; 4] = ["red", "green", "blue", "alpha"];

const NO_TURN: Quaternion = Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 };

/// `/tf`: the panel in the world, and each arm's flange and tool over the panel.
pub(super) fn tool_frames(at: Timestamp, microphone_mm: [f64; 3], speaker_mm: [f64; 3]) -> FrameTransforms {
    let holder = Vector3 { x: 0.0, y: 0.0, z: -HOLDER_M };
    let flange = |mm: [f64; 3]| {
        let Vector3 { x, y, z } = to_metres(mm);
        Vector3 { x, y, z: z + HOLDER_M }
    };
    let frame = |parent: &str, child: &str, translation: Vector3| FrameTransform {
        timestamp: Some(foxglove_time(at)),
        parent_frame_id: parent.into(),
        child_frame_id: child.into(),
        translation: Some(translation),
        rotation: Some(NO_TURN),
    };
    FrameTransforms {
        transforms: vec![
            frame("world", "panel", Vector3 { x: 0.0, y: 0.0, z: PANEL_M }),
            frame("panel", "microphone_flange", flange(microphone_mm)),
            frame("microphone_flange", "microphone", holder),
            frame("panel", "speaker_flange", flange(speaker_mm)),
            frame("speaker_flange", "speaker", holder),
        ],
    }
}

/// `/tf`: the panel in the world, and each arm's links from foot to tool.
pub(super) fn arm_frames(at: Timestamp, cell: &Cell, joints: &[Joints; 2]) -> FrameTransforms {
    let frame = |parent: &str, child: &str, [x, y, z]: [f64; 3], [qx, qy, qz, qw]: [f64; 4]| FrameTransform {
        timestamp: Some(foxglove_time(at)),
        parent_frame_id: parent.into(),
        child_frame_id: child.into(),
        translation: Some(Vector3 { x, y, z }),
        rotation: Some(Quaternion { x: qx, y: qy, z: qz, w: qw }),
    };
    let mut transforms = vec![frame("world", "panel", [0.0, 0.0, PANEL_M], [0.0, 0.0, 0.0, 1.0])];
    for (tool, joints) in [Tool::Microphone, Tool::Speaker].into_iter().zip(joints) {
        let mut parent = "world".to_owned();
        let names = frame_names(tool);
        for (i, (name, pose)) in names.into_iter().zip(cell.arm_with_tool(tool).relative_frames(joints)).enumerate() {
            let mut at = pose.translation.to_array();
            // Feet are known over the panel, and stand on the world.
            at[2] += if i == 0 { PANEL_M } else { 0.0 };
            transforms.push(frame(&parent, &name, at, pose.rotation.to_array()));
            parent = name;
        }
    }
    FrameTransforms { transforms }
}

/// `/robots/<name>/joint_states`.
pub(super) fn joint_states(at: Timestamp, tool: Tool, joints: &Joints) -> JointStates {
    let state =
        |(name, position): (String, &f64)| JointState { name, position: Some(*position), ..JointState::default() };
    JointStates {
        timestamp: Some(foxglove_time(at)),
        joints: joint_names(tool).into_iter().zip(joints).map(state).collect(),
    }
}

/// A position over the panel.
pub(super) fn pose_over_panel(at: Timestamp, position_mm: [f64; 3]) -> PoseInFrame {
    let pose = Pose { position: Some(to_metres(position_mm)), orientation: Some(NO_TURN) };
    PoseInFrame { timestamp: Some(foxglove_time(at)), frame_id: "panel".into(), pose: Some(pose) }
}

/// `/panel/scene`: the panel as a GLB model. Viewers turn GLB's Y-up into Z-up themselves.
pub(super) fn panel_scene(at: Timestamp, glb: Vec<u8>) -> SceneUpdate {
    let model = ModelPrimitive {
        pose: Some(Pose { position: Some(Vector3 { x: 0.0, y: 0.0, z: 0.0 }), orientation: Some(NO_TURN) }),
        scale: Some(Vector3 { x: 1.0, y: 1.0, z: 1.0 }),
        color: Some(Color { r: 0.8, g: 0.78, b: 0.74, a: 1.0 }),
        override_color: false,
        url: String::new(),
        media_type: "model/gltf-binary".into(),
        data: glb.into(),
    };
    let entity = SceneEntity {
        timestamp: Some(foxglove_time(at)),
        frame_id: "panel".into(),
        id: "panel".into(),
        frame_locked: true,
        models: vec![model],
        ..SceneEntity::default()
    };
    SceneUpdate { deletions: Vec::new(), entities: vec![entity] }
}

/// `/panel/points`: the relief, thinned out, its low cells dark and its high ones light: points have no shading.
pub(super) fn panel_points(at: Timestamp, heights: &HeightField) -> PointCloud {
    let step = heights.cells().div_ceil(POINTS_A_SIDE);
    let extremes = |(low, high): (f32, f32), h: &f32| (low.min(*h), high.max(*h));
    let (low_mm, high_mm) = heights.heights_mm().iter().fold((f32::INFINITY, f32::NEG_INFINITY), extremes);
    let mut data = Vec::new();
    for iy in (0..heights.cells()).step_by(step) {
        for ix in (0..heights.cells()).step_by(step) {
            let height_mm = heights.cell_height(ix, iy);
            let mm = [heights.centre_mm(ix), heights.centre_mm(iy), f64::from(height_mm)];
            data.extend(mm.into_iter().flat_map(|x| ((x / 1e3) as f32).to_le_bytes()));
            data.extend(height_colour((height_mm - low_mm) / (high_mm - low_mm).max(f32::MIN_POSITIVE)));
        }
    }
    let field =
        |name: &str, offset, kind: NumericType| PackedElementField { name: name.into(), offset, r#type: kind as i32 };
    let place = ["x", "y", "z"].into_iter().zip([0, 4, 8]).map(|(name, at)| field(name, at, NumericType::Float32));
    let shade = COLOURS.into_iter().zip(12..).map(|(name, at)| field(name, at, NumericType::Uint8));
    PointCloud {
        timestamp: Some(foxglove_time(at)),
        frame_id: "panel".into(),
        pose: Some(Pose { position: Some(Vector3 { x: 0.0, y: 0.0, z: 0.0 }), orientation: Some(NO_TURN) }),
        point_stride: 16,
        fields: place.chain(shade).collect(),
        data: data.into(),
    }
}

// Dark blue to light blue: the arms are yellow.
fn height_colour(share: f32) -> [u8; 4] {
    let between = |low: f32, high: f32| (low + share * (high - low)) as u8;
    [between(20.0, 130.0), between(60.0, 190.0), between(140.0, 240.0), u8::MAX]
}

/// `/sweep/audio`.
pub(super) fn sweep_audio(at: Timestamp, data: Vec<u8>, sample_rate: u32) -> RawAudio {
    RawAudio {
        timestamp: Some(foxglove_time(at)),
        data: data.into(),
        format: "pcm-s16".into(),
        sample_rate,
        number_of_channels: 1,
    }
}

/// `/log`.
pub(super) fn log_message(at: Timestamp, level: LogLevel, name: &str, message: &str) -> Log {
    let level = match level {
        LogLevel::Debug => log::Level::Debug,
        LogLevel::Info => log::Level::Info,
        LogLevel::Warning => log::Level::Warning,
        LogLevel::Error => log::Level::Error,
    };
    Log {
        timestamp: Some(foxglove_time(at)),
        level: level as i32,
        message: message.into(),
        name: name.into(),
        ..Log::default()
    }
}

fn to_metres([x, y, z]: [f64; 3]) -> Vector3 {
    Vector3 { x: x / 1e3, y: y / 1e3, z: z / 1e3 }
}

fn foxglove_time(at: Timestamp) -> FoxgloveTime {
    let secs = u32::try_from(at.0.div_euclid(1_000_000_000)).unwrap_or(0);
    FoxgloveTime::new(secs, at.0.rem_euclid(1_000_000_000) as u32)
}
