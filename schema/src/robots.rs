//! Placement of a rig's two arms, and the order in which they visit the grid.

use serde::{Deserialize, Serialize};

/// The `[robots]` section of a rig file. Omitted settings are those of [`RobotCell::default`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RobotCell {
    /// Order in which pairs are visited.
    pub order: VisitOrder,
    /// Foot of the microphone's arm, mm from the panel's centre.
    pub microphone_foot_mm: [f64; 3],
    /// Foot of the speaker's arm, mm from the panel's centre.
    pub speaker_foot_mm: [f64; 3],
    /// Tilt of the microphone's rod.
    pub rod: Rod,
    /// The relief's highest point over its mean plane, mm.
    pub relief_mm: f64,
    /// The table over the relief's mean plane, mm; negative, the panel lies on it.
    pub table_mm: f64,
    /// Least distance of anything from anything, mm.
    pub margin_mm: f64,
}

/// Order in which pairs are visited.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum VisitOrder {
    /// By their numbers.
    Numbered,
    /// So that the arms travel little.
    Planned,
}

/// Tilt of the microphone's rod.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rod {
    /// Leaning towards its own arm.
    Leaning,
    /// Straight up.
    Upright,
}

impl Default for RobotCell {
    /// An arrangement in which the paper's whole grid is within reach. The paper prints no positions; these were
    /// found by trial (`stress/src/motion.rs` prints the reach): the arms face each other over the
    /// panel, the microphone's at lower x, because in a layer the microphone's point has the lower x. The relief's
    /// top is 29 mm over the mean plane (the paper's heights against those of the published data).
    fn default() -> Self {
        Self {
            order: VisitOrder::Numbered,
            microphone_foot_mm: [-560.0, 0.0, -100.0],
            speaker_foot_mm: [560.0, 0.0, -100.0],
            rod: Rod::Leaning,
            relief_mm: 29.0,
            table_mm: -100.0,
            margin_mm: 5.0,
        }
    }
}

impl RobotCell {
    /// Returns whether this is the default, which rig files leave out.
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// Describes the first contradiction among the settings.
    pub(crate) fn find_contradiction(&self) -> Option<String> {
        let lengths = [self.relief_mm, self.table_mm, self.margin_mm];
        let finite =
            self.microphone_foot_mm.iter().chain(&self.speaker_foot_mm).chain(&lengths).all(|x| x.abs() <= 1e4);
        match () {
            () if !finite => Some("expected lengths within 10 m".into()),
            () if self.table_mm >= self.relief_mm => {
                Some(format!("table_mm = {} is not below relief_mm = {}", self.table_mm, self.relief_mm))
            }
            () if self.margin_mm < 0.0 => Some(format!("margin_mm = {} is negative", self.margin_mm)),
            () => None,
        }
    }
}
