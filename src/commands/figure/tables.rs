//! The paper's tables.

use std::collections::HashMap;

use anyhow::Context as _;
use echolake_figures::{FigureTable, TableRow};
use echolake_query::figure_rows::{LevelReference, band_keys, band_labels, band_list, quote_literal};
use serde::Deserialize;

use super::source::{FigureSource, SelectedSurface};
use super::{TableArgs, ValuesArg};

#[derive(Deserialize)]
struct BandLevel {
    surface_id: String,
    band: String,
    level_db: Option<f64>,
}

#[derive(Deserialize)]
struct SurfaceMeans {
    surface_id: String,
    means: Vec<Option<f64>>,
}

/// A table and the query of its numbers.
type QueriedTable = (FigureTable, String);

pub(super) async fn write_table(source: &FigureSource, args: &TableArgs) -> anyhow::Result<()> {
    let surfaces = source.selected_surfaces(&args.selection).await?;
    source.require_levels(&surfaces).await?;
    let base = source.base_surface(args.less.as_ref()).await?;
    anyhow::ensure!(
        base.is_none() || args.values != ValuesArg::Energies,
        "--less subtracts levels, and --values energies has none; hint: leave one of them out"
    );
    for group in args.output.group_surfaces(&surfaces)? {
        let (table, query) = match args.values {
            ValuesArg::Levels => level_table(source, group, base.as_ref(), "p90_mean_db").await?,
            ValuesArg::UnbiasedLevels => level_table(source, group, base.as_ref(), "unbiased_p90_mean_db").await?,
            ValuesArg::Energies => energy_table(source, group).await?,
        };
        let title = args.output.title_or(|| default_title(args.values, group, base.as_ref()));
        let notes = source.figure_notes(title, query, group.iter().chain(&base));
        args.output.write_table(&table, &notes, group)?;
    }
    Ok(())
}

fn default_title(values: ValuesArg, surfaces: &[SelectedSurface], base: Option<&SelectedSurface>) -> String {
    let unit = level_unit(surfaces, base);
    match values {
        ValuesArg::Levels => format!("Mean TNCE of the values up to the 90th percentile, {unit}"),
        ValuesArg::UnbiasedLevels => {
            format!("Mean TNCE of the values up to the 90th percentile, {unit}, without Foam\u{2019}s reflection")
        }
        ValuesArg::Energies => "Mean TNCE over the pairs, over Flat\u{2019}s total".to_owned(),
    }
}

// Levels less those of their Flat are over the same band.
fn level_unit(surfaces: &[SelectedSurface], base: Option<&SelectedSurface>) -> String {
    let Some(base) = base else { return LevelReference::FlatTotal.unit().to_owned() };
    let id = &base.surface_id;
    let is_flat = surfaces.iter().all(|surface| surface.flat_reference == *id && surface.surface_id != *id);
    if is_flat { LevelReference::FlatBand.unit().to_owned() } else { format!("dB, less {id}") }
}

fn surface_list(surfaces: &[&str]) -> String {
    surfaces.iter().map(|name| quote_literal(name)).collect::<Vec<_>>().join(", ")
}

async fn level_table(
    source: &FigureSource,
    surfaces: &[SelectedSurface],
    base: Option<&SelectedSurface>,
    column: &str,
) -> anyhow::Result<QueriedTable> {
    let names: Vec<_> = surfaces.iter().map(|surface| surface.surface_id.as_str()).collect();
    let base = base.map(|surface| surface.surface_id.as_str());
    let all: Vec<_> = names.iter().copied().chain(base).collect();
    let query = format!(
        "select surface_id, band, {column} as level_db from surface_stats where surface_id in ({}) order by run_id",
        surface_list(&all)
    );
    let rows: Vec<BandLevel> = source.query_rows(&query).await?;
    // Of several runs of a surface, the newest counts.
    let levels: HashMap<_, _> =
        rows.iter().map(|row| ((row.surface_id.as_str(), row.band.as_str()), row.level_db)).collect();
    let keys = band_keys(source.lake.rig());
    let level = |surface: &str, band: &str| levels.get(&(surface, band)).copied().flatten();
    let value = |surface: &str, band: &str| match base {
        Some(base) if base != surface => Some(level(surface, band)? - level(base, band)?),
        _ => level(surface, band),
    };
    let is_flat = |name: &str| surfaces.iter().any(|s| s.surface_id == name && s.flat_reference == name);
    let row = |name: &&str| TableRow {
        name: match base {
            Some(base) if base != *name => format!("{name} less {base}"),
            _ if is_flat(name) => reference_name(name),
            _ => (*name).to_owned(),
        },
        values: keys.iter().map(|band| value(name, band)).collect(),
        decimals: 2,
        is_percent: false,
    };
    let table = FigureTable {
        corner: "Surface".into(),
        columns: band_labels(source.lake.rig()),
        rows: names.iter().map(row).collect(),
        // Levels and differences are not compared with each other.
        with_extremes: base.is_none(),
    };
    Ok((table, query))
}

async fn energy_table(source: &FigureSource, surfaces: &[SelectedSurface]) -> anyhow::Result<QueriedTable> {
    let rig = source.lake.rig();
    let names = surfaces.iter().flat_map(|surface| [surface.flat_reference.as_str(), surface.surface_id.as_str()]);
    let mut names: Vec<_> = names.collect();
    names.sort_unstable();
    names.dedup();
    let means = band_list(rig, |band| format!("avg(tnce_{band})"));
    let list = surface_list(&names);
    let query =
        format!("select surface_id, {means} as means from tnce where surface_id in ({list}) group by surface_id");
    let rows: Vec<SurfaceMeans> = source.query_rows(&query).await?;
    let of = |name: &str| {
        let row = rows.iter().find(|row| row.surface_id == name);
        row.with_context(|| format!("surface `{name}` has no energies; hint: `echolake doctor` says what is missing"))
    };
    let mut table_rows = Vec::new();
    let mut flat_names: Vec<&str> = Vec::new();
    for surface in surfaces {
        let flat = of(&surface.flat_reference)?;
        if !flat_names.contains(&surface.flat_reference.as_str()) {
            flat_names.push(&surface.flat_reference);
            table_rows.push(energy_row(&reference_name(&surface.flat_reference), flat.means.clone()));
        }
        if surface.surface_id == surface.flat_reference {
            continue;
        }
        let own = of(&surface.surface_id)?;
        table_rows.push(energy_row(&surface.surface_id, own.means.clone()));
        let change = |(own, flat): (&Option<f64>, &Option<f64>)| Some(100.0 * ((*own)? / (*flat)? - 1.0));
        table_rows.push(TableRow {
            name: format!("{}, difference", surface.surface_id),
            values: own.means.iter().zip(&flat.means).map(change).collect(),
            decimals: 1,
            is_percent: true,
        });
    }
    let columns = band_labels(rig);
    Ok((FigureTable { corner: "Surface".into(), columns, rows: table_rows, with_extremes: false }, query))
}

// Flat over itself is 0 dB by definition: no reader is to take it for a measurement.
fn reference_name(flat: &str) -> String {
    format!("{flat} (reference)")
}

fn energy_row(name: &str, values: Vec<Option<f64>>) -> TableRow {
    TableRow { name: name.to_owned(), values, decimals: 3, is_percent: false }
}
