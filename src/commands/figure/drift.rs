//! The control chart of a Flat.

use echolake_figures::{FigureTable, LevelsFigure, TableRow};
use echolake_query::figure_rows::{band_keys, band_labels, quote_literal};
use serde::Deserialize;

use super::DriftArgs;
use super::source::FigureSource;

const WIDTH_PX: f32 = 900.0;

#[derive(Deserialize)]
struct DriftRow {
    band: String,
    run_id: String,
    started: String,
    level_db: f64,
    u_db: Option<f64>,
    alarm: Option<String>,
    shift_db: Option<f64>,
}

/// Writes the chart, and says its alarms.
pub(super) async fn write_drift(source: &FigureSource, args: &DriftArgs) -> anyhow::Result<()> {
    let flat = args.surface.as_ref().unwrap_or(&source.lake.config().references.flat);
    let surfaces = source.named_surfaces(&[flat.as_str()]).await?;
    let query = format!(
        "select band, run_id, cast(started as varchar) as started, level_db - mean_db as level_db, u_db, alarm, \
         shift_db from flat_drift where surface_id = {} order by started, run_id, band_hz",
        quote_literal(flat.as_str())
    );
    let rows: Vec<DriftRow> = source.query_rows(&query).await?;
    anyhow::ensure!(
        !rows.is_empty(),
        "surface `{flat}` is no Flat that has levels; hint: echolake sql \"select distinct flat_reference from \
         surfaces\""
    );
    let mut runs: Vec<(&str, &str)> = Vec::new();
    for row in &rows {
        if runs.last().is_none_or(|(run, _)| *run != row.run_id) {
            runs.push((&row.run_id, row.started.get(..10).unwrap_or(&row.started)));
        }
    }
    let labels = band_labels(source.lake.rig());
    let band_row = |(band, name): (String, String)| {
        let of_run = |run: &(&str, &str)| rows.iter().find(|row| row.band == band && row.run_id == run.0);
        TableRow {
            name,
            values: runs.iter().map(|run| Some(of_run(run)?.level_db)).collect(),
            uncertainties: runs.iter().map(|run| of_run(run)?.u_db).collect(),
            decimals: 3,
            is_percent: false,
        }
    };
    let table = FigureTable {
        corner: "Band".into(),
        columns: runs.iter().map(|(_, day)| (*day).to_owned()).collect(),
        rows: band_keys(source.lake.rig()).into_iter().zip(labels).map(band_row).collect(),
        with_extremes: false,
    };
    for row in &rows {
        let size = match row.alarm.as_deref() {
            Some("shift") => format!("another level from this run on, by {:+.3} dB", row.shift_db.unwrap_or_default()),
            Some(_) => format!("this run alone differs, by {:+.3} dB", row.level_db),
            None => continue,
        };
        eprintln!("{flat}, {} of {}, band {}: {size}", row.run_id, row.started, row.band);
    }
    let figure = LevelsFigure { table, unit: "dB re mean of all runs".into(), width_px: WIDTH_PX, with_caption: true };
    let notes =
        source.figure_notes(args.output.title_or(|| format!("Level of {flat}, run after run")), query, &surfaces);
    args.output.write_chart(&figure.draw(&notes), &figure.table, &notes, &surfaces)
}
