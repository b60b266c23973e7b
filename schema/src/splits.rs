//! Assigns surfaces to the parts of a training set: whole physical panels, so that no panel leaks. Exports and SQL share
//! it.

use std::collections::BTreeMap;

use sha2::{Digest as _, Sha256};

use crate::SurfaceId;

/// The kind of group that is held out of training.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SplitBy {
    /// Panels that were never seen.
    Panel,
    /// Typologies that were never seen.
    Typology,
    /// Macrostructures that were never seen.
    Macrostructure,
    /// Nothing: everything is for training.
    Nothing,
}

impl SplitBy {
    /// Its name in cards and arguments.
    pub fn name(self) -> &'static str {
        match self {
            Self::Panel => "by-panel",
            Self::Typology => "by-typology",
            Self::Macrostructure => "by-macrostructure",
            Self::Nothing => "none",
        }
    }
}

/// Parameters of the split.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SplitParams {
    /// The kind of group that is held out.
    pub by: SplitBy,
    /// Minimum share of the surfaces in the test set, 0 to 1.
    pub test: f64,
    /// Minimum share of the surfaces in the validation set, 0 to 1.
    pub validation: f64,
    /// Seed of the random draw and of the order of surfaces in the files.
    pub seed: u64,
}

impl Default for SplitParams {
    fn default() -> Self {
        Self { by: SplitBy::Panel, test: 0.1, validation: 0.1, seed: 1 }
    }
}

/// A part of a training set, the rarest first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum SplitPart {
    /// For the last measurement of an error.
    Test,
    /// For choosing among models.
    Validation,
    /// For learning.
    Train,
}

impl SplitPart {
    /// All parts, as cards list them.
    pub const ALL: [Self; 3] = [Self::Train, Self::Validation, Self::Test];

    /// Its name in files and columns.
    pub fn name(self) -> &'static str {
        match self {
            Self::Test => "test",
            Self::Validation => "validation",
            Self::Train => "train",
        }
    }
}

/// A surface, as far as its part depends on it.
#[derive(Debug, Clone, Copy)]
pub struct SplitSurface<'a> {
    /// Its name, which has its panel.
    pub id: &'a SurfaceId,
    /// Its typology.
    pub typology: &'a str,
    /// Its macrostructure.
    pub macrostructure: Option<&'a str>,
    /// True if other surfaces name it as their Flat or Foam, or its typology is `reference`.
    pub is_reference: bool,
}

impl<'a> SplitSurface<'a> {
    /// Returns the group that is held out or trained on as a whole.
    pub fn split_category(&self, by: SplitBy) -> &'a str {
        match by {
            SplitBy::Panel | SplitBy::Nothing => self.id.panel(),
            SplitBy::Typology => self.typology,
            SplitBy::Macrostructure => self.macrostructure.unwrap_or("flat"),
        }
    }
}

/// Returns the part of each surface, in the given order; None for a surface that is left out because another side of
/// its panel is in another part.
///
/// A reference is in the numbers of every other surface already, so it and its panel are for training. Any other panel
/// is in the rarest part of its sides. If there are too few categories, the test set is empty first, then validation.
pub fn assign_parts(surfaces: &[SplitSurface<'_>], split: SplitParams) -> Vec<Option<SplitPart>> {
    let drawn = draw_parts(surfaces, split);
    let own = |surface: &SplitSurface<'_>| match drawn.get(surface.split_category(split.by)) {
        Some(part) if !surface.is_reference => *part,
        _ => SplitPart::Train,
    };
    let mut of_panel: BTreeMap<&str, SplitPart> = BTreeMap::new();
    for surface in surfaces {
        let part = of_panel.entry(surface.id.panel()).or_insert(SplitPart::Train);
        *part = own(surface).min(*part);
    }
    of_panel.extend(surfaces.iter().filter(|s| s.is_reference).map(|s| (s.id.panel(), SplitPart::Train)));
    let assign = |surface: &SplitSurface<'_>| {
        let part = *of_panel.get(surface.id.panel())?;
        // A typology that is held out is not trained on, even if it is beside a reference.
        (split.by == SplitBy::Panel || own(surface) == part).then_some(part)
    };
    surfaces.iter().map(assign).collect()
}

// Draws a part for each category: sorted by digest, the first fill the test set, the next the validation set.
fn draw_parts<'a>(surfaces: &[SplitSurface<'a>], split: SplitParams) -> BTreeMap<&'a str, SplitPart> {
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    surfaces
        .iter()
        .filter(|s| !s.is_reference)
        .for_each(|s| *counts.entry(s.split_category(split.by)).or_default() += 1);
    if split.by == SplitBy::Nothing {
        return counts.into_keys().map(|category| (category, SplitPart::Train)).collect();
    }
    let wanted = [(SplitPart::Test, split.test), (SplitPart::Validation, split.validation)];
    let total = counts.values().sum::<usize>();
    let mut order: Vec<_> = counts.into_iter().collect();
    order.sort_by_cached_key(|(category, _)| order_digest(split.seed, category));
    let mut left = order.len();
    let mut order = order.into_iter();
    let mut drawn = BTreeMap::new();
    for (number, (part, share)) in wanted.into_iter().enumerate() {
        // Leaves at least one category for every part that is still to be filled.
        let later = wanted[number + 1..].iter().filter(|(_, share)| *share > 0.0).count() + 1;
        let mut have = 0;
        while (have as f64) < share * total as f64 && left > later {
            let Some((category, count)) = order.next() else { break };
            have += count;
            left -= 1;
            drawn.insert(category, part);
        }
    }
    drawn.extend(order.map(|(category, _)| (category, SplitPart::Train)));
    drawn
}

/// Returns a digest for a pseudorandom order that is the same on every machine.
pub fn order_digest(seed: u64, name: &str) -> [u8; 32] {
    let mut sha = Sha256::new();
    sha.update(seed.to_le_bytes());
    sha.update(name.as_bytes());
    sha.finalize().into()
}

#[cfg(test)]
mod tests {
    use std::collections::{HashMap, HashSet};

    use super::*;

    /// A name, a typology, and whether it is a reference.
    type TestSurface = (SurfaceId, &'static str, bool);

    fn lake() -> Vec<TestSurface> {
        let typologies = ["brick", "wavy", "rubble", "ashlar"];
        let side = |i: usize| (format!("{:04}_{}", i / 2, i % 2), typologies[(i * 7 + i / 5) % 4], false);
        let references = ["flat", "foam"].map(|name| (name.to_owned(), "reference", true));
        let all = (0..200).map(side).chain(references);
        all.map(|(id, typology, is_reference)| (id.parse().expect("valid"), typology, is_reference)).collect()
    }

    fn assign(lake: &[TestSurface], split: SplitParams) -> Vec<Option<SplitPart>> {
        let surfaces: Vec<_> = lake
            .iter()
            .map(|(id, typology, is_reference)| SplitSurface {
                id,
                typology,
                macrostructure: None,
                is_reference: *is_reference,
            })
            .collect();
        assign_parts(&surfaces, split)
    }

    #[test]
    fn no_panel_is_in_two_parts() {
        for by in [SplitBy::Panel, SplitBy::Typology, SplitBy::Nothing] {
            for seed in 0..50 {
                let surfaces = lake();
                let parts = assign(&surfaces, SplitParams { by, seed, ..SplitParams::default() });
                let mut of_panel: HashMap<&str, HashSet<SplitPart>> = HashMap::new();
                for ((id, ..), part) in surfaces.iter().zip(&parts) {
                    of_panel.entry(id.panel()).or_default().extend(*part);
                }
                assert!(of_panel.values().all(|parts| parts.len() == 1), "{by:?} {seed} {of_panel:?}");
                let has = |part| parts.contains(&Some(part));
                assert_eq!(has(SplitPart::Test) && has(SplitPart::Validation), by != SplitBy::Nothing, "{by:?} {seed}");
                assert!(has(SplitPart::Train));
            }
        }
    }

    /// E31: a held-out typology beside a reference is left out, too.
    #[test]
    fn a_typology_that_is_held_out_is_never_trained_on() {
        let mut surfaces = lake();
        surfaces.iter_mut().step_by(5).for_each(|(.., is_reference)| *is_reference = true);
        for surfaces in [lake(), surfaces] {
            let parts = assign(&surfaces, SplitParams { by: SplitBy::Typology, ..SplitParams::default() });
            let of = |part| -> HashSet<&str> {
                let of_part =
                    surfaces.iter().zip(&parts).filter(|((.., reference), p)| **p == Some(part) && !reference);
                of_part.map(|((_, typology, _), _)| *typology).collect()
            };
            assert!(of(SplitPart::Test).is_disjoint(&of(SplitPart::Train)));
            assert!(of(SplitPart::Validation).is_disjoint(&of(SplitPart::Train)));
            assert!(parts.iter().any(Option::is_none), "other sides of held-out panels are left out");
        }
    }

    #[test]
    fn references_and_their_panels_are_trained_on() {
        let mut surfaces = lake();
        surfaces[30].2 = true;
        let panel = surfaces[30].0.panel();
        for seed in 0..20 {
            let parts = assign(&surfaces, SplitParams { seed, ..SplitParams::default() });
            for ((id, _, is_reference), part) in surfaces.iter().zip(parts) {
                if *is_reference || id.panel() == panel {
                    assert_eq!(part, Some(SplitPart::Train), "{id}");
                }
            }
        }
    }
}
