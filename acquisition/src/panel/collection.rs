//! A simulated collection of panels of any size: the references, then both sides of panel after panel.

use echolake_schema::{Error, SurfaceId};

use crate::panel::relief::PanelRelief;

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
}

/// Returns the first `count` surfaces of the collection that `seed` names; a larger one begins with the smaller one.
///
/// # Errors
/// [`Error::Quantity`] if there are more than [`LARGEST`].
pub fn collection(seed: u64, count: usize) -> Result<Vec<CollectionSurface>, Error> {
    if count > LARGEST {
        let (quantity, expected) = ("number of surfaces", "20001 at most, as panels have four digits");
        return Err(Error::Quantity { quantity, actual: count.to_string(), expected });
    }
    let references = REFERENCES.map(|(name, relief)| (name.to_owned(), relief));
    let sides = (0u64..).map(|n| (format!("{:04}_{}", n / 2 + 1, n % 2), PanelRelief::drawn(seed, n)));
    let surfaces = references.into_iter().chain(sides).take(count);
    surfaces.map(|(name, relief)| Ok(CollectionSurface { surface: name.parse()?, relief })).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn references_come_first_and_sides_of_a_panel_together() {
        let ten = collection(1, 10).expect("a collection");
        let names: Vec<_> = ten.iter().map(|m| m.surface.as_str()).collect();
        assert_eq!(
            names,
            ["flat", "foam", "wood", "0001_0", "0001_1", "0002_0", "0002_1", "0003_0", "0003_1", "0004_0"]
        );
        let (panel, side) = (ten[8].surface.panel(), ten[8].surface.side());
        assert_eq!((panel, side), ("0003", Some(1)));
        assert_eq!(collection(1, 4).expect("a collection"), ten[..4]);
        assert_ne!(collection(2, 10).expect("a collection"), ten);
    }

    #[test]
    fn the_largest_is_the_largest() {
        let all = collection(1, LARGEST).expect("a collection");
        assert_eq!(all[LARGEST - 1].surface.as_str(), "9999_1");
        let refused = collection(1, LARGEST + 1).expect_err("too many").to_string();
        assert!(refused.contains(&format!("is {}, expected {LARGEST} at most", LARGEST + 1)), "{refused}");
    }
}
