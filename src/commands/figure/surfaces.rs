//! Figures of surfaces.

use std::collections::HashMap;

use anyhow::Context as _;
use echolake_dsp::air::AirState;
use echolake_dsp::chain::ResponseCorrection;
use echolake_dsp::components::PrincipalComponents;
use echolake_dsp::heights;
use echolake_dsp::self_organising_map::SelfOrganisingMap;
use echolake_dsp::temperature::ReferenceAir;
use echolake_figures::{
    GridFigure, GridLayer, GridPanel, LevelPalette, MapFigure, NceFigure, NcePanel, ReliefFigure, ReliefPanel,
    ResponseTrace, StepsFigure, StepsRow,
};
use echolake_query::figure_rows::{
    CurveRow, GridCell, GridLevels, LevelReference, OrbitEnergies, band_keys, band_labels, curves_query, grid_query,
    orbit_energies_query, point_filter, quote_literal, thinned_samples, times_ms, total_curve,
};
use serde::Deserialize;

use super::source::{FigureSource, SelectedSurface};
use super::{GridArgs, MapArgs, MapKind, NceArgs, ReliefArgs, StepsArgs};

/// Samples of a curve that are drawn.
const CURVE_POINTS: usize = 192;
/// Components that a map finds.
const COMPONENTS: usize = 2;

pub(super) async fn write_grid(source: &FigureSource, args: &GridArgs) -> anyhow::Result<()> {
    let surfaces = source.selected_surfaces(&args.selection).await?;
    source.require_levels(&surfaces).await?;
    let microphone = source.microphone_point(args.microphone.as_deref())?;
    let over = LevelReference::from(args.reference.over);
    let rig = source.lake.rig();
    let labels = band_labels(rig);
    let keys = band_keys(rig);
    let shown: Vec<usize> = match &args.band {
        None => (0..keys.len()).collect(),
        Some(key) => {
            let found = keys.iter().position(|known| known == key);
            vec![found.with_context(|| format!("there is no band `{key}`; hint: {}", keys.join(", ")))?]
        }
    };
    let base = match source.base_surface(args.less.as_ref()).await? {
        Some(surface) => {
            let levels = read_grid(source, &surface.surface_id, microphone.id.index(), over).await?;
            Some((surface, levels.bands))
        }
        None => None,
    };
    for group in args.output.group_surfaces(&surfaces)? {
        let mut panels = Vec::new();
        for surface in group {
            let id = &surface.surface_id;
            let levels = read_grid(source, id, microphone.id.index(), over).await?;
            let base = base.as_ref().map(|(surface, bands)| (surface.surface_id.as_str(), &bands[..]));
            panels.push(GridPanel::new(id, &levels.bands, &shown, base));
        }
        let figure = GridFigure {
            bands: shown.iter().map(|band| labels[*band].clone()).collect(),
            layers: GridLayer::from_grid(source.lake.grid()),
            microphone: microphone.id.index(),
            panels,
            palette: if args.paper_colours { LevelPalette::Paper } else { LevelPalette::Centred },
            panel_px: 440.0,
            columns: args.columns as usize,
            with_caption: true,
        };
        let default = || GridFigure::default_title(&microphone.label(), over.unit());
        let query = first_query(group, |id| grid_query(rig, over, id, &microphone.id.index().to_string()));
        let used = group.iter().chain(base.as_ref().map(|(surface, _)| surface));
        let notes = source.figure_notes(args.output.title_or(default), query, used);
        args.output.write_drawing(&figure.draw(&notes), group)?;
    }
    Ok(())
}

async fn read_grid(
    source: &FigureSource,
    surface: &str,
    microphone: usize,
    over: LevelReference,
) -> anyhow::Result<GridLevels> {
    let rig = source.lake.rig();
    let cells: Vec<GridCell> =
        source.query_rows(&grid_query(rig, over, &quote_literal(surface), &microphone.to_string())).await?;
    let points = source.lake.grid().points().len();
    let bands = rig.bands.centres_hz.len() + 1;
    Ok(GridLevels::from_cells(cells, microphone, points, bands))
}

// The first surface's query; the others differ by its name alone.
fn first_query(surfaces: &[SelectedSurface], query: impl Fn(&str) -> String) -> String {
    surfaces.first().map_or_else(String::new, |surface| query(&quote_literal(&surface.surface_id)))
}

pub(super) async fn write_nce(source: &FigureSource, args: &NceArgs) -> anyhow::Result<()> {
    let surfaces = source.selected_surfaces(&args.selection).await?;
    source.require_levels(&surfaces).await?;
    let rig = source.lake.rig();
    let point = args.microphone.as_ref().map(|named| source.microphone_point(Some(named))).transpose()?;
    let filter = point.map_or_else(String::new, |point| point_filter(&point.id.index().to_string()));
    let kept = thinned_samples(rig.impulse_response.length, CURVE_POINTS);
    let mut bands = band_labels(rig);
    bands.pop();
    let mut flat_totals: HashMap<&str, Vec<f32>> = HashMap::new();
    for group in args.output.group_surfaces(&surfaces)? {
        let mut panels = Vec::new();
        for surface in group {
            let id = surface.surface_id.as_str();
            let flat = surface.flat_reference.as_str();
            let bands = read_curves(source, id, &filter, &kept)
                .await?
                .with_context(|| format!("surface `{id}` has no curves; hint: energies need Flat and Foam"))?;
            if !flat_totals.contains_key(flat) {
                let curves = read_curves(source, flat, &filter, &kept).await?.unwrap_or_default();
                flat_totals.insert(flat, total_curve(&curves));
            }
            panels.push(NcePanel { title: id.to_owned(), bands, flat_total: flat_totals[flat].clone() });
        }
        let time_ms = times_ms(rig, &kept);
        let figure = NceFigure {
            bands: bands.clone(),
            time_ms,
            panels,
            panel_px: 420.0,
            columns: args.columns as usize,
            with_caption: true,
        };
        let title = args.output.title_or(|| NceFigure::default_title(point.map(|point| point.label()).as_deref()));
        let notes = source.figure_notes(title, first_query(group, |id| curves_query(rig, id, &filter)), group);
        args.output.write_drawing(&figure.draw(&notes), group)?;
    }
    Ok(())
}

// By band, then by time; none if there are no curves.
async fn read_curves(
    source: &FigureSource,
    surface: &str,
    filter: &str,
    kept: &[usize],
) -> anyhow::Result<Option<Vec<Vec<f32>>>> {
    let query = curves_query(source.lake.rig(), &quote_literal(surface), filter);
    let row: Option<CurveRow> = source.query_rows(&query).await?.pop();
    Ok(row.map(|row| row.curves_at(kept)))
}

#[derive(Deserialize)]
struct RecordedResponse {
    samples: Vec<f32>,
    sample_rate_hz: f64,
    temperature_c: f64,
    temperature_corrected: bool,
}

#[derive(Deserialize)]
struct DerivedResponse {
    ir: Vec<f32>,
    reflected_ir: Option<Vec<f32>>,
}

pub(super) async fn write_steps(source: &FigureSource, args: &StepsArgs) -> anyhow::Result<()> {
    let id = args.surface.as_str();
    let surfaces = source.named_surfaces(&[id]).await?;
    let rig = source.lake.rig();
    let run = surfaces[0].run_id.as_deref().with_context(|| format!("surface `{id}` has no run"))?;
    let quoted_run = quote_literal(run);
    let pair = args.pair;
    let recorded = format!(
        "select samples, sample_rate_hz, temperature_c, temperature_corrected from mcap({quoted_run}, '/ir') \
         where pair_id = {pair} and attempt = \
         (select max(attempt) from measurements where run_id = {quoted_run} and pair_id = {pair})"
    );
    let derived = format!(
        "select m.ir, n.reflected_ir from measurements m \
         left join nce n on n.run_id = m.run_id and n.pair_id = m.pair_id where m.run_id = {quoted_run} and m.pair_id \
         = {pair}"
    );
    let missing = || format!("surface `{id}` has no pair {pair}; hint: 0 to {}", source.lake.grid().pairs().len() - 1);
    let raw = source.query_rows::<RecordedResponse>(&recorded).await?.pop().with_context(missing)?;
    let DerivedResponse { ir, reflected_ir } = source.query_rows(&derived).await?.pop().with_context(missing)?;
    let reference = rig.impulse_response.reference_temperature_c.get();
    let step_ms = 1000.0 / raw.sample_rate_hz;
    let trace = |name: String, samples: Vec<f32>, step_ms| ResponseTrace { name, samples, step_ms };
    let own_step = 1000.0 / rig.sweep.rate_hz.get();
    let corrected = match args.celsius.is_empty() {
        true => vec![trace(format!("corrected to {reference} °C"), ir.clone(), own_step)],
        false => {
            let mut traces = Vec::new();
            for celsius in &args.celsius {
                anyhow::ensure!((-60.0..=80.0).contains(celsius), "`--celsius` is {celsius}; it is -60 to 80");
                let mut samples = vec![0.0; ir.len()];
                let reference = ReferenceAir::from_response(&rig.impulse_response);
                let correction = ResponseCorrection::<f32>::new(reference, rig.impulse_response.division);
                let air = AirState::with_known(*celsius, None, None);
                correction.correct_response(&raw.samples, &air, &mut samples);
                traces.push(trace(format!("as if measured at {celsius} °C"), samples, own_step));
            }
            traces
        }
    };
    let air = if raw.temperature_corrected {
        "at the reference temperature".into()
    } else {
        format!("{:.1} °C", raw.temperature_c)
    };
    let mut rows = vec![
        StepsRow { title: "Measured".into(), traces: vec![trace(air, raw.samples, step_ms)] },
        StepsRow { title: format!("Temperature corrected to {reference} °C"), traces: corrected },
    ];
    // Without Foam there are two steps.
    if let Some(reflected) = reflected_ir {
        let name = format!("less {}", surfaces[0].foam_reference);
        rows.push(StepsRow { title: "Direct sound removed".into(), traces: vec![trace(name, reflected, own_step)] });
    }
    let figure = StepsFigure { rows, from_ms: 0.0, to_ms: own_step * ir.len() as f64, width_px: 720.0 };
    let title = args.output.title_or(|| format!("Response of {id}, pair {pair}"));
    let notes = source.figure_notes(title, format!("{recorded}; {derived}"), &surfaces);
    args.output.write_drawing(&figure.draw(&notes), &surfaces)
}

pub(super) async fn write_map(source: &FigureSource, args: &MapArgs, kind: MapKind) -> anyhow::Result<()> {
    let predicate = args.predicate.as_deref().unwrap_or("surface_id <> foam_reference");
    let surfaces = source.surfaces_where(predicate).await?;
    let names: Vec<_> = surfaces.iter().map(|surface| surface.surface_id.clone()).collect();
    let rig = source.lake.rig();
    let mut energies = OrbitEnergies::new(&names, source.lake.grid(), rig.bands.centres_hz.len(), 1);
    let query = orbit_energies_query(rig);
    let mut answer = source.session().query(&query).await?;
    while let Some(batch) = answer.next().await? {
        energies.add_batch(&batch)?;
    }
    let mut levels = energies.into_level_rows();
    let has_levels: Vec<_> = levels.iter().map(|row| row.iter().any(|level| level.is_finite())).collect();
    let mut placed = has_levels.iter();
    levels.retain(|_| placed.next() == Some(&true));
    let surfaces: Vec<_> =
        surfaces.into_iter().zip(has_levels).filter(|(_, has)| *has).map(|(surface, _)| surface).collect();
    anyhow::ensure!(surfaces.len() > 1, "a map needs two surfaces with levels; hint: levels need Flat and Foam");
    let found = PrincipalComponents::from_rows(&mut levels, COMPONENTS)?;
    let rows = surfaces.iter().enumerate();
    let rows = rows.map(|(i, surface)| (i, surface.surface_id.as_str(), surface.typology.as_str()));
    let figure = match kind {
        MapKind::Components => MapFigure::of_components(&found, [0, 1], rows),
        MapKind::Units => MapFigure::of_units(&SelfOrganisingMap::from_components(&found), rows),
    };
    let title = args.output.title_or(|| MapFigure::default_title(surfaces.len(), LevelReference::FlatBand.unit()));
    args.output.write_drawing(&figure.draw(&source.figure_notes(title, query, &surfaces)), &[])
}

#[derive(Deserialize)]
struct HeightmapRow {
    cells: usize,
    size_mm: f32,
    heights_mm: Vec<f32>,
    /// Those of the mesh, which the cells' means do not reach.
    relief_min_mm: Option<f32>,
    relief_max_mm: Option<f32>,
}

pub(super) async fn write_relief(source: &FigureSource, args: &ReliefArgs) -> anyhow::Result<()> {
    let surfaces = source.selected_surfaces(&args.selection).await?;
    let query = |id: &str| {
        format!(
            "select cells, size_mm, heights_mm, relief_min_mm, relief_max_mm from heightmaps h left join surfaces s on \
             s.surface_id = h.surface_id where h.surface_id = {id} and symmetry = 'identity' order by h.run_id desc \
             limit 1"
        )
    };
    for group in args.output.group_surfaces(&surfaces)? {
        let mut panels = Vec::new();
        for surface in group {
            let row = source.query_rows::<HeightmapRow>(&query(&quote_literal(&surface.surface_id))).await?.pop();
            let row = row.filter(|row| row.cells > 0 && row.heights_mm.len() == row.cells * row.cells);
            let missing =
                || format!("surface `{}` has no height map; hint: its run came without a mesh", surface.surface_id);
            let row = row.with_context(missing)?;
            let heights = row.heights_mm.iter().map(|height| f64::from(*height));
            let [low, high] = heights.fold([f64::MAX, f64::MIN], |[low, high], h| [low.min(h), high.max(h)]);
            panels.push(ReliefPanel {
                title: surface.surface_id.clone(),
                shaded: heights::shade_heights(&row.heights_mm, row.size_mm / row.cells as f32)?,
                cells: row.cells,
                extent_mm: [row.relief_min_mm.map_or(low, f64::from), row.relief_max_mm.map_or(high, f64::from)],
            });
        }
        let panel_mm = source.lake.rig().panel.size_mm;
        let figure = ReliefFigure { panels, panel_mm, panel_px: 200.0, columns: args.columns as usize };
        let title = args.output.title_or(|| "Reliefs in oblique light".into());
        let notes = source.figure_notes(title, first_query(group, query), group);
        args.output.write_drawing(&figure.draw(&notes), group)?;
    }
    Ok(())
}
