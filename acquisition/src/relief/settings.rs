//! Values of a wall's parameters.

use std::collections::BTreeMap;

use super::parameter::{ParameterDomain, ParameterValue, ReliefParameter};

/// The wall is this many times as large as the panel (Rust et al. 2021).
pub const FULL_SCALE: f64 = 10.0;
/// Values by parameter name; parameters without one have their defaults.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct WallSettings(pub(super) BTreeMap<String, ParameterValue>);

impl WallSettings {
    pub(super) fn number(&self, parameter: &ReliefParameter) -> f64 {
        match (self.0.get(parameter.key), parameter.domain) {
            (Some(ParameterValue::Number(x)), _) => *x,
            (Some(ParameterValue::Whole(x)), _) => *x as f64,
            (_, ParameterDomain::Number { default, .. }) => default,
            _ => 0.0,
        }
    }

    /// A full-scale length as the panel's.
    pub(super) fn model_mm(&self, parameter: &ReliefParameter) -> f64 {
        self.number(parameter) / FULL_SCALE
    }

    pub(super) fn word(&self, parameter: &ReliefParameter) -> &str {
        match (self.0.get(parameter.key), parameter.domain) {
            (Some(ParameterValue::Word(word)), _) => word,
            (_, ParameterDomain::Choice { default, .. }) => default,
            _ => "",
        }
    }
}
