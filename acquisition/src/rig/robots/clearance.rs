//! Distances between capsules: arm to arm, arm to itself, arm to panel and table.

use rs_opw_kinematics::glam::DVec3;

use super::arm::{ArmPart, LinkCapsule};

/// Obstacles around the arms, beside each other.
#[derive(Debug, Clone, Copy)]
pub struct ArmSurroundings {
    /// Half the panel's side, m.
    pub half_m: f64,
    /// The relief's highest point, m over the panel's mean plane.
    pub relief_m: f64,
    /// The table, m over the panel's mean plane; negative, the panel stands on it.
    pub table_m: f64,
    /// Least distance of anything from anything, m.
    pub margin_m: f64,
}

/// Distance of two capsules' surfaces, m; negative if they overlap.
pub fn capsule_distance(a: &LinkCapsule, b: &LinkCapsule) -> f64 {
    segment_distance(a.from, a.to, b.from, b.to) - a.radius - b.radius
}

/// The first parts of two arms that are nearer to each other than `margin_m`.
pub fn touching_parts(a: &[LinkCapsule; 6], b: &[LinkCapsule; 6], margin_m: f64) -> Option<(ArmPart, ArmPart)> {
    let near = |a: &&LinkCapsule, b: &LinkCapsule| capsule_distance(a, b) < margin_m;
    a.iter().rev().find_map(|a| b.iter().rev().find(|b| near(&a, b)).map(|b| (a.part, b.part)))
}

/// Returns whether an arm touches itself: wrist and tool with column and upper arm. Neighbours touch always.
pub fn touches_itself(arm: &[LinkCapsule; 6], margin_m: f64) -> bool {
    arm[3..].iter().any(|outer| arm[..2].iter().any(|inner| capsule_distance(outer, inner) < margin_m))
}

impl ArmSurroundings {
    /// Returns whether an arm that stands on the table keeps away from the table and the panel.
    pub fn is_clear(&self, arm: &[LinkCapsule; 6]) -> bool {
        arm[1..].iter().all(|c| self.over_table(c) && self.over_panel(c))
    }

    fn over_table(&self, c: &LinkCapsule) -> bool {
        c.from.z.min(c.to.z) - c.radius >= self.table_m + self.margin_m
    }

    // The part of the segment that is over the panel, widened by radius and margin, has to be high enough.
    fn over_panel(&self, c: &LinkCapsule) -> bool {
        let reach = self.half_m + c.radius + self.margin_m;
        let along = c.to - c.from;
        let mut range = [0.0f64, 1.0];
        for (from, along) in [(c.from.x, along.x), (c.from.y, along.y)] {
            if along == 0.0 && from.abs() > reach {
                return true;
            }
            if along != 0.0 {
                let [a, b] = [(-reach - from) / along, (reach - from) / along];
                range = [range[0].max(a.min(b)), range[1].min(a.max(b))];
            }
        }
        let height = |t: f64| c.from.z + t * along.z - c.radius;
        range[0] > range[1] || range.map(height).into_iter().fold(f64::MAX, f64::min) >= self.relief_m + self.margin_m
    }
}

// Least distance of two segments (Ericson, Real-Time Collision Detection, 5.1.9).
fn segment_distance(p1: DVec3, q1: DVec3, p2: DVec3, q2: DVec3) -> f64 {
    let d1 = q1 - p1;
    let d2 = q2 - p2;
    let r = p1 - p2;
    let a = d1.dot(d1);
    let e = d2.dot(d2);
    let f = d2.dot(r);
    let b = d1.dot(d2);
    let c = d1.dot(r);
    let clamped = |x: f64| if x.is_finite() { x.clamp(0.0, 1.0) } else { 0.0 };
    let parallel = a * e - b * b;
    let s = if parallel > 1e-12 { clamped((b * f - c * e) / parallel) } else { 0.0 };
    let (s, t) = match (b * s + f) / e {
        t if t.is_nan() => (clamped(-c / a), 0.0),
        t if t < 0.0 => (clamped(-c / a), 0.0),
        t if t > 1.0 => (clamped((b - c) / a), 1.0),
        t => (s, t),
    };
    (p1 + d1 * s).distance(p2 + d2 * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn capsule(from: [f64; 3], to: [f64; 3], radius: f64) -> LinkCapsule {
        LinkCapsule { part: ArmPart::Forearm, from: from.into(), to: to.into(), radius }
    }

    #[test]
    fn distances_are_those_of_a_fine_search() {
        let mut x = 1u64;
        let mut random = || {
            x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (x >> 33) as f64 / f64::from(1u32 << 30) - 1.0
        };
        for _ in 0..200 {
            let mut point = || DVec3::new(random(), random(), random());
            let [p1, q1, p2, q2] = [point(), point(), point(), point()];
            let along = |p: DVec3, q: DVec3, i: i32| p + (q - p) * (f64::from(i) / 200.0);
            let searched = (0..=200)
                .flat_map(|i| (0..=200).map(move |j| (i, j)))
                .map(|(i, j)| along(p1, q1, i).distance(along(p2, q2, j)))
                .fold(f64::MAX, f64::min);
            let found = segment_distance(p1, q1, p2, q2);
            assert!(found <= searched + 1e-12 && searched < found + 0.02, "{found} {searched}");
        }
    }

    #[test]
    fn points_and_parallels_have_distances_too() {
        let check = |a: [[f64; 3]; 2], b: [[f64; 3]; 2], expected: f64| {
            let found = capsule_distance(&capsule(a[0], a[1], 0.1), &capsule(b[0], b[1], 0.2));
            assert!((found - (expected - 0.3)).abs() < 1e-12, "{found}");
        };
        check([[0.0; 3], [1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0], [1.0, 1.0, 0.0]], 1.0);
        check([[0.0; 3], [0.0; 3]], [[0.0, 2.0, 0.0], [1.0, 2.0, 0.0]], 2.0);
        check([[0.0; 3], [0.0; 3]], [[0.0, 0.0, 3.0], [0.0, 0.0, 3.0]], 3.0);
        check([[0.0; 3], [1.0, 0.0, 0.0]], [[3.0, 0.0, 0.0], [4.0, 0.0, 0.0]], 2.0);
    }

    #[test]
    fn what_dips_into_the_panel_is_not_clear() {
        let around = ArmSurroundings { half_m: 0.3, relief_m: 0.03, table_m: -0.1, margin_m: 0.01 };
        let over = |from, to| around.over_panel(&capsule(from, to, 0.02));
        assert!(over([-0.6, 0.0, 0.0], [-0.35, 0.0, 0.0]), "beside the panel");
        assert!(!over([-0.6, 0.0, 0.2], [0.0, 0.0, 0.05]), "into it");
        assert!(over([-0.6, 0.0, 0.2], [0.0, 0.0, 0.07]), "over it");
        assert!(over([-0.6, 0.0, 0.0], [-0.29, 0.0, 0.5]), "up beside it");
    }
}
