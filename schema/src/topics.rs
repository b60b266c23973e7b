//! Topics of a run's MCAP file, and the names of its attachments and metadata records.

/// Coordinate frames over time: world, panel, flanges, speaker, microphone.
pub const TF: &str = "/tf";
/// The panel as a GLB model, once.
pub const PANEL_SCENE: &str = "/panel/scene";
/// The relief as points, once.
pub const PANEL_POINTS: &str = "/panel/points";
/// The microphone's pose at each measurement.
pub const MICROPHONE_POSE: &str = "/microphone/pose";
/// The speaker's pose at each measurement.
pub const SPEAKER_POSE: &str = "/speaker/pose";
/// Each recorded sweep, both channels.
pub const SWEEP: &str = "/sweep";
/// The second recording of each sweep, both channels, if the rig plays it twice.
pub const SWEEP_REPEAT: &str = "/sweep/repeat";
/// Each recorded sweep's microphone channel, ten times slower, for ears and players.
pub const SWEEP_AUDIO: &str = "/sweep/audio";
/// Each impulse response.
pub const IR: &str = "/ir";
/// Readings of the ambient sensor.
pub const ENVIRONMENT: &str = "/environment";
/// Verdicts of the run controller.
pub const MEASUREMENT: &str = "/measurement";
/// The run's log.
pub const LOG: &str = "/log";

/// The arms as URDF, once, if their joints are known.
pub const ROBOT_DESCRIPTION: &str = "/robot_description";
/// Joints of the arm that carries the microphone, at each measurement.
pub const MICROPHONE_JOINTS: &str = "/robots/microphone/joint_states";
/// Joints of the arm that carries the speaker.
pub const SPEAKER_JOINTS: &str = "/robots/speaker/joint_states";

/// Metadata record written first: the run's manifest.
pub const RUN_METADATA: &str = "echolake.run";
/// Metadata record written after it if a run can be resumed: the plan that resuming needs. While such a recording is
/// unfinished it is no run yet, however its recorder ended.
pub const RUN_PLAN_METADATA: &str = "echolake.run.plan";
/// Metadata record of a file that was rebuilt: from what, and what was lost.
pub const RECOVERY_METADATA: &str = "echolake.recovery";
/// Metadata record written last: how the run ended. A file without it was cut off.
pub const RUN_END_METADATA: &str = "echolake.run.end";

/// Attachment: the rig's description, TOML.
pub const RIG_ATTACHMENT: &str = "rig.toml";
/// Attachment: the surface's record, JSON.
pub const SURFACE_ATTACHMENT: &str = "surface.json";
/// Attachment: the panel's mesh, GLB, metres, Y up.
pub const MESH_ATTACHMENT: &str = "panel.glb";
/// Attachment: the panel's heights, little-endian f32 in mm, a square, row by row along x, y ascending.
pub const HEIGHTS_ATTACHMENT: &str = "heights.f32";
