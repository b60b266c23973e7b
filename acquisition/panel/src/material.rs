//! Materials of simulated panels: the share of the sound that they reflect at each frequency.

use std::f64::consts::TAU;

use realfft::num_complex::Complex;

/// Absorption of the coated print at low frequencies: below 0.1 in the impedance tube, 2 to 6 kHz (Rust et al. 2021).
const PRINT_ABSORPTION: f64 = 0.048;
/// The print's reflection falls between these frequencies. The paper tells only that Flat reflects 29.3 % less energy
/// than Wood; the lower frequency keeps its absorption below 0.1 up to 6 kHz, the upper one makes the 29.3 %.
const PRINT_SHELF_HZ: [f64; 2] = [20_000.0, 31_200.0];
/// Pressure reflection factor of the board.
const BOARD_FACTOR: f64 = 0.99;
/// Thickness of the foam (Rust et al. 2021), m, and its resistance to flow, Pa s/m^2: an assumption amid the 8 to 20
/// kPa s/m^2 that is usual for melamine foam.
const FOAM_M: f64 = 0.05;
const FOAM_RESISTIVITY: f64 = 10e3;
/// Speed of sound at 20 C, m/s.
const SPEED_M_S: f64 = 343.2;
/// Below this frequency the foam's model is not evaluated, Hz.
const FOAM_LOWEST_HZ: f64 = 100.0;

/// Material of a surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SurfaceMaterial {
    /// Printed sand with two coats of paint.
    CoatedPrint,
    /// A board of wood fibres.
    FibreBoard,
    /// 50 mm of melamine foam on a hard back.
    MelamineFoam,
}

impl SurfaceMaterial {
    /// Its name, as table `surfaces` has it.
    pub fn name(self) -> &'static str {
        match self {
            Self::CoatedPrint => "coated print",
            Self::FibreBoard => "MDF",
            Self::MelamineFoam => "melamine foam",
        }
    }

    /// Pressure reflection factor as one number for all frequencies.
    pub fn reflection_factor(self) -> f64 {
        match self {
            Self::CoatedPrint => 0.83,
            Self::FibreBoard => BOARD_FACTOR,
            Self::MelamineFoam => 0.05,
        }
    }

    /// Pressure reflection factor at normal incidence and one frequency.
    pub fn reflection_at(self, frequency_hz: f64) -> Complex<f64> {
        match self {
            Self::CoatedPrint => {
                let [falls, ends] = PRINT_SHELF_HZ.map(|corner| Complex::new(1.0, frequency_hz / corner));
                ends / falls * (1.0 - PRINT_ABSORPTION).sqrt()
            }
            Self::FibreBoard => BOARD_FACTOR.into(),
            Self::MelamineFoam => foam_reflection(frequency_hz.max(FOAM_LOWEST_HZ)),
        }
    }
}

// Impedance and wave number of a fibrous layer by its resistance to flow: Miki 1990, J. Acoust. Soc. Jpn. (E) 11(1),
// 19-24, who mended Delany's and Bazley's; time goes as e^(i omega t).
fn foam_reflection(frequency_hz: f64) -> Complex<f64> {
    let x = 1e3 * frequency_hz / FOAM_RESISTIVITY;
    let impedance = Complex::new(1.0 + 5.50 * x.powf(-0.632), -8.43 * x.powf(-0.632));
    let wave_number =
        Complex::new(1.0 + 7.81 * x.powf(-0.618), -11.41 * x.powf(-0.618)) * (TAU * frequency_hz / SPEED_M_S);
    let surface = impedance * Complex::new(0.0, -1.0) / (wave_number * FOAM_M).tan();
    (surface - 1.0) / (surface + 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reflection_is_as_published() {
        let absorption = |material: SurfaceMaterial, hz| 1.0 - material.reflection_at(hz).norm_sqr();
        for hz in [2e3, 4e3, 6e3] {
            let print = absorption(SurfaceMaterial::CoatedPrint, hz);
            assert!((0.04..0.1).contains(&print), "{hz}: {print}");
        }
        // Less of the higher frequencies comes back. The foam's back is heard at the lowest alone.
        let octaves = |material: SurfaceMaterial| {
            [0, 1, 2, 3, 4].map(|n| material.reflection_at(2_500.0 * f64::from(1 << n)).norm())
        };
        let print = octaves(SurfaceMaterial::CoatedPrint);
        assert!(print.windows(2).all(|pair| pair[1] < pair[0]) && print[4] > 0.6, "{print:?}");
        let foam = octaves(SurfaceMaterial::MelamineFoam);
        assert!(foam.iter().all(|factor| *factor < 0.25) && foam[2] > 2.0 * foam[4], "{foam:?}");
    }
}
