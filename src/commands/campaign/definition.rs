//! The file of a campaign: its surfaces, their references, and the levels that are expected of them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail, ensure};
use echolake_acquisition::panel::collection::CollectionSurface;
use echolake_acquisition::panel::relief::PanelRelief;
use echolake_lake::ReferenceSurfaces;
use echolake_schema::{ProjectName, SurfaceId};
use serde::Deserialize;

/// Runs of one surface at most.
const MOST_RUNS: usize = 1_000;

/// A campaign, as its TOML file has it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CampaignDefinition {
    pub(super) name: String,
    /// Its purpose; printed above its tables.
    #[serde(default)]
    pub(super) about: String,
    /// The rig's file, beside this one.
    rig: Option<PathBuf>,
    /// The project that its surfaces belong to.
    pub(super) project: Option<ProjectName>,
    /// Seed of the simulation.
    #[serde(default = "default_seed")]
    pub(super) seed: u64,
    #[serde(default)]
    references: NamedReferences,
    surfaces: Vec<NamedSurface>,
    #[serde(default)]
    pub(super) expected: Vec<ExpectedLevels>,
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
    pub(super) surface: SurfaceId,
    /// The surface that they are relative to; Flat if there is none.
    pub(super) relative_to: Option<SurfaceId>,
    /// Levels by the names of bands, and `total`.
    pub(super) levels_db: BTreeMap<String, f64>,
    /// Their source.
    #[serde(default)]
    pub(super) source: String,
}

/// A surface of a campaign, with its relief.
#[derive(Debug)]
pub(super) struct CampaignSurface {
    pub(super) member: CollectionSurface,
    pub(super) seed: u64,
    pub(super) runs: usize,
}

fn default_seed() -> u64 {
    1
}

fn default_runs() -> usize {
    1
}

impl CampaignDefinition {
    /// Reads a campaign's file.
    pub(super) fn read(path: &Path) -> anyhow::Result<Self> {
        let text =
            std::fs::read_to_string(path).with_context(|| format!("cannot read campaign `{}`", path.display()))?;
        let parsed: Result<Self, _> = toml::from_str(&text);
        parsed.map_err(|e| {
            anyhow::anyhow!("campaign `{}`: {e}hint: examples/campaigns has some that are right", path.display())
        })
    }

    /// Returns the path of the rig's file, which is named relative to the campaign's.
    pub(super) fn rig_file(&self, path: &Path) -> Option<PathBuf> {
        let rig = self.rig.as_ref()?;
        Some(path.parent().map_or_else(|| rig.clone(), |folder| folder.join(rig)))
    }

    /// Returns Flat and Foam of all surfaces: the file's, else the lake's.
    pub(super) fn references(&self, lake: &ReferenceSurfaces) -> [SurfaceId; 2] {
        let named = &self.references;
        [named.flat.as_ref().unwrap_or(&lake.flat), named.foam.as_ref().unwrap_or(&lake.foam)].map(Clone::clone)
    }

    /// Returns Flat and Foam if the file names them.
    pub(super) fn named_references(&self) -> [Option<SurfaceId>; 2] {
        [self.references.flat.clone(), self.references.foam.clone()]
    }

    /// Makes the surfaces in the order in which they are measured: references that the file does not list come first.
    pub(super) fn make_surfaces(&self, references: &[SurfaceId]) -> anyhow::Result<Vec<CampaignSurface>> {
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
        let missing = references.iter().filter(|reference| !listed.contains(reference)).map(NamedSurface::reference);
        let missing: Vec<_> = missing.collect();
        let all = missing.iter().chain(&self.surfaces);
        let made = all.zip(0u64..).map(|(surface, number)| {
            surface.make(self.seed.wrapping_mul(1_000).wrapping_add(number * MOST_RUNS as u64))
        });
        made.collect()
    }

    /// Checks that all that is expected has the names of surfaces and of bands.
    pub(super) fn check_expected(&self, surfaces: &[CampaignSurface], bands: &[String]) -> anyhow::Result<()> {
        let names: Vec<_> = surfaces.iter().map(|surface| surface.member.surface.as_str()).collect();
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
    fn reference(name: &SurfaceId) -> Self {
        let parameters = BTreeMap::new();
        Self { name: name.clone(), relief: None, parameters, macro_reference: None, seed: None, runs: default_runs() }
    }

    fn make(&self, seed: u64) -> anyhow::Result<CampaignSurface> {
        let name = &self.name;
        ensure!(
            (1..=MOST_RUNS).contains(&self.runs),
            "`runs` of surface `{name}` is {}, expected 1 to {MOST_RUNS}; hint: surfaces that are not needed are left out",
            self.runs
        );
        let relief = self.relief.as_deref().or_else(|| PanelRelief::guess(name.as_str()));
        let relief = relief.with_context(|| {
            format!("surface `{name}` has no `relief`, and its name says none; hint: {}", PanelRelief::NAMES.join(", "))
        })?;
        let mut member = CollectionSurface::by_relief_name(name.clone(), relief)
            .with_context(|| format!("`relief` of surface `{name}`"))?;
        let mut set = || {
            for (key, value) in &self.parameters {
                member.relief.set(key, value.as_str().unwrap_or(&value.to_string()))?;
            }
            member.relief.check_depth()
        };
        set().with_context(|| format!("`parameters` of surface `{name}`"))?;
        if self.macro_reference.is_some() {
            member.macro_reference.clone_from(&self.macro_reference);
        }
        Ok(CampaignSurface { member, seed: self.seed.unwrap_or(seed), runs: self.runs })
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
        let campaign: CampaignDefinition = toml::from_str(text)?;
        let surfaces = campaign.make_surfaces(&campaign.references(&ReferenceSurfaces::default()))?;
        campaign.check_expected(&surfaces, &["2500", "total"].map(str::to_owned))?;
        Ok(surfaces)
    }

    #[test]
    fn surfaces_are_made_after_their_references() {
        let made = surfaces(TEXT).expect("a campaign");
        let names: Vec<_> = made.iter().map(|s| s.member.surface.as_str()).collect();
        assert_eq!(names, ["flat", "foam", "0012_1", "0015_1", "mine"]);
        let reference = |n: usize| made[n].member.macro_reference.as_ref().map(SurfaceId::as_str);
        assert_eq!([reference(2), reference(3), reference(4)], [Some("0015_1"), None, Some("flat")]);
        assert_eq!(made[4].member.relief.parameters()["joint_depth_mm"], 20.0);
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
}
