//! `GET /api/v1/correlations`: how the reliefs' parameters and the bands' levels go together.

use std::collections::BTreeMap;

use axum::Extension;
use echolake_dsp::significance::{CorrelationCell, FALSE_DISCOVERY_RATE, LEAST_VALUES, test_correlations};
use echolake_service::RequestFault;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::{IntoParams, ToSchema};

use super::super::extract::QueryParams;
use super::content::{AnswerContent, EndpointAnswer};
use super::request::CatalogueRequest;
use super::snapshot::summary::SurfaceEntry;

/// Parameters that are answered.
const MOST: usize = 500;
/// A parameter without meaning for the shape of a relief.
const SEED: &str = "seed";

/// Correlations of parameters and levels.
#[derive(Serialize, ToSchema)]
#[schema(as = Correlations)]
struct CorrelationTable {
    /// Correlations of fewer surfaces are null.
    least_surfaces: usize,
    /// Share of chance findings that is accepted among the findings of the table.
    false_discovery_rate: f64,
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
    /// Surfaces that have both.
    n: usize,
    /// Pearson's coefficient.
    r: Option<f64>,
    /// 95 % interval of `r`, by Fisher's z.
    r_low: Option<f64>,
    r_high: Option<f64>,
    /// Probability that chance makes an `r` of this size or greater.
    p: Option<f64>,
    /// `p` adjusted for all correlations of the table, by Benjamini and Hochberg.
    adjusted_p: Option<f64>,
    /// Spearman's coefficient, which is Pearson's of the ranks.
    rank_r: Option<f64>,
    rank_p: Option<f64>,
    rank_adjusted_p: Option<f64>,
    /// Both adjusted p values are at most `false_discovery_rate`: chance does not explain it.
    beyond_chance: bool,
}

impl BandCorrelation {
    fn new(parameter: &str, band: &str, cell: &CorrelationCell) -> Self {
        Self {
            parameter: parameter.to_owned(),
            unit: parameter_unit(parameter),
            band: band.to_owned(),
            n: cell.count,
            r: cell.linear.map(|test| test.coefficient),
            r_low: cell.interval.map(|[low, _]| low),
            r_high: cell.interval.map(|[_, high]| high),
            p: cell.linear.map(|test| test.p_value),
            adjusted_p: cell.linear.map(|test| test.adjusted_p),
            rank_r: cell.rank.map(|test| test.coefficient),
            rank_p: cell.rank.map(|test| test.p_value),
            rank_adjusted_p: cell.rank.map(|test| test.adjusted_p),
            beyond_chance: cell.is_beyond_chance(),
        }
    }
}

/// The surfaces that correlations are of.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct CorrelationsQuery {
    typology: Vec<String>,
}

/// Correlations of every numeric geometric parameter with every band's level against Flat, and what of them chance
/// explains: of 15 parameters and 6 bands of 8 surfaces chance alone makes an r of 0.85.
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
    let parameters = parameter_columns(&chosen);
    let mut names = Vec::new();
    let mut columns = Vec::new();
    for (parameter, values) in &parameters {
        for (b, band) in summary.bands.iter().enumerate() {
            let both = values.iter().filter_map(|(i, value)| Some((*value, chosen[*i].surface.against_flat_db[b]?)));
            let (x, y): (Vec<_>, Vec<_>) = both.unzip();
            names.push((parameter.as_str(), band.key.as_str()));
            columns.push([x, y]);
        }
    }
    let cells = test_correlations(&columns).map_err(RequestFault::defect("columns are not equally long"))?;
    let items = names.into_iter().zip(&cells);
    Ok(AnswerContent::encode_json(&CorrelationTable {
        least_surfaces: LEAST_VALUES,
        false_discovery_rate: FALSE_DISCOVERY_RATE,
        items: items.map(|((parameter, band), cell)| BandCorrelation::new(parameter, band, cell)).collect(),
        surfaces: chosen.len(),
    })?)
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
