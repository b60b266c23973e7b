//! Description of a rig: its grid, its sweep, and how its recordings become impulse responses and bands.

use serde::{Deserialize, Serialize};

use crate::devices::DeviceParams;
use crate::grid::{Grid, GridParams, Layer};
use crate::robots::RobotCell;
use crate::simulation::SimulationParams;
use crate::{Celsius, Error, MODEL_SCALE, SampleRate};

/// Highest frequency that people hear, Hz.
const HIGHEST_AUDIBLE_HZ: f64 = 20e3;
/// Least and greatest scale.
const SCALES: [f64; 2] = [0.1, 1000.0];
/// Number of single points that a difference names.
const SHOWN_POINTS: usize = 4;

/// A rig, as its TOML describes it. Settings that the TOML omits are those of Rust et al. 2021
/// ("A data acquisition setup for data driven acoustic design", Building Acoustics 28(4)).
///
/// ```
/// use echolake_schema::Rig;
///
/// let rig = Rig::from_toml("name = \"hall\"\n[sweep]\nduration_secs = 1.0")?;
/// assert_eq!((rig.recording_len(), rig.band_names().len()), (96_960, 5));
/// assert!(Rig::paper().differences_from(&rig).is_empty(), "the tables' numbers mean the same");
/// assert!(Rig::from_toml("[sweep]\nlow_hz = 50e3").is_err());
/// # Ok::<(), echolake_schema::Error>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Rig {
    /// Its name.
    pub name: String,
    /// Full size over the size that is measured: 10 of models at 1:10, 1 of rooms and walls. See [`Rig::known_scale`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scale: Option<f64>,
    /// The excitation.
    pub sweep: Sweep,
    /// Length and corrections of each impulse response.
    pub impulse_response: ImpulseResponse,
    /// The filter bank.
    pub bands: Bands,
    /// The measured object.
    pub panel: Panel,
    /// Limits that a measurement must meet.
    pub validation: Validation,
    /// The points and pairs.
    pub grid: GridParams,
    /// Placement of the arms, and the order of their visits.
    #[serde(skip_serializing_if = "RobotCell::is_default")]
    pub robots: RobotCell,
    /// Its devices.
    #[serde(skip_serializing_if = "DeviceParams::are_simulated")]
    pub devices: DeviceParams,
    /// Effects that simulated devices compute.
    #[serde(skip_serializing_if = "SimulationParams::is_default")]
    pub simulation: SimulationParams,
}

/// The sweep that is played.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Sweep {
    /// Course of its frequency.
    #[serde(skip_serializing_if = "SweepShape::is_linear")]
    pub shape: SweepShape,
    /// Sampling rate, Hz.
    pub rate_hz: SampleRate,
    /// Lowest frequency, Hz.
    pub low_hz: f64,
    /// Highest frequency, Hz.
    pub high_hz: f64,
    /// Duration, s.
    pub duration_secs: f64,
    /// Half-cosine fade at either end, s.
    pub fade_secs: f64,
    /// Silence recorded after it, s.
    pub tail_secs: f64,
    /// Peak level, dB re full scale.
    pub level_dbfs: f64,
    /// Takes of each pair, 1 or 2: the second one shows what changes between them (ISO 18233:2006, time variance).
    #[serde(skip_serializing_if = "is_single")]
    pub repeat: u8,
}

// serde calls it with a reference.
#[expect(clippy::trivially_copy_pass_by_ref)]
fn is_single(repeat: &u8) -> bool {
    *repeat == 1
}

/// Course of a sweep's frequency.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SweepShape {
    /// It rises by equal steps in equal times.
    #[default]
    Linear,
    /// It rises by equal factors in equal times, so that harmonics of distortion arrive apart from the response.
    Exponential,
}

impl SweepShape {
    fn is_linear(&self) -> bool {
        *self == Self::Linear
    }
}

/// Length and corrections of each impulse response.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "ImpulseResponseFields", into = "ImpulseResponseFields")]
pub struct ImpulseResponse {
    /// Samples.
    pub length: usize,
    /// Temperature that responses are corrected to, C.
    pub reference_temperature_c: Celsius,
    /// Treatment of frequencies at the limits of the sweep's range and beyond them.
    pub division: SpectralDivision,
    /// What of the air responses are corrected for.
    pub air: AirTreatment,
    /// Standard uncertainty of the temperature of a run's air, K.
    pub temperature_u_k: f64,
}

/// What of the air responses are corrected for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AirTreatment {
    /// The time axis for the speed of sound, which depends on temperature, humidity and pressure (Cramer 1993);
    /// energies for absorption (ISO 9613-1), and for the frequencies that the time axis moves along the slopes of
    /// speaker and microphone.
    #[default]
    Complete,
    /// The time axis alone, and for the temperature alone, as the paper prints it: 331.3 sqrt(1 + T / 273.15) m/s.
    Paper,
}

impl AirTreatment {
    /// Its name, as rig files spell it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Complete => "complete",
            Self::Paper => "paper",
        }
    }
}

/// Division of the recording's spectrum by the loopback's at the limits of the sweep's range and beyond them; in
/// between it is exact.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SpectralDivision {
    /// Nothing is left beyond the limits, and the quotient rises from there over a half cosine as wide as the response
    /// resolves (the sampling rate over its length), so that numbers do not depend on the sweep's length.
    Tapered,
    /// Beyond the limits the divisor's power is raised.
    Floored {
        /// The least power of the divisor, dB re its mean in the range.
        floor_db: f64,
    },
    /// Plain division everywhere, as the paper prints it: noise beyond the limits.
    Literal,
}

impl SpectralDivision {
    /// Floor of the reference pipeline, dB.
    pub const FLOOR_DB: f64 = -60.0;

    /// Its name, as rig files spell it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Tapered => "tapered",
            Self::Floored { .. } => "floored",
            Self::Literal => "literal",
        }
    }
}

/// An [`ImpulseResponse`] as rig files spell it. One that has a floor and names no division is from a version that knew
/// no other.
#[derive(Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct ImpulseResponseFields {
    length: usize,
    reference_temperature_c: Celsius,
    division: Option<DivisionName>,
    #[serde(skip_serializing_if = "Option::is_none")]
    floor_db: Option<f64>,
    air: AirTreatment,
    temperature_u_k: f64,
}

#[derive(Clone, Copy, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum DivisionName {
    Tapered,
    Floored,
    Literal,
}

impl Default for ImpulseResponseFields {
    fn default() -> Self {
        let ImpulseResponse { length, reference_temperature_c, air, temperature_u_k, .. } = ImpulseResponse::default();
        Self { length, reference_temperature_c, division: None, floor_db: None, air, temperature_u_k }
    }
}

impl TryFrom<ImpulseResponseFields> for ImpulseResponse {
    type Error = &'static str;

    fn try_from(fields: ImpulseResponseFields) -> Result<Self, Self::Error> {
        let ImpulseResponseFields { length, reference_temperature_c, division, floor_db, air, temperature_u_k } =
            fields;
        let division = match (division, floor_db) {
            (None | Some(DivisionName::Tapered), None) => SpectralDivision::Tapered,
            (Some(DivisionName::Literal), None) => SpectralDivision::Literal,
            (None | Some(DivisionName::Floored), floor) => {
                SpectralDivision::Floored { floor_db: floor.unwrap_or(SpectralDivision::FLOOR_DB) }
            }
            (Some(_), Some(_)) => return Err("`floor_db` goes with `division = \"floored\"` only"),
        };
        if !(0.0..=10.0).contains(&temperature_u_k) {
            return Err("`temperature_u_k` is not from 0 to 10");
        }
        Ok(Self { length, reference_temperature_c, division, air, temperature_u_k })
    }
}

impl From<ImpulseResponse> for ImpulseResponseFields {
    fn from(response: ImpulseResponse) -> Self {
        let ImpulseResponse { length, reference_temperature_c, division, air, temperature_u_k } = response;
        let (name, floor_db) = match division {
            SpectralDivision::Tapered => (DivisionName::Tapered, None),
            SpectralDivision::Floored { floor_db } => (DivisionName::Floored, Some(floor_db)),
            SpectralDivision::Literal => (DivisionName::Literal, None),
        };
        Self { length, reference_temperature_c, division: Some(name), floor_db, air, temperature_u_k }
    }
}

/// The octave-spaced itersine filter bank.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Bands {
    /// Band centres an octave apart, Hz, ascending.
    pub centres_hz: Vec<f64>,
}

/// The measured object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Panel {
    /// Edge of the square, mm.
    pub size_mm: f64,
    /// Depth that the relief may have, mm.
    pub depth_mm: f64,
}

/// Limits that a measurement must meet, and the number of attempts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Validation {
    /// Attempts per pair.
    pub attempts: u32,
    /// Least signal-to-noise ratio in the sweep's band, dB.
    pub snr_db: f64,
    /// Read for rig files that have it, and ignored: a loopback is judged by how well it matches the sweep.
    #[serde(skip_serializing)]
    pub loopback_dbfs: Option<f64>,
    /// Highest sound pressure level outside, dB re 20 uPa.
    pub outside_level_db: f64,
    /// Largest difference of the direct sound's arrival from the time that geometry gives, us.
    pub arrival_us: f64,
}

impl Default for Rig {
    fn default() -> Self {
        Self {
            name: "paper".into(),
            scale: None,
            sweep: Sweep::default(),
            impulse_response: ImpulseResponse::default(),
            bands: Bands::default(),
            panel: Panel::default(),
            validation: Validation::default(),
            grid: GridParams::default(),
            robots: RobotCell::default(),
            devices: DeviceParams::default(),
            simulation: SimulationParams::default(),
        }
    }
}

impl Default for Sweep {
    fn default() -> Self {
        Self {
            shape: SweepShape::Linear,
            rate_hz: SampleRate::PAPER,
            low_hz: 2_000.0,
            high_hz: 40_000.0,
            duration_secs: 0.5,
            fade_secs: 0.001,
            tail_secs: 0.01,
            level_dbfs: -3.0,
            repeat: 1,
        }
    }
}

impl Default for ImpulseResponse {
    fn default() -> Self {
        Self {
            length: 384,
            reference_temperature_c: Celsius::PAPER,
            division: SpectralDivision::Tapered,
            air: AirTreatment::Complete,
            temperature_u_k: 0.05,
        }
    }
}

impl Default for Bands {
    fn default() -> Self {
        Self { centres_hz: vec![2_500.0, 5_000.0, 10_000.0, 20_000.0, 40_000.0] }
    }
}

impl Default for Panel {
    fn default() -> Self {
        Self { size_mm: 585.0, depth_mm: 40.0 }
    }
}

impl Default for Validation {
    fn default() -> Self {
        Self { attempts: 3, snr_db: 30.0, loopback_dbfs: None, outside_level_db: 65.0, arrival_us: 20.0 }
    }
}

fn describe_division(division: &SpectralDivision) -> String {
    match division {
        SpectralDivision::Floored { floor_db } => format!("floored at {floor_db} dB"),
        other => other.name().to_owned(),
    }
}

fn describe_layers(layers: &[Layer]) -> String {
    let describe = |Layer { points_per_side, pitch_mm, height_mm }: &Layer| match points_per_side {
        1 => format!("1 point at {height_mm} mm"),
        n => format!("{n} x {n} points {pitch_mm} mm apart at {height_mm} mm"),
    };
    match layers {
        [] => "none".to_owned(),
        layers => layers.iter().map(describe).collect::<Vec<_>>().join(", "),
    }
}

fn describe_points(points: &[[f64; 3]]) -> String {
    let describe = |[x, y, z]: &[f64; 3]| format!("{x} {y} {z}");
    let shown: Vec<_> = points.iter().take(SHOWN_POINTS).map(describe).collect();
    match points.len() {
        0 => "none".to_owned(),
        count if count > SHOWN_POINTS => format!("{count} points ({}, ...)", shown.join(", ")),
        count => format!("{count} points ({})", shown.join(", ")),
    }
}

fn join_numbers(numbers: &[f64]) -> String {
    numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(", ")
}

impl Rig {
    /// The rig of Rust et al. 2021.
    pub fn paper() -> Self {
        Self::default()
    }

    /// Reads a TOML description and checks it.
    ///
    /// # Errors
    /// [`Error::RigSyntax`] if it is no such TOML, [`Error::Rig`] or [`Error::Quantity`] if it contradicts itself.
    pub fn from_toml(text: &str) -> Result<Self, Error> {
        let rig: Self = toml::from_str(text).map_err(|e| Error::RigSyntax { message: e.to_string() })?;
        rig.check_consistency()?;
        Ok(rig)
    }

    /// As TOML.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).unwrap_or_default()
    }

    /// The points and pairs.
    ///
    /// # Errors
    /// [`Error::Quantity`] if there are too few points or too many.
    pub fn build_grid(&self) -> Result<Grid, Error> {
        self.grid.build_grid()
    }

    /// Samples of the whole recording: sweep and tail.
    pub fn recording_len(&self) -> usize {
        let rate = self.sweep.rate_hz.get();
        (self.sweep.duration_secs * rate).round() as usize + (self.sweep.tail_secs * rate).round() as usize
    }

    /// Full size over the size that is measured: `scale`, or 1 if the sweep ends at 20 kHz or below, or [`MODEL_SCALE`]
    /// with the panel and the grid of Rust et al. 2021. None if nothing tells: a room may be measured over 20 kHz, too.
    pub fn known_scale(&self) -> Option<f64> {
        let is_of_paper = self.panel == Panel::default() && self.grid == GridParams::default();
        let by_sweep = || (self.sweep.high_hz <= HIGHEST_AUDIBLE_HZ).then_some(1.0);
        self.scale.or_else(by_sweep).or_else(|| is_of_paper.then_some(MODEL_SCALE))
    }

    /// Suffix of each band's columns: its centre in Hz.
    pub fn band_names(&self) -> Vec<String> {
        self.bands.centres_hz.iter().map(|hz| format!("{hz:.0}")).collect()
    }

    /// Width of the taper at the limits of the sweep's range, Hz: what a response of this length resolves.
    pub fn taper_hz(&self) -> f64 {
        self.sweep.rate_hz.get() / self.impulse_response.length as f64
    }

    /// The settings that decide what the tables' numbers mean and that differ from `other`'s, as
    /// (field, here, there). A lake holds only runs for which there are none.
    pub fn differences_from(&self, other: &Self) -> Vec<(&'static str, String, String)> {
        fn compare_field<T: PartialEq>(
            field: &'static str,
            [a, b]: [&T; 2],
            describe: impl Fn(&T) -> String,
        ) -> Option<(&'static str, String, String)> {
            (a != b).then(|| (field, describe(a), describe(b)))
        }
        let rigs = [self, other];
        let responses = rigs.map(|r| &r.impulse_response);
        let is_tapered = self.impulse_response.division == SpectralDivision::Tapered;
        let durations = (!is_tapered).then(|| rigs.map(|r| &r.sweep.duration_secs));
        // A rig that leaves its scale open takes any.
        let scales = rigs.map(Self::known_scale);
        let scales = if let [Some(here), Some(there)] = &scales { Some([here, there]) } else { None };
        [
            scales.and_then(|scales| compare_field("scale", scales, f64::to_string)),
            compare_field("sweep.rate_hz", rigs.map(|r| &r.sweep.rate_hz), |rate| rate.get().to_string()),
            compare_field("sweep.low_hz", rigs.map(|r| &r.sweep.low_hz), f64::to_string),
            compare_field("sweep.high_hz", rigs.map(|r| &r.sweep.high_hz), f64::to_string),
            compare_field("impulse_response.length", responses.map(|r| &r.length), usize::to_string),
            compare_field(
                "impulse_response.reference_temperature_c",
                responses.map(|r| &r.reference_temperature_c),
                |t| t.get().to_string(),
            ),
            compare_field("impulse_response.division", responses.map(|r| &r.division), describe_division),
            // Without a taper the numbers depend on the sweep's length.
            durations.and_then(|durations| compare_field("sweep.duration_secs", durations, f64::to_string)),
            compare_field("bands.centres_hz", rigs.map(|r| &r.bands.centres_hz), |centres| join_numbers(centres)),
            compare_field("panel.size_mm", rigs.map(|r| &r.panel.size_mm), f64::to_string),
            compare_field("panel.depth_mm", rigs.map(|r| &r.panel.depth_mm), f64::to_string),
            compare_field("grid.pairs", rigs.map(|r| &r.grid.pairs), |rule| rule.name().to_owned()),
            compare_field("grid.clearance_mm", rigs.map(|r| &r.grid.clearance_mm), f64::to_string),
            compare_field("grid.layers", rigs.map(|r| &r.grid.layers), |layers| describe_layers(layers)),
            compare_field("grid.points_mm", rigs.map(|r| &r.grid.points_mm), |points| describe_points(points)),
        ]
        .into_iter()
        .flatten()
        .collect()
    }

    /// Checks that the description does not contradict itself.
    ///
    /// # Errors
    /// [`Error::Rig`] or [`Error::Quantity`], naming the field.
    pub fn check_consistency(&self) -> Result<(), Error> {
        let sweep = &self.sweep;
        let nyquist = self.sweep.rate_hz.get() / 2.0;
        let positive = |x: f64, max: f64| x > 0.0 && x <= max;
        let rules = [
            (!self.name.trim().is_empty(), "name", "is empty".to_owned()),
            (
                self.scale.is_none_or(|scale| (SCALES[0]..=SCALES[1]).contains(&scale)),
                "scale",
                format!(
                    "is {}, expected full size over the size that is measured, {} to {}",
                    self.scale.unwrap_or_default(),
                    SCALES[0],
                    SCALES[1]
                ),
            ),
            (
                sweep.low_hz > 0.0 && sweep.low_hz < sweep.high_hz,
                "sweep.low_hz",
                format!("is {}, expected above 0 and below sweep.high_hz = {}", sweep.low_hz, sweep.high_hz),
            ),
            (
                sweep.high_hz <= nyquist,
                "sweep.high_hz",
                format!("is {}, above half the sampling rate, {nyquist} Hz", sweep.high_hz),
            ),
            (
                positive(sweep.duration_secs, 600.0),
                "sweep.duration_secs",
                format!("is {}, expected above 0, up to 600", sweep.duration_secs),
            ),
            (
                (0.0..=sweep.duration_secs / 2.0).contains(&sweep.fade_secs),
                "sweep.fade_secs",
                format!("is {}, expected 0 to half the duration", sweep.fade_secs),
            ),
            (
                (0.0..=60.0).contains(&sweep.tail_secs),
                "sweep.tail_secs",
                format!("is {}, expected 0 to 60", sweep.tail_secs),
            ),
            (
                (-120.0..=0.0).contains(&sweep.level_dbfs),
                "sweep.level_dbfs",
                format!("is {}, expected -120 to 0", sweep.level_dbfs),
            ),
            (
                matches!(sweep.repeat, 1 | 2),
                "sweep.repeat",
                format!("is {}, expected 1 or 2 takes of each pair", sweep.repeat),
            ),
            (
                (1..=16_777_216).contains(&self.impulse_response.length),
                "impulse_response.length",
                format!("is {}, expected 1 to 16777216", self.impulse_response.length),
            ),
            (
                !matches!(self.impulse_response.division, SpectralDivision::Floored { floor_db } if !(-200.0..=0.0).contains(&floor_db)),
                "impulse_response.floor_db",
                format!("is {:?}, expected -200 to 0", self.impulse_response.division),
            ),
            (
                are_octaves(&self.bands.centres_hz),
                "bands.centres_hz",
                format!(
                    "is {:?}, expected 1 to 12 whole numbers of Hz, each twice the one before",
                    self.bands.centres_hz
                ),
            ),
            (
                positive(self.panel.size_mm, 1e5) && positive(self.panel.depth_mm, 1e5),
                "panel",
                format!("is {:?}, expected positive lengths up to 100 m", self.panel),
            ),
            (
                (1..=100).contains(&self.validation.attempts),
                "validation.attempts",
                format!("is {}, expected 1 to 100", self.validation.attempts),
            ),
            (
                self.robots.find_contradiction().is_none(),
                "robots",
                self.robots.find_contradiction().unwrap_or_default(),
            ),
            (
                self.devices.find_contradiction().is_none(),
                "devices",
                self.devices.find_contradiction().unwrap_or_default(),
            ),
            (
                self.simulation.find_contradiction().is_none(),
                "simulation",
                self.simulation.find_contradiction().unwrap_or_default(),
            ),
        ];
        match rules.into_iter().find(|(holds, ..)| !holds) {
            Some((_, field, reason)) => Err(Error::Rig { rig: self.name.clone(), field, reason }),
            None => self.build_grid().map(drop),
        }
    }
}

// Column names carry the centre in whole Hz.
fn are_octaves(centres: &[f64]) -> bool {
    let whole = centres.iter().all(|c| (1.0..=1e6).contains(c) && c.fract() == 0.0);
    let doubled = centres.windows(2).all(|w| (w[1] / w[0] - 2.0).abs() < 1e-6);
    (1..=12).contains(&centres.len()) && whole && doubled
}

impl SampleRate {
    /// 96 kHz (Rust et al. 2021, appendix, step 2).
    pub const PAPER: Self = Self::from_known(96_000.0);
}

impl Celsius {
    /// 20 C (Rust et al. 2021, appendix, step 2).
    pub const PAPER: Self = Self::from_known(20.0);
}

#[cfg(test)]
mod tests {
    use expect_test::expect;

    use super::*;

    #[test]
    fn the_paper_s_rig_is_valid_and_round_trips() {
        let rig = Rig::paper();
        assert_eq!(rig.check_consistency(), Ok(()));
        assert_eq!(Rig::from_toml(&rig.to_toml()), Ok(rig.clone()));
        assert_eq!(Rig::from_toml(""), Ok(rig.clone()));
        assert_eq!(rig.band_names(), ["2500", "5000", "10000", "20000", "40000"]);
        assert_eq!(rig.recording_len(), 48_960);
    }

    #[test]
    fn lakes_and_runs_without_a_division_have_the_floor_that_they_were_made_with() {
        let division = |toml: &str| Rig::from_toml(toml).map(|rig| rig.impulse_response.division);
        let floored = SpectralDivision::Floored { floor_db: -60.0 };
        assert_eq!(division("[impulse_response]\nlength = 384\nfloor_db = -60"), Ok(floored));
        assert_eq!(division("impulse_response.division = \"floored\""), Ok(floored));
        assert_eq!(division("impulse_response.length = 400"), Ok(SpectralDivision::Tapered));
        assert!(division("impulse_response = { division = \"literal\", floor_db = -60 }").is_err());
        assert!(division("impulse_response.floor_db = 3").is_err());
        for toml in ["impulse_response.division = \"literal\"", "impulse_response.floor_db = -40"] {
            let rig = Rig::from_toml(toml).expect("a rig");
            assert_eq!(Rig::from_toml(&rig.to_toml()), Ok(rig.clone()));
            let fields: Vec<_> = rig.differences_from(&Rig::paper()).into_iter().map(|(field, ..)| field).collect();
            assert_eq!(fields, ["impulse_response.division"]);
            // The sweep's length matters where there is no taper.
            let mut longer = rig.clone();
            longer.sweep.duration_secs *= 2.0;
            assert_eq!(rig.differences_from(&longer).len(), 1);
        }
        let mut longer = Rig::paper();
        longer.sweep.duration_secs *= 2.0;
        assert_eq!(Rig::paper().differences_from(&longer), []);
    }

    const REAL: &str = "[devices]\naudio.kind = \"alsa\"\nsensor.kind = \"serial\"\nrobots.kind = \"rosbridge\"\n";

    #[test]
    fn a_rig_with_devices_round_trips() {
        let rig = Rig::from_toml(REAL).expect("a rig");
        assert!(!rig.devices.are_simulated() && Rig::paper().devices.are_simulated());
        assert_eq!(Rig::from_toml(&rig.to_toml()), Ok(rig.clone()));
        assert_eq!(rig.differences_from(&Rig::paper()), [], "devices do not change what numbers mean");
        assert!(!Rig::paper().to_toml().contains("devices") && !Rig::paper().to_toml().contains("robots"));
    }

    #[test]
    fn contradictions_name_the_field() {
        let mut said = String::new();
        for toml in [
            "sweep.rate_hz = 48000",
            "sweep.rate_hz = -1",
            "sweep.low_hz = 50000",
            "sweep.repeat = 3",
            "bands.centres_hz = [1000, 3000]",
            "bands.centres_hz = []",
            "impulse_response.length = 0",
            "impulse_response.reference_temperature_c = 400",
            "sweeep.rate_hz = 1",
            "scale = 0",
            "[grid]\nlayers = []\npoints_mm = []",
            "name = [",
            "robots.table_mm = 50",
            "devices.sensor.kind = \"serial\"",
            "devices.sensor.kind = \"parallel\"",
            "devices.sensor = { kind = \"serial\", bauds = 3 }",
            &format!("{REAL}audio.loopback = 3"),
            &format!("{REAL}robots.speed = 2.0"),
            "robots.order = \"random\"",
            "simulation.calibration_mm = -0.1",
        ] {
            let error = Rig::from_toml(toml).expect_err(toml);
            said += &format!("{}\n    {error}\n", toml.strip_prefix(REAL).unwrap_or(toml));
        }
        expect![[r#"
            sweep.rate_hz = 48000
                rig `paper`: `sweep.high_hz` is 40000, above half the sampling rate, 24000 Hz
            sweep.rate_hz = -1
                not a rig description: TOML parse error at line 1, column 17
              |
            1 | sweep.rate_hz = -1
              |                 ^^
            sampling rate (Hz) is -1, expected 1 to 10 000 000

            sweep.low_hz = 50000
                rig `paper`: `sweep.low_hz` is 50000, expected above 0 and below sweep.high_hz = 40000
            sweep.repeat = 3
                rig `paper`: `sweep.repeat` is 3, expected 1 or 2 takes of each pair
            bands.centres_hz = [1000, 3000]
                rig `paper`: `bands.centres_hz` is [1000.0, 3000.0], expected 1 to 12 whole numbers of Hz, each twice the one before
            bands.centres_hz = []
                rig `paper`: `bands.centres_hz` is [], expected 1 to 12 whole numbers of Hz, each twice the one before
            impulse_response.length = 0
                rig `paper`: `impulse_response.length` is 0, expected 1 to 16777216
            impulse_response.reference_temperature_c = 400
                not a rig description: TOML parse error at line 1, column 44
              |
            1 | impulse_response.reference_temperature_c = 400
              |                                            ^^^
            temperature (C) is 400, expected -60 to 80

            sweeep.rate_hz = 1
                not a rig description: TOML parse error at line 1, column 1
              |
            1 | sweeep.rate_hz = 1
              | ^^^^^^
            unknown field `sweeep`, expected one of `name`, `scale`, `sweep`, `impulse_response`, `bands`, `panel`, `validation`, `grid`, `robots`, `devices`, `simulation`

            scale = 0
                rig `paper`: `scale` is 0, expected full size over the size that is measured, 0.1 to 1000
            [grid]
            layers = []
            points_mm = []
                number of grid points is 0, expected 2 to 2000
            name = [
                not a rig description: TOML parse error at line 1, column 9
              |
            1 | name = [
              |         ^
            unclosed array, expected `]`

            robots.table_mm = 50
                rig `paper`: `robots` table_mm = 50 is not below relief_mm = 29
            devices.sensor.kind = "serial"
                rig `paper`: `devices` has simulated devices beside real ones; hint: audio, sensor and robots all need a `kind`
            devices.sensor.kind = "parallel"
                not a rig description: TOML parse error at line 1, column 23
              |
            1 | devices.sensor.kind = "parallel"
              |                       ^^^^^^^^^^
            unknown variant `parallel`, expected `simulated` or `serial`

            devices.sensor = { kind = "serial", bauds = 3 }
                not a rig description: TOML parse error at line 1, column 18
              |
            1 | devices.sensor = { kind = "serial", bauds = 3 }
              |                  ^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^
            unknown field `bauds`, expected one of `path`, `baud`, `timeout_secs`

            audio.loopback = 3
                rig `paper`: `devices` audio: a channel is 0 or beyond `outputs` or `inputs`, or microphone and loopback are one
            robots.speed = 2.0
                rig `paper`: `devices` robots: expected 0 < speed <= 1, 0 < tolerance_deg <= 5, timeout_secs above 0
            robots.order = "random"
                not a rig description: TOML parse error at line 1, column 16
              |
            1 | robots.order = "random"
              |                ^^^^^^^^
            unknown variant `random`, expected `numbered` or `planned`

            simulation.calibration_mm = -0.1
                rig `paper`: `simulation` expected repeatability_mm and calibration_mm from 0 to 10
        "#]].assert_eq(&said);
    }

    #[test]
    fn only_what_changes_the_tables_counts_as_different() {
        let paper = Rig::paper();
        let mut other = Rig::paper();
        other.name = "attic".into();
        other.sweep.duration_secs = 0.05;
        other.validation.attempts = 9;
        other.simulation.directivity = false;
        assert_eq!(paper.differences_from(&other), []);
        other.impulse_response.length = 400;
        assert_eq!(paper.differences_from(&other), [("impulse_response.length", "384".into(), "400".into())]);
    }

    #[test]
    fn the_scale_is_said_or_known() {
        let scale = |toml: &str| Rig::from_toml(toml).map(|rig| rig.known_scale());
        assert_eq!(scale(""), Ok(Some(10.0)));
        assert_eq!(scale("sweep.high_hz = 20000"), Ok(Some(1.0)), "what people hear");
        assert_eq!(scale("panel.size_mm = 600"), Ok(None));
        assert_eq!(scale("panel.size_mm = 600\nsweep.high_hz = 20000"), Ok(Some(1.0)));
        assert_eq!(scale("grid.points_mm = [[0, 0, 1000], [2000, 0, 1000]]"), Ok(None));
        assert_eq!(scale("scale = 2.5\nsweep.high_hz = 20000"), Ok(Some(2.5)));
        assert_eq!(scale("scale = 1"), Ok(Some(1.0)));
        let wall = Rig { scale: Some(1.0), ..Rig::paper() };
        assert_eq!(Rig::from_toml(&wall.to_toml()), Ok(wall.clone()));
        assert_eq!(wall.differences_from(&Rig::paper()), [("scale", "1".into(), "10".into())]);
        let open = Rig::from_toml("sweep.high_hz = 41000\npanel.size_mm = 600").expect("a rig");
        let fields: Vec<_> = open.differences_from(&wall).into_iter().map(|(field, ..)| field).collect();
        assert_eq!(fields, ["sweep.high_hz", "panel.size_mm"]);
    }

    #[test]
    fn differences_are_in_words() {
        let room = "impulse_response.division = \"floored\"\nbands.centres_hz = [125, 250]\npanel.size_mm = 600\n\
            sweep = { rate_hz = 48000, high_hz = 20000 }\n\
            grid = { pairs = \"ordered\", points_mm = [[0, 0, 1000], [2000, 0, 1000.5]] }";
        let room = Rig::from_toml(room).expect("a rig");
        let said: String =
            room.differences_from(&Rig::paper()).iter().map(|(field, a, b)| format!("{field}: {a} | {b}\n")).collect();
        expect_test::expect![[r#"
            scale: 1 | 10
            sweep.rate_hz: 48000 | 96000
            sweep.high_hz: 20000 | 40000
            impulse_response.division: floored at -60 dB | tapered
            bands.centres_hz: 125, 250 | 2500, 5000, 10000, 20000, 40000
            panel.size_mm: 600 | 585
            grid.pairs: ordered | unordered
            grid.layers: none | 6 x 6 points 75 mm apart at 124 mm, 5 x 5 points 93.75 mm apart at 214 mm, 4 x 4 points 125 mm apart at 304 mm, 1 point at 474 mm
            grid.points_mm: 2 points (0 0 1000, 2000 0 1000.5) | none
        "#]]
        .assert_eq(&said);
    }
}
