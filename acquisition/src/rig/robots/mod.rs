//! Two Stäubli TX2-60L as models: where they can stand, how they move through a grid, and what viewers show of them.
//!
//! ```
//! use echolake_acquisition::rig::robots::Cell;
//!
//! let cell = Cell::from_rig(&echolake_schema::Rig::paper());
//! let standing = cell.reach_positions([-37.5, 37.5, 124.0], [62.5, -62.5, 304.0])?;
//! assert!(cell.is_clear(&standing.microphone, &standing.speaker));
//! # Ok::<(), echolake_acquisition::rig::robots::UnreachableReason>(())
//! ```

pub mod arm;
mod cell;
mod choreography;
pub mod clearance;
mod description;
mod motion;
mod plan;

pub use arm::{ArmPart, Joints, RobotArm, Tool};
pub use cell::{ArmPose, ArmSolutions, Cell, SpeakerAim, UnreachableReason};
pub use choreography::{Choreography, MissingPair};
pub use description::{PANEL_M, frame_names, joint_names};
pub use motion::{ArmMotion, MotionCourse, plan_motion};
pub use plan::{PlanParams, length_secs, plan_visit_order};
