//! Air: the speed of sound in it, and its absorption.

use std::ops::RangeInclusive;

use echolake_schema::AirTreatment;

use crate::Error;
use crate::temperature::speed_of_sound;

/// 0 C, 20 C and the triple point of water, K.
const ZERO_CELSIUS_K: f64 = 273.15;
const REFERENCE_K: f64 = 293.15;
const TRIPLE_POINT_K: f64 = 273.16;
/// Reference pressure, hPa.
const REFERENCE_HPA: f64 = 1_013.25;

/// Humidity, %, and pressure, hPa, that air can have in a laboratory.
const HUMIDITY_PCT: RangeInclusive<f64> = 0.0..=100.0;
const PRESSURE_HPA: RangeInclusive<f64> = 300.0..=1_100.0;
/// Share of carbon dioxide, by amount.
const CARBON_DIOXIDE: f64 = 0.000_4;
/// Coefficients of the speed of sound, T in C, pressure in Pa, shares by amount: of 1, T and T^2; of the share of water
/// with each; of the pressure with each; of the share of carbon dioxide with each; of the squares of all three; of
/// their product.
const CRAMER: [f64; 16] = [
    331.502_4,
    0.603_055,
    -0.000_528,
    51.471_935,
    0.149_587_4,
    -0.000_782,
    -1.82e-7,
    3.73e-8,
    -2.93e-10,
    -85.209_31,
    -0.228_525,
    5.91e-5,
    -2.835_149,
    -2.15e-13,
    29.179_762,
    0.000_486,
];

/// State of the air.
///
/// ```
/// use echolake_dsp::air::AirState;
/// use echolake_schema::AirTreatment;
///
/// let air = |humidity_pct| AirState { temperature_c: 20.0, humidity_pct, pressure_hpa: 1_013.25 };
/// let change = |treatment| air(60.0).speed_of_sound(treatment) / air(50.0).speed_of_sound(treatment) - 1.0;
/// // As much as 0.21 K.
/// assert!((change(AirTreatment::Complete) - 0.000_364).abs() < 0.000_001);
/// assert_eq!(change(AirTreatment::Paper), 0.0);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AirState {
    /// Temperature, C.
    pub temperature_c: f64,
    /// Relative humidity, %.
    pub humidity_pct: f64,
    /// Pressure, hPa.
    pub pressure_hpa: f64,
}

impl AirState {
    /// Relative humidity of the reference air, and of air whose humidity nobody measured, %.
    pub const REFERENCE_HUMIDITY_PCT: f64 = 50.0;
    /// Pressure of the reference air, and of air whose pressure nobody measured, hPa.
    pub const REFERENCE_PRESSURE_HPA: f64 = REFERENCE_HPA;

    /// Air of a temperature in C, with the reference air's values where humidity (%) and pressure (hPa) are unknown, or
    /// are such as no air has.
    pub fn with_known(temperature_c: f64, humidity_pct: Option<f64>, pressure_hpa: Option<f64>) -> Self {
        Self {
            temperature_c,
            humidity_pct: humidity_pct.filter(|x| HUMIDITY_PCT.contains(x)).unwrap_or(Self::REFERENCE_HUMIDITY_PCT),
            pressure_hpa: pressure_hpa.filter(|x| PRESSURE_HPA.contains(x)).unwrap_or(Self::REFERENCE_PRESSURE_HPA),
        }
    }

    /// Checks humidity and pressure.
    ///
    /// # Errors
    /// [`Error::Setting`] outside of 0 to 100 % and 300 to 1100 hPa.
    pub fn check_moisture(&self) -> Result<(), Error> {
        let refuse = |what, value: f64, expected| Err(Error::Setting { what, actual: value.to_string(), expected });
        if !HUMIDITY_PCT.contains(&self.humidity_pct) {
            return refuse("the humidity (%)", self.humidity_pct, "0 to 100");
        }
        if !PRESSURE_HPA.contains(&self.pressure_hpa) {
            return refuse("the pressure (hPa)", self.pressure_hpa, "300 to 1100");
        }
        Ok(())
    }

    /// Computes the speed of sound, m/s: by Cramer's formula, or by the paper's.
    ///
    /// Cramer's formula is within 0.03 % from 0 to 30 C, 750 to 1020 hPa, and any humidity; elsewhere it extrapolates.
    ///
    /// Source: Cramer 1993, "The variation of the specific heat ratio and the speed of sound in air with temperature,
    /// pressure, humidity, and CO2 concentration", JASA 93, table III and equations of its appendix.
    pub fn speed_of_sound(&self, treatment: AirTreatment) -> f64 {
        if treatment == AirTreatment::Paper {
            return speed_of_sound(self.temperature_c);
        }
        let [a0, a1, a2, a3, a4, a5, a6, a7, a8, a9, a10, a11, a12, a13, a14, a15] = CRAMER;
        let t = self.temperature_c;
        let p = 100.0 * self.pressure_hpa;
        let w = self.water_share();
        let x = CARBON_DIOXIDE;
        a0 + t * (a1 + t * a2)
            + w * (a3 + t * (a4 + t * a5))
            + p * (a6 + t * (a7 + t * a8))
            + x * (a9 + t * (a10 + t * a11))
            + a12 * w * w
            + a13 * p * p
            + a14 * x * x
            + a15 * w * p * x
    }

    // Share of water vapour, by amount.
    fn water_share(&self) -> f64 {
        let pascal = 100.0 * self.pressure_hpa;
        let kelvin = self.temperature_c + ZERO_CELSIUS_K;
        let enhancement = 1.000_62 + 3.14e-8 * pascal + 5.6e-7 * self.temperature_c.powi(2);
        let saturation_pa =
            (1.281_180_5e-5 * kelvin.powi(2) - 1.950_987_4e-2 * kelvin + 34.049_260_34 - 6.353_631_1e3 / kelvin).exp();
        self.humidity_pct / 100.0 * enhancement * saturation_pa / pascal
    }
}

/// Absorption of pure tones by air of one temperature, humidity and pressure.
///
/// ```
/// use echolake_dsp::air::{AirAbsorption, AirState};
///
/// let air = AirAbsorption::new(&AirState { temperature_c: 20.0, humidity_pct: 45.0, pressure_hpa: 965.0 });
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
    /// The absorption by air in this state.
    pub fn new(&AirState { temperature_c, humidity_pct, pressure_hpa }: &AirState) -> Self {
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
        self.db_per_m_of_square(frequency_hz * frequency_hz)
    }

    // Of the square of a frequency, Hz^2.
    pub(crate) fn db_per_m_of_square(&self, square: f64) -> f64 {
        let relaxation = |[hz, strength]: [f64; 2]| strength * hz / (hz * hz + square);
        8.686 * square * (self.classical + relaxation(self.oxygen) + relaxation(self.nitrogen))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // Computed in Python from the coefficients as Cramer prints them, with 0.04 % of carbon dioxide.
    #[test]
    fn speeds_are_cramers() {
        for (temperature_c, humidity_pct, pressure_hpa, expected) in [
            (0.0, 0.0, 1_013.25, 331.447_67),
            (20.0, 0.0, 1_013.25, 343.359_47),
            (20.0, 50.0, 1_013.25, 343.986_73),
            (18.0, 30.0, 965.0, 342.533_94),
            (25.0, 60.0, 965.0, 347.346_90),
        ] {
            let air = AirState { temperature_c, humidity_pct, pressure_hpa };
            assert!((air.speed_of_sound(AirTreatment::Complete) - expected).abs() < 1e-4, "{air:?}");
        }
    }

    // Table 2 of ISO 9613-2:1996, dB/km by octave from 63 Hz, printed with two digits.
    #[test]
    fn octaves_are_those_of_the_standard() {
        for (temperature_c, humidity_pct, expected) in [
            (10.0, 70.0, [0.1, 0.4, 1.0, 1.9, 3.7, 9.7, 32.8, 117.0]),
            (20.0, 70.0, [0.1, 0.3, 1.1, 2.8, 5.0, 9.0, 22.9, 76.6]),
            (15.0, 20.0, [0.3, 0.6, 1.2, 2.7, 8.2, 28.2, 88.8, 202.0]),
        ] {
            let air = AirAbsorption::new(&AirState { temperature_c, humidity_pct, pressure_hpa: 1_013.25 });
            for (octave, expected) in (0..).zip(expected) {
                // Exact octaves around 1 kHz, by powers of ten, as the standard computes.
                let hz = 1e3 * 10f64.powf(0.3 * f64::from(octave - 4));
                let got = 1e3 * air.db_per_m(hz);
                assert!((got - expected).abs() < 0.05 + 0.01 * expected, "{temperature_c} C, {hz}: {got}");
            }
        }
    }
}
