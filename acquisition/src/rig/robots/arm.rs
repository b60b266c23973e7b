//! One Stäubli TX2-60L with a tool: forward kinematics from joints to links, inverse kinematics from the tool's pose to
//! joints.
//!
//! Lengths in m, angles in rad. Closed-form solutions are those of the crate rs-opw-kinematics.

use rs_opw_kinematics::glam::{DQuat, DVec3};
use rs_opw_kinematics::kinematic_traits::{Kinematics as _, Pose};
use rs_opw_kinematics::kinematics_impl::OPWKinematics;
use rs_opw_kinematics::parameters::opw_kinematics::Parameters;

/// Six joints, rad.
pub type Joints = [f64; 6];

/// Height of the shoulder over the foot, m. This and the lengths below: Stäubli's drawings of the TX2-60L, as
/// ROS-Industrial's `staubli_tx2_60_support` (`tx2_60l_macro.xacro`) and compas_fab's kinematics have them.
pub const SHOULDER_M: f64 = 0.375;
/// From shoulder to elbow, m.
pub const UPPER_ARM_M: f64 = 0.400;
/// Sideways offset of the elbow, m.
pub const ELBOW_ASIDE_M: f64 = 0.020;
/// From elbow to wrist, m.
pub const FOREARM_M: f64 = 0.450;
/// From wrist to flange, m.
pub const FLANGE_M: f64 = 0.070;

/// Ranges of the joints, degrees (the same source, which cites Stäubli's instruction manual).
pub const RANGES_DEG: [[f64; 2]; 6] =
    [[-180.0, 180.0], [-127.5, 127.5], [-152.5, 152.5], [-270.0, 270.0], [-121.0, 132.5], [-270.0, 270.0]];
/// Highest speeds of the joints, degrees a second (the same source).
pub const SPEEDS_DEG: [f64; 6] = [435.0, 385.0, 500.0, 995.0, 1065.0, 1445.0];

/// Joints of an idle arm, degrees: elbow up, wrist over the panel's near edge.
const HOME_DEG: Joints = [0.0, -10.0, 110.0, 0.0, 50.0, 0.0];
/// Weights of the joints in the distance from home: a turn of the big joints moves the arm more.
const WEIGHTS: Joints = [1.0, 1.0, 1.0, 0.3, 0.3, 0.05];
/// Radii of the capsules of column, upper arm, forearm and wrist, m. They enclose the castings as the drawings show
/// them.
pub(super) const RADII_M: [f64; 4] = [0.095, 0.075, 0.060, 0.045];

/// The tool of an arm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Tool {
    /// A microphone at the end of a thin rod.
    Microphone,
    /// A tweeter on a mount of 45 degrees.
    Speaker,
}

impl Tool {
    /// Length along the flange's axis, m: the rod (Rust et al. 2021: about 0.5 m), or the neck up to the mount's bend.
    pub const fn length_m(self) -> f64 {
        match self {
            Self::Microphone => 0.500,
            Self::Speaker => 0.080,
        }
    }

    /// From the bend to the acoustic centre, m.
    pub const fn reach_m(self) -> f64 {
        match self {
            Self::Microphone => 0.0,
            Self::Speaker => 0.050,
        }
    }

    /// Angle between the flange's axis and the tool's, rad.
    pub const fn bend_rad(self) -> f64 {
        match self {
            Self::Microphone => 0.0,
            Self::Speaker => std::f64::consts::FRAC_PI_4,
        }
    }

    /// Radii of its two capsules, m: rod or neck, then holder of the capsule or the driver.
    pub(super) const fn radii_m(self) -> [f64; 2] {
        match self {
            Self::Microphone => [0.008, 0.0065],
            Self::Speaker => [0.015, 0.022],
        }
    }

    /// The name that topics and frames use.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Microphone => "microphone",
            Self::Speaker => "speaker",
        }
    }

    // Flange to tool: the tool's z is its acoustic axis, its origin the acoustic centre.
    pub(super) fn pose_on_flange(self) -> Pose {
        let turn = DQuat::from_rotation_y(self.bend_rad());
        let centre = DVec3::new(0.0, 0.0, self.length_m()) + turn * DVec3::new(0.0, 0.0, self.reach_m());
        Pose::from_parts(centre, turn)
    }
}

/// Part of an arm, as collisions name it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ArmPart {
    /// From the foot to the shoulder.
    Column,
    /// From the shoulder to the elbow.
    UpperArm,
    /// From the elbow to the wrist.
    Forearm,
    /// From the wrist to the flange.
    Wrist,
    /// Rod or mount.
    Holder,
    /// Microphone or driver.
    Transducer,
}

/// All points nearer to a segment than a radius, m.
#[derive(Debug, Clone, Copy)]
pub struct LinkCapsule {
    /// The part that it encloses.
    pub part: ArmPart,
    /// One end.
    pub from: DVec3,
    /// The other.
    pub to: DVec3,
    /// Its radius.
    pub radius: f64,
}

/// An arm on its foot.
pub struct RobotArm {
    kinematics: OPWKinematics,
    foot: Pose,
    tool: Tool,
}

impl RobotArm {
    /// Makes an arm with its foot at `foot_m` over the panel, turned by `heading` about the vertical.
    pub fn new(tool: Tool, foot_m: [f64; 3], heading: f64) -> Self {
        let parameters = Parameters {
            a1: 0.0,
            a2: 0.0,
            b: ELBOW_ASIDE_M,
            c1: SHOULDER_M,
            c2: UPPER_ARM_M,
            c3: FOREARM_M,
            c4: FLANGE_M,
            offsets: [0.0; 6],
            sign_corrections: [1; 6],
            dof: 6,
        };
        let foot = Pose::from_parts(DVec3::from_array(foot_m), DQuat::from_rotation_z(heading));
        Self { kinematics: OPWKinematics::new(parameters), foot, tool }
    }

    /// Returns its tool.
    pub fn tool(&self) -> Tool {
        self.tool
    }

    /// Returns the pose of its foot.
    pub fn foot(&self) -> Pose {
        self.foot
    }

    /// Returns the direction of its tool's acoustic axis.
    pub fn tool_axis(&self, joints: &Joints) -> [f64; 3] {
        self.frames_over_panel(joints)[7].transform_vector(DVec3::Z).to_array()
    }

    /// Frames over the panel: foot, links 1 to 6 (the last is the flange), tool.
    pub fn frames_over_panel(&self, joints: &Joints) -> [Pose; 8] {
        let mut frames = self.relative_frames(joints);
        for i in 1..frames.len() {
            frames[i] = frames[i - 1].compose(frames[i]);
        }
        frames
    }

    /// Each frame over the one before it, the foot over the panel.
    pub fn relative_frames(&self, joints: &Joints) -> [Pose; 8] {
        let [a, b, c, d, e, f] = link_poses(joints);
        [self.foot, a, b, c, d, e, f, self.tool.pose_on_flange()]
    }

    /// Returns all joints that bring the tool to this pose, in their ranges or not.
    pub fn solve_joints(&self, tool: Pose) -> Vec<Joints> {
        let flange = self.foot.inverse().compose(tool).compose(self.tool.pose_on_flange().inverse());
        let mut found: Vec<Joints> = self.kinematics.inverse(&flange);
        found.iter_mut().flatten().for_each(|q| *q = wrap_angle(*q));
        found
    }

    /// The arm as capsules.
    pub fn link_capsules(&self, joints: &Joints) -> [LinkCapsule; 6] {
        let frames = self.frames_over_panel(joints);
        let at = |i: usize| frames[i].translation;
        let bend = frames[6].transform_point(DVec3::new(0.0, 0.0, self.tool.length_m() * self.holder_share()));
        let [holder, transducer] = self.tool.radii_m();
        let capsule = |part, from, to, radius| LinkCapsule { part, from, to, radius };
        [
            capsule(ArmPart::Column, at(0), at(1), RADII_M[0]),
            capsule(ArmPart::UpperArm, at(2), at(3), RADII_M[1]),
            capsule(ArmPart::Forearm, at(3), at(5), RADII_M[2]),
            capsule(ArmPart::Wrist, at(5), at(6), RADII_M[3]),
            capsule(ArmPart::Holder, at(6), bend, holder),
            capsule(ArmPart::Transducer, bend, at(7), transducer),
        ]
    }

    // End of the holder and begin of the transducer, as a share of the length along the flange's axis.
    fn holder_share(&self) -> f64 {
        match self.tool {
            Tool::Microphone => 0.8,
            Tool::Speaker => 1.0,
        }
    }
}

/// Poses of each link over the one before, foot to flange.
fn link_poses(q: &Joints) -> [Pose; 6] {
    let y = DQuat::from_rotation_y;
    let z = DQuat::from_rotation_z;
    let step = |x: [f64; 3], turn| Pose::from_parts(DVec3::from_array(x), turn);
    [
        step([0.0, 0.0, SHOULDER_M], z(q[0])),
        step([0.0; 3], y(q[1])),
        step([0.0, ELBOW_ASIDE_M, UPPER_ARM_M], y(q[2])),
        step([0.0; 3], z(q[3])),
        step([0.0, 0.0, FOREARM_M], y(q[4])),
        step([0.0, 0.0, FLANGE_M], z(q[5])),
    ]
}

/// Returns the joints of an idle arm.
pub fn home_joints() -> Joints {
    HOME_DEG.map(f64::to_radians)
}

/// Weighted squared distance of joints from home; the solver prefers small ones.
pub(super) fn from_home(joints: &Joints) -> f64 {
    let home = home_joints();
    (0..6).map(|i| WEIGHTS[i] * (joints[i] - home[i]).powi(2)).sum()
}

/// Returns whether all joints are in their ranges.
pub fn in_range(joints: &Joints) -> bool {
    joints.iter().zip(RANGES_DEG).all(|(q, [low, high])| (low..=high).contains(&q.to_degrees()))
}

/// Least time for the joints from one pose to another, s, at the data sheet's speeds; acceleration left out.
pub fn travel_secs(from: &Joints, to: &Joints) -> f64 {
    (0..6).map(|i| (from[i] - to[i]).abs().to_degrees() / SPEEDS_DEG[i]).fold(0.0, f64::max)
}

fn wrap_angle(angle: f64) -> f64 {
    use std::f64::consts::{PI, TAU};
    (angle + PI).rem_euclid(TAU) - PI
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arm(tool: Tool) -> RobotArm {
        RobotArm::new(tool, [-0.6, 0.1, -0.2], 0.3)
    }

    #[test]
    fn straight_up_it_is_as_high_as_the_data_sheet_says() {
        let [.., flange, tool] = arm(Tool::Microphone).frames_over_panel(&[0.0; 6]);
        assert!((flange.translation.z - (1.295 - 0.2)).abs() < 1e-12, "{flange:?}");
        assert!((tool.translation.z - (1.795 - 0.2)).abs() < 1e-12, "{tool:?}");
        // 920 mm of reach: shoulder to flange.
        assert!((UPPER_ARM_M + FOREARM_M + FLANGE_M - 0.92).abs() < 1e-12);
    }

    #[test]
    fn every_solution_leads_back_to_the_pose() {
        for (tool, seed) in [(Tool::Microphone, 0.1), (Tool::Speaker, 0.35)] {
            let arm = arm(tool);
            let joints = [0.4 + seed, -0.3, 1.7, 0.5, 0.8 - seed, -0.6];
            let wanted = arm.frames_over_panel(&joints)[7];
            let found = arm.solve_joints(wanted);
            assert!(found.iter().any(|q| q.iter().zip(joints).all(|(a, b)| (a - b).abs() < 1e-6)), "{found:?}");
            assert!(found.len() >= 4, "elbow and wrist both ways");
            for q in &found {
                let reached = arm.frames_over_panel(q)[7];
                assert!(reached.translation.distance(wanted.translation) < 1e-7, "{q:?}");
                assert!(reached.angular_distance(wanted) < 1e-6, "{q:?}");
            }
        }
    }

    #[test]
    fn the_speaker_looks_45_degrees_off_the_flange() {
        let frames = arm(Tool::Speaker).frames_over_panel(&[0.3, 0.2, 1.0, 0.1, 0.7, 0.2]);
        let axis = |pose: Pose| pose.transform_vector(DVec3::Z);
        assert!((axis(frames[6]).angle_between(axis(frames[7])).to_degrees() - 45.0).abs() < 1e-9);
    }

    #[test]
    fn joints_beyond_their_range_are_refused() {
        assert!(in_range(&home_joints()));
        for (joint, degrees) in [(1, 128.0), (2, -153.0), (4, -122.0)] {
            let mut joints = home_joints();
            joints[joint] = f64::to_radians(degrees);
            assert!(!in_range(&joints), "{joint}");
        }
    }
}
