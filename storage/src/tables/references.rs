//! The surfaces that a surface's levels rest on, as the rows of `surfaces` name them.

use std::collections::{BTreeSet, HashMap};

use echolake_schema::tables::Table;
use echolake_schema::{SurfaceId, SurfaceRecord};

use crate::tables::file_name::{FileName, VisibleRun};
use crate::{DataFile, LakeSnapshot, ReferenceSurfaces};

/// The surfaces that a surface names as its references.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct ReferenceNames {
    /// The surface that normalises.
    pub flat: SurfaceId,
    /// The surface whose response is the direct sound.
    pub foam: SurfaceId,
}

/// The references that each surface of a snapshot names.
#[derive(Debug, Clone)]
pub struct SurfaceReferences {
    named: HashMap<SurfaceId, ReferenceNames>,
    defaults: ReferenceNames,
}

impl ReferenceNames {
    /// Returns the names that a run's surface gives, else the lake's.
    pub fn from_surface(surface: &SurfaceRecord, references: &ReferenceSurfaces) -> Self {
        Self {
            flat: surface.flat_reference.clone().unwrap_or_else(|| references.flat.clone()),
            foam: surface.foam_reference.clone().unwrap_or_else(|| references.foam.clone()),
        }
    }
}

impl SurfaceReferences {
    /// Reads the names from the log's statistics of `surfaces`.
    pub fn from_snapshot(snapshot: &LakeSnapshot, references: &ReferenceSurfaces) -> Self {
        let defaults = ReferenceNames { flat: references.flat.clone(), foam: references.foam.clone() };
        let files = snapshot.files(Table::Surfaces).iter();
        let named = files.flat_map(|file| names_of_file(file, &defaults)).collect();
        Self { named, defaults }
    }

    /// Returns the names that a surface gives; the lake's for an unknown surface.
    pub fn names_of(&self, surface: &SurfaceId) -> ReferenceNames {
        self.named.get(surface).unwrap_or(&self.defaults).clone()
    }

    /// Lists the surfaces whose runs a surface's levels are computed from: itself, its Flat, its Foam, and Flat's Foam.
    pub fn supporting_surfaces(&self, surface: &SurfaceId) -> BTreeSet<SurfaceId> {
        let ReferenceNames { flat, foam } = self.names_of(surface);
        let flat_foam = self.names_of(&flat).foam;
        BTreeSet::from([surface.clone(), flat, foam, flat_foam])
    }

    /// Lists the runs of other surfaces whose levels rest on a surface's runs.
    pub fn dependent_runs<'a>(
        &'a self,
        snapshot: &'a LakeSnapshot,
        surface: &'a SurfaceId,
    ) -> impl Iterator<Item = &'a VisibleRun> + 'a {
        let of_others = snapshot.runs().filter(move |run| run.surface != *surface);
        of_others.filter(move |run| self.supporting_surfaces(&run.surface).contains(surface))
    }

    /// Returns whether all surfaces rest on this one that name no references.
    pub fn is_default(&self, surface: &SurfaceId) -> bool {
        [&self.defaults.flat, &self.defaults.foam].contains(&surface)
    }
}

// The names in the rows of a file's surfaces, which are the same in all of them, taken from the file's statistics.
fn names_of_file(file: &DataFile, defaults: &ReferenceNames) -> Vec<(SurfaceId, ReferenceNames)> {
    let surfaces = match &file.name {
        Some(FileName::Rows { surface, .. }) => vec![surface.clone()],
        _ => file.visible_parts().map(|(part, _)| part.surface.clone()).collect(),
    };
    let text = |column: &str| file.stats.as_ref()?.min.get(column)?.as_str()?.parse().ok();
    let names = ReferenceNames {
        flat: text("flat_reference").unwrap_or_else(|| defaults.flat.clone()),
        foam: text("foam_reference").unwrap_or_else(|| defaults.foam.clone()),
    };
    surfaces.into_iter().map(|surface| (surface, names.clone())).collect()
}
