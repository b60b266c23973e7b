//! Figures of surfaces: what `echolake figure` writes, for the pages, which show them and offer them as files.

use std::io;

use axum::Extension;
use echolake_figures::{
    FigureDrawing, FigureNotes, FigureTable, GridFigure, GridLayer, GridPanel, LevelPalette, LevelsFigure, MapFigure,
    NceFigure, NcePanel, TableRow,
};
use echolake_query::figure_rows::{
    LevelReference, band_labels, curves_query, grid_query, lake_version, orbit_energies_query, point_filter,
    quote_literal, total_curve,
};
use echolake_service::RequestFault;
use serde::Deserialize;
use utoipa::{IntoParams, ToSchema};

use super::super::extract::{BinaryContent, PathParams, QueryParams, WholeNumber};
use super::content::{AnswerContent, EndpointAnswer};
use super::curves::{CurveSet, PairSelection};
use super::map::surface_positions;
use super::request::{CatalogueRequest, SurfacePath};
use super::snapshot::summary::{BAND_STATISTICS, SurfaceEntry};
use super::surface::{GridNormalisation, read_grid, required_microphone};

/// Surfaces of one figure.
const MOST_SURFACES: usize = 8;
/// Surfaces in a row.
const COLUMNS: usize = 4;

/// The file format of a figure.
#[derive(Clone, Copy, Default, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(default = "svg")]
enum FigureFormat {
    #[default]
    Svg,
    Pdf,
    Png,
}

impl FigureFormat {
    /// Writes a drawing.
    ///
    /// # Errors
    /// Those of computing beside the requests, and a drawing that the format cannot hold.
    async fn write_drawing(self, request: &CatalogueRequest, drawing: FigureDrawing) -> EndpointAnswer {
        let write = move || -> io::Result<AnswerContent> {
            Ok(match self {
                Self::Svg => AnswerContent::new("image/svg+xml", drawing.to_svg()),
                Self::Pdf => AnswerContent::new("application/pdf", drawing.to_pdf()?),
                Self::Png => AnswerContent::new("image/png", drawing.to_png()?),
            })
        };
        let written = request.catalogue.service().compute_blocking(write).await?;
        Ok(written.map_err(RequestFault::defect("a figure cannot be written"))?)
    }
}

/// The surroundings of a figure.
#[derive(Clone, Copy, Default, PartialEq, Eq, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(default = "caption")]
enum FigureFrame {
    /// Titles, scale and origin, for a file.
    #[default]
    Caption,
    /// None of them, for a page that has them.
    Bare,
}

/// The colours of levels.
#[derive(Clone, Copy, Default, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(default = "centred")]
enum FigurePalette {
    /// Grey is 0 dB, blue below, orange above; the range fits.
    #[default]
    Centred,
    /// White is -20 dB, black 0 dB, red 6 dB.
    Paper,
}

/// The contents of a grid plot.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct GridFigureQuery {
    /// A grid point.
    #[param(value_type = usize, required = true)]
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    microphone: Option<String>,
    /// As of grid.
    #[serde(default)]
    #[param(inline)]
    over: GridNormalisation,
    /// Surfaces beside this one.
    #[serde(default)]
    beside: Vec<String>,
    /// A surface whose levels are subtracted from those of the others.
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    less: Option<String>,
    /// Key of the only band, as in `lake.bands`; all if there is none.
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    band: Option<String>,
    #[serde(default)]
    #[param(inline)]
    palette: FigurePalette,
    #[serde(default)]
    #[param(inline)]
    frame: FigureFrame,
    /// Width of a surface's plot, px.
    #[serde(default)]
    #[param(inline)]
    width: WholeNumber<160, 1200, 560>,
    #[serde(default)]
    #[param(inline)]
    format: FigureFormat,
}

/// TNCE over the grid for one microphone point, drawn.
///
/// Grey is 0 dB, blue below, orange above, unless the palette is the paper's. Cells have `data-row` (band) and
/// `data-point`.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/grid.svg",
    tag = "catalogue",
    params(SurfacePath, GridFigureQuery),
    responses((status = 200, description = "OK", content(
        (inline(BinaryContent) = "image/svg+xml"),
        (inline(BinaryContent) = "application/pdf"),
        (inline(BinaryContent) = "image/png")
    ))),
    extensions(("x-sql" = json!(["as of grid"])))
)]
pub(super) async fn grid_figure(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<SurfacePath>,
    QueryParams(query): QueryParams<GridFigureQuery>,
) -> EndpointAnswer {
    let entries = find_surfaces(&request, &path.surface_id, &query.beside).await?;
    let microphone = required_microphone(&request, query.microphone.as_deref())?;
    let lake = request.catalogue.lake();
    let keys = &request.read_summary().await?.bands;
    let shown: Vec<usize> = match &query.band {
        None => (0..keys.len()).collect(),
        Some(key) => vec![keys.iter().position(|band| band.key == *key).ok_or_else(|| {
            RequestFault::bad_request(format!("`band` is `{key}`; hint: a key of `bands` of GET /api/v1/lake"))
        })?],
    };
    let base = match &query.less {
        Some(name) => {
            let entry = request.find_surface(name).await?;
            Some((entry, read_grid(&request, entry, microphone, query.over).await?))
        }
        None => None,
    };
    let mut panels = Vec::new();
    for entry in &entries {
        let id = &entry.surface.surface_id;
        let levels = read_grid(&request, entry, microphone, query.over).await?;
        let base = base.as_ref().map(|(entry, base)| (entry.surface.surface_id.as_str(), &base.bands[..]));
        panels.push(GridPanel::new(id, &levels.bands, &shown, base));
    }
    let labels = band_labels(lake.rig());
    let over = LevelReference::from(query.over);
    let point = lake.grid().points().get(microphone).map(|point| point.label()).unwrap_or_default();
    let figure = GridFigure {
        bands: shown.iter().map(|band| labels[*band].clone()).collect(),
        layers: GridLayer::from_grid(lake.grid()),
        microphone,
        panels,
        palette: match query.palette {
            FigurePalette::Centred => LevelPalette::Centred,
            FigurePalette::Paper => LevelPalette::Paper,
        },
        panel_px: query.width.get() as f32,
        columns: COLUMNS,
        with_caption: query.frame == FigureFrame::Caption,
    };
    let mut options = vec![format!("--microphone {microphone}")];
    options.extend((over == LevelReference::FlatTotal).then(|| "--over total".to_owned()));
    options.extend(query.band.iter().map(|band| format!("--band {band}")));
    options.extend(base.iter().map(|(base, _)| format!("--less {}", base.surface.surface_id)));
    options.extend((figure.palette == LevelPalette::Paper).then(|| "--paper-colours".to_owned()));
    let used: Vec<_> = entries.iter().copied().chain(base.iter().map(|(base, _)| *base)).collect();
    let notes = FigureNotes {
        title: GridFigure::default_title(&point, over.unit()),
        command: figure_command("grid", &entries, &options),
        query: grid_query(lake.rig(), over, &quote_literal(&path.surface_id), &microphone.to_string()),
        ..figure_notes(&request, &used)
    };
    query.format.write_drawing(&request, figure.draw(&notes)).await
}

/// The contents of a chart of levels.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct LevelsFigureQuery {
    /// As of grid.
    #[param(inline)]
    over: GridNormalisation,
    /// Surfaces beside this one.
    beside: Vec<String>,
    #[param(inline)]
    frame: FigureFrame,
    /// Width, px.
    #[param(inline)]
    width: WholeNumber<160, 1200, 720>,
    #[param(inline)]
    format: FigureFormat,
}

/// Levels by band with error bars, a series for each surface; drawn.
///
/// Bars are 1.96 times the standard uncertainty. Dots have `data-series` and `data-band`.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/levels.svg",
    tag = "catalogue",
    params(SurfacePath, LevelsFigureQuery),
    responses((status = 200, description = "OK", content(
        (inline(BinaryContent) = "image/svg+xml"),
        (inline(BinaryContent) = "application/pdf"),
        (inline(BinaryContent) = "image/png")
    ))),
    extensions(("x-sql" = json!(["the summary of /surfaces"])))
)]
pub(super) async fn levels_figure(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<SurfacePath>,
    QueryParams(query): QueryParams<LevelsFigureQuery>,
) -> EndpointAnswer {
    let entries = find_surfaces(&request, &path.surface_id, &query.beside).await?;
    let over = LevelReference::from(query.over);
    let table = FigureTable {
        corner: "Surface".into(),
        columns: band_labels(request.catalogue.lake().rig()),
        rows: entries.iter().map(|entry| level_row(entry, over)).collect(),
        with_extremes: true,
    };
    let with_caption = query.frame == FigureFrame::Caption;
    let figure = LevelsFigure { table, unit: over.unit().to_owned(), width_px: query.width.get() as f32, with_caption };
    let options: Vec<_> = (over == LevelReference::FlatTotal).then(|| "--over total".to_owned()).into_iter().collect();
    let notes = FigureNotes {
        title: LevelsFigure::shown_title(over.unit(), entries.iter().any(|entry| entry.surface.has_foam)),
        command: figure_command("levels", &entries, &options),
        query: BAND_STATISTICS.to_owned(),
        ..figure_notes(&request, &entries)
    };
    query.format.write_drawing(&request, figure.draw(&notes)).await
}

// Flat over itself is 0 dB by definition, and has no uncertainty.
fn level_row(entry: &SurfaceEntry, over: LevelReference) -> TableRow {
    let surface = &entry.surface;
    let is_flat = surface.surface_id == surface.flat_reference;
    let total = surface.level_u_db.len().saturating_sub(1);
    let is_defined = |band: usize| is_flat && (over == LevelReference::FlatBand || band == total);
    let uncertainties = surface.level_u_db.iter().enumerate();
    TableRow {
        name: if is_flat { format!("{} (reference)", surface.surface_id) } else { surface.surface_id.clone() },
        values: match over {
            LevelReference::FlatBand => surface.against_flat_db.clone(),
            LevelReference::FlatTotal => surface.level_db.clone(),
        },
        uncertainties: uncertainties.map(|(band, u)| u.filter(|_| !is_defined(band))).collect(),
        decimals: 2,
        is_percent: false,
    }
}

/// The contents of a plot of NCE curves.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct CurvesFigureQuery {
    /// A grid point.
    #[param(value_type = usize, required = false)]
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    microphone: Option<String>,
    #[param(inline)]
    points: WholeNumber<16, 4096, 192>,
    /// Surfaces beside this one.
    beside: Vec<String>,
    #[param(inline)]
    frame: FigureFrame,
    /// Width of a surface's plot, px.
    #[param(inline)]
    width: WholeNumber<160, 1200, 560>,
    #[param(inline)]
    format: FigureFormat,
}

/// NCE by band, a mean over pairs, stacked, beside Flat's total; drawn.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/curves.svg",
    tag = "catalogue",
    params(SurfacePath, CurvesFigureQuery),
    responses((status = 200, description = "OK", content(
        (inline(BinaryContent) = "image/svg+xml"),
        (inline(BinaryContent) = "application/pdf"),
        (inline(BinaryContent) = "image/png")
    ))),
    extensions(("x-sql" = json!(["as of curves"])))
)]
pub(super) async fn curves_figure(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<SurfacePath>,
    QueryParams(query): QueryParams<CurvesFigureQuery>,
) -> EndpointAnswer {
    let entries = find_surfaces(&request, &path.surface_id, &query.beside).await?;
    let microphone = query.microphone.as_deref().map(|point| request.parse_microphone(point)).transpose()?;
    let rig = request.catalogue.lake().rig();
    let mut time_ms = Vec::new();
    let mut panels = Vec::new();
    for entry in &entries {
        let over = microphone.map_or(PairSelection::All, PairSelection::Point);
        let set = CurveSet::read_curves(&request, entry, over, query.points.get()).await?;
        let flat_total = total_curve(&set.flat.bands);
        panels.push(NcePanel { title: entry.surface.surface_id.clone(), bands: set.surface.bands, flat_total });
        time_ms = set.time_ms;
    }
    let mut bands = band_labels(rig);
    bands.pop();
    let with_caption = query.frame == FigureFrame::Caption;
    let panel_px = query.width.get() as f32;
    let figure = NceFigure { bands, time_ms, panels, panel_px, columns: COLUMNS, with_caption };
    let point = microphone.and_then(|point| request.catalogue.lake().grid().points().get(point));
    let filter = microphone.map_or_else(String::new, |point| point_filter(&point.to_string()));
    let options: Vec<_> = microphone.iter().map(|point| format!("--microphone {point}")).collect();
    let notes = FigureNotes {
        title: NceFigure::default_title(point.map(|point| point.label()).as_deref()),
        command: figure_command("nce", &entries, &options),
        query: curves_query(rig, &quote_literal(&path.surface_id), &filter),
        ..figure_notes(&request, &entries)
    };
    query.format.write_drawing(&request, figure.draw(&notes)).await
}

/// Two principal components of the map, or its self-organising map.
#[derive(Clone, Copy, Default, Deserialize, ToSchema)]
#[schema(default = "12")]
enum MapAxes {
    #[default]
    #[serde(rename = "12")]
    FirstSecond,
    #[serde(rename = "13")]
    FirstThird,
    #[serde(rename = "23")]
    SecondThird,
    #[serde(rename = "som")]
    Units,
}

impl MapAxes {
    /// The two components; None for the self-organising map.
    fn component_indices(self) -> Option<[usize; 2]> {
        match self {
            Self::FirstSecond => Some([0, 1]),
            Self::FirstThird => Some([0, 2]),
            Self::SecondThird => Some([1, 2]),
            Self::Units => None,
        }
    }

    /// The command that writes the same figure to a file; empty if there is none.
    fn command(self) -> &'static str {
        match self {
            Self::FirstSecond => "echolake figure map",
            Self::Units => "echolake figure som",
            Self::FirstThird | Self::SecondThird => "",
        }
    }
}

/// The contents of a map.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default)]
#[into_params(parameter_in = Query)]
pub(super) struct MapFigureQuery {
    /// Components to the right and upwards, or `som`.
    #[param(inline)]
    axes: MapAxes,
    #[param(inline)]
    format: FigureFormat,
}

/// Surfaces as points, close together if they reflect alike; drawn.
#[utoipa::path(
    get,
    path = "/api/v1/map.svg",
    tag = "catalogue",
    params(MapFigureQuery),
    responses((status = 200, description = "OK", content(
        (inline(BinaryContent) = "image/svg+xml"),
        (inline(BinaryContent) = "application/pdf"),
        (inline(BinaryContent) = "image/png")
    ))),
    extensions(("x-sql" = json!(["as of map"])))
)]
pub(super) async fn map_figure(
    Extension(request): Extension<CatalogueRequest>,
    QueryParams(query): QueryParams<MapFigureQuery>,
) -> EndpointAnswer {
    let summary = request.read_summary().await?;
    let places = surface_positions(&request).await?;
    let placed: Vec<_> =
        places.names.iter().enumerate().filter_map(|(i, name)| Some((i, summary.find_entry(name)?))).collect();
    let surfaces =
        placed.iter().map(|(i, entry)| (*i, entry.surface.surface_id.as_str(), entry.surface.typology.as_str()));
    let entries: Vec<_> = placed.iter().map(|(_, entry)| *entry).collect();
    let figure = match query.axes.component_indices() {
        Some(components) => MapFigure::of_components(&places.components, components, surfaces),
        None => MapFigure::of_units(&places.units, surfaces),
    };
    let notes = FigureNotes {
        title: MapFigure::default_title(entries.len(), LevelReference::FlatBand.unit()),
        command: query.axes.command().to_owned(),
        query: orbit_energies_query(request.catalogue.lake().rig()),
        ..figure_notes(&request, &entries)
    };
    query.format.write_drawing(&request, figure.draw(&notes)).await
}

async fn find_surfaces<'a>(
    request: &'a CatalogueRequest,
    first: &str,
    beside: &[String],
) -> Result<Vec<&'a SurfaceEntry>, RequestFault> {
    if beside.len() >= MOST_SURFACES {
        let text = format!("`beside` is there {} times; hint: {} at most", beside.len(), MOST_SURFACES - 1);
        return Err(RequestFault::bad_request(text));
    }
    let mut entries = vec![request.find_surface(first).await?];
    for name in beside {
        entries.push(request.find_surface(name).await?);
    }
    Ok(entries)
}

/// Returns the command that writes the same figure to a file.
fn figure_command(kind: &str, entries: &[&SurfaceEntry], options: &[String]) -> String {
    let names = entries.iter().map(|entry| entry.surface.surface_id.as_str());
    let words: Vec<_> =
        ["echolake figure", kind].into_iter().chain(names).chain(options.iter().map(String::as_str)).collect();
    words.join(" ")
}

fn figure_notes(request: &CatalogueRequest, entries: &[&SurfaceEntry]) -> FigureNotes {
    let origins = entries.iter().map(|entry| entry.surface.origin.clone());
    FigureNotes::of_lake(lake_version(&request.view.snapshot), origins)
}
