//! The first Fresnel zone of a reflection in the plane z = 0.

use crate::geometry::{horizontal_mm, image_mm, specular_point};

/// An ellipse in the plane z = 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FresnelZone {
    /// Its centre, mm.
    pub centre_mm: [f64; 2],
    /// Half its diameter in the plane of incidence, mm.
    pub semi_major_mm: f64,
    /// Half its diameter across, mm.
    pub semi_minor_mm: f64,
}

/// The first Fresnel zone: the points of the plane over which a path is at most half a wavelength longer than the
/// reflection's, the section of the spheroid with the speaker and the microphone's image as foci.
///
/// The paper's own four diameters fit no definition exactly; this one gives 227.6 to 535.5 mm at 2 kHz and
/// 47.3 to 162.3 mm at 40 kHz over the measured pairs.
///
/// ```
/// let above = [0.0, 0.0, 100.0];
/// let zone = echolake_dsp::fresnel::first_fresnel_zone(above, above, 3_430.0, 343.0);
/// assert!((zone.semi_major_mm - 75.0).abs() < 1e-9 && (zone.semi_minor_mm - 75.0).abs() < 1e-9);
/// ```
pub fn first_fresnel_zone(
    microphone: [f64; 3],
    speaker: [f64; 3],
    frequency_hz: f64,
    speed_of_sound_m_s: f64,
) -> FresnelZone {
    let from = speaker[2];
    let to = microphone[2];
    let distance = horizontal_mm(microphone, speaker);
    let excess = speed_of_sound_m_s * 1e3 / frequency_hz / 2.0;
    let path = image_mm(microphone, speaker) + excess;
    let k = from * from - to * to - distance * distance;
    // A x^2 + B x + C + (2 L)^2 y^2 = 0, x from the speaker's foot towards the microphone's.
    let a = 4.0 * (path * path - distance * distance);
    let b = -4.0 * distance * (path * path + k);
    let c = 4.0 * path * path * from * from - (path * path + k).powi(2);
    let g = b * b / (4.0 * a) - c;
    let along = -b / (2.0 * a);
    let centre_mm = if distance == 0.0 {
        specular_point(microphone, speaker)
    } else {
        [0, 1].map(|i| speaker[i] + (microphone[i] - speaker[i]) * along / distance)
    };
    FresnelZone { centre_mm, semi_major_mm: (g / a).sqrt(), semi_minor_mm: g.sqrt() / (2.0 * path) }
}

#[cfg(test)]
mod tests {
    use super::*;

    // On the ellipse the detour is half a wavelength: the definition itself, at all four ends of its axes.
    #[test]
    fn the_rim_is_half_a_wavelength_longer() {
        let (microphone, speaker) = ([-100.0, 30.0, 124.0], [150.0, -60.0, 304.0]);
        let zone = first_fresnel_zone(microphone, speaker, 5_000.0, 343.0);
        let d = horizontal_mm(microphone, speaker);
        let [ux, uy] = [(microphone[0] - speaker[0]) / d, (microphone[1] - speaker[1]) / d];
        let ends = [
            (zone.semi_major_mm * ux, zone.semi_major_mm * uy),
            (-zone.semi_major_mm * ux, -zone.semi_major_mm * uy),
            (-zone.semi_minor_mm * uy, zone.semi_minor_mm * ux),
            (zone.semi_minor_mm * uy, -zone.semi_minor_mm * ux),
        ];
        for (dx, dy) in ends {
            let p = [zone.centre_mm[0] + dx, zone.centre_mm[1] + dy];
            let leg = |q: [f64; 3]| ((p[0] - q[0]).powi(2) + (p[1] - q[1]).powi(2) + q[2] * q[2]).sqrt();
            let detour = leg(microphone) + leg(speaker) - image_mm(microphone, speaker);
            assert!((detour - 343e3 / 5e3 / 2.0).abs() < 1e-6, "{detour}");
        }
    }
}
