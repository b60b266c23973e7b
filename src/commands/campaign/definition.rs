//! The file of a campaign: its surfaces, their references, and the levels that are expected of them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail, ensure};
use echolake_acquisition::disk::read_text_file;
use echolake_lake::ReferenceSurfaces;
use echolake_panel::PanelSpecimen;
use echolake_panel::collection::CollectionSurface;
use echolake_panel::mesh::PanelSide;
use echolake_panel::relief::PanelRelief;
use echolake_schema::{ProjectName, SurfaceId};
use serde::Deserialize;

use crate::UsageError;

/// Runs of one surface at most.
const MOST_RUNS: usize = 1_000;

/// A campaign, as its TOML file has it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CampaignDefinition {
    pub name: String,
    /// Its purpose; printed above its tables.
    #[serde(default)]
    pub about: String,
    /// The rig's file, beside this one.
    rig: Option<PathBuf>,
    /// The project that its surfaces belong to.
    pub project: Option<ProjectName>,
    /// Seed of the simulation.
    #[serde(default = "default_seed")]
    pub seed: u64,
    #[serde(default)]
    references: NamedReferences,
    surfaces: Vec<NamedSurface>,
    #[serde(default)]
    pub expected: Vec<ExpectedLevels>,
}

/// References of all surfaces of a campaign, if they are not the lake's.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct NamedReferences {
    flat: Option<SurfaceId>,
    foam: Option<SurfaceId>,
}

/// A surface by its name and relief.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct NamedSurface {
    name: SurfaceId,
    /// A name of `panel --list`; by default what the surface's name says.
    relief: Option<String>,
    #[serde(default)]
    parameters: BTreeMap<String, toml::Value>,
    /// A mesh in place of a relief; a relative path begins at the campaign's folder.
    mesh: Option<PathBuf>,
    /// The side of the mesh that is measured: `front` or `back`.
    side: Option<String>,
    macro_reference: Option<SurfaceId>,
    /// Seed of its first run.
    seed: Option<u64>,
    #[serde(default = "default_runs")]
    runs: usize,
}

/// Levels that are expected of a surface.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ExpectedLevels {
    pub surface: SurfaceId,
    /// The surface that they are relative to; Flat if there is none.
    pub relative_to: Option<SurfaceId>,
    /// Levels by the names of bands, and `total`.
    pub levels_db: BTreeMap<String, f64>,
    /// Their source.
    #[serde(default)]
    pub source: String,
}

/// What a surface is whose relief or mesh the file does not name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum UnnamedGeometry {
    /// The relief that its name begins with: on the simulated rig.
    Guessed,
    /// A panel without known geometry.
    Unknown,
    /// An error: a real panel is what it is, whatever its surface is called.
    Refused,
}

/// A surface of a campaign, with its geometry.
#[derive(Debug)]
pub(super) struct CampaignSurface {
    pub surface: SurfaceId,
    pub specimen: PanelSpecimen,
    /// The surface that has its large shape alone.
    pub macro_reference: Option<SurfaceId>,
    pub seed: u64,
    pub runs: usize,
}

fn default_seed() -> u64 {
    1
}

fn default_runs() -> usize {
    1
}

impl CampaignDefinition {
    /// Reads a campaign's file.
    pub fn from_file(path: &Path) -> anyhow::Result<Self> {
        let text = read_text_file(path).with_context(|| format!("cannot read campaign `{}`", path.display()))?;
        let parsed: Result<Self, _> = toml::from_str(&text);
        let mut campaign = parsed.map_err(|e| {
            anyhow::anyhow!("campaign `{}`: {e}hint: examples/campaigns has some that are right", path.display())
        })?;
        // Absolute, so that a run can be resumed from another folder.
        let path = std::path::absolute(path)?;
        let meshes = campaign.surfaces.iter_mut().filter_map(|surface| surface.mesh.as_mut());
        meshes.for_each(|mesh| *mesh = path.with_file_name(&*mesh));
        Ok(campaign)
    }

    /// Returns the path of the rig's file, which is named relative to the campaign's.
    pub fn rig_file(&self, path: &Path) -> Option<PathBuf> {
        let rig = self.rig.as_ref()?;
        Some(path.parent().map_or_else(|| rig.clone(), |folder| folder.join(rig)))
    }

    /// Returns Flat and Foam of all surfaces: the file's, else the lake's.
    pub fn reference_surfaces(&self, lake: &ReferenceSurfaces) -> [SurfaceId; 2] {
        let named = &self.references;
        [named.flat.as_ref().unwrap_or(&lake.flat), named.foam.as_ref().unwrap_or(&lake.foam)].map(Clone::clone)
    }

    /// Returns Flat and Foam if the file names them.
    pub fn named_references(&self) -> [Option<SurfaceId>; 2] {
        [self.references.flat.clone(), self.references.foam.clone()]
    }

    /// Makes the surfaces in the order in which they are measured: references that the file does not list come first.
    pub fn make_surfaces(
        &self,
        references: &[SurfaceId],
        unnamed: UnnamedGeometry,
    ) -> anyhow::Result<Vec<CampaignSurface>> {
        ensure!(!self.surfaces.is_empty(), "`surfaces` is empty; hint: [[surfaces]] with name = \"0012_1\"");
        let listed: BTreeSet<_> = self.surfaces.iter().map(|surface| &surface.name).collect();
        ensure!(listed.len() == self.surfaces.len(), "`surfaces` name one surface twice; hint: runs = 2 repeats it");
        for NamedSurface { name, macro_reference, .. } in &self.surfaces {
            let unknown = macro_reference.as_ref().filter(|m| !listed.contains(m) && !references.contains(m));
            if let Some(unknown) = unknown {
                bail!(
                    "`macro_reference` of surface `{name}` is `{unknown}`, expected a surface of the campaign; hint: \
                     [[surfaces]] with name = \"{unknown}\""
                );
            }
        }
        let missing =
            references.iter().filter(|reference| !listed.contains(reference)).map(NamedSurface::for_reference);
        let missing: Vec<_> = missing.collect();
        let all = missing.iter().chain(&self.surfaces);
        let made = all.zip(0u64..).map(|(surface, number)| {
            surface.make_surface(self.seed.wrapping_mul(1_000).wrapping_add(number * MOST_RUNS as u64), unnamed)
        });
        made.collect()
    }

    /// Checks that all that is expected has the names of surfaces and of bands.
    pub fn check_expected(&self, surfaces: &[CampaignSurface], bands: &[String]) -> anyhow::Result<()> {
        let names: Vec<_> = surfaces.iter().map(|surface| surface.surface.as_str()).collect();
        for (ExpectedLevels { surface, relative_to, levels_db, .. }, number) in self.expected.iter().zip(1..) {
            for (key, name) in [("surface", Some(surface)), ("relative_to", relative_to.as_ref())] {
                if let Some(name) = name.filter(|name| !names.contains(&name.as_str())) {
                    bail!(
                        "`{key}` of `expected` {number} is `{name}`, expected a surface of the campaign; hint: {}",
                        names.join(", ")
                    );
                }
            }
            for (band, level_db) in levels_db {
                ensure!(
                    bands.contains(band),
                    "`levels_db` of `expected` {number} (`{surface}`) has a band `{band}`, expected one of the rig's; \
                     hint: {}",
                    bands.join(", ")
                );
                ensure!(
                    level_db.is_finite(),
                    "`levels_db` of `expected` {number} (`{surface}`) is {level_db} for `{band}`, expected a number; \
                     hint: leave it out if it is not known"
                );
            }
        }
        Ok(())
    }
}

impl NamedSurface {
    fn for_reference(name: &SurfaceId) -> Self {
        Self {
            name: name.clone(),
            relief: None,
            parameters: BTreeMap::new(),
            mesh: None,
            side: None,
            macro_reference: None,
            seed: None,
            runs: default_runs(),
        }
    }

    fn make_surface(&self, seed: u64, unnamed: UnnamedGeometry) -> anyhow::Result<CampaignSurface> {
        let name = &self.name;
        ensure!(
            (1..=MOST_RUNS).contains(&self.runs),
            "`runs` of surface `{name}` is {}, expected 1 to {MOST_RUNS}; hint: surfaces that are not needed are left \
                out",
            self.runs
        );
        let (specimen, macro_reference) = match &self.mesh {
            Some(mesh) => (self.measured_mesh(mesh)?, None),
            None => self.measured_relief(unnamed)?,
        };
        let macro_reference = self.macro_reference.clone().or(macro_reference);
        let seed = self.seed.unwrap_or(seed);
        Ok(CampaignSurface { surface: name.clone(), specimen, macro_reference, seed, runs: self.runs })
    }

    fn measured_mesh(&self, mesh: &Path) -> anyhow::Result<PanelSpecimen> {
        let name = &self.name;
        ensure!(
            self.relief.is_none() && self.parameters.is_empty(),
            "surface `{name}` has a `mesh` and a `relief`, expected one of both"
        );
        let side = self.side.as_deref().map_or(Some(PanelSide::Front), PanelSide::parse);
        let side = side.with_context(|| format!("`side` of surface `{name}` is none, expected front or back"))?;
        Ok(PanelSpecimen::Mesh(mesh.to_owned(), side))
    }

    // With the reference that the paper's panels have.
    fn measured_relief(&self, unnamed: UnnamedGeometry) -> anyhow::Result<(PanelSpecimen, Option<SurfaceId>)> {
        let name = &self.name;
        let guessed = || PanelRelief::guess_name(name.as_str()).filter(|_| unnamed == UnnamedGeometry::Guessed);
        let relief = match (self.relief.as_deref().or_else(guessed), unnamed) {
            (Some(relief), _) => relief,
            (None, UnnamedGeometry::Unknown) => return Ok((PanelSpecimen::NoGeometry, None)),
            (None, UnnamedGeometry::Refused) => {
                let text = format!(
                    "the rig's devices are real, and nothing says what the panel of surface `{name}` looks like; hint: \
                     `mesh = \"FILE\"` (or the `relief` that it was made from) in its [[surfaces]], or --no-geometry"
                );
                return Err(UsageError(text).into());
            }
            (None, UnnamedGeometry::Guessed) => bail!(
                "surface `{name}` has no `relief`, and its name says none; hint: {}",
                PanelRelief::NAMES.join(", ")
            ),
        };
        let mut member = CollectionSurface::by_relief_name(name.clone(), relief)
            .with_context(|| format!("`relief` of surface `{name}`"))?;
        let mut set = || {
            for (key, value) in &self.parameters {
                member.relief.set_parameter(key, value.as_str().unwrap_or(&value.to_string()))?;
            }
            member.relief.check_depth()
        };
        set().with_context(|| format!("`parameters` of surface `{name}`"))?;
        Ok((PanelSpecimen::Relief(member.relief), member.macro_reference))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "name = \"mortar\"\n[[surfaces]]\nname = \"0012_1\"\n[[surfaces]]\nname = \"0015_1\"\nruns = 2\n\
        [[surfaces]]\nname = \"mine\"\nrelief = \"stretcher_bond\"\nparameters = { joint_depth_mm = 20 }\n\
        macro_reference = \"flat\"\n\
        [[expected]]\nsurface = \"0012_1\"\nrelative_to = \"0015_1\"\nlevels_db = { 2500 = -0.1, total = -0.6 }\n";

    fn surfaces(text: &str) -> anyhow::Result<Vec<CampaignSurface>> {
        made_surfaces(text, UnnamedGeometry::Guessed)
    }

    fn made_surfaces(text: &str, unnamed: UnnamedGeometry) -> anyhow::Result<Vec<CampaignSurface>> {
        let campaign: CampaignDefinition = toml::from_str(text)?;
        let surfaces = campaign.make_surfaces(&campaign.reference_surfaces(&ReferenceSurfaces::default()), unnamed)?;
        campaign.check_expected(&surfaces, &["2500", "total"].map(str::to_owned))?;
        Ok(surfaces)
    }

    #[test]
    fn surfaces_are_made_after_their_references() {
        let made = surfaces(TEXT).expect("a campaign");
        let names: Vec<_> = made.iter().map(|s| s.surface.as_str()).collect();
        assert_eq!(names, ["flat", "foam", "0012_1", "0015_1", "mine"]);
        let reference = |n: usize| made[n].macro_reference.as_ref().map(SurfaceId::as_str);
        assert_eq!([reference(2), reference(3), reference(4)], [Some("0015_1"), None, Some("flat")]);
        let PanelSpecimen::Relief(relief) = &made[4].specimen else { panic!("{:?}", made[4]) };
        assert_eq!(relief.parameters()["joint_depth_mm"], 20.0);
        assert_eq!((made[2].runs, made[3].runs), (1, 2));
        let seeds: BTreeSet<_> = made.iter().map(|s| s.seed).collect();
        assert_eq!(seeds.len(), 5, "{seeds:?}");
    }

    #[test]
    fn what_is_no_campaign_is_refused_by_its_key() {
        let check = |from: &str, to: &str, expected: &str| {
            let error = format!("{:#}", surfaces(&TEXT.replacen(from, to, 1)).expect_err(to));
            assert!(error.contains(expected), "{error}");
        };
        check("runs = 2", "rnus = 2", "unknown field `rnus`");
        check("runs = 2", "runs = 0", "`runs` of surface `0015_1` is 0, expected 1 to 1000");
        check("\"mine\"", "\"0012_1\"", "one surface twice");
        check("relief = \"stretcher_bond\"", "", "surface `mine` has no `relief`");
        check("stretcher_bond", "marble", "`relief` of surface `mine`: `marble` is no relief");
        check(
            "joint_depth_mm = 20",
            "joint_depth_mm = 200",
            "`parameters` of surface `mine`: parameter `joint_depth_mm`",
        );
        check("relative_to = \"0015_1\"", "relative_to = \"0015_2\"", "`relative_to` of `expected` 1 is `0015_2`");
        check(
            "macro_reference = \"flat\"",
            "macro_reference = \"bowl\"",
            "`macro_reference` of surface `mine` is `bowl`",
        );
        check("2500 =", "250 =", "`levels_db` of `expected` 1 (`0012_1`) has a band `250`");
        check("-0.6", "nan", "expected a number");
    }

    #[test]
    fn a_real_panel_has_the_geometry_that_the_file_names() {
        let text = TEXT.replace("name = \"0012_1\"", "name = \"0012_1\"\nmesh = \"a.glb\"\nside = \"back\"");
        let error = made_surfaces(&text, UnnamedGeometry::Refused).expect_err("flat is not listed");
        assert!(error.is::<UsageError>() && error.to_string().contains("panel of surface `flat`"), "{error}");
        let made = made_surfaces(&text, UnnamedGeometry::Unknown).expect("surfaces");
        assert_eq!(made[2].specimen, PanelSpecimen::Mesh("a.glb".into(), PanelSide::Back));
        for unknown in [0, 1, 3] {
            assert_eq!((&made[unknown].specimen, &made[unknown].macro_reference), (&PanelSpecimen::NoGeometry, &None));
        }
        assert!(matches!(made[4].specimen, PanelSpecimen::Relief(_)), "it is named: {:?}", made[4]);
        let both = TEXT.replace("relief = ", "mesh = \"a.glb\"\nrelief = ");
        assert!(surfaces(&both).expect_err("both").to_string().contains("`mesh` and a `relief`"));
    }
}
