//! Mesostructures of walls: the list of all arrangements of stones.

use super::parameter::Parameter;
use super::settings::Settings;
use super::stones::Stones;
use super::{courses, masonry, primitives, voronoi, wells};

/// Mesostructure of a wall: the arrangement of its stones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mesostructure {
    /// No stones: the large shape alone.
    Macrostructure,
    /// Bricks, each course shifted by half a brick.
    StretcherBond,
    /// Bricks, long and short sides in turn.
    FlemishBond,
    /// Squared stones in courses of different heights.
    CoursedAshlar,
    /// Stones with many sides.
    PolygonalRubble,
    /// Round stones.
    RiverRock,
    /// Thin slabs.
    SlatedStone,
    /// Pyramids, hemispheres and the like on a lattice.
    Primitives,
    /// Wells of a 2D primitive-root diffuser.
    PrimitiveRoot,
}

impl Mesostructure {
    /// All of them.
    pub const ALL: [Self; 9] = [
        Self::Macrostructure,
        Self::StretcherBond,
        Self::FlemishBond,
        Self::CoursedAshlar,
        Self::PolygonalRubble,
        Self::RiverRock,
        Self::SlatedStone,
        Self::Primitives,
        Self::PrimitiveRoot,
    ];

    /// Its name, as `echolake panel` takes it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Macrostructure => "macrostructure",
            Self::StretcherBond => "stretcher_bond",
            Self::FlemishBond => "flemish_bond",
            Self::CoursedAshlar => "coursed_ashlar",
            Self::PolygonalRubble => "polygonal_rubble",
            Self::RiverRock => "river_rock",
            Self::SlatedStone => "slated_stone",
            Self::Primitives => "primitives",
            Self::PrimitiveRoot => "primitive_root",
        }
    }

    /// Its kind, as table `surfaces` and the published data name it.
    pub fn typology(self) -> &'static str {
        match self {
            Self::Macrostructure => "macrostructure",
            Self::StretcherBond => "stretcher_bond_bricks",
            Self::FlemishBond => "flemish_bond_bricks",
            Self::CoursedAshlar => "coursed_ashlar_stones",
            Self::PolygonalRubble => "polygonal_rubble_stones",
            Self::RiverRock => "river_rock_stones",
            Self::SlatedStone => "slated_stones",
            Self::Primitives => "primitives",
            Self::PrimitiveRoot => "primitive_root_diffuser",
        }
    }

    /// Parameters of the stones and their joints.
    pub(super) fn parameters(self) -> &'static [Parameter] {
        match self {
            Self::Macrostructure => &[],
            Self::StretcherBond | Self::FlemishBond => &masonry::PARAMETERS,
            Self::CoursedAshlar => &courses::ASHLAR,
            Self::SlatedStone => &courses::SLATE,
            Self::PolygonalRubble => &voronoi::RUBBLE,
            Self::RiverRock => &voronoi::RIVER_ROCK,
            Self::Primitives => &primitives::PARAMETERS,
            Self::PrimitiveRoot => &wells::PARAMETERS,
        }
    }

    /// Returns its stones; None if it has none.
    pub(super) fn stones(self, settings: &Settings, seed: u64) -> Option<Box<dyn Stones>> {
        Some(match self {
            Self::Macrostructure => return None,
            Self::StretcherBond => Box::new(masonry::Masonry::of(settings, seed, super::Bond::Stretcher)),
            Self::FlemishBond => Box::new(masonry::Masonry::of(settings, seed, super::Bond::Flemish)),
            Self::CoursedAshlar | Self::SlatedStone => Box::new(courses::Courses::of(settings, seed)),
            Self::PolygonalRubble => Box::new(voronoi::Cells::of(settings, seed, voronoi::Outline::Polygons)),
            Self::RiverRock => Box::new(voronoi::Cells::of(settings, seed, voronoi::Outline::Round)),
            Self::Primitives => Box::new(primitives::Primitives::of(settings, seed)),
            Self::PrimitiveRoot => Box::new(wells::Wells::of(settings)),
        })
    }
}
