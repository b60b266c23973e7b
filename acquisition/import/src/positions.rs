//! Positions of foreign files: their type and units, and the millimetres that they mean.

/// Units of lengths, and how many millimetres each has.
const LENGTHS: [(&[&str], f64); 3] = [
    (&["metre", "metres", "meter", "meters", "m"], 1e3),
    (&["centimetre", "centimetres", "centimeter", "centimeters", "cm"], 10.0),
    (&["millimetre", "millimetres", "millimeter", "millimeters", "mm"], 1.0),
];
const DEGREES: &[&str] = &["degree", "degrees", "deg", "°"];
const RADIANS: &[&str] = &["radian", "radians", "rad"];

/// Type and units of three coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct CoordinateFrame {
    is_spherical: bool,
    /// Millimetres, or radians, of one unit of each coordinate.
    scales: [Scale; 3],
}

/// A unit of one coordinate.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Scale {
    Millimetres(f64),
    Degrees,
    Radians,
}

/// A type or unit that is not known.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct FrameFault {
    pub actual: String,
    pub expected: &'static str,
}

impl CoordinateFrame {
    /// Reads a type (cartesian if empty) and units: one of all coordinates, or a list; metres and degrees if empty.
    pub fn parse(kind: &str, units: &str) -> Result<Self, FrameFault> {
        let is_spherical = match kind.trim().to_lowercase().as_str() {
            "cartesian" | "" => false,
            "spherical" => true,
            _ => return Err(FrameFault { actual: format!("type `{kind}`"), expected: "cartesian or spherical" }),
        };
        let names = units.to_lowercase();
        let names: Vec<&str> =
            names.split(|c: char| c == ',' || c == ';' || c.is_whitespace()).filter(|name| !name.is_empty()).collect();
        let expected = if is_spherical {
            "degree or radian, the same again, and metre, centimetre or millimetre"
        } else {
            "metre, centimetre or millimetre, of all coordinates or of each of the three"
        };
        let fault = || FrameFault { actual: format!("units `{units}`"), expected };
        let names = match (names.as_slice(), is_spherical) {
            ([], false) => ["metre"; 3],
            ([], true) => ["degree", "degree", "metre"],
            ([one], false) => [*one; 3],
            ([a, b, c], _) => [*a, *b, *c],
            _ => return Err(fault()),
        };
        let mut scales = [Scale::Degrees; 3];
        for (i, (scale, name)) in scales.iter_mut().zip(names).enumerate() {
            let is_angle = is_spherical && i < 2;
            *scale = Scale::parse(name).filter(|s| is_angle != matches!(s, Scale::Millimetres(_))).ok_or_else(fault)?;
        }
        Ok(Self { is_spherical, scales })
    }

    /// Returns a position as cartesian coordinates, mm.
    pub fn position_mm(&self, position: [f64; 3]) -> [f64; 3] {
        let [a, b, c] = [0, 1, 2].map(|i| self.scales[i].scale_value(position[i]));
        if !self.is_spherical {
            return [a, b, c].map(to_nano);
        }
        // Azimuth and elevation, then the distance.
        let flat = c * b.cos();
        [flat * a.cos(), flat * a.sin(), c * b.sin()].map(to_nano)
    }
}

impl Scale {
    fn parse(name: &str) -> Option<Self> {
        let length = LENGTHS.iter().find(|(names, _)| names.contains(&name));
        match length {
            Some((_, millimetres)) => Some(Self::Millimetres(*millimetres)),
            None if DEGREES.contains(&name) => Some(Self::Degrees),
            None => RADIANS.contains(&name).then_some(Self::Radians),
        }
    }

    fn scale_value(self, x: f64) -> f64 {
        match self {
            Self::Millimetres(scale) => x * scale,
            Self::Degrees => x.to_radians(),
            Self::Radians => x,
        }
    }
}

/// Rounds to the ninth place: what metres or kelvin have behind it is their conversion's.
pub(crate) fn to_nano(x: f64) -> f64 {
    (x * 1e9).round() / 1e9
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_of_all_spellings_are_millimetres() {
        let check = |kind: &str, units: &str, position: [f64; 3], expected: [f64; 3]| {
            let frame = CoordinateFrame::parse(kind, units).unwrap_or_else(|e| panic!("{kind} {units}: {e:?}"));
            assert_eq!(frame.position_mm(position), expected, "{kind} {units}");
        };
        for units in ["", "metre", "meter", "m", "metres", "Meters", "METRE", "metre, metre, metre", "m m m", "m,m,m"] {
            check("cartesian", units, [0.15, -0.2, 1.0], [150.0, -200.0, 1000.0]);
        }
        for units in ["millimetre", "millimeters", "mm", "MM", "mm, mm, mm", " Millimetre "] {
            check("Cartesian", units, [150.0, -200.0, 1000.0], [150.0, -200.0, 1000.0]);
        }
        check("", "cm", [15.0, -20.0, 100.0], [150.0, -200.0, 1000.0]);
        check("cartesian", "metre, mm, cm", [0.15, -200.0, 100.0], [150.0, -200.0, 1000.0]);
        for units in
            ["", "degree, degree, metre", "degrees degrees,meter", "Degree, Degree, Metre", "deg;deg;m", "°, °, m"]
        {
            check("spherical", units, [90.0, 0.0, 1.5], [0.0, 1500.0, 0.0]);
        }
        let right = std::f64::consts::FRAC_PI_2;
        check("Spherical", "radian, radian, millimetre", [right, 0.0, 1500.0], [0.0, 1500.0, 0.0]);
        check("spherical", "degree, rad, cm", [90.0, right, 150.0], [0.0, 0.0, 1500.0]);
    }

    #[test]
    fn what_is_not_known_is_refused() {
        let refused = |kind: &str, units: &str, expected: &str| {
            let fault = CoordinateFrame::parse(kind, units).expect_err(expected);
            assert_eq!(fault.actual, expected);
        };
        refused("cartesian", "foot", "units `foot`");
        refused("cartesian", "degree, degree, metre", "units `degree, degree, metre`");
        refused("cartesian", "metre, metre", "units `metre, metre`");
        refused("spherical", "metre", "units `metre`");
        refused("spherical", "degree, metre, metre", "units `degree, metre, metre`");
        refused("spherical", "degree, degree, degree", "units `degree, degree, degree`");
        refused("spherical harmonics", "degree, degree, metre", "type `spherical harmonics`");
    }
}
