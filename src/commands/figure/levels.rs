//! Levels of surfaces by band with their standard uncertainties, as tables and as a chart.

use std::collections::HashMap;

use echolake_figures::{FigureTable, LevelsFigure, TableRow};
use echolake_query::figure_rows::{LevelReference, TOTAL_BAND, band_keys, band_labels, quote_literal};
use serde::Deserialize;

use super::LevelsArgs;
use super::source::{FigureSource, SelectedSurface};

/// Width of a chart, px.
const WIDTH_PX: f32 = 720.0;

#[derive(Deserialize)]
struct LevelRow {
    surface_id: String,
    band: String,
    level_db: Option<f64>,
    u_db: Option<f64>,
    has_foam: bool,
}

/// A level and its standard uncertainty, dB.
#[derive(Debug, Clone, Copy)]
struct LevelValue {
    level_db: f64,
    u_db: Option<f64>,
}

/// The mean that stands for a surface's pairs in a band, by its columns of view `levels`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LevelKind {
    /// Of the TNCE values up to their 90th percentile.
    Measured,
    /// The same without Foam's own reflection.
    Unbiased,
    /// The same without Foam's own reflection if it is known, as pages show.
    Shown,
}

impl LevelKind {
    // Level and uncertainty.
    fn columns(self, over: LevelReference) -> [&'static str; 2] {
        match (self, over) {
            (Self::Measured, LevelReference::FlatTotal) => ["level_db", "coalesce(combined_u_db, u_db)"],
            (Self::Measured, LevelReference::FlatBand) => ["against_flat_db", "coalesce(combined_u_db, u_db)"],
            (Self::Unbiased, LevelReference::FlatTotal) => ["unbiased_db", "unbiased_u_db"],
            (Self::Unbiased, LevelReference::FlatBand) => ["unbiased_against_flat_db", "unbiased_against_flat_u_db"],
            (Self::Shown, LevelReference::FlatTotal) => ["shown_db", "shown_u_db"],
            (Self::Shown, LevelReference::FlatBand) => ["shown_against_flat_db", "shown_u_db"],
        }
    }
}

/// Levels of surfaces and of their Flats.
pub(super) struct LevelTable<'a> {
    surfaces: &'a [SelectedSurface],
    base: Option<&'a SelectedSurface>,
    kind: LevelKind,
    over: LevelReference,
    has_foam: bool,
    values: HashMap<(String, String), LevelValue>,
    /// The query that reads them.
    pub query: String,
}

impl<'a> LevelTable<'a> {
    /// Reads the levels of surfaces. If there is a base, its levels are to be subtracted from those of the others.
    ///
    /// # Errors
    /// Those of the query.
    pub async fn read(
        source: &FigureSource,
        surfaces: &'a [SelectedSurface],
        base: Option<&'a SelectedSurface>,
        kind: LevelKind,
        over: LevelReference,
    ) -> anyhow::Result<Self> {
        let names: Vec<_> = surfaces.iter().chain(base).map(|surface| surface.surface_id.as_str()).collect();
        let list: Vec<_> = names.iter().enumerate().filter(|(i, name)| !names[..*i].contains(name)).collect();
        let list: Vec<_> = list.into_iter().map(|(_, name)| quote_literal(name)).collect();
        let [level, u] = kind.columns(over);
        let query = format!(
            "select surface_id, band, {level} as level_db, {u} as u_db, has_foam from levels where surface_id in ({}) \
             order by surface_id, band_hz",
            list.join(", ")
        );
        let rows: Vec<LevelRow> = source.query_rows(&query).await?;
        let has_foam = rows.iter().any(|row| row.has_foam);
        let known = |row: LevelRow| {
            let value = LevelValue { level_db: row.level_db?, u_db: row.u_db };
            Some(((row.surface_id, row.band), value))
        };
        let values = rows.into_iter().filter_map(known).collect();
        Ok(Self { surfaces, base, kind, over, has_foam, values, query })
    }

    fn stored_value(&self, surface: &str, band: &str) -> Option<LevelValue> {
        self.values.get(&(surface.to_owned(), band.to_owned())).copied()
    }

    // Flat over itself is 0 dB by definition.
    fn level_value(&self, surface: &SelectedSurface, band: &str) -> Option<LevelValue> {
        let own = self.stored_value(&surface.surface_id, band)?;
        let is_flat = surface.surface_id == surface.flat_reference;
        match self.over {
            LevelReference::FlatBand if is_flat => Some(LevelValue { level_db: 0.0, u_db: None }),
            LevelReference::FlatTotal if is_flat && band == TOTAL_BAND => Some(LevelValue { u_db: None, ..own }),
            _ => Some(own),
        }
    }

    // Both uncertainties hold the share of the Flat that the surfaces have in common, so that theirs is an upper bound.
    fn shown_value(&self, surface: &SelectedSurface, band: &str) -> Option<LevelValue> {
        let own = self.level_value(surface, band)?;
        let Some(base) = self.base.filter(|base| base.surface_id != surface.surface_id) else { return Some(own) };
        let other = self.level_value(base, band)?;
        let is_flat = base.surface_id == surface.flat_reference && self.kind == LevelKind::Measured;
        // A Flat over itself has none, and needs none.
        let other_u = match other.u_db {
            None if base.surface_id == base.flat_reference => Some(0.0),
            _ if is_flat => Some(0.0),
            known => known,
        };
        let u_db = own.u_db.zip(other_u).map(|(own, other)| own.hypot(other));
        Some(LevelValue { level_db: own.level_db - other.level_db, u_db })
    }

    // Flat over itself is 0 dB by definition: no reader is to take it for a measurement.
    fn row_name(&self, surface: &SelectedSurface) -> String {
        let name = &surface.surface_id;
        match self.base {
            Some(base) if base.surface_id != *name => format!("{name} less {}", base.surface_id),
            _ if *name == surface.flat_reference => reference_name(name),
            _ => name.clone(),
        }
    }

    /// Returns one row per surface and one column per band.
    pub fn to_table(&self, source: &FigureSource) -> FigureTable {
        let keys = band_keys(source.lake.rig());
        let mut rows = Vec::new();
        for surface in self.surfaces {
            let values: Vec<_> = keys.iter().map(|band| self.shown_value(surface, band)).collect();
            let uncertainties: Vec<_> = values.iter().map(|value| (*value)?.u_db).collect();
            let is_known = uncertainties.iter().any(Option::is_some);
            rows.push(TableRow {
                name: self.row_name(surface),
                values: values.iter().map(|value| Some((*value)?.level_db)).collect(),
                uncertainties: if is_known { uncertainties } else { Vec::new() },
                decimals: 2,
                is_percent: false,
            });
        }
        FigureTable {
            corner: "Surface".into(),
            columns: band_labels(source.lake.rig()),
            rows,
            // Levels and differences are not compared with each other.
            with_extremes: self.base.is_none(),
        }
    }

    /// Returns the title of the levels, with their unit.
    pub fn default_title(&self) -> String {
        match self.kind {
            LevelKind::Measured => LevelsFigure::default_title(&self.unit()),
            LevelKind::Unbiased => LevelsFigure::shown_title(&self.unit(), false),
            LevelKind::Shown => LevelsFigure::shown_title(&self.unit(), self.has_foam),
        }
    }

    // Levels less those of their Flat are over the same band.
    fn unit(&self) -> String {
        let Some(base) = self.base else { return self.over.unit().to_owned() };
        let id = &base.surface_id;
        let is_flat = self.surfaces.iter().all(|surface| surface.flat_reference == *id && surface.surface_id != *id);
        if is_flat { LevelReference::FlatBand.unit().to_owned() } else { format!("dB, less {id}") }
    }
}

pub(super) async fn write_levels(source: &FigureSource, args: &LevelsArgs) -> anyhow::Result<()> {
    let surfaces = source.selected_surfaces(&args.selection).await?;
    source.require_levels(&surfaces).await?;
    let base = source.base_surface(args.less.as_ref()).await?;
    for group in args.output.group_surfaces(&surfaces)? {
        let over = args.reference.over.into();
        let kind = if args.measured { LevelKind::Measured } else { LevelKind::Shown };
        let levels = LevelTable::read(source, group, base.as_ref(), kind, over).await?;
        let table = levels.to_table(source);
        let figure = LevelsFigure { table, unit: levels.unit(), width_px: WIDTH_PX, with_caption: true };
        let title = args.output.title_or(|| levels.default_title());
        let notes = source.figure_notes(title, levels.query.clone(), group.iter().chain(&base));
        args.output.write_chart(&figure.draw(&notes), &figure.table, &notes, group)?;
    }
    Ok(())
}

/// Returns the name of a Flat in a table.
pub(super) fn reference_name(flat: &str) -> String {
    format!("{flat} (reference)")
}
