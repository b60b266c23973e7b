//! A simulated collection of panels of any size: the references, then both sides of panel after panel. Those that have
//! a name of the paper's are the paper's.

use echolake_schema::{Error, SurfaceId};

use crate::paper_panel::PaperPanel;
use crate::relief::{self, PanelRelief};

/// The references, which are measured first.
const REFERENCES: [(&str, PanelRelief); 3] =
    [("flat", PanelRelief::Flat), ("foam", PanelRelief::Foam), ("wood", PanelRelief::Wood)];
/// Number of surfaces of the largest collection: four digits number its panels.
pub const LARGEST: usize = REFERENCES.len() + 2 * 9_999;

/// One surface of a collection.
#[derive(Debug, Clone, PartialEq)]
pub struct CollectionSurface {
    /// Its name: `flat`, `foam`, `wood`, then `0001_0`, `0001_1`, `0002_0`, ...
    pub surface: SurfaceId,
    /// Its geometry and material.
    pub relief: PanelRelief,
    /// The surface that has its large shape alone.
    pub macro_reference: Option<SurfaceId>,
}

impl CollectionSurface {
    /// Makes a surface of the relief or the paper's panel of this name.
    ///
    /// # Errors
    /// [`relief::Error::Name`] if there is none.
    pub fn by_relief_name(surface: SurfaceId, relief: &str) -> Result<Self, relief::Error> {
        let reference = PaperPanel::by_name(relief).and_then(|panel| panel.macro_reference);
        let macro_reference = reference.and_then(|name| name.parse().ok());
        Ok(Self { surface, relief: PanelRelief::by_name(relief)?, macro_reference })
    }

    // A panel of the paper if it has the name of one.
    fn new(name: &str, relief: PanelRelief) -> Result<Self, Error> {
        let paper = PaperPanel::by_name(name);
        let relief = paper.and_then(|panel| PanelRelief::from_paper(&panel).ok()).unwrap_or(relief);
        let macro_reference = paper.and_then(|panel| panel.macro_reference).map(str::parse).transpose()?;
        Ok(Self { surface: name.parse()?, relief, macro_reference })
    }
}

/// Returns the first `count` surfaces of the collection that `seed` names; a larger one begins with the smaller one.
///
/// # Errors
/// [`Error::Quantity`] if there are more than [`LARGEST`].
pub fn collection_surfaces(seed: u64, count: usize) -> Result<Vec<CollectionSurface>, Error> {
    if count > LARGEST {
        let quantity = "number of surfaces";
        let expected = "20001 at most, as panels have four digits";
        return Err(Error::Quantity { quantity, actual: count.to_string(), expected });
    }
    let references = REFERENCES.map(|(name, relief)| (name.to_owned(), relief));
    let sides = (0u64..).map(|n| (format!("{:04}_{}", n / 2 + 1, n % 2), PanelRelief::from_seed(seed, n)));
    let surfaces = references.into_iter().chain(sides).take(count);
    surfaces.map(|(name, relief)| CollectionSurface::new(&name, relief)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn references_come_first_and_sides_of_a_panel_together() {
        let ten = collection_surfaces(1, 10).expect("a collection");
        let names: Vec<_> = ten.iter().map(|m| m.surface.as_str()).collect();
        assert_eq!(
            names,
            ["flat", "foam", "wood", "0001_0", "0001_1", "0002_0", "0002_1", "0003_0", "0003_1", "0004_0"]
        );
        let (panel, side) = (ten[8].surface.panel(), ten[8].surface.side());
        assert_eq!((panel, side), ("0003", Some(1)));
        assert_eq!(collection_surfaces(1, 4).expect("a collection"), ten[..4]);
        assert_ne!(collection_surfaces(2, 10).expect("a collection"), ten);
    }

    #[test]
    fn panels_of_the_paper_are_the_papers() {
        let all = collection_surfaces(3, 40).expect("a collection");
        let of = |name: &str| all.iter().find(|m| m.surface.as_str() == name).expect(name);
        assert_eq!(Ok(&of("0012_1").relief), PanelRelief::by_name("0012_1").as_ref());
        assert_eq!(of("0012_1").macro_reference.as_ref().map(SurfaceId::as_str), Some("0015_1"));
        assert_eq!(of("0012_0").macro_reference, None);
    }

    #[test]
    fn the_largest_is_the_largest() {
        let all = collection_surfaces(1, LARGEST).expect("a collection");
        assert_eq!(all[LARGEST - 1].surface.as_str(), "9999_1");
        let refused = collection_surfaces(1, LARGEST + 1).expect_err("too many").to_string();
        assert!(refused.contains(&format!("is {}, expected {LARGEST} at most", LARGEST + 1)), "{refused}");
    }
}
