//! Ridges along y that repeat along x: sines and rectangular profiles, whose scattering is published.

use super::parameter::{ParameterLayer, ParameterValue, ReliefParameter};

const WHOLE: ParameterLayer = ParameterLayer::Whole;
const SINE: &str = "sine";

/// Parameters of relief `ridges`; its lengths are the panel's own. Cells of the heights are 2.1 mm.
pub(super) const PARAMETERS: [ReliefParameter; 4] = [
    ReliefParameter::new_choice(
        "profile",
        WHOLE,
        &[SINE, "rectangle"],
        "a sine, or ridges with level tops and troughs",
    ),
    ReliefParameter::new_number("period_mm", WHOLE, "mm on the panel", [8.0, 300.0, 17.7], "from ridge to ridge"),
    ReliefParameter::new_number("depth_mm", WHOLE, "mm on the panel", [0.5, 28.0, 5.1], "from troughs to tops"),
    ReliefParameter::new_number("width_share", WHOLE, "", [0.1, 0.9, 0.5], "of a rectangle's period, what is its top"),
];

/// Ridges. By default the sine of Vorlaender, Embrechts et al. 2004, 0.177 m and 0.051 m, at 1:10.
#[derive(Debug, Clone, PartialEq)]
pub struct RidgeRelief {
    profile: String,
    period_mm: f64,
    depth_mm: f64,
    width_share: f64,
}

impl Default for RidgeRelief {
    fn default() -> Self {
        Self { profile: SINE.to_owned(), period_mm: 17.7, depth_mm: 5.1, width_share: 0.5 }
    }
}

impl RidgeRelief {
    /// Sets one of [`PARAMETERS`] to a value of its domain.
    pub(super) fn set_value(&mut self, key: &str, value: ParameterValue) {
        match (key, value) {
            ("profile", ParameterValue::Word(profile)) => self.profile = profile,
            ("period_mm", ParameterValue::Number(mm)) => self.period_mm = mm,
            ("depth_mm", ParameterValue::Number(mm)) => self.depth_mm = mm,
            ("width_share", ParameterValue::Number(share)) => self.width_share = share,
            _ => {}
        }
    }

    /// Its parameters by name.
    pub(super) fn named_parameters(&self) -> [(&'static str, serde_json::Value); 4] {
        [
            ("profile", self.profile.as_str().into()),
            ("period_mm", self.period_mm.into()),
            ("depth_mm", self.depth_mm.into()),
            ("width_share", self.width_share.into()),
        ]
    }

    /// Height at a place over the troughs; a top is in the middle.
    pub(super) fn height_at(&self, x: f64) -> f64 {
        let turns = x / self.period_mm;
        let share = match self.profile.as_str() {
            SINE => 0.5 + 0.5 * super::chance::cosine_of_turns(turns),
            _ => f64::from(u8::from((turns - turns.round()).abs() < self.width_share / 2.0)),
        };
        self.depth_mm * share
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn profiles_are_what_they_say() {
        let sine = RidgeRelief::default();
        assert!((sine.height_at(0.0) - 5.1).abs() < 1e-9 && sine.height_at(17.7 / 2.0).abs() < 1e-9);
        assert!((sine.height_at(17.7 / 4.0) - 2.55).abs() < 1e-9 && (sine.height_at(177.0) - 5.1).abs() < 1e-6);
        let ridges =
            RidgeRelief { profile: "rectangle".into(), period_mm: 50.0, depth_mm: 20.0, ..RidgeRelief::default() };
        let heights = [0.0, 12.0, 13.0, 37.0, 38.0, 50.0, -12.0, -13.0].map(|x| ridges.height_at(x));
        assert_eq!(heights, [20.0, 20.0, 0.0, 0.0, 20.0, 20.0, 20.0, 0.0]);
    }
}
