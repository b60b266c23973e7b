//! Assigns surfaces to the parts of a training set, if they can be split.

use std::collections::BTreeSet;

use echolake_schema::splits::{self, SplitBy, SplitParams, SplitPart, SplitSurface};

use super::surfaces::TrainingSurface;
use crate::error::{Error, Result};

/// Returns the part of each surface as [`splits::assign_parts`] does.
pub(super) fn assign_parts(surfaces: &[TrainingSurface], split: SplitParams) -> Result<Vec<Option<SplitPart>>> {
    let surfaces: Vec<_> = surfaces.iter().map(split_surface).collect();
    check_split(&surfaces, split)?;
    Ok(splits::assign_parts(&surfaces, split))
}

fn split_surface(surface: &TrainingSurface) -> SplitSurface<'_> {
    SplitSurface {
        id: &surface.id,
        typology: &surface.typology,
        macrostructure: surface.macrostructure.as_deref(),
        is_reference: surface.reference,
    }
}

fn check_split(surfaces: &[SplitSurface<'_>], split: SplitParams) -> Result<()> {
    if split.by == SplitBy::Nothing {
        return Ok(());
    }
    let share = |x: f64| (0.0..1.0).contains(&x);
    if !share(split.test) || !share(split.validation) || !share(split.test + split.validation) {
        let reason = format!("shares of {} and {} do not leave anything to train with", split.test, split.validation);
        return Err(Error::Split { by: split.by.name(), reason });
    }
    let reliefs = surfaces.iter().filter(|surface| !surface.is_reference);
    let categories = reliefs.map(|surface| surface.split_category(split.by)).collect::<BTreeSet<_>>().len();
    let needed = 1 + [split.test, split.validation].into_iter().filter(|share| *share > 0.0).count();
    if categories < needed {
        let reason =
            format!("beside references it has {categories} of them, expected {needed} at least; hint: --split none");
        return Err(Error::Split { by: split.by.name(), reason });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_split_says_so() {
        let surface = |i: usize| TrainingSurface {
            id: format!("{i:04}_0").parse().expect("valid"),
            typology: "brick".into(),
            macrostructure: None,
            origin: "simulated".into(),
            reference: false,
            runs: Vec::new(),
        };
        let lake: Vec<_> = (0..20).map(surface).collect();
        let error = assign_parts(&lake[..2], SplitParams::default()).expect_err("two panels").to_string();
        assert!(error.contains("has 2 of them, expected 3"), "{error}");
        let error = assign_parts(&lake, SplitParams { test: 0.6, validation: 0.5, ..SplitParams::default() })
            .expect_err("too much");
        assert!(error.to_string().contains("0.6 and 0.5"), "{error}");
    }
}
