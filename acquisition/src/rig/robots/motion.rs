//! Motions from one pose of the arms to the next without touching anything: at once, one arm after the other, or with
//! arms drawn back meanwhile.

use super::arm::{Joints, SPEEDS_DEG, travel_secs};
use super::cell::{ArmPose, Cell};

/// Largest turn of a joint between two collision checks, degrees: 850 mm of arm move 15 mm.
const STEP_DEG: f64 = 1.0;
/// Shoulder and elbow of an arm that is drawn back, degrees: low over its foot, high, half-way out and others; if one
/// is blocked, another need not be.
const BACKS_DEG: [[f64; 2]; 8] = [
    [-70.0, 130.0],
    [-30.0, 70.0],
    [-30.0, 115.0],
    [0.0, 60.0],
    [-50.0, 100.0],
    [-90.0, 90.0],
    [-90.0, 140.0],
    [20.0, 100.0],
];

/// Order in which both arms get from one pose to another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MotionCourse {
    /// Both at once.
    Together,
    /// The microphone's arm, then the speaker's.
    MicrophoneFirst,
    /// The speaker's arm, then the microphone's.
    SpeakerFirst,
    /// The speaker's arm draws back, the microphone's moves, the speaker's comes out again.
    SpeakerDrawnBack,
    /// The microphone's arm draws back, the speaker's moves, the microphone's comes out again.
    MicrophoneDrawnBack,
    /// Both draw back, the speaker's first, and come out, the speaker's last.
    SpeakerLast,
    /// Both draw back, the microphone's first, and come out, the microphone's last.
    MicrophoneLast,
    /// Both draw back, each its own way, and come out in any order.
    BothDrawnBack,
}

impl MotionCourse {
    // Those that are tried first.
    const SIMPLE: [Self; 7] = [
        Self::Together,
        Self::MicrophoneFirst,
        Self::SpeakerFirst,
        Self::SpeakerDrawnBack,
        Self::MicrophoneDrawnBack,
        Self::SpeakerLast,
        Self::MicrophoneLast,
    ];

    // The poses on the way, the last included.
    fn stops_between(self, back_deg: [f64; 2], from: &Pose, to: &Pose) -> Vec<Pose> {
        let ([m0, s0], [m1, s1]) = (*from, *to);
        let [mb0, sb0, mb1, sb1] = [m0, s0, m1, s1].map(|joints| drawn_back(joints, back_deg));
        match self {
            Self::Together => vec![*to],
            Self::MicrophoneFirst => vec![[m1, s0], *to],
            Self::SpeakerFirst => vec![[m0, s1], *to],
            Self::SpeakerDrawnBack => vec![[m0, sb0], [m1, sb1], *to],
            Self::MicrophoneDrawnBack => vec![[mb0, s0], [mb1, s1], *to],
            Self::SpeakerLast => vec![[m0, sb0], [mb0, sb0], [mb1, sb1], [m1, sb1], *to],
            Self::MicrophoneLast => vec![[mb0, s0], [mb0, sb0], [mb1, sb1], [mb1, s1], *to],
            Self::BothDrawnBack => vec![[mb0, sb0], [mb1, sb1], *to],
        }
    }
}

// Upper arm and forearm leant back over the foot: the tool goes up and away from the panel.
fn drawn_back(mut joints: Joints, [shoulder, elbow]: [f64; 2]) -> Joints {
    (joints[1], joints[2]) = (shoulder.to_radians(), elbow.to_radians());
    joints
}

type Pose = [Joints; 2];

/// A motion from one pose of both arms to another.
#[derive(Debug, Clone)]
pub struct ArmMotion {
    /// Order of its moves.
    pub course: MotionCourse,
    /// Joints of microphone's and speaker's arm at each stop, the last included.
    pub stops: Vec<[Joints; 2]>,
    /// Time that it takes at least, s: the data sheet's speeds, acceleration left out.
    pub secs: f64,
}

/// Returns a course on which nothing touches, the quickest of its kind; None if no [`MotionCourse`] is one.
pub fn plan_motion(cell: &Cell, from: &ArmPose, to: &ArmPose) -> Option<ArmMotion> {
    let [from, to] = [from, to].map(|s| [s.microphone, s.speaker]);
    let motion = |(course, back_deg): (MotionCourse, [f64; 2])| {
        ArmMotion::new(course, &from, course.stops_between(back_deg, &from, &to))
    };
    let ways = BACKS_DEG.iter().flat_map(|back_deg| MotionCourse::SIMPLE.map(|course| (course, *back_deg)));
    let mut motions: Vec<_> = ways.map(motion).collect();
    motions.sort_by(|a, b| a.secs.total_cmp(&b.secs));
    let is_free = |motion: &ArmMotion| motion_legs(&from, &motion.stops).all(|(a, b)| is_clear(cell, a, b));
    motions.into_iter().find(is_free).or_else(|| both_drawn_back(cell, &from, &to))
}

// Any way out of the first pose with any way out of the second, backwards.
fn both_drawn_back(cell: &Cell, from: &Pose, to: &Pose) -> Option<ArmMotion> {
    let outs = find_retreats(cell, from);
    let ins = find_retreats(cell, to);
    let pairs = outs.iter().flat_map(|out| ins.iter().map(move |back| (out, back)));
    let motion = |(out, back): (&Vec<Pose>, &Vec<Pose>)| {
        let stops = out.iter().chain(back.iter().rev()).chain([to]).copied().collect();
        let joint = [out.last().copied().unwrap_or(*from), back.last().copied().unwrap_or(*to)];
        (ArmMotion::new(MotionCourse::BothDrawnBack, from, stops), joint)
    };
    let mut motions: Vec<_> = pairs.map(motion).collect();
    motions.sort_by(|(a, _), (b, _)| a.secs.total_cmp(&b.secs));
    motions.into_iter().find(|(_, [out, back])| is_clear(cell, out, back)).map(|(motion, _)| motion)
}

// The ways in which both arms can draw back from a pose: the stops of each.
fn find_retreats(cell: &Cell, from: &Pose) -> Vec<Vec<Pose>> {
    let [m, s] = *from;
    let backs = BACKS_DEG.iter().flat_map(|a| BACKS_DEG.iter().map(move |b| (drawn_back(m, *a), drawn_back(s, *b))));
    let ways = backs.flat_map(|(mb, sb)| [vec![[mb, sb]], vec![[mb, s], [mb, sb]], vec![[m, sb], [mb, sb]]]);
    ways.filter(|stops| motion_legs(from, stops).all(|(a, b)| is_clear(cell, a, b))).collect()
}

impl ArmMotion {
    fn new(course: MotionCourse, from: &Pose, stops: Vec<Pose>) -> Self {
        let secs = motion_legs(from, &stops).map(|(a, b)| leg_secs(a, b)).sum();
        Self { course, stops, secs }
    }
}

fn motion_legs<'a>(from: &'a Pose, stops: &'a [Pose]) -> impl Iterator<Item = (&'a Pose, &'a Pose)> {
    std::iter::once(from).chain(stops).zip(stops)
}

/// Least time of both arms from one pose to another, s.
fn leg_secs(from: &Pose, to: &Pose) -> f64 {
    travel_secs(&from[0], &to[0]).max(travel_secs(&from[1], &to[1]))
}

// All joints start and arrive together, as a trajectory of two points is driven.
fn is_clear(cell: &Cell, from: &Pose, to: &Pose) -> bool {
    let widest = from.iter().flatten().zip(to.iter().flatten()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    let steps = (widest.to_degrees() / STEP_DEG).ceil().max(1.0) as usize;
    let between = |arm: usize, share: f64| -> Joints {
        std::array::from_fn(|i| from[arm][i] + share * (to[arm][i] - from[arm][i]))
    };
    (0..=steps).map(|i| i as f64 / steps as f64).all(|share| cell.is_clear(&between(0, share), &between(1, share)))
}

/// Returns a pose as twelve times, s: the greatest difference of two is the time between them.
pub(super) fn as_secs(standing: &ArmPose) -> [f32; 12] {
    std::array::from_fn(|i| {
        let joints = if i < 6 { &standing.microphone } else { &standing.speaker };
        (joints[i % 6].to_degrees() / SPEEDS_DEG[i % 6]) as f32
    })
}
