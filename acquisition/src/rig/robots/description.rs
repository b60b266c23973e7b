//! The arms as URDF, of simple shapes. Links are the frames of `/tf`; lengths in m, angles in rad.

use std::fmt::Write as _;

use rs_opw_kinematics::glam::DVec3;
use rs_opw_kinematics::kinematic_traits::Pose;

use super::arm::{
    ELBOW_ASIDE_M, FLANGE_M, FOREARM_M, RADII_M, RANGES_DEG, RobotArm, SHOULDER_M, SPEEDS_DEG, Tool, UPPER_ARM_M,
};
use super::cell::Cell;

/// Height of the panel's mean plane over the floor, m: a table's height.
pub const PANEL_M: f64 = 0.8;
/// Sides of the table, m, and how thick it is.
const TABLE_M: [f64; 3] = [1.6, 1.2, 0.02];
/// Axes of the six joints.
const AXES: [&str; 6] = ["0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1"];

/// Frames of an arm, foot to tool, as `/tf` and the URDF name them.
pub fn frame_names(tool: Tool) -> [String; 8] {
    let name = tool.name();
    std::array::from_fn(|i| match i {
        0 => format!("{name}_foot"),
        6 => format!("{name}_flange"),
        7 => name.to_owned(),
        i => format!("{name}_link_{i}"),
    })
}

/// Names of an arm's joints.
pub fn joint_names(tool: Tool) -> [String; 6] {
    std::array::from_fn(|i| format!("{}_joint_{}", tool.name(), i + 1))
}

impl Cell {
    /// Both arms, table and panel as URDF; `name` says what they are, and whether they are simulated.
    pub fn to_urdf(&self, name: &str) -> String {
        let mut out = String::from("<?xml version=\"1.0\"?>\n");
        let name = name.replace(['<', '>', '&', '"'], "_");
        // Writing to a String cannot fail.
        let _ = writeln!(out, "<robot name=\"{name}\">");
        let table = PANEL_M + self.arm_surroundings().table_m - TABLE_M[2] / 2.0;
        let [x, y, z] = TABLE_M;
        write_link(&mut out, "world", &format!("<box size=\"{x} {y} {z}\"/>"), table, "0.45 0.4 0.35");
        write_link(&mut out, "panel", "", 0.0, "");
        write_fixed_joint(&mut out, "world", "panel", [0.0, 0.0, PANEL_M], [0.0; 3]);
        for tool in [Tool::Microphone, Tool::Speaker] {
            write_arm(&mut out, self.arm_with_tool(tool));
        }
        out.push_str("</robot>\n");
        out
    }
}

fn write_arm(out: &mut String, arm: &RobotArm) {
    let tool = arm.tool();
    let frames = frame_names(arm.tool());
    let cylinder = |radius: f64, length: f64| format!("<cylinder radius=\"{radius}\" length=\"{length}\"/>");
    let sphere = |radius: f64| format!("<sphere radius=\"{radius}\"/>");
    let [holder, transducer] = tool.radii_m();
    let colour = if tool == Tool::Microphone { "0.95 0.75 0.2" } else { "0.85 0.6 0.15" };
    let shapes = [
        (cylinder(RADII_M[0], SHOULDER_M), SHOULDER_M / 2.0),
        (sphere(RADII_M[0]), 0.0),
        (cylinder(RADII_M[1], UPPER_ARM_M), UPPER_ARM_M / 2.0),
        (sphere(RADII_M[1]), 0.0),
        (cylinder(RADII_M[2], FOREARM_M), FOREARM_M / 2.0),
        (cylinder(RADII_M[3], FLANGE_M), FLANGE_M / 2.0),
        (cylinder(holder, tool.length_m()), tool.length_m() / 2.0),
        (cylinder(transducer, 0.04), -0.02),
    ];
    for (name, (shape, z)) in frames.iter().zip(&shapes) {
        write_link(out, name, shape, *z, colour);
    }
    let foot = arm.foot();
    let tool = tool.pose_on_flange();
    let over_floor = (foot.translation + DVec3::new(0.0, 0.0, PANEL_M)).to_array();
    write_fixed_joint(out, "world", &frames[0], over_floor, roll_pitch_yaw(foot));
    for (i, joint) in joint_names(arm.tool()).iter().enumerate() {
        let origin = match i {
            0 => format!("0 0 {SHOULDER_M}"),
            2 => format!("0 {ELBOW_ASIDE_M} {UPPER_ARM_M}"),
            4 => format!("0 0 {FOREARM_M}"),
            5 => format!("0 0 {FLANGE_M}"),
            _ => "0 0 0".to_owned(),
        };
        let [low, high] = RANGES_DEG[i].map(f64::to_radians);
        let speed = SPEEDS_DEG[i].to_radians();
        let parent = &frames[i];
        let child = &frames[i + 1];
        let axis = AXES[i];
        let _ = writeln!(
            out,
            "  <joint name=\"{joint}\" type=\"revolute\"><origin xyz=\"{origin}\"/><parent link=\"{parent}\"/>\
             <child link=\"{child}\"/><axis xyz=\"{axis}\"/>\
             <limit lower=\"{low}\" upper=\"{high}\" effort=\"0\" velocity=\"{speed}\"/></joint>"
        );
    }
    write_fixed_joint(out, &frames[6], &frames[7], tool.translation.to_array(), roll_pitch_yaw(tool));
}

fn write_link(out: &mut String, name: &str, shape: &str, z: f64, colour: &str) {
    let _ = match shape {
        "" => writeln!(out, "  <link name=\"{name}\"/>"),
        shape => writeln!(
            out,
            "  <link name=\"{name}\"><visual><origin xyz=\"0 0 {z}\"/><geometry>{shape}</geometry>\
             <material name=\"{name}\"><color rgba=\"{colour} 1\"/></material></visual></link>"
        ),
    };
}

fn write_fixed_joint(out: &mut String, parent: &str, child: &str, [x, y, z]: [f64; 3], [a, b, c]: [f64; 3]) {
    let _ = writeln!(
        out,
        "  <joint name=\"{parent}-{child}\" type=\"fixed\"><origin xyz=\"{x} {y} {z}\" rpy=\"{a} {b} {c}\"/>\
         <parent link=\"{parent}\"/><child link=\"{child}\"/></joint>"
    );
}

// URDF turns about x, then y, then z, all of them fixed.
fn roll_pitch_yaw(pose: Pose) -> [f64; 3] {
    let (z, y, x) = pose.rotation.to_euler(rs_opw_kinematics::glam::EulerRot::ZYX);
    [x, y, z]
}
