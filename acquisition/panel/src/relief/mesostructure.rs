//! Mesostructures of walls: the list of all arrangements of stones.

use super::parameter::ReliefParameter;
use super::settings::WallSettings;
use super::stones::StoneLayout;
use super::{courses, masonry, primitives, voronoi, wells};

/// Mesostructure of a wall: the arrangement of its stones.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StoneArrangement {
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

impl StoneArrangement {
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
    pub(super) fn parameters(self) -> &'static [ReliefParameter] {
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
    pub(super) fn stone_layout(self, settings: &WallSettings) -> Option<Box<dyn StoneLayout>> {
        Some(match self {
            Self::Macrostructure => return None,
            Self::StretcherBond => {
                Box::new(masonry::MasonryStones::from_settings(settings, masonry::BrickBond::Stretcher))
            }
            Self::FlemishBond => Box::new(masonry::MasonryStones::from_settings(settings, masonry::BrickBond::Flemish)),
            Self::CoursedAshlar | Self::SlatedStone => Box::new(courses::CoursedStones::from_settings(settings)),
            Self::PolygonalRubble => {
                Box::new(voronoi::StoneCells::from_settings(settings, voronoi::StoneOutline::Polygons))
            }
            Self::RiverRock => Box::new(voronoi::StoneCells::from_settings(settings, voronoi::StoneOutline::Round)),
            Self::Primitives => Box::new(primitives::PrimitiveStones::from_settings(settings)),
            Self::PrimitiveRoot => Box::new(wells::DiffuserWells::from_settings(settings)),
        })
    }
}
