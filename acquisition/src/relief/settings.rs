//! Values of a wall's parameters.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::parameter::{Domain, Parameter, Setting};

/// The wall is this many times as large as the panel (Rust et al. 2021).
pub const FULL_SCALE: f64 = 10.0;
/// Values by parameter name; parameters without one have their defaults.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub(super) struct Settings(pub(super) BTreeMap<String, Setting>);

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
