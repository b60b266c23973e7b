//! Both arms over the panel: joints for a pair of positions, or the reason why there are none.

use std::f64::consts::{PI, TAU};

use echolake_schema::Rig;
use echolake_schema::robots::{RobotCell, Rod};
use rs_opw_kinematics::glam::{DQuat, DVec3};
use rs_opw_kinematics::kinematic_traits::Pose;

use super::arm::{ArmPart, Joints, LinkCapsule, RobotArm, Tool, from_home, home_joints, in_range};
use super::clearance::{ArmSurroundings, touches_itself, touching_parts};

/// Inclinations of the microphone's rod that are tried, degrees from the vertical: its wrist then stays on its own
/// side, and the speaker has room above the microphone.
const TILTS_DEG: [f64; 5] = [45.0, 30.0, 60.0, 15.0, 75.0];
const UPRIGHT_DEG: [f64; 1] = [0.0];
/// Directions that the rod leans to, degrees from straight away from its arm.
const TURNS_DEG: [f64; 7] = [0.0, -25.0, 25.0, -50.0, 50.0, -80.0, 80.0];
/// Turns about the speaker's axis that are tried: the 45 degree mount may come from any side.
const ROLLS: usize = 24;
/// Ways of the speaker's arm that are tried: few at first, because mostly the first will do.
const TRIED: [usize; 2] = [6, usize::MAX];

/// Direction of the speaker's axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum SpeakerAim {
    /// At the point of the panel where a mirror would reflect to the microphone.
    Specular,
    /// Half-way between that point and the one straight below.
    Steeper,
    /// Straight down.
    Down,
}

impl SpeakerAim {
    const ALL: [Self; 3] = [Self::Specular, Self::Steeper, Self::Down];

    // The axis from `speaker` for a microphone at `microphone`, both in m over the mirror plane z = 0.
    fn aim_axis(self, microphone: DVec3, speaker: DVec3) -> DVec3 {
        let share = speaker.z / (speaker.z + microphone.z);
        let specular = speaker + (microphone - speaker) * share;
        let foot = DVec3::new(speaker.x, speaker.y, 0.0);
        let target = foot + (DVec3::new(specular.x, specular.y, 0.0) - foot) * self.specular_share();
        (target - speaker).normalize()
    }

    fn specular_share(self) -> f64 {
        match self {
            Self::Specular => 1.0,
            Self::Steeper => 0.5,
            Self::Down => 0.0,
        }
    }
}

/// Joints of both arms at a pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmPose {
    /// Joints of the microphone's arm.
    pub microphone: Joints,
    /// Joints of the speaker's arm.
    pub speaker: Joints,
    /// Direction of the speaker's axis.
    pub aim: SpeakerAim,
}

impl ArmPose {
    /// Both arms at home.
    pub fn at_home() -> Self {
        Self { microphone: home_joints(), speaker: home_joints(), aim: SpeakerAim::Down }
    }
}

/// The reason why a pair cannot be reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum UnreachableReason {
    /// A position is not finite.
    #[error("a position is not a number")]
    NoPosition,
    /// The wrist would have to be farther, or nearer, than the arm goes.
    #[error("{} arm: out of reach", .0.name())]
    OutOfReach(Tool),
    /// Only with joints beyond their ranges.
    #[error("{} arm: joints beyond their ranges", .0.name())]
    Joints(Tool),
    /// Only with the arm in the table, the panel or itself.
    #[error("{} arm: would touch the panel, the table or itself", .0.name())]
    Touches(Tool),
    /// Both arms get there, but not at the same time.
    #[error("the arms would touch: {0:?} of the microphone's and {1:?} of the speaker's")]
    ArmsTouch(ArmPart, ArmPart),
}

impl UnreachableReason {
    /// Returns the reason as a static text, for [`crate::rig::Error::Unreachable`].
    pub fn reason_text(&self) -> &'static str {
        match self {
            Self::NoPosition => "a position is not a number",
            Self::OutOfReach(Tool::Microphone) => "the microphone's arm does not reach that far",
            Self::OutOfReach(Tool::Speaker) => "the speaker's arm does not reach that far",
            Self::Joints(Tool::Microphone) => "joints of the microphone's arm would leave their ranges",
            Self::Joints(Tool::Speaker) => "joints of the speaker's arm would leave their ranges",
            Self::Touches(Tool::Microphone) => "the microphone's arm would touch panel, table or itself",
            Self::Touches(Tool::Speaker) => "the speaker's arm would touch panel, table or itself",
            Self::ArmsTouch(..) => "the arms would touch",
        }
    }
}

/// Both arms and their surroundings.
pub struct Cell {
    microphone: RobotArm,
    speaker: RobotArm,
    rod: Rod,
    around: ArmSurroundings,
}

/// One solution for an arm, with the space that it occupies.
#[derive(Clone)]
struct ArmSolution {
    joints: Joints,
    capsules: [LinkCapsule; 6],
    cost: f64,
}

/// Solutions for an arm at a position, or the reason why there are none.
#[derive(Clone)]
pub struct ArmSolutions(Result<Vec<ArmSolution>, UnreachableReason>);

impl Cell {
    /// The arms over a panel with sides of `panel_mm`.
    pub fn new(place: &RobotCell, panel_mm: f64) -> Self {
        let metres = |mm: [f64; 3]| mm.map(|x| x / 1e3);
        // Each faces the panel.
        let heading = |foot: [f64; 3]| (-foot[1]).atan2(-foot[0]);
        let arm = |tool, foot| RobotArm::new(tool, metres(foot), heading(foot));
        Self {
            microphone: arm(Tool::Microphone, place.microphone_foot_mm),
            speaker: arm(Tool::Speaker, place.speaker_foot_mm),
            rod: place.rod,
            around: ArmSurroundings {
                half_m: panel_mm / 2e3,
                relief_m: place.relief_mm / 1e3,
                table_m: place.table_mm / 1e3,
                margin_m: place.margin_mm / 1e3,
            },
        }
    }

    /// A rig's arms.
    pub fn from_rig(rig: &Rig) -> Self {
        Self::new(&rig.robots, rig.panel.size_mm)
    }

    /// Returns the arms' surroundings.
    pub fn arm_surroundings(&self) -> &ArmSurroundings {
        &self.around
    }

    /// The arm that carries a tool.
    pub fn arm_with_tool(&self, tool: Tool) -> &RobotArm {
        match tool {
            Tool::Microphone => &self.microphone,
            Tool::Speaker => &self.speaker,
        }
    }

    /// Returns the positions of microphone and speaker for given joints, mm.
    pub fn positions_mm(&self, microphone: &Joints, speaker: &Joints) -> [[f64; 3]; 2] {
        [self.microphone.frames_over_panel(microphone), self.speaker.frames_over_panel(speaker)]
            .map(|frames| (frames[7].translation * 1e3).to_array())
    }

    /// Returns joints of both arms that bring the tools to these positions.
    ///
    /// # Errors
    /// [`UnreachableReason`], with the obstacle.
    pub fn reach_positions(&self, microphone_mm: [f64; 3], speaker_mm: [f64; 3]) -> Result<ArmPose, UnreachableReason> {
        self.reach_with(&self.microphone_ways(microphone_mm), microphone_mm, speaker_mm)
    }

    /// As [`Self::reach_positions`], with the microphone's ways found before: they do not depend on the speaker.
    ///
    /// # Errors
    /// [`UnreachableReason`].
    pub fn reach_with(
        &self,
        ways: &ArmSolutions,
        microphone_mm: [f64; 3],
        speaker_mm: [f64; 3],
    ) -> Result<ArmPose, UnreachableReason> {
        if !microphone_mm.iter().chain(&speaker_mm).all(|x| x.is_finite()) {
            return Err(UnreachableReason::NoPosition);
        }
        let microphones = ways.0.as_ref().map_err(|e| *e)?;
        let mut failure = None;
        for aim in SpeakerAim::ALL {
            let solved = self.speaker_solutions(microphone_mm, speaker_mm, aim);
            for most in TRIED {
                let ways = self.clear_ways(&self.speaker, &solved, most).0;
                match ways.and_then(|speakers| self.pick_clear_pair(microphones, &speakers)) {
                    Ok([microphone, speaker]) => return Ok(ArmPose { microphone, speaker, aim }),
                    Err(e) => failure = failure.max(Some(e)),
                }
            }
        }
        Err(failure.unwrap_or(UnreachableReason::NoPosition))
    }

    /// Returns the solutions of the microphone's arm for a position.
    pub fn microphone_ways(&self, position_mm: [f64; 3]) -> ArmSolutions {
        if !position_mm.iter().all(|x| x.is_finite()) {
            return ArmSolutions(Err(UnreachableReason::NoPosition));
        }
        let position = DVec3::from_array(position_mm) / 1e3;
        let away = self.microphone.foot().transform_vector(DVec3::X);
        let heading = away.y.atan2(away.x);
        let tilts: &[f64] = match self.rod {
            Rod::Leaning => &TILTS_DEG,
            Rod::Upright => &UPRIGHT_DEG,
        };
        let poses = tilts.iter().flat_map(|tilt| TURNS_DEG.map(|turn| (tilt.to_radians(), turn.to_radians())));
        let pose = |(tilt, turn): (f64, f64)| {
            let turn = DQuat::from_rotation_z(heading + turn) * DQuat::from_rotation_y(PI - tilt);
            Pose::from_parts(position, turn)
        };
        self.clear_ways(&self.microphone, &sorted_solutions(&self.microphone, poses.map(pose)), usize::MAX)
    }

    fn speaker_solutions(&self, microphone_mm: [f64; 3], speaker_mm: [f64; 3], aim: SpeakerAim) -> Vec<Joints> {
        let [microphone, speaker] = [microphone_mm, speaker_mm].map(|mm| DVec3::from_array(mm) / 1e3);
        // From below the panel's plane no mirror is seen; straight down will do, and is refused as what it is.
        let axis = if speaker.z > 0.0 && microphone.z > 0.0 { aim.aim_axis(microphone, speaker) } else { -DVec3::Z };
        let aimed = DQuat::from_rotation_arc(DVec3::Z, axis);
        let roll = |i: usize| aimed * DQuat::from_rotation_z(i as f64 * TAU / ROLLS as f64);
        sorted_solutions(&self.speaker, (0..ROLLS).map(|i| Pose::from_parts(speaker, roll(i))))
    }

    // The first ways, nearest to home, in which an arm touches neither itself nor its surroundings.
    fn clear_ways(&self, arm: &RobotArm, solved: &[Joints], most: usize) -> ArmSolutions {
        let mut failure = if solved.is_empty() {
            UnreachableReason::OutOfReach(arm.tool())
        } else {
            UnreachableReason::Joints(arm.tool())
        };
        let mut ways = Vec::new();
        for joints in solved.iter().filter(|joints| in_range(joints)) {
            let capsules = arm.link_capsules(joints);
            if !self.around.is_clear(&capsules) || touches_itself(&capsules, self.around.margin_m) {
                failure = UnreachableReason::Touches(arm.tool());
                continue;
            }
            ways.push(ArmSolution { joints: *joints, capsules, cost: from_home(joints) });
            if ways.len() == most {
                break;
            }
        }
        ArmSolutions(if ways.is_empty() { Err(failure) } else { Ok(ways) })
    }

    // The ways that are nearest to home together, of those in which the arms keep clear of each other.
    fn pick_clear_pair(
        &self,
        microphones: &[ArmSolution],
        speakers: &[ArmSolution],
    ) -> Result<[Joints; 2], UnreachableReason> {
        let mut best: Option<(f64, [Joints; 2])> = None;
        let mut touch = None;
        for a in microphones {
            for b in speakers {
                let cost = a.cost + b.cost;
                if best.as_ref().is_some_and(|(least, _)| cost >= *least) {
                    break;
                }
                match touching_parts(&a.capsules, &b.capsules, self.around.margin_m) {
                    None => best = Some((cost, [a.joints, b.joints])),
                    Some((a, b)) => touch = touch.or(Some(UnreachableReason::ArmsTouch(a, b))),
                }
            }
        }
        best.map(|(_, joints)| joints).ok_or(touch.unwrap_or(UnreachableReason::NoPosition))
    }

    /// Returns whether both arms keep clear of each other and of their surroundings.
    pub fn is_clear(&self, microphone: &Joints, speaker: &Joints) -> bool {
        let [a, b] = [self.microphone.link_capsules(microphone), self.speaker.link_capsules(speaker)];
        let alone = |arm| self.around.is_clear(arm) && !touches_itself(arm, self.around.margin_m);
        alone(&a) && alone(&b) && touching_parts(&a, &b, self.around.margin_m).is_none()
    }
}

// All joints that bring an arm's tool to one of these poses, nearest to home first.
fn sorted_solutions(arm: &RobotArm, poses: impl Iterator<Item = Pose>) -> Vec<Joints> {
    let mut found: Vec<(f64, Joints)> =
        poses.flat_map(|pose| arm.solve_joints(pose)).map(|q| (from_home(&q), q)).collect();
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    found.into_iter().map(|(_, joints)| joints).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell() -> Cell {
        Cell::from_rig(&Rig::paper())
    }

    #[test]
    fn the_tools_are_where_they_were_told_to_be_and_the_speaker_aims() {
        let (cell, microphone, speaker) = (cell(), [-37.5, 112.5, 124.0], [93.75, -93.75, 214.0]);
        let stand = cell.reach_positions(microphone, speaker).expect("within reach");
        for (wanted, reached) in [microphone, speaker].iter().zip(cell.positions_mm(&stand.microphone, &stand.speaker))
        {
            assert!(wanted.iter().zip(reached).all(|(a, b)| (a - b).abs() < 1e-6), "{reached:?}");
        }
        assert_eq!(stand.aim, SpeakerAim::Specular);
        // A ray along the axis, mirrored by the plane z = 0, meets the microphone.
        let frame = cell.arm_with_tool(Tool::Speaker).frames_over_panel(&stand.speaker)[7];
        let axis = frame.transform_vector(DVec3::Z);
        let to_image = (DVec3::new(-0.0375, 0.1125, -0.124) - frame.translation).normalize();
        assert!(axis.angle_between(to_image) < 1e-7);
        assert!(cell.is_clear(&stand.microphone, &stand.speaker));
    }

    #[test]
    fn what_cannot_be_reached_has_a_reason() {
        let cell = cell();
        let near = [-187.5, -187.5, 124.0];
        let reason = |microphone, speaker| cell.reach_positions(microphone, speaker).expect_err("out of reach");
        assert_eq!(reason(near, [0.0, 0.0, 5_000.0]), UnreachableReason::OutOfReach(Tool::Speaker));
        assert_eq!(reason([0.0, 2_000.0, 124.0], near), UnreachableReason::OutOfReach(Tool::Microphone));
        assert_eq!(reason([f64::NAN, 0.0, 124.0], near), UnreachableReason::NoPosition);
        assert_eq!(reason([0.0, 0.0, 10.0], near), UnreachableReason::Touches(Tool::Microphone));
        assert!(matches!(reason(near, near), UnreachableReason::ArmsTouch(ArmPart::Transducer, ArmPart::Transducer)));
    }
}
