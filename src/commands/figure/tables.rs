//! The paper's tables.

use anyhow::Context as _;
use echolake_figures::{FigureTable, TableRow};
use echolake_query::figure_rows::{DiffusionRow, band_labels, band_list, diffusion_query, quote_literal};
use serde::Deserialize;

use super::levels::{LevelKind, LevelTable, reference_name};
use super::source::{FigureSource, SelectedSurface};
use super::{TableArgs, ValuesArg};

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
    let kind = match args.values {
        ValuesArg::Shown => Some(LevelKind::Shown),
        ValuesArg::Levels => Some(LevelKind::Measured),
        ValuesArg::UnbiasedLevels => Some(LevelKind::Unbiased),
        ValuesArg::Energies | ValuesArg::Diffusion => None,
    };
    anyhow::ensure!(
        base.is_none() || kind.is_some(),
        "--less subtracts levels, which `--values` selects none of; hint: leave one of them out"
    );
    for group in args.output.group_surfaces(&surfaces)? {
        let (table, query, title) = match kind {
            Some(kind) => {
                let levels = LevelTable::read(source, group, base.as_ref(), kind, args.reference.over.into()).await?;
                (levels.to_table(source), levels.query.clone(), levels.default_title())
            }
            None if args.values == ValuesArg::Diffusion => {
                let (table, query) = diffusion_table(source, group).await?;
                (table, query, "Diffusion coefficient in the near field, mean over grid points".to_owned())
            }
            None => {
                let (table, query) = energy_table(source, group).await?;
                (table, query, "Mean TNCE over all pairs, over Flat\u{2019}s total".to_owned())
            }
        };
        let notes = source.figure_notes(args.output.title_or(|| title), query, group.iter().chain(&base));
        args.output.write_table(&table, &notes, group)?;
    }
    Ok(())
}

fn surface_list(surfaces: &[&str]) -> String {
    surfaces.iter().map(|name| quote_literal(name)).collect::<Vec<_>>().join(", ")
}

async fn energy_table(source: &FigureSource, surfaces: &[SelectedSurface]) -> anyhow::Result<QueriedTable> {
    let rig = source.lake.rig();
    let names = surfaces.iter().flat_map(|surface| [surface.flat_reference.as_str(), surface.surface_id.as_str()]);
    let mut names: Vec<_> = names.collect();
    names.sort_unstable();
    names.dedup();
    let means = band_list(rig, |band| format!("avg(tnce_{band})"));
    let list = surface_list(&names);
    let query = format!(
        "select surface_id, {means} as means from tnce where surface_id in ({list}) and not is_rejected(run_id, \
             pair_id) group by surface_id"
    );
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
            uncertainties: Vec::new(),
            decimals: 1,
            is_percent: true,
        });
    }
    let columns = band_labels(rig);
    Ok((FigureTable { corner: "Surface".into(), columns, rows: table_rows, with_extremes: false }, query))
}

async fn diffusion_table(source: &FigureSource, surfaces: &[SelectedSurface]) -> anyhow::Result<QueriedTable> {
    let names: Vec<_> = surfaces.iter().map(|surface| surface.surface_id.as_str()).collect();
    let query = diffusion_query(source.lake.rig(), &format!("where surface_id in ({})", surface_list(&names)));
    let rows: Vec<DiffusionRow> = source.query_rows(&query).await?;
    let row = |name: &&str| TableRow {
        name: (*name).to_owned(),
        values: rows.iter().find(|row| row.surface_id == **name).map(|row| row.diffusion.clone()).unwrap_or_default(),
        uncertainties: Vec::new(),
        decimals: 3,
        is_percent: false,
    };
    let rows = names.iter().map(row).collect();
    let columns = band_labels(source.lake.rig());
    Ok((FigureTable { corner: "Surface".into(), columns, rows, with_extremes: true }, query))
}

fn energy_row(name: &str, values: Vec<Option<f64>>) -> TableRow {
    TableRow { name: name.to_owned(), values, uncertainties: Vec::new(), decimals: 3, is_percent: false }
}
