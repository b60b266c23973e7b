//! The effects that simulated devices compute.

use serde::{Deserialize, Serialize};

/// Phase of a relief's details, rad, up to which simulated levels are trusted in a band: over it single pairs are off
/// by 0.9 dB or more, root mean square, and up to it by 0.4 dB at most. A choice between the table's phases of 0.16 and
/// 0.19.
///
/// Source: docs/devices.md, the table of the boundary-element method, with `steep_facets`. A test compares the table
/// with these constants, and with what the manual and the pages print of them.
pub const TRUSTED_PHASE: f64 = 0.18;
/// Error of a band's mean level over [`TRUSTED_PHASE`], dB: root mean square over the reliefs and bands of that table.
pub const UNTRUSTED_ERROR_DB: f64 = 0.58;
/// Standard uncertainty of a simulated mean level, dB: a constant and a slope over the phase of details, rad, up to the
/// greatest. All bands of that table are within 1.96 times.
const MEAN_LEVEL_U_DB: [f64; 3] = [0.04, 2.4, 0.65];

/// Standard uncertainty of a relief's simulated mean level over the grid in a band, dB, by the phase of its details in
/// that band, rad; the greatest if that is unknown.
pub fn mean_level_u_db(detail_phase: Option<f64>) -> f64 {
    let [constant, slope, greatest] = MEAN_LEVEL_U_DB;
    detail_phase.map_or(greatest, |phase| (constant + slope * phase).min(greatest))
}

/// The `[simulation]` section of a rig file: effects that the simulated rig has in common with a real one. All are on
/// unless the file switches them off. They are no part of what a lake's numbers mean, so runs with and without them go
/// together.
///
/// ```
/// let rig = echolake_schema::Rig::from_toml("[simulation]\ncalibration_mm = 0.0")?;
/// assert!(rig.simulation.air_absorption && rig.simulation.calibration_mm == 0.0);
/// # Ok::<(), echolake_schema::Error>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SimulationParams {
    /// Steep facets scatter as the boundary-element method says, as far as that goes without second reflections; if
    /// off, what falls on facets that face away is lost.
    pub steep_facets: bool,
    /// Materials reflect each frequency as they do; if off, all frequencies alike.
    pub material_spectra: bool,
    /// Foam reflects a little; if off nothing, so that what is left of a panel is its own reflection alone.
    pub foam_reflection: bool,
    /// Foam's resistance to flow, Pa s/m^2, with which it reflects if `material_spectra` is on.
    pub foam_flow_resistivity: f64,
    /// Foam's thickness, mm.
    pub foam_thickness_mm: f64,
    /// The air absorbs, by its temperature, humidity and pressure.
    pub air_absorption: bool,
    /// Distance of an arm from where it stood before at the same point, root mean square, mm. 0 for none.
    pub repeatability_mm: f64,
    /// Mean distance of an arm from the place that it believes to have, mm: fixed for a point and an arm. 0 for none.
    pub calibration_mm: f64,
    /// Speaker and microphone have axes, and hear and shine less beside them.
    pub directivity: bool,
    /// Speaker and microphone are louder at some frequencies.
    pub transducer_response: bool,
    /// Frequency of a resonance of the tweeter, Hz, at which it is three times as loud. 0 for none.
    pub resonance_hz: f64,
    /// Quality factor of the resonance.
    pub resonance_q: f64,
    /// Mean temperature of the air, C.
    pub temperature_c: f64,
    /// Mean relative humidity of the air, %.
    pub humidity_pct: f64,
    /// Channels and sensors have noise, the air drifts, and now and then something spoils a take.
    pub noise_and_drift: bool,
}

impl Default for SimulationParams {
    /// All effects, the distances of the arms and the thickness of the foam as Rust et al. 2021 print them. Its
    /// resistance to flow is an assumption amid the 8 to 20 kPa s/m^2 that are usual for melamine foam.
    fn default() -> Self {
        Self {
            steep_facets: true,
            material_spectra: true,
            foam_reflection: true,
            foam_flow_resistivity: 10e3,
            foam_thickness_mm: 50.0,
            air_absorption: true,
            repeatability_mm: 0.02,
            calibration_mm: 0.17,
            directivity: true,
            transducer_response: true,
            resonance_hz: 0.0,
            resonance_q: 8.0,
            temperature_c: 21.5,
            humidity_pct: 45.0,
            noise_and_drift: true,
        }
    }
}

impl SimulationParams {
    /// Returns whether this is the default, which rig files leave out.
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// Describes the first contradiction among the settings.
    pub(crate) fn find_contradiction(&self) -> Option<String> {
        let is_plausible = |mm: f64| (0.0..=10.0).contains(&mm);
        if !(is_plausible(self.repeatability_mm) && is_plausible(self.calibration_mm)) {
            return Some("expected repeatability_mm and calibration_mm from 0 to 10".to_owned());
        }
        if !((100.0..=1e6).contains(&self.foam_flow_resistivity) && (1.0..=500.0).contains(&self.foam_thickness_mm)) {
            return Some(
                "expected foam_flow_resistivity from 100 to 1e6 and foam_thickness_mm from 1 to 500".to_owned(),
            );
        }
        if !((0.0..=1e6).contains(&self.resonance_hz) && (0.5..=100.0).contains(&self.resonance_q)) {
            return Some("expected resonance_hz from 0 to 1e6 and resonance_q from 0.5 to 100".to_owned());
        }
        let is_room = (0.0..=40.0).contains(&self.temperature_c) && (5.0..=95.0).contains(&self.humidity_pct);
        (!is_room).then(|| "expected temperature_c from 0 to 40 and humidity_pct from 5 to 95".to_owned())
    }
}

#[cfg(test)]
mod tests;
