//! `GET /api/v1/correlations`: how the reliefs' parameters and the bands' levels go together.

use std::collections::BTreeMap;

use axum::Extension;
use echolake_dsp::correlation::pearson;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::{IntoParams, ToSchema};

use super::super::extract::QueryParams;
use super::content::{AnswerContent, EndpointAnswer};
use super::request::CatalogueRequest;
use super::snapshot::summary::SurfaceEntry;

/// Fewer surfaces have no meaningful correlation: two are always on a line.
const LEAST: usize = 3;
/// Parameters that are answered.
const MOST: usize = 500;
/// A parameter without meaning for the shape of a relief.
const SEED: &str = "seed";

/// Correlations of parameters and levels.
#[derive(Serialize, ToSchema)]
#[schema(as = Correlations)]
struct CorrelationTable {
    method: &'static str,
    items: Vec<BandCorrelation>,
    surfaces: usize,
}

/// The correlation of a parameter with the level of a band.
#[derive(Serialize, ToSchema)]
#[schema(as = Correlation)]
struct BandCorrelation {
    parameter: String,
    unit: &'static str,
    band: String,
    r: Option<f64>,
    n: usize,
}

/// The surfaces that correlations are of.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct CorrelationsQuery {
    typology: Vec<String>,
}

/// Pearson's r of every numeric geometric parameter with every band's level against Flat.
#[utoipa::path(
    get,
    path = "/api/v1/correlations",
    tag = "catalogue",
    params(CorrelationsQuery),
    responses((status = 200, description = "OK", body = CorrelationTable)),
    extensions(("x-sql" = json!([
        "select surface_id, parameters, relief_rms_mm, relief_max_mm - relief_min_mm, reflection_factor from \
         surfaces where typology <> 'reference', joined with the summary of /surfaces",
    ])))
)]
pub(super) async fn correlations(
    Extension(request): Extension<CatalogueRequest>,
    QueryParams(query): QueryParams<CorrelationsQuery>,
) -> EndpointAnswer {
    let summary = request.read_summary().await?;
    let is_chosen = |entry: &&SurfaceEntry| {
        let typology = entry.surface.typology.as_str();
        !entry.surface.is_reference()
            && (query.typology.is_empty() || query.typology.iter().any(|chosen| chosen == typology))
    };
    let chosen: Vec<_> = summary.entries.iter().filter(is_chosen).collect();
    let mut items = Vec::new();
    for (parameter, values) in parameter_columns(&chosen) {
        for (b, band) in summary.bands.iter().enumerate() {
            let both = values.iter().filter_map(|(i, value)| Some((*value, chosen[*i].surface.against_flat_db[b]?)));
            let (x, y): (Vec<_>, Vec<_>) = both.unzip();
            // They are equally long.
            let r = if x.len() < LEAST { None } else { pearson(&x, &y).unwrap_or(None) };
            let unit = parameter_unit(&parameter);
            items.push(BandCorrelation { parameter: parameter.clone(), unit, band: band.key.clone(), r, n: x.len() });
        }
    }
    Ok(AnswerContent::encode_json(&CorrelationTable { method: "pearson", items, surfaces: chosen.len() })?)
}

// Each parameter's values, with the surface that has them.
fn parameter_columns(chosen: &[&SurfaceEntry]) -> BTreeMap<String, Vec<(usize, f64)>> {
    let mut columns: BTreeMap<String, Vec<(usize, f64)>> = BTreeMap::new();
    for (i, entry) in chosen.iter().enumerate() {
        let own = [
            ("relief_rms_mm", entry.surface.relief_rms_mm),
            ("relief_range_mm", entry.relief_range_mm()),
            ("reflection_factor", entry.reflection_factor),
        ];
        let given = entry.parameters.iter().map(|(name, value)| (name.as_str(), Value::as_f64(value)));
        for (name, value) in own.into_iter().chain(given.filter(|(name, _)| *name != SEED)) {
            if let Some(value) = value.filter(|v| v.is_finite())
                && (columns.len() < MOST || columns.contains_key(name))
            {
                let column = columns.entry(name.to_owned()).or_default();
                // A parameter of one of our own names does not count twice.
                if column.last().is_none_or(|(last, _)| *last != i) {
                    column.push((i, value));
                }
            }
        }
    }
    columns
}

fn parameter_unit(parameter: &str) -> &'static str {
    match parameter.rsplit('_').next() {
        Some("mm") => "mm",
        Some("deg") => "deg",
        _ => "1",
    }
}
