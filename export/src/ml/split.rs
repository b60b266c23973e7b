//! Assigns surfaces to the parts of a training set: whole physical panels, so that no panel leaks.

use std::collections::BTreeMap;

use sha2::{Digest as _, Sha256};

use super::surfaces::TrainingSurface;
use crate::error::{Error, Result};

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

/// Returns the part of each surface, in the given order; None for a surface that is left out because another side of
/// its panel is in a rarer part.
pub(super) fn assign_parts(surfaces: &[TrainingSurface], split: SplitParams) -> Result<Vec<Option<SplitPart>>> {
    let drawn = draw_parts(surfaces, split)?;
    let own = |surface: &TrainingSurface| match (surface.reference, drawn.get(&split_category(surface, split.by))) {
        (false, Some(part)) => *part,
        // References are in the numbers of every other surface already.
        _ => SplitPart::Train,
    };
    let mut rarest: BTreeMap<&str, SplitPart> = BTreeMap::new();
    let mut fixed: BTreeMap<&str, ()> = BTreeMap::new();
    for surface in surfaces {
        let part = own(surface);
        let at = rarest.entry(surface.id.panel()).or_insert(part);
        *at = part.min(*at);
        if surface.reference {
            fixed.insert(surface.id.panel(), ());
        }
    }
    let part = |surface: &TrainingSurface| {
        let of_panel =
            if fixed.contains_key(surface.id.panel()) { SplitPart::Train } else { *rarest.get(surface.id.panel())? };
        (own(surface) == of_panel || fixed.contains_key(surface.id.panel())).then_some(of_panel)
    };
    Ok(surfaces.iter().map(part).collect())
}

// Draws a part for each category: sorted by digest, the first fill the test set, the next the validation set.
fn draw_parts(surfaces: &[TrainingSurface], split: SplitParams) -> Result<BTreeMap<String, SplitPart>> {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    surfaces.iter().filter(|s| !s.reference).for_each(|s| *counts.entry(split_category(s, split.by)).or_default() += 1);
    if split.by == SplitBy::Nothing {
        return Ok(counts.into_keys().map(|c| (c, SplitPart::Train)).collect());
    }
    let share = |x: f64| (0.0..1.0).contains(&x);
    if !share(split.test) || !share(split.validation) || !share(split.test + split.validation) {
        let reason = format!("shares of {} and {} do not leave anything to train with", split.test, split.validation);
        return Err(Error::Split { by: split.by.name(), reason });
    }
    let total = counts.values().sum::<usize>();
    let categories = counts.len();
    let wanted = [(SplitPart::Test, split.test), (SplitPart::Validation, split.validation)];
    let needed = 1 + wanted.iter().filter(|(_, share)| *share > 0.0).count();
    if categories < needed {
        let reason =
            format!("beside references it has {categories} of them, expected {needed} at least; hint: --split none");
        return Err(Error::Split { by: split.by.name(), reason });
    }
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
    Ok(drawn)
}

fn split_category(surface: &TrainingSurface, by: SplitBy) -> String {
    match by {
        SplitBy::Panel | SplitBy::Nothing => surface.id.panel().to_owned(),
        SplitBy::Typology => surface.typology.clone(),
        SplitBy::Macrostructure => surface.macrostructure.clone().unwrap_or_else(|| "flat".to_owned()),
    }
}

/// Returns a digest for a pseudorandom order that is the same on every machine.
pub(super) fn order_digest(seed: u64, name: &str) -> [u8; 32] {
    let mut sha = Sha256::new();
    sha.update(seed.to_le_bytes());
    sha.update(name.as_bytes());
    sha.finalize().into()
}

#[cfg(test)]
mod tests {
    use std::collections::{HashMap, HashSet};

    use super::*;

    fn surface(id: &str, typology: &str) -> TrainingSurface {
        TrainingSurface {
            id: id.parse().expect("valid"),
            typology: typology.into(),
            macrostructure: None,
            origin: "simulated".into(),
            reference: typology == "reference",
            runs: Vec::new(),
        }
    }

    fn lake() -> Vec<TrainingSurface> {
        let typologies = ["brick", "wavy", "rubble", "ashlar"];
        let side = |i: usize| surface(&format!("{:04}_{}", i / 2, i % 2), typologies[(i * 7 + i / 5) % 4]);
        let mut all: Vec<_> = (0..200).map(side).collect();
        all.push(surface("flat", "reference"));
        all.push(surface("foam", "reference"));
        all
    }

    #[test]
    fn no_panel_is_in_two_parts() {
        for by in [SplitBy::Panel, SplitBy::Typology, SplitBy::Nothing] {
            for seed in 0..50 {
                let surfaces = lake();
                let parts = assign_parts(&surfaces, SplitParams { by, seed, ..SplitParams::default() }).expect("split");
                let mut of_panel: HashMap<&str, HashSet<SplitPart>> = HashMap::new();
                for (surface, part) in surfaces.iter().zip(&parts) {
                    of_panel.entry(surface.id.panel()).or_default().extend(*part);
                }
                assert!(of_panel.values().all(|parts| parts.len() == 1), "{by:?} {seed} {of_panel:?}");
                let has = |part| parts.contains(&Some(part));
                assert_eq!(has(SplitPart::Test) && has(SplitPart::Validation), by != SplitBy::Nothing, "{by:?} {seed}");
                assert!(has(SplitPart::Train));
            }
        }
    }

    #[test]
    fn a_typology_that_is_held_out_is_never_trained_on() {
        let surfaces = lake();
        let parts =
            assign_parts(&surfaces, SplitParams { by: SplitBy::Typology, ..SplitParams::default() }).expect("split");
        let of = |part| -> HashSet<&str> {
            let of_part = surfaces.iter().zip(&parts).filter(|(_, p)| **p == Some(part));
            of_part.map(|(s, _)| s.typology.as_str()).collect()
        };
        assert!(of(SplitPart::Test).is_disjoint(&of(SplitPart::Train)));
        assert!(of(SplitPart::Validation).is_disjoint(&of(SplitPart::Train)));
        assert!(parts.iter().any(Option::is_none), "other sides of held-out panels are left out");
    }

    #[test]
    fn references_and_their_panels_are_trained_on() {
        let mut surfaces = lake();
        surfaces[30].reference = true;
        for seed in 0..20 {
            let parts = assign_parts(&surfaces, SplitParams { seed, ..SplitParams::default() }).expect("split");
            for (surface, part) in surfaces.iter().zip(parts) {
                if surface.reference || surface.id.panel() == surfaces[30].id.panel() {
                    assert_eq!(part, Some(SplitPart::Train), "{}", surface.id);
                }
            }
        }
    }

    #[test]
    fn what_cannot_be_split_says_so() {
        let few: Vec<_> = lake().into_iter().take(4).collect();
        let error = assign_parts(&few, SplitParams::default()).expect_err("two panels").to_string();
        assert!(error.contains("has 2 of them, expected 3"), "{error}");
        let error = assign_parts(&lake(), SplitParams { test: 0.6, validation: 0.5, ..SplitParams::default() })
            .expect_err("too much");
        assert!(error.to_string().contains("0.6 and 0.5"), "{error}");
    }
}
