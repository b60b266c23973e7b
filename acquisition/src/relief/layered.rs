//! Walls in three layers, as the paper makes its panels: any large shape, with any stones, with any joints and skin.
//!
//! Parameters are full-scale: the panel is a tenth of the wall. Every parameter's range is such that all of them at
//! their greatest still fit the relief's 40 mm, so that each combination can be made.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::macrostructure::{self, Macrostructure};
use super::mesostructure::{Mesostructure, SEED};
use super::microstructure::{GRAIN, JOINT_DEPTH, JOINT_SHAPE, JOINT_WIDTH, Microstructure, ROUGHNESS};
use super::parameter::{Domain, Parameter, Setting};
use super::{Error, HeightField, PANEL_SIZE_MM, RELIEF_MM};

/// The wall is this many times as large as the panel (Rust et al. 2021).
pub const FULL_SCALE: f64 = 10.0;
/// Heights of a cell are the mean of those this far apart or less, mm: a joint is 1 mm wide.
const DETAIL_MM: f64 = 0.4;

/// A wall in layers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Layered {
    mesostructure: Mesostructure,
    #[serde(flatten)]
    settings: Settings,
}

/// What parameters are set to; those that are not have their defaults.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub(super) struct Settings(BTreeMap<String, Setting>);

impl Settings {
    pub(super) fn number(&self, parameter: &Parameter) -> f64 {
        match (self.0.get(parameter.key), parameter.domain) {
            (Some(Setting::Number(x)), _) => *x,
            (Some(Setting::Whole(x)), _) => *x as f64,
            (_, Domain::Number { default, .. }) => default,
            _ => 0.0,
        }
    }

    /// A full-scale length as the panel's.
    pub(super) fn model_mm(&self, parameter: &Parameter) -> f64 {
        self.number(parameter) / FULL_SCALE
    }

    pub(super) fn word(&self, parameter: &Parameter) -> &str {
        match (self.0.get(parameter.key), parameter.domain) {
            (Some(Setting::Word(word)), _) => word,
            (_, Domain::Choice { default, .. }) => default,
            _ => "",
        }
    }
}

impl Layered {
    /// A wall with its default parameters.
    pub fn new(mesostructure: Mesostructure) -> Self {
        let default = |p: Parameter| (p.key.to_owned(), p.default_setting());
        let mut settings = Settings(parameters(mesostructure).into_iter().map(default).collect());
        if mesostructure == Mesostructure::Macrostructure {
            // Without stones and flat it would be Flat.
            settings.0.insert(macrostructure::SHAPE.key.to_owned(), Setting::Word("wavy_xy".to_owned()));
        }
        Self { mesostructure, settings }
    }

    /// How its stones lie.
    pub fn mesostructure(&self) -> Mesostructure {
        self.mesostructure
    }

    /// Its large shape.
    pub fn macrostructure(&self) -> &str {
        self.settings.word(&macrostructure::SHAPE)
    }

    /// Its joints and skin, in words.
    pub fn microstructure(&self) -> String {
        let skin = match self.settings.number(&ROUGHNESS) {
            0.0 => "smooth".to_owned(),
            roughness => format!("rough by {roughness} mm"),
        };
        let [width, depth] = [&JOINT_WIDTH, &JOINT_DEPTH].map(|p| self.settings.number(p));
        match self.settings.word(&JOINT_SHAPE) {
            _ if width == 0.0 || self.mesostructure == Mesostructure::Macrostructure => skin,
            "flush" => format!("flush joints {width} mm wide, {skin}"),
            shape => format!("{shape} joints {width} mm wide and {depth} mm deep, {skin}"),
        }
    }

    /// Its parameters and what they are set to.
    pub fn settings(&self) -> impl Iterator<Item = (&str, &Setting)> {
        self.settings.0.iter().map(|(key, setting)| (key.as_str(), setting))
    }

    /// Makes what the parameter is set to here its default.
    pub(super) fn name_default(&self, parameter: &mut Parameter) {
        if let Domain::Choice { options, default } = &mut parameter.domain {
            let set = self.settings.word(&Parameter::choice(parameter.key, parameter.layer, options, ""));
            *default = options.iter().find(|o| **o == set).unwrap_or(default);
        }
    }

    pub(super) fn set(&mut self, key: &str, text: &str) -> Result<(), Error> {
        let relief = self.mesostructure.name();
        let known = parameters(self.mesostructure);
        let parameter = known.iter().find(|p| p.key == key).ok_or_else(|| Error::Parameter {
            relief,
            given: key.to_owned(),
            valid: known.iter().map(|p| p.key).collect::<Vec<_>>().join(", "),
        })?;
        self.settings.0.insert(key.to_owned(), parameter.parse(relief, text)?);
        Ok(())
    }

    /// Its heights, each the mean over its cell. Their mean is 0 where that keeps them within the relief.
    pub(super) fn height_field(&self, cells: usize) -> HeightField {
        let settings = &self.settings;
        let seed = match settings.0.get(SEED.key) {
            Some(Setting::Whole(seed)) => *seed,
            _ => 1,
        };
        let shape = Macrostructure::of(settings);
        let skin = Microstructure::of(settings, seed);
        let stones = self.mesostructure.stones(settings, seed);
        let half_joint = settings.model_mm(&JOINT_WIDTH) / 2.0;
        let height = |x: f64, y: f64| {
            let relief = stones.as_ref().map_or(0.0, |stones| {
                let spot = stones.spot(x, y, half_joint);
                let inside = skin.inside(spot.to_joint);
                if inside < 0.0 { skin.joint(inside, x, y) } else { spot.face }
            });
            shape.height(x, y) + relief + skin.roughness(x, y)
        };
        let pitch = PANEL_SIZE_MM / cells.max(2) as f64;
        let places = ((pitch / DETAIL_MM).ceil() as usize).clamp(2, 6);
        let off = |i: usize| ((i as f64 + 0.5) / places as f64 - 0.5) * pitch;
        let mean = |x: f64, y: f64| {
            let rows = (0..places).map(|j| (0..places).map(|i| height(x + off(i), y + off(j))).sum::<f64>());
            rows.sum::<f64>() / (places * places) as f64
        };
        centred(HeightField::from_fn(PANEL_SIZE_MM, cells, mean))
    }
}

/// Parameters of all layers of a wall.
pub(super) fn parameters(mesostructure: Mesostructure) -> Vec<Parameter> {
    use macrostructure::{DEPTH, PHASE, SHAPE, WAVELENGTH};
    let large = [SHAPE, DEPTH, WAVELENGTH, PHASE];
    let seed = (mesostructure.parameters().iter().all(|p| p.key != SEED.key)).then_some(SEED);
    large.into_iter().chain(mesostructure.parameters().iter().copied()).chain([ROUGHNESS, GRAIN]).chain(seed).collect()
}

fn centred(heights: HeightField) -> HeightField {
    let all = heights.heights_mm();
    let mean = all.iter().copied().map(f64::from).sum::<f64>() / all.len() as f64;
    let [low, high] = heights.extent_mm().map(f64::from);
    let shift = (-mean).clamp(RELIEF_MM[0] - low, (RELIEF_MM[1] - high).max(RELIEF_MM[0] - low));
    heights.raised_by(shift)
}
