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
    /// Melamine foam on a hard back.
    MelamineFoam,
}

/// A layer of foam on a hard back.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FoamLayer {
    /// Resistance to flow, Pa s/m^2.
    pub flow_resistivity: f64,
    /// Thickness, mm.
    pub thickness_mm: f64,
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

    /// Pressure reflection factor for plane waves of one frequency; only that of foam depends on the angle of
    /// incidence.
    pub fn reflection_at(self, frequency_hz: f64, incidence_deg: f64, foam: FoamLayer) -> Complex<f64> {
        match self {
            Self::CoatedPrint => {
                let [falls, ends] = PRINT_SHELF_HZ.map(|corner| Complex::new(1.0, frequency_hz / corner));
                ends / falls * (1.0 - PRINT_ABSORPTION).sqrt()
            }
            Self::FibreBoard => BOARD_FACTOR.into(),
            Self::MelamineFoam => foam.reflection_at(frequency_hz, incidence_deg),
        }
    }
}

impl FoamLayer {
    /// Pressure reflection factor for plane waves of one frequency at an angle of incidence. Waves go through the layer
    /// in the direction that Snell's law gives them (bulk reaction). Time goes as e^(i omega t).
    ///
    /// R = (Zs cos(a) - 1)/(Zs cos(a) + 1), Zs = -i Zc (k/kz) cot(kz d), kz^2 = k^2 - (k0 sin(a))^2, impedances over
    /// the air's: Allard & Atalla 2009, Propagation of Sound in Porous Media, chapter 3. Zc and k by the resistance to
    /// flow: Miki 1990, J. Acoust. Soc. Jpn. (E) 11(1), 19-24, who mended Delany's and Bazley's.
    pub fn reflection_at(self, frequency_hz: f64, incidence_deg: f64) -> Complex<f64> {
        let frequency_hz = frequency_hz.max(FOAM_LOWEST_HZ);
        let x = 1e3 * frequency_hz / self.flow_resistivity;
        let impedance = Complex::new(1.0 + 5.50 * x.powf(-0.632), -8.43 * x.powf(-0.632));
        let index = Complex::new(1.0 + 7.81 * x.powf(-0.618), -11.41 * x.powf(-0.618));
        let incidence = incidence_deg.to_radians();
        // k/k0 and kz/k0.
        let normal_index = (index * index - incidence.sin().powi(2)).sqrt();
        let turn = normal_index * (TAU * frequency_hz / SPEED_M_S * self.thickness_mm / 1e3);
        let surface = impedance * index / normal_index * Complex::new(0.0, -1.0) / turn.tan() * incidence.cos();
        (surface - 1.0) / (surface + 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAYER: FoamLayer = FoamLayer { flow_resistivity: 10e3, thickness_mm: 50.0 };

    #[test]
    fn reflection_is_as_published() {
        let reflection = |material: SurfaceMaterial, hz| material.reflection_at(hz, 0.0, LAYER).norm();
        for hz in [2e3, 4e3, 6e3] {
            let absorption = 1.0 - reflection(SurfaceMaterial::CoatedPrint, hz).powi(2);
            assert!((0.04..0.1).contains(&absorption), "{hz}: {absorption}");
        }
        let print = [0, 1, 2, 3, 4].map(|n| reflection(SurfaceMaterial::CoatedPrint, 2_500.0 * f64::from(1 << n)));
        assert!(print.windows(2).all(|pair| pair[1] < pair[0]) && print[4] > 0.6, "{print:?}");
    }

    // By the same formulas in another program (NumPy).
    #[test]
    fn foam_reflects_by_the_angle() {
        for (hz, thickness_mm, levels_db) in [
            (10e3, 50.0, [-19.0, -36.0, -11.5]),
            (2_500.0, 50.0, [-12.4, -19.0, -8.5]),
            (10e3, 25.0, [-15.3, -14.2, -12.9]),
            (40e3, 75.0, [-31.5, -41.4, -14.9]),
        ] {
            for (incidence_deg, expected) in [0.0, 35.0, 70.0].into_iter().zip(levels_db) {
                let layer = FoamLayer { thickness_mm, ..LAYER };
                let found = 20.0 * layer.reflection_at(hz, incidence_deg).norm().log10();
                assert!((found - expected).abs() < 0.06, "{hz} Hz, {thickness_mm} mm, {incidence_deg}: {found}");
            }
        }
    }

    // What resists no flow is air, and its back is all that reflects, at any angle: e^(-2 i k0 d cos(a)). What nothing
    // flows through is hard, and no layer is the back.
    #[test]
    fn limits_of_foam() {
        for incidence_deg in [0.0, 30.0, 60.0] {
            let air = FoamLayer { flow_resistivity: 1e-6, ..LAYER }.reflection_at(5e3, incidence_deg);
            let path = 2.0 * TAU * 5e3 / SPEED_M_S * 0.05 * f64::to_radians(incidence_deg).cos();
            assert!((air - Complex::from_polar(1.0, -path)).norm() < 1e-3, "{incidence_deg}: {air}");
            let hard = FoamLayer { flow_resistivity: 1e12, thickness_mm: 0.1 }.reflection_at(5e3, incidence_deg);
            let none = FoamLayer { thickness_mm: 1e-6, ..LAYER }.reflection_at(5e3, incidence_deg);
            assert!((hard - 1.0).norm() < 1e-3 && (none - 1.0).norm() < 1e-3, "{incidence_deg}: {hard}, {none}");
        }
        // At a right angle nothing enters: all comes back, in the opposite phase.
        assert!((LAYER.reflection_at(5e3, 90.0) + 1.0).norm() < 1e-9);
    }
}
