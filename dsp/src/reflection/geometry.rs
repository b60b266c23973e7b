//! Paths between microphone and speaker, direct and by the mirror image in the plane z = 0. Positions in mm.

/// Length of the direct path, mm.
pub fn direct_mm(microphone: [f64; 3], speaker: [f64; 3]) -> f64 {
    vector_length([0, 1, 2].map(|i| microphone[i] - speaker[i]))
}

/// Length of the path by the speaker's mirror image, mm.
///
/// ```
/// use echolake_dsp::geometry::{direct_mm, image_mm, specular_point};
///
/// let (microphone, speaker) = ([0.0, 0.0, 20.0], [30.0, 0.0, 20.0]);
/// assert_eq!((direct_mm(microphone, speaker), image_mm(microphone, speaker)), (30.0, 50.0));
/// assert_eq!(specular_point(microphone, speaker), [15.0, 0.0]);
/// ```
pub fn image_mm(microphone: [f64; 3], speaker: [f64; 3]) -> f64 {
    direct_mm(microphone, mirrored_point(speaker))
}

/// Angle of that path against the plane's normal, degrees.
pub fn incidence_deg(microphone: [f64; 3], speaker: [f64; 3]) -> f64 {
    horizontal_mm(microphone, speaker).atan2(microphone[2] + speaker[2]).to_degrees()
}

/// Point at which that path meets the plane, mm.
pub fn specular_point(microphone: [f64; 3], speaker: [f64; 3]) -> [f64; 2] {
    let share = speaker[2] / (speaker[2] + microphone[2]);
    [0, 1].map(|i| speaker[i] + share * (microphone[i] - speaker[i]))
}

/// Horizontal distance, mm.
pub(crate) fn horizontal_mm(microphone: [f64; 3], speaker: [f64; 3]) -> f64 {
    (microphone[0] - speaker[0]).hypot(microphone[1] - speaker[1])
}

fn mirrored_point([x, y, z]: [f64; 3]) -> [f64; 3] {
    [x, y, -z]
}

fn vector_length(d: [f64; 3]) -> f64 {
    d.iter().map(|x| x * x).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_345_triangle() {
        let (microphone, speaker) = ([0.0, 0.0, 2.0], [3.0, 0.0, 2.0]);
        assert_eq!(direct_mm(microphone, speaker), 3.0);
        assert_eq!(image_mm(microphone, speaker), 5.0);
        assert!((incidence_deg(microphone, speaker) - (3.0f64 / 4.0).atan().to_degrees()).abs() < 1e-12);
        assert_eq!(specular_point(microphone, speaker), [1.5, 0.0]);
    }

    #[test]
    fn both_legs_meet_the_plane_at_the_same_angle() {
        let (microphone, speaker) = ([10.0, -40.0, 124.0], [150.0, 93.75, 304.0]);
        let [x, y] = specular_point(microphone, speaker);
        let slope = |p: [f64; 3]| (p[0] - x).hypot(p[1] - y) / p[2];
        assert!((slope(microphone) - slope(speaker)).abs() < 1e-12);
    }
}
