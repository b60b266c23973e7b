//! Absorption of sound by air.

/// 0 C, 20 C and the triple point of water, K.
const ZERO_CELSIUS_K: f64 = 273.15;
const REFERENCE_K: f64 = 293.15;
const TRIPLE_POINT_K: f64 = 273.16;
/// Reference pressure, hPa.
const REFERENCE_HPA: f64 = 1_013.25;

/// Absorption of pure tones by air of one temperature, humidity and pressure.
///
/// ```
/// let air = echolake_dsp::air::AirAbsorption::new(20.0, 45.0, 965.0);
/// assert!((air.db_per_m(40e3) - 1.27).abs() < 0.05);
/// ```
///
/// Source: ISO 9613-1:1993, equations 3 to 5, B.1 to B.3.
#[derive(Debug, Clone, Copy)]
pub struct AirAbsorption {
    /// Relaxation frequencies of oxygen and nitrogen, Hz, and what each absorbs.
    oxygen: [f64; 2],
    nitrogen: [f64; 2],
    classical: f64,
}

impl AirAbsorption {
    /// Air of a temperature in C, a relative humidity in % and a pressure in hPa.
    pub fn new(temperature_c: f64, humidity_pct: f64, pressure_hpa: f64) -> Self {
        let kelvin = temperature_c + ZERO_CELSIUS_K;
        let warmth = kelvin / REFERENCE_K;
        let pressure = pressure_hpa / REFERENCE_HPA;
        let saturation = 10f64.powf(4.6151 - 6.8346 * (TRIPLE_POINT_K / kelvin).powf(1.261));
        // Molar concentration of water vapour, %.
        let water = humidity_pct * saturation / pressure;
        let oxygen_hz = pressure * (24.0 + 4.04e4 * water * (0.02 + water) / (0.391 + water));
        let nitrogen_hz =
            pressure / warmth.sqrt() * (9.0 + 280.0 * water * (-4.170 * (warmth.powf(-1.0 / 3.0) - 1.0)).exp());
        let share = warmth.powf(-2.5);
        Self {
            oxygen: [oxygen_hz, share * 0.012_75 * (-2_239.1 / kelvin).exp()],
            nitrogen: [nitrogen_hz, share * 0.106_8 * (-3_352.0 / kelvin).exp()],
            classical: 1.84e-11 / pressure * warmth.sqrt(),
        }
    }

    /// Attenuation of a pure tone, dB/m.
    pub fn db_per_m(&self, frequency_hz: f64) -> f64 {
        let square = frequency_hz * frequency_hz;
        let relaxation = |[hz, strength]: [f64; 2]| strength / (hz + square / hz);
        8.686 * square * (self.classical + relaxation(self.oxygen) + relaxation(self.nitrogen))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // Table 2 of ISO 9613-2:1996, dB/km by octave from 63 Hz, printed with two digits.
    #[test]
    fn octaves_are_those_of_the_standard() {
        for (temperature_c, humidity_pct, expected) in [
            (10.0, 70.0, [0.1, 0.4, 1.0, 1.9, 3.7, 9.7, 32.8, 117.0]),
            (20.0, 70.0, [0.1, 0.3, 1.1, 2.8, 5.0, 9.0, 22.9, 76.6]),
            (15.0, 20.0, [0.3, 0.6, 1.2, 2.7, 8.2, 28.2, 88.8, 202.0]),
        ] {
            let air = AirAbsorption::new(temperature_c, humidity_pct, 1_013.25);
            for (octave, expected) in (0..).zip(expected) {
                // Exact octaves around 1 kHz, by powers of ten, as the standard computes.
                let hz = 1e3 * 10f64.powf(0.3 * f64::from(octave - 4));
                let got = 1e3 * air.db_per_m(hz);
                assert!((got - expected).abs() < 0.05 + 0.01 * expected, "{temperature_c} C, {hz}: {got}");
            }
        }
    }
}
