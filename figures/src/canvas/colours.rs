//! Colours that carry numbers.

use crate::canvas::drawing::FigureColour;

/// The paper's scale: white at -20 dB, black at 0 dB (equal to Flat), red at +6 dB.
pub(crate) const LOW_DB: f64 = -20.0;
pub(crate) const HIGH_DB: f64 = 6.0;
/// Ends of the scale of differences.
pub(crate) const DIFFERENCE_DB: f64 = 6.0;

/// The colour of levels over 0 dB.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum LevelPalette {
    /// Red, as in the paper.
    #[default]
    Paper,
    /// Amber, and a square in the cell: for those who do not tell red from black.
    Safe,
}

/// Returns a level's colour; beyond the ends of the scale it is that of the end.
pub(crate) fn level_colour(level_db: f64, palette: LevelPalette) -> [u8; 3] {
    if level_db <= 0.0 {
        let grey = (255.0 * (level_db / LOW_DB).min(1.0)).round() as u8;
        return [grey; 3];
    }
    let end = match palette {
        LevelPalette::Paper => [255.0, 0.0, 0.0],
        LevelPalette::Safe => [255.0, 176.0, 0.0],
    };
    let share = (level_db / HIGH_DB).min(1.0);
    end.map(|part: f64| (part * share).round() as u8)
}

/// Returns a difference's colour: grey at 0, blue below, orange above.
pub(crate) fn difference_colour(difference_db: f64) -> [u8; 3] {
    let share = (difference_db / DIFFERENCE_DB).clamp(-1.0, 1.0);
    let end: [f64; 3] = if share < 0.0 { [33.0, 102.0, 172.0] } else { [217.0, 95.0, 2.0] };
    end.map(|part| (236.0 + (part - 236.0) * share.abs()).round() as u8)
}

/// Returns black or white, whichever is read better on a colour.
pub(crate) fn ink_on([r, g, b]: [u8; 3]) -> [u8; 3] {
    let linear = |part: u8| (f64::from(part) / 255.0).powf(2.2);
    if 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b) > 0.18 { [0; 3] } else { [255; 3] }
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
            assert_eq!(level_colour(level, LevelPalette::Paper), expected, "{level} dB");
        }
        assert_eq!(level_colour(6.0, LevelPalette::Safe), [255, 176, 0]);
        assert_eq!(difference_colour(0.0), [236; 3]);
        assert_eq!(ink_on([255; 3]), [0; 3]);
    }
}
