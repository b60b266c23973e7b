//! Reliefs: surfaces as height fields, and the generators that make them.

mod chance;
mod courses;
pub mod group;
mod layered;
mod macrostructure;
mod masonry;
mod mesostructure;
mod microstructure;
mod parameter;
mod primitive_root;
mod primitives;
mod ridges;
mod settings;
mod stone;
mod stones;
mod voronoi;
mod wells;

pub use layered::LayeredWall;
pub use mesostructure::StoneArrangement;
pub use parameter::{ParameterDomain, ParameterLayer, ParameterValue, ReliefParameter};
pub use primitive_root::PrimitiveRootDiffuser;
pub use ridges::RidgeRelief;
pub use settings::FULL_SCALE;

pub use echolake_dsp::height_field::HeightField;

use crate::material::SurfaceMaterial;
use crate::paper_panel::PaperPanel;
use chance::SeededRandom;

/// Edge of a panel, mm (Rust et al. 2021).
pub const PANEL_SIZE_MM: f64 = 585.0;
/// The relief lies between these heights over the plane that the grid's heights count from, mm: in the published
/// data the lowest layer stands 135 mm over its bottom and 95 mm over its top, and 124 mm over the plane.
pub const RELIEF_MM: [f64; 2] = [-11.0, 29.0];

/// A relief and its material.
#[derive(Debug, Clone, PartialEq)]
pub enum PanelRelief {
    /// A plane print.
    Flat,
    /// A plane absorber: only the direct sound remains.
    Foam,
    /// A plane board.
    Wood,
    /// A 2D primitive-root diffuser.
    Prd(PrimitiveRootDiffuser),
    /// Ridges that repeat.
    Ridges(RidgeRelief),
    /// A wall in layers, with full-scale parameters.
    Layered(LayeredWall),
}

/// A relief on the way from a plane to a wall.
#[derive(Debug, Clone, PartialEq)]
pub struct GenerationStep {
    /// What was done.
    pub caption: &'static str,
    /// The relief after it.
    pub relief: PanelRelief,
}

/// An error of making a relief.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// No such relief.
    #[error(
        "`{given}` is no relief; hint: {}, or one of the paper's panels: {}",
        PanelRelief::NAMES.join(", "), paper_names()
    )]
    Name {
        /// The given name.
        given: String,
    },
    /// A relief of before, which a wall in layers replaces.
    #[error(
        "relief `{given}` is gone: `{name}` makes such walls, with full-scale lengths, ten times the panel's; hint: \
         `echolake panel {name} --list`"
    )]
    Renamed {
        /// The given name.
        given: String,
        /// The name of its successor.
        name: &'static str,
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
    /// Values that are fine each, and too deep together.
    #[error(
        "relief `{relief}` is {depth_mm} mm deep at most with {parts}, expected {greatest_mm} mm full scale or less; \
         hint: less of one of them"
    )]
    Depth {
        /// The relief.
        relief: &'static str,
        /// Its depth, mm full scale.
        depth_mm: f64,
        /// The greatest depth.
        greatest_mm: f64,
        /// The parameters that make it.
        parts: String,
    },
    /// Text without a relief.
    #[error("these are no parameters of a relief: {reason}; hint: `echolake panel NAME -o FILE.json` writes some")]
    Text {
        /// The fault.
        reason: String,
    },
}

/// Reliefs of before, and what replaces them. Surfaces may still be named after them.
const RENAMED: [(&str, &str); 3] =
    [("brick", "stretcher_bond"), ("flemish", "flemish_bond"), ("wavy", "macrostructure")];

/// Walls of each kind among [`DECK_SIZE`]. The paper had measured about 150 surfaces when it counted 92 brick and 46
/// stone walls (Rust et al. 2021); how these and the others divide into kinds is an assumption: evenly.
const SHARES: [(StoneArrangement, usize); 9] = [
    (StoneArrangement::StretcherBond, 46),
    (StoneArrangement::FlemishBond, 46),
    (StoneArrangement::CoursedAshlar, 12),
    (StoneArrangement::PolygonalRubble, 12),
    (StoneArrangement::RiverRock, 11),
    (StoneArrangement::SlatedStone, 11),
    (StoneArrangement::Macrostructure, 4),
    (StoneArrangement::Primitives, 4),
    (StoneArrangement::PrimitiveRoot, 4),
];
/// Surfaces after which the kinds of walls begin anew.
const DECK_SIZE: u64 = 150;

// Kinds of walls in an order of chance; a small collection has one of each kind first.
fn shuffle_deck(chance: SeededRandom) -> Vec<StoneArrangement> {
    let kinds: Vec<_> = SHARES.iter().flat_map(|(kind, count)| std::iter::repeat_n(*kind, *count)).collect();
    let mut deck: Vec<_> = chance.random_order(kinds.len()).into_iter().map(|n| kinds[n]).collect();
    for first in 0..SHARES.len() {
        if let Some(next) = (first..deck.len()).find(|n: &usize| !deck[..first].contains(&deck[*n])) {
            deck.swap(first, next);
        }
    }
    deck
}

fn paper_names() -> String {
    PaperPanel::ALL.map(|panel| panel.name).join(", ")
}

impl PanelRelief {
    /// The names that [`PanelRelief::by_name`] knows.
    pub const NAMES: [&'static str; 14] = [
        "flat",
        "foam",
        "wood",
        "prd",
        "ridges",
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

    /// A relief with its default parameters, or a panel of the paper with its own.
    ///
    /// # Errors
    /// [`Error::Name`], which lists the names, or [`Error::Renamed`].
    pub fn by_name(name: &str) -> Result<Self, Error> {
        if let Some(panel) = PaperPanel::by_name(name) {
            return Self::from_paper(&panel);
        }
        Ok(match name {
            "flat" => Self::Flat,
            "foam" => Self::Foam,
            "wood" => Self::Wood,
            "prd" => Self::Prd(PrimitiveRootDiffuser::default()),
            "ridges" => Self::Ridges(RidgeRelief::default()),
            _ => match StoneArrangement::ALL.into_iter().find(|m| m.name() == name) {
                Some(mesostructure) => Self::Layered(LayeredWall::new(mesostructure)),
                None => {
                    let given = name.to_owned();
                    return Err(match RENAMED.iter().find(|(old, _)| *old == name) {
                        Some((_, name)) => Error::Renamed { given, name },
                        None => Error::Name { given },
                    });
                }
            },
        })
    }

    /// Makes the relief of a panel of the paper.
    ///
    /// # Errors
    /// None for those of [`PaperPanel::ALL`].
    pub fn from_paper(panel: &PaperPanel) -> Result<Self, Error> {
        let mut relief = Self::by_name(panel.relief)?;
        panel.settings.iter().try_for_each(|(key, value)| relief.set_parameter(key, value))?;
        relief.check_depth()?;
        Ok(relief)
    }

    /// Returns the panel of the paper that has a surface's name, or the relief that the name begins with: the longest
    /// name that matches.
    pub fn guess_name(surface: &str) -> Option<&'static str> {
        if let Some(panel) = PaperPanel::by_name(surface) {
            return Some(panel.name);
        }
        let names = Self::NAMES.into_iter().map(|name| (name, name)).chain(RENAMED);
        let matching = names.filter(|(start, _)| surface.starts_with(start));
        matching.max_by_key(|(start, _)| start.len()).map(|(_, name)| name)
    }

    /// Relief `number` of the collection that `seed` names; it does not depend on how many there are. Every 150 from a
    /// multiple of it are 92 walls of brick, 46 of stone and 12 others, in any order, but the first nine are one of
    /// each kind; their parameters are from all of their ranges.
    pub fn from_seed(seed: u64, number: u64) -> Self {
        let chance = SeededRandom::new(seed, 0xDECC);
        let deck = shuffle_deck(chance.at_place((number / DECK_SIZE) as i64, 1));
        Self::Layered(LayeredWall::from_chance(deck[(number % DECK_SIZE) as usize], chance.at_place(number as i64, 0)))
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
            relief.set_parameter(key, value.as_str().unwrap_or(&value.to_string()))?;
        }
        relief.check_depth()?;
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
    pub fn describe_parameters(&self) -> Vec<ReliefParameter> {
        match self {
            Self::Layered(wall) => {
                let mut all = layered::wall_parameters(wall.mesostructure());
                let fresh = LayeredWall::new(wall.mesostructure());
                all.iter_mut().for_each(|p| fresh.name_default(p));
                all
            }
            Self::Prd(_) => primitive_root::PARAMETERS.to_vec(),
            Self::Ridges(_) => ridges::PARAMETERS.to_vec(),
            Self::Flat | Self::Foam | Self::Wood => Vec::new(),
        }
    }

    /// Checks that all parameters together make a relief that a panel has room for.
    ///
    /// # Errors
    /// [`Error::Depth`].
    pub fn check_depth(&self) -> Result<(), Error> {
        match self {
            Self::Layered(wall) => wall.check_depth(),
            _ => Ok(()),
        }
    }

    /// Sets a parameter; when all are set, [`PanelRelief::check_depth`] tries them together.
    ///
    /// # Errors
    /// [`Error::Parameter`] or [`Error::Value`], which name the valid ones.
    pub fn set_parameter(&mut self, key: &str, value: &str) -> Result<(), Error> {
        let relief = self.name();
        let known = self.describe_parameters();
        let parameter = known.iter().find(|p| p.key == key).ok_or_else(|| Error::Parameter {
            relief,
            given: key.to_owned(),
            valid: match known.iter().map(|p| p.key).collect::<Vec<_>>() {
                names if names.is_empty() => "it has none".to_owned(),
                names => names.join(", "),
            },
        })?;
        let setting = parameter.parse_value(relief, value)?;
        match self {
            Self::Layered(wall) => wall.set_values([(parameter.key, setting)]),
            Self::Prd(prd) => prd.set_value(&setting).map_err(|expected| Error::Value {
                relief,
                key: key.to_owned(),
                given: value.to_owned(),
                expected: expected.to_owned(),
                hint: parameter.about,
            })?,
            Self::Ridges(ridges) => ridges.set_value(key, setting),
            Self::Flat | Self::Foam | Self::Wood => {}
        }
        Ok(())
    }

    /// Returns the steps in which a wall of stones is generated; none if it has no joints.
    pub fn generation_steps(&self) -> Vec<GenerationStep> {
        match self {
            Self::Layered(wall) => wall.generation_steps(),
            _ => Vec::new(),
        }
    }

    /// Its name.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Flat => "flat",
            Self::Foam => "foam",
            Self::Wood => "wood",
            Self::Prd(_) => "prd",
            Self::Ridges(_) => "ridges",
            Self::Layered(wall) => wall.mesostructure().name(),
        }
    }

    /// Its kind, as table `surfaces` names it.
    pub fn typology(&self) -> &'static str {
        match self {
            Self::Flat | Self::Foam | Self::Wood => "reference",
            Self::Prd(_) => "primitive_root_diffuser",
            Self::Ridges(_) => "ridges",
            Self::Layered(wall) => wall.mesostructure().typology(),
        }
    }

    /// Returns its material.
    pub fn material(&self) -> SurfaceMaterial {
        match self {
            Self::Foam => SurfaceMaterial::MelamineFoam,
            Self::Wood => SurfaceMaterial::FibreBoard,
            _ => SurfaceMaterial::CoatedPrint,
        }
    }

    /// Its parameters by name.
    pub fn parameters(&self) -> serde_json::Map<String, serde_json::Value> {
        match self {
            Self::Flat | Self::Foam | Self::Wood => serde_json::Map::new(),
            Self::Prd(prd) => [("prime", prd.prime.into()), ("depth_mm", prd.depth_mm.into())]
                .map(|(key, value): (&str, serde_json::Value)| (key.to_owned(), value))
                .into_iter()
                .collect(),
            Self::Ridges(ridges) => {
                ridges.named_parameters().into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
            }
            Self::Layered(wall) => wall.parameters(),
        }
    }

    /// Its heights, `cells` along each side.
    pub fn height_field(&self, cells: usize) -> HeightField {
        match self {
            Self::Flat | Self::Foam | Self::Wood => HeightField::from_fn(PANEL_SIZE_MM, cells, |_, _| 0.0),
            Self::Prd(prd) => {
                let depths = prd.depths_mm();
                HeightField::from_fn(PANEL_SIZE_MM, cells, |x, y| prd.height_at(&depths, x, y))
            }
            Self::Ridges(ridges) => HeightField::from_fn(PANEL_SIZE_MM, cells, |x, _| ridges.height_at(x)),
            Self::Layered(wall) => wall.height_field(cells),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn parameters_are_set_by_name() {
        let mut prd = PanelRelief::by_name("prd").expect("a relief");
        prd.set_parameter("depth_mm", "6").expect("a parameter");
        prd.set_parameter("prime", "31").expect("a parameter");
        assert_eq!((&prd.parameters()["depth_mm"], &prd.parameters()["prime"]), (&6.0.into(), &31.into()));
        let unknown = prd.set_parameter("colour", "red").expect_err("unknown").to_string();
        assert!(unknown.contains("has no parameter `colour`; hint: prime, depth_mm"), "{unknown}");
        for (key, value) in
            [("depth_mm", "NaN"), ("depth_mm", "-1"), ("depth_mm", "39"), ("prime", "32"), ("prime", "1.5")]
        {
            assert!(prd.set_parameter(key, value).is_err(), "{key}={value}");
        }
        assert!(PanelRelief::Flat.set_parameter("depth", "1").expect_err("none").to_string().contains("it has none"));
        assert!(PanelRelief::by_name("marble").expect_err("unknown").to_string().contains("river_rock"));
    }

    #[test]
    fn reliefs_of_before_name_their_successor() {
        for (old, new) in RENAMED {
            let refused = PanelRelief::by_name(old).expect_err("gone").to_string();
            assert!(refused.contains(&format!("`{old}` is gone")) && refused.contains(&format!("panel {new} --list")));
            assert_eq!(PanelRelief::guess_name(&format!("{old}_2")), Some(new));
        }
        assert_eq!(PanelRelief::guess_name("flemish_bond_2"), Some("flemish_bond"));
        assert_eq!(PanelRelief::guess_name("0001_0"), None);
    }

    #[test]
    fn collections_are_their_seeds() {
        let drawn = |seed| (0..2 * DECK_SIZE).map(|n| PanelRelief::from_seed(seed, n)).collect::<Vec<_>>();
        assert_eq!(drawn(1), drawn(1));
        let (one, two) = (drawn(1), drawn(2));
        assert!(one.iter().zip(&two).all(|(a, b)| a != b));
        for block in one.chunks(DECK_SIZE as usize) {
            let names: BTreeSet<_> = block[..9].iter().map(PanelRelief::name).collect();
            assert_eq!(names.len(), 9, "{names:?}");
            let count = |part: &str| block.iter().filter(|relief| relief.typology().contains(part)).count();
            assert_eq!((count("brick"), count("stone")), (92, 46));
        }
        let first: BTreeSet<_> = (1..9).map(|seed| PanelRelief::from_seed(seed, 0).name()).collect();
        assert!(first.len() > 3, "the order changes: {first:?}");
        // What is drawn can be set, so it is within the ranges, and a panel has room for it.
        for relief in one {
            assert_eq!(PanelRelief::from_json(&relief.to_json().to_string()), Ok(relief));
        }
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
