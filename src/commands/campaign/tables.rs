//! The tables of a campaign, as the paper prints them: levels by band, extremes coloured, beside what was expected.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use echolake_schema::SurfaceId;
use serde::Serialize;

use super::definition::ExpectedLevels;

/// Colours of a band's greatest and least level; the paper has red and green.
const GREATEST: &str = "\x1b[31m";
const LEAST: &str = "\x1b[32m";
const PLAIN: &str = "\x1b[0m";

/// Levels of each surface by band, dB re Flat total.
pub(super) type LevelsBySurface = BTreeMap<String, BTreeMap<String, f64>>;

/// Colours of a printed table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TableColours {
    /// Extremes have colours.
    Extremes,
    /// None.
    None,
}

/// Levels that are relative to one surface.
#[derive(Debug, Serialize)]
pub(super) struct LevelTable {
    /// The surface; Flat if there is none.
    relative_to: Option<String>,
    rows: Vec<LevelTableRow>,
}

/// Levels of one surface, dB; those that are not known are left out.
#[derive(Debug, Serialize)]
struct LevelTableRow {
    surface: String,
    levels_db: BTreeMap<String, f64>,
    expected_db: BTreeMap<String, f64>,
    #[serde(skip_serializing_if = "String::is_empty")]
    source: String,
}

/// Makes the table of levels re Flat total, and one for each surface that others are relative to.
pub(super) fn make_tables(
    surfaces: &[(&SurfaceId, Option<&SurfaceId>)],
    levels: &LevelsBySurface,
    expected: &[ExpectedLevels],
) -> Vec<LevelTable> {
    let mut relations: Vec<(Option<&SurfaceId>, &SurfaceId)> = surfaces.iter().map(|(name, _)| (None, *name)).collect();
    relations.extend(surfaces.iter().filter_map(|(name, reference)| Some((Some((*reference)?), *name))));
    relations.extend(expected.iter().map(|e| (e.relative_to.as_ref(), &e.surface)));
    let mut tables: Vec<(Option<&SurfaceId>, Vec<LevelTableRow>)> = Vec::new();
    for (relative_to, surface) in relations {
        let place = tables.iter().position(|(other, _)| *other == relative_to);
        let place = place.unwrap_or_else(|| {
            tables.push((relative_to, Vec::new()));
            tables.len() - 1
        });
        let rows = &mut tables[place].1;
        if rows.iter().all(|row| row.surface != surface.as_str()) {
            rows.push(LevelTableRow::new(surface, relative_to, levels, expected));
        }
    }
    // A reference that nobody measured, or a surface without energies such as Foam, has no levels.
    for (_, rows) in &mut tables {
        rows.retain(|row| !row.levels_db.is_empty());
    }
    tables.retain(|(_, rows)| !rows.is_empty());
    let named = |(relative_to, rows): (Option<&SurfaceId>, _)| LevelTable {
        relative_to: relative_to.map(SurfaceId::to_string),
        rows,
    };
    tables.into_iter().map(named).collect()
}

impl LevelTableRow {
    fn new(
        surface: &SurfaceId,
        relative_to: Option<&SurfaceId>,
        levels: &LevelsBySurface,
        expected: &[ExpectedLevels],
    ) -> Self {
        let of = |surface: &SurfaceId| levels.get(surface.as_str()).cloned().unwrap_or_default();
        let mut levels_db = of(surface);
        if let Some(reference) = relative_to {
            let reference = of(reference);
            levels_db.retain(|band, _| reference.contains_key(band));
            levels_db.iter_mut().for_each(|(band, level_db)| *level_db -= reference[band]);
        }
        let found = expected.iter().find(|e| e.surface == *surface && e.relative_to.as_ref() == relative_to);
        Self {
            surface: surface.to_string(),
            levels_db,
            expected_db: found.map(|e| e.levels_db.clone()).unwrap_or_default(),
            source: found.map(|e| e.source.clone()).unwrap_or_default(),
        }
    }

    fn has_expected(&self) -> bool {
        !self.expected_db.is_empty()
    }

    fn format_cell(&self, band: &str) -> String {
        let level = self.levels_db.get(band).map_or_else(|| "-".to_owned(), |level| format_level(*level));
        match self.expected_db.get(band) {
            Some(expected) => format!("{level} ({})", format_level(*expected)),
            None => level,
        }
    }
}

impl LevelTable {
    /// Returns its text, a column for each band.
    pub fn to_text(&self, bands: &[String], colours: TableColours) -> String {
        let relative = |surface: &String| format!("dB relative to {surface}");
        let unit = self.relative_to.as_ref().map_or_else(|| "dB re Flat total".to_owned(), relative);
        let beside = if self.rows.iter().any(LevelTableRow::has_expected) { ", expected in brackets" } else { "" };
        let mut text = format!("Mean TNCE of the values up to the 90th percentile, {unit}{beside}\n");
        let names = self.rows.iter().map(|row| row.surface.len()).max().unwrap_or(0).max("surface".len());
        let cells: Vec<Vec<String>> =
            self.rows.iter().map(|row| bands.iter().map(|b| row.format_cell(b)).collect()).collect();
        let heads: Vec<_> = bands.iter().map(|b| if b == "total" { b.clone() } else { format!("{b} Hz") }).collect();
        let width =
            |column: usize| cells.iter().map(|row| row[column].len()).max().unwrap_or(0).max(heads[column].len());
        let widths: Vec<usize> = (0..bands.len()).map(width).collect();
        // Writing to a text cannot fail.
        let _ = write!(text, "{:<names$}", "surface");
        heads.iter().zip(&widths).for_each(|(head, &width)| _ = write!(text, "  {head:>width$}"));
        for (row, cells) in self.rows.iter().zip(&cells) {
            let _ = write!(text, "\n{:<names$}", row.surface);
            for ((band, cell), &width) in bands.iter().zip(cells).zip(&widths) {
                let (on, off) = match self.cell_colour(row, band) {
                    Some(colour) if colours == TableColours::Extremes => (colour, PLAIN),
                    _ => ("", ""),
                };
                let _ = write!(text, "  {on}{cell:>width$}{off}");
            }
        }
        let mut sources: Vec<_> = self.rows.iter().map(|row| &row.source).filter(|s| !s.is_empty()).collect();
        sources.dedup();
        sources.iter().for_each(|source| _ = write!(text, "\nexpected: {source}"));
        text
    }

    // Two levels that are alike have no extremes.
    fn cell_colour(&self, row: &LevelTableRow, band: &str) -> Option<&'static str> {
        let own = *row.levels_db.get(band)?;
        let all = || self.rows.iter().filter_map(|row| row.levels_db.get(band).copied());
        let least = all().fold(own, f64::min);
        let greatest = all().fold(own, f64::max);
        match own {
            _ if greatest - least < 0.005 => None,
            _ if own == greatest => Some(GREATEST),
            _ if own == least => Some(LEAST),
            _ => None,
        }
    }
}

// Without the sign of a zero.
fn format_level(level_db: f64) -> String {
    format!("{:.2}", (level_db * 100.0).round() / 100.0 + 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(name: &str) -> SurfaceId {
        name.parse().expect("a name")
    }

    fn levels(of: &[(&str, f64, f64)]) -> LevelsBySurface {
        let bands = |a: f64, b: f64| BTreeMap::from([("2500".to_owned(), a), ("total".to_owned(), b)]);
        of.iter().map(|(name, a, b)| ((*name).to_owned(), bands(*a, *b))).collect()
    }

    #[test]
    fn levels_stand_beside_what_is_expected() {
        let [flat, plain, low, high, foam] = ["flat", "0015_1", "0011_1", "0012_1", "foam"].map(id);
        let surfaces = [(&flat, None), (&foam, None), (&plain, None), (&low, Some(&plain)), (&high, Some(&plain))];
        let levels =
            levels(&[("flat", -10.0, 0.0), ("0015_1", -7.5, -0.5), ("0011_1", -8.0, -1.5), ("0012_1", -7.75, -0.5)]);
        let expected = [ExpectedLevels {
            surface: low.clone(),
            relative_to: Some(plain.clone()),
            levels_db: BTreeMap::from([("total".to_owned(), -0.46)]),
            source: "the paper".to_owned(),
        }];
        let tables = make_tables(&surfaces, &levels, &expected);
        let bands = ["2500", "total"].map(str::to_owned);
        let texts: Vec<_> = tables.iter().map(|table| table.to_text(&bands, TableColours::None)).collect();
        assert_eq!(
            texts[0],
            "Mean TNCE of the values up to the 90th percentile, dB re Flat total\n\
             surface  2500 Hz  total\n\
             flat      -10.00   0.00\n\
             0015_1     -7.50  -0.50\n\
             0011_1     -8.00  -1.50\n\
             0012_1     -7.75  -0.50"
        );
        assert_eq!(
            texts[1],
            "Mean TNCE of the values up to the 90th percentile, dB relative to 0015_1, expected in brackets\n\
             surface  2500 Hz          total\n\
             0011_1     -0.50  -1.00 (-0.46)\n\
             0012_1     -0.25           0.00\n\
             expected: the paper"
        );
        assert_eq!(texts.len(), 2);
        let coloured = tables[1].to_text(&bands, TableColours::Extremes);
        assert!(
            coloured.contains("\x1b[32m  -0.50\x1b[0m") && coloured.contains("\x1b[31m  -0.25\x1b[0m"),
            "{coloured:?}"
        );
        let json = serde_json::to_value(&tables).expect("JSON");
        assert_eq!(json[1]["rows"][0]["expected_db"]["total"], -0.46);
        assert_eq!(json[0]["relative_to"], serde_json::Value::Null);
    }
}
