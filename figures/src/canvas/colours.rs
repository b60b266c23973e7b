//! Colours that carry numbers.

use crate::canvas::drawing::FigureColour;

/// The paper's scale: white at -20 dB, black at 0 dB (equal to Flat), red at +6 dB.
pub(crate) const LOW_DB: f64 = -20.0;
pub(crate) const HIGH_DB: f64 = 6.0;
/// Ends of scales around 0 dB.
const REACHES_DB: [f64; 11] = [1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, 40.0];
/// Share of the values that a scale holds; the others have the colours of its ends.
const WITHIN: f64 = 0.98;

/// The colours of levels.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum LevelPalette {
    /// Grey at 0 dB, blue below and orange above, with a range that fits; told apart with every kind of colour vision.
    #[default]
    Centred,
    /// The paper's: white, black and red.
    Paper,
}

/// Returns a level's colour on the paper's scale; beyond the ends of the scale it is that of the end.
pub(crate) fn paper_colour(level_db: f64) -> [u8; 3] {
    if level_db <= 0.0 {
        let grey = (255.0 * (level_db / LOW_DB).min(1.0)).round() as u8;
        return [grey; 3];
    }
    [(255.0 * (level_db / HIGH_DB).min(1.0)).round() as u8, 0, 0]
}

/// Returns a value's colour: grey at 0, blue and orange at both ends, `reach_db`, and beyond.
pub(crate) fn centred_colour(value_db: f64, reach_db: f64) -> [u8; 3] {
    let share = (value_db / reach_db).clamp(-1.0, 1.0);
    let end: [f64; 3] = if share < 0.0 { [33.0, 102.0, 172.0] } else { [217.0, 95.0, 2.0] };
    end.map(|part| (236.0 + (part - 236.0) * share.abs()).round() as u8)
}

/// Returns the smallest round range around 0 dB that holds nearly all values.
pub(crate) fn fitting_reach(values_db: impl Iterator<Item = f64>) -> f64 {
    let mut sizes: Vec<f64> = values_db.filter(|value| value.is_finite()).map(f64::abs).collect();
    sizes.sort_by(f64::total_cmp);
    let held = (WITHIN * sizes.len() as f64).ceil() as usize;
    let most = held.checked_sub(1).and_then(|last| sizes.get(last)).copied().unwrap_or(0.0);
    REACHES_DB.into_iter().find(|reach| *reach >= most).unwrap_or(REACHES_DB[REACHES_DB.len() - 1])
}

/// The paper's colours of the five bands, by its Table 2.
const BANDS: [[u8; 3]; 5] = [[32, 118, 179], [174, 199, 232], [255, 127, 15], [255, 187, 120], [43, 160, 45]];
/// Colours of kinds, told apart with every kind of colour vision.
const KINDS: [[u8; 3]; 8] = [
    [0, 114, 178],
    [194, 78, 0],
    [0, 121, 90],
    [168, 69, 127],
    [106, 90, 205],
    [138, 109, 0],
    [11, 143, 176],
    [90, 95, 98],
];

/// Returns the colour of a band.
pub(crate) fn band_colour(band: usize) -> FigureColour {
    FigureColour::Rgb(BANDS[band % BANDS.len()])
}

/// Colours of kinds, after which they begin again.
pub(crate) const KIND_COUNT: usize = KINDS.len();

/// Returns the colour of a kind.
pub(crate) fn kind_colour(kind: usize) -> FigureColour {
    FigureColour::Rgb(KINDS[kind % KINDS.len()])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_have_the_papers_colours() {
        let cases = [
            (-30.0, [255; 3]),
            (-20.0, [255; 3]),
            (-10.0, [128; 3]),
            (0.0, [0; 3]),
            (3.0, [128, 0, 0]),
            (6.0, [255, 0, 0]),
            (9.0, [255, 0, 0]),
        ];
        for (level, expected) in cases {
            assert_eq!(paper_colour(level), expected, "{level} dB");
        }
    }

    #[test]
    fn scales_around_0_db_fit() {
        assert_eq!(centred_colour(0.0, 3.0), [236; 3]);
        assert_eq!([centred_colour(-3.0, 3.0), centred_colour(-9.0, 3.0)], [[33, 102, 172]; 2]);
        assert_eq!(centred_colour(1.5, 3.0), [227, 166, 119], "half of the way to orange");
        // One of a hundred values is beyond the end.
        let values = (0..100).map(|i| if i == 0 { -25.0 } else { 2.5 });
        assert_eq!(fitting_reach(values.chain([f64::NAN])), 3.0);
        assert_eq!(fitting_reach(std::iter::empty()), 1.0);
        assert_eq!(fitting_reach([99.0].into_iter()), 40.0);
    }
}
