//! Reliefs: surfaces as height fields, and the generators that make them.

mod bricks;
mod chance;
mod courses;
pub mod group;
mod layered;
mod macrostructure;
mod masonry;
mod mesostructure;
mod microstructure;
mod model;
mod parameter;
mod primitive_root;
mod primitives;
mod random;
mod settings;
mod stone;
mod stones;
mod voronoi;
mod wavy;
mod wells;

pub use bricks::{BrickBond, BrickWall};
pub use layered::LayeredWall;
pub use mesostructure::StoneArrangement;
pub use parameter::{ParameterDomain, ParameterLayer, ParameterValue, ReliefParameter};
pub use primitive_root::PrimitiveRootDiffuser;
pub use settings::FULL_SCALE;
pub use wavy::WavyWall;

pub use echolake_dsp::height_field::HeightField;
use serde::{Deserialize, Serialize};

/// Edge of a panel, mm (Rust et al. 2021).
pub const PANEL_SIZE_MM: f64 = 585.0;
/// The relief lies between these heights over the plane that the grid's heights count from, mm: in the published
/// data the lowest layer stands 135 mm over its bottom and 95 mm over its top, and 124 mm over the plane.
pub const RELIEF_MM: [f64; 2] = [-11.0, 29.0];

/// A relief and its material.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "relief", rename_all = "snake_case")]
pub enum PanelRelief {
    /// A plane print.
    Flat,
    /// A plane absorber: only the direct sound remains.
    Foam,
    /// A plane board.
    Wood,
    /// A 2D primitive-root diffuser.
    Prd(PrimitiveRootDiffuser),
    /// Bricks in stretcher bond.
    Brick(BrickWall),
    /// Bricks in Flemish bond.
    Flemish(BrickWall),
    /// A smooth macrostructure.
    Wavy(WavyWall),
    /// A wall in layers, with full-scale parameters.
    Layered(LayeredWall),
}

/// Material of a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceMaterial {
    /// Its name.
    pub name: &'static str,
    /// Pressure reflection factor.
    pub reflection_factor: f64,
}

/// An error of making a relief.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// No such relief.
    #[error("`{given}` is no relief; hint: {}", PanelRelief::NAMES.join(", "))]
    Name {
        /// The given name.
        given: String,
    },
    /// No such parameter.
    #[error("relief `{relief}` has no parameter `{given}`; hint: {valid}")]
    Parameter {
        /// The relief.
        relief: &'static str,
        /// The given name.
        given: String,
        /// The names that it has.
        valid: String,
    },
    /// A value that makes no such relief.
    #[error("parameter `{key}` of relief `{relief}` is `{given}`, expected {expected}; hint: {hint}")]
    Value {
        /// The relief.
        relief: &'static str,
        /// The parameter.
        key: String,
        /// The given value.
        given: String,
        /// The expected value.
        expected: String,
        /// The parameter's meaning.
        hint: &'static str,
    },
    /// Text without a relief.
    #[error("these are no parameters of a relief: {reason}; hint: `echolake panel NAME -o FILE.json` writes some")]
    Text {
        /// The fault.
        reason: String,
    },
}

impl PanelRelief {
    /// The names that [`PanelRelief::by_name`] knows.
    pub const NAMES: [&'static str; 16] = [
        "flat",
        "foam",
        "wood",
        "prd",
        "brick",
        "flemish",
        "wavy",
        "macrostructure",
        "stretcher_bond",
        "flemish_bond",
        "coursed_ashlar",
        "polygonal_rubble",
        "river_rock",
        "slated_stone",
        "primitives",
        "primitive_root",
    ];

    /// A relief with its default parameters.
    ///
    /// # Errors
    /// [`Error::Name`], which lists the names.
    pub fn by_name(name: &str) -> Result<Self, Error> {
        Ok(match name {
            "flat" => Self::Flat,
            "foam" => Self::Foam,
            "wood" => Self::Wood,
            "prd" => Self::Prd(PrimitiveRootDiffuser::default()),
            "brick" => Self::Brick(BrickWall { bond: BrickBond::Stretcher, ..BrickWall::default() }),
            "flemish" => Self::Flemish(BrickWall { bond: BrickBond::Flemish, ..BrickWall::default() }),
            "wavy" => Self::Wavy(WavyWall::default()),
            _ => match StoneArrangement::ALL.into_iter().find(|m| m.name() == name) {
                Some(mesostructure) => Self::Layered(LayeredWall::new(mesostructure)),
                None => return Err(Error::Name { given: name.to_owned() }),
            },
        })
    }

    /// Returns the relief that a surface's name begins with: the longest name that matches.
    pub fn guess(surface: &str) -> Option<&'static str> {
        Self::NAMES.into_iter().filter(|name| surface.starts_with(name)).max_by_key(|name| name.len())
    }

    /// Parses the text of [`PanelRelief::to_json`]; every parameter is checked, missing ones have their defaults.
    ///
    /// # Errors
    /// [`Error`], as for the names and values themselves.
    pub fn from_json(text: &str) -> Result<Self, Error> {
        let wrong = |reason: String| Error::Text { reason };
        let fields: serde_json::Map<_, _> = serde_json::from_str(text).map_err(|e| wrong(e.to_string()))?;
        let name = fields.get("relief").and_then(|name| name.as_str());
        let mut relief = Self::by_name(name.ok_or_else(|| wrong("they do not name a `relief`".to_owned()))?)?;
        let parameters = fields.get("parameters").and_then(|p| p.as_object());
        for (key, value) in parameters.ok_or_else(|| wrong("they have no `parameters`".to_owned()))? {
            // The bond of the older walls is their name's.
            if key != "bond" {
                relief.set(key, value.as_str().unwrap_or(&value.to_string()))?;
            }
        }
        Ok(relief)
    }

    /// Returns the relief as JSON: its name, its kind, the scale of its parameters in mm, and the parameters.
    pub fn to_json(&self) -> serde_json::Value {
        serde_json::json!({
            "relief": self.name(),
            "typology": self.typology(),
            "scale": match self { Self::Layered(_) => "full scale, 10 times the panel", _ => "the panel's, 1:10" },
            "parameters": self.parameters(),
        })
    }

    /// Returns the parameters, with ranges and defaults.
    pub fn describe(&self) -> Vec<ReliefParameter> {
        match self {
            Self::Layered(wall) => {
                let mut all = layered::parameters(wall.mesostructure());
                let fresh = LayeredWall::new(wall.mesostructure());
                all.iter_mut().for_each(|p| fresh.name_default(p));
                all
            }
            older => model::parameters(older.name()).to_vec(),
        }
    }

    /// Sets a parameter.
    ///
    /// # Errors
    /// [`Error::Parameter`] or [`Error::Value`], which name the valid ones.
    pub fn set(&mut self, key: &str, value: &str) -> Result<(), Error> {
        if let Self::Layered(wall) = self {
            return wall.set(key, value);
        }
        let relief = self.name();
        let known = model::parameters(relief);
        let parameter = known.iter().find(|p| p.key == key).ok_or_else(|| Error::Parameter {
            relief,
            given: key.to_owned(),
            valid: match known.iter().map(|p| p.key).collect::<Vec<_>>() {
                names if names.is_empty() => "it has none".to_owned(),
                names => names.join(", "),
            },
        })?;
        let setting = parameter.parse(relief, value)?;
        let wrong = |expected: &str| Error::Value {
            relief,
            key: key.to_owned(),
            given: value.to_owned(),
            expected: expected.to_owned(),
            hint: parameter.about,
        };
        let mut fields = self.parameters();
        fields.insert(key.to_owned(), serde_json::to_value(setting).unwrap_or_default());
        fields.insert("relief".to_owned(), relief.into());
        let changed: Self = serde_json::from_value(fields.into()).map_err(|_| wrong("another kind of value"))?;
        // What depends on other parameters too.
        changed.check().map_err(wrong)?;
        *self = changed;
        Ok(())
    }

    /// Its name.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Flat => "flat",
            Self::Foam => "foam",
            Self::Wood => "wood",
            Self::Prd(_) => "prd",
            Self::Brick(_) => "brick",
            Self::Flemish(_) => "flemish",
            Self::Wavy(_) => "wavy",
            Self::Layered(wall) => wall.mesostructure().name(),
        }
    }

    /// Its kind, as table `surfaces` names it.
    pub fn typology(&self) -> &'static str {
        match self {
            Self::Flat | Self::Foam | Self::Wood => "reference",
            Self::Prd(_) => "primitive_root_diffuser",
            Self::Brick(_) => "stretcher_bond_bricks",
            Self::Flemish(_) => "flemish_bond_bricks",
            Self::Wavy(_) => "macrostructure",
            Self::Layered(wall) => wall.mesostructure().typology(),
        }
    }

    /// Returns its material. Flat reflects 29.3 % less energy than Wood (Rust et al. 2021), hence 0.83.
    pub fn material(&self) -> SurfaceMaterial {
        match self {
            Self::Foam => SurfaceMaterial { name: "melamine foam", reflection_factor: 0.05 },
            Self::Wood => SurfaceMaterial { name: "MDF", reflection_factor: 0.99 },
            _ => SurfaceMaterial { name: "coated print", reflection_factor: 0.83 },
        }
    }

    /// Its parameters by name, all that [`BrickWall`] and the like have.
    pub fn parameters(&self) -> serde_json::Map<String, serde_json::Value> {
        if let Self::Layered(wall) = self {
            let value = |setting| serde_json::to_value(setting).unwrap_or_default();
            return wall.settings().map(|(key, setting)| (key.to_owned(), value(setting))).collect();
        }
        match serde_json::to_value(self) {
            Ok(serde_json::Value::Object(mut fields)) => {
                fields.remove("relief");
                fields
            }
            _ => serde_json::Map::new(),
        }
    }

    /// Its heights, `cells` along each side.
    pub fn height_field(&self, cells: usize) -> HeightField {
        match self {
            Self::Flat | Self::Foam | Self::Wood => HeightField::from_fn(PANEL_SIZE_MM, cells, |_, _| 0.0),
            Self::Prd(prd) => {
                let depths = prd.depths_mm();
                HeightField::from_fn(PANEL_SIZE_MM, cells, |x, y| prd.height(&depths, x, y))
            }
            Self::Brick(bricks) | Self::Flemish(bricks) => {
                HeightField::from_fn(PANEL_SIZE_MM, cells, |x, y| bricks.height(x, y))
            }
            Self::Wavy(wavy) => {
                let waves = wavy.waves();
                HeightField::from_fn(PANEL_SIZE_MM, cells, |x, y| waves.height(x, y))
            }
            Self::Layered(wall) => wall.height_field(cells),
        }
    }

    fn check(&self) -> Result<(), &'static str> {
        match self {
            Self::Prd(prd) => prd.check(),
            Self::Brick(bricks) | Self::Flemish(bricks) => bricks.check(),
            Self::Wavy(wavy) => wavy.check(),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flemish_wall_stays_one_whatever_is_set() {
        let mut wall = PanelRelief::by_name("flemish").expect("a relief");
        wall.set("seed", "7").expect("a parameter");
        assert_eq!(wall, PanelRelief::Flemish(BrickWall { bond: BrickBond::Flemish, seed: 7, ..BrickWall::default() }));
        // Parameters alone say what the wall is: the table `surfaces` keeps them.
        let again: BrickWall = serde_json::from_value(wall.parameters().into()).expect("bricks");
        assert_eq!(PanelRelief::Flemish(again), wall);
        let refused = wall.set("bond", "stretcher").expect_err("another relief").to_string();
        assert!(refused.contains("has no parameter `bond`") && !refused.contains("bond,"), "{refused}");
    }

    #[test]
    fn parameters_are_set_by_name() {
        let mut brick = PanelRelief::by_name("brick").expect("a relief");
        brick.set("joint_depth_mm", "6").expect("a parameter");
        brick.set("seed", "7").expect("a parameter");
        assert_eq!(brick.parameters()["joint_depth_mm"], 6.0);
        let unknown = brick.set("colour", "red").expect_err("unknown").to_string();
        assert!(unknown.contains("joint_depth_mm"), "{unknown}");
        for (key, value) in [("joint_depth_mm", "NaN"), ("joint_depth_mm", "-1"), ("length_mm", "0"), ("seed", "1.5")] {
            assert!(brick.set(key, value).is_err(), "{key}={value}");
        }
        assert!(PanelRelief::Flat.set("depth", "1").expect_err("none").to_string().contains("it has none"));
        assert!(PanelRelief::by_name("marble").expect_err("unknown").to_string().contains("wavy"));
    }

    mod slow {
        use super::*;

        #[test]
        fn every_relief_stays_within_its_depth() {
            for name in PanelRelief::NAMES {
                let relief = PanelRelief::by_name(name).expect(name);
                assert_eq!(relief.name(), name);
                let [low, high] = relief.height_field(274).extent_mm();
                assert!(low >= -11.0 && high <= 29.0, "{name}: {low} {high}");
                let is_plane = matches!(relief, PanelRelief::Flat | PanelRelief::Foam | PanelRelief::Wood);
                assert_eq!(high - low < 1.0, is_plane, "{name}: {low} {high}");
                assert_eq!(relief.height_field(64), relief.height_field(64), "{name}");
            }
        }
    }
}
