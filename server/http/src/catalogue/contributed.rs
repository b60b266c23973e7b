//! Contributions of users about a run or a pair: annotations, and predictions of models beside the measurements.

use axum::Extension;
use datafusion::scalar::ScalarValue;
use echolake_query::figure_rows::{TOTAL_BAND, band_list, levels_db};
use echolake_schema::Rig;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::super::extract::{PathParams, QueryParams};
use super::content::{AnswerContent, EndpointAnswer};
use super::pair::PairPath;
use super::request::{CatalogueRequest, RunPath, SurfacePath, number_value, text_value};

/// The pair whose annotations are wanted.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct AnnotationParams {
    /// Leaves out annotations on other pairs.
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    #[param(value_type = Option<usize>)]
    pair: Option<String>,
}

/// Annotations on a run, the newest first, 200 at most.
#[derive(Serialize, ToSchema)]
struct RunAnnotations {
    /// All annotations on the run, or on the pair.
    total: i64,
    /// Measurements of the run, or of the pair, that the last verdict rejects. Views leave them out.
    rejected: i64,
    annotations: Vec<ShownAnnotation>,
}

/// An annotation.
#[derive(Deserialize, Serialize, ToSchema)]
struct ShownAnnotation {
    annotation_id: String,
    /// label, verdict or note.
    kind: String,
    value: String,
    comment: String,
    author: String,
    #[schema(format = DateTime)]
    annotated: String,
    lake_version: Option<i64>,
    /// Pairs that are meant; null for the whole run.
    pairs: Option<i64>,
}

#[derive(Deserialize)]
struct TotalCount {
    total: i64,
}

/// Predictions of models for a pair.
#[derive(Deserialize, Serialize, ToSchema)]
struct PairPrediction {
    model: String,
    model_version: String,
    author: String,
    #[schema(format = DateTime)]
    predicted: String,
    /// dB re Flat total. One value per band in the order of `lake.bands`, the total last; null if it was not predicted.
    tnce_db: Vec<Option<f64>>,
    /// dB re Flat, same band.
    tnce_band_db: Vec<Option<f64>>,
}

/// The error of a model's predictions over the pairs of a surface, against its newest run.
#[derive(Deserialize, Serialize, ToSchema)]
struct SurfacePrediction {
    model: String,
    model_version: String,
    author: String,
    pairs: i64,
    /// Root mean square of predicted less measured level, dB re Flat total, by band as `tnce_db` of a pair; null if it
    /// was not predicted.
    rms_db: Vec<Option<f64>>,
    /// The same of levels over Flat's same band.
    rms_band_db: Vec<Option<f64>>,
}

const SHOWN: &str = "select annotation_id, kind, value, comment, author, annotated, lake_version, \
    cast(cardinality(pair_ids) as bigint) as pairs from annotations \
    where run_id = $1 and ($2 is null or pair_ids is null or array_has(pair_ids, $2)) \
    order by annotated desc, annotation_id limit 200";
const TOTAL: &str = "select count(*) as total from annotations \
    where run_id = $1 and ($2 is null or pair_ids is null or array_has(pair_ids, $2))";
const REJECTED: &str = "select count(*) as total from measurements \
    where run_id = $1 and ($2 is null or pair_id = $2) and is_rejected(run_id, pair_id)";

/// Annotations of users on a run, and how many of its measurements are rejected.
#[utoipa::path(
    get,
    path = "/api/v1/runs/{run_id}/annotations",
    tag = "runs",
    params(RunPath, AnnotationParams),
    responses((status = 200, description = "OK", body = RunAnnotations)),
    extensions(("x-sql" = json!([
        "select * from annotations where run_id = $1 and ($pair is null or pair_ids is null or array_has(pair_ids, \
         $pair)) order by annotated desc limit 200",
        "select count(*) from measurements where run_id = $1 and is_rejected(run_id, pair_id)",
    ])))
)]
pub(super) async fn run_annotations(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<RunPath>,
    QueryParams(params): QueryParams<AnnotationParams>,
) -> EndpointAnswer {
    let run = text_value(request.find_run(&path.run_id)?.run.as_str());
    let pair = params.pair.map(|pair| request.parse_pair(&pair)).transpose()?;
    let values = vec![run, pair.map_or(ScalarValue::Int32(None), number_value)];
    let (annotations, total, rejected) = tokio::try_join!(
        request.read_rows::<ShownAnnotation>(SHOWN, values.clone()),
        request.read_rows::<TotalCount>(TOTAL, values.clone()),
        request.read_rows::<TotalCount>(REJECTED, values),
    )?;
    let count = |rows: Vec<TotalCount>| rows.first().map_or(0, |row| row.total);
    Ok(AnswerContent::encode_json(&RunAnnotations { total: count(total), rejected: count(rejected), annotations })?)
}

/// Predictions of models for one pair of a surface.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/pairs/{pair_id}/predictions",
    tag = "catalogue",
    params(PairPath),
    responses((status = 200, description = "OK", body = Vec<PairPrediction>)),
    extensions(("x-sql" = json!([
        "select * from predictions where surface_id = $1 and pair_id = $2 and project is not distinct from $project",
    ])))
)]
pub(super) async fn pair_predictions(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<PairPath>,
) -> EndpointAnswer {
    let surface = &request.find_surface(&path.surface_id).await?.surface;
    let project = project_value(&request, surface.run_id.as_deref());
    let surface = text_value(&surface.surface_id);
    let pair = number_value(request.parse_pair(&path.pair_id)?);
    let rig = request.catalogue.lake().rig();
    let sql = format!(
        "select model, model_version, author, predicted, {} as tnce_db, {} as tnce_band_db from predictions \
         where surface_id = $1 and pair_id = $2 and project is not distinct from $3 \
         order by model, predicted",
        band_list(rig, over_total),
        band_list(rig, over_band)
    );
    let mut predictions: Vec<PairPrediction> = request.read_rows(&sql, vec![surface, pair, project]).await?;
    for prediction in &mut predictions {
        // They are stored as ratios.
        prediction.tnce_db = levels_db(&prediction.tnce_db);
        prediction.tnce_band_db = levels_db(&prediction.tnce_band_db);
    }
    Ok(AnswerContent::encode_json(&predictions)?)
}

/// Models that predict a surface, with their errors.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/predictions",
    tag = "catalogue",
    params(SurfacePath),
    responses((status = 200, description = "OK", body = Vec<SurfacePrediction>)),
    extensions(("x-sql" = json!([
        "select p.model, p.model_version, sqrt(avg(power(10 * log10(p.tnce_band_2500 / t.tnce_band_2500), 2))), ... \
         from predictions p join tnce t using (surface_id, pair_id) where p.surface_id = $1 and p.project is not \
         distinct from $project and t.run_id = $newest and not is_rejected(t.run_id, t.pair_id) group by p.model, \
         p.model_version"
    ])))
)]
pub(super) async fn surface_predictions(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<SurfacePath>,
) -> EndpointAnswer {
    let surface = &request.find_surface(&path.surface_id).await?.surface;
    let sql = error_sql(request.catalogue.lake().rig());
    let project = project_value(&request, surface.run_id.as_deref());
    let run = ScalarValue::Utf8(surface.run_id.clone());
    let values = vec![text_value(&surface.surface_id), run, project];
    let rows: Vec<SurfacePrediction> = request.read_rows(&sql, values).await?;
    Ok(AnswerContent::encode_json(&rows)?)
}

// The project of the surface's run: another project may have a surface of the same name.
fn project_value(request: &CatalogueRequest, run: Option<&str>) -> ScalarValue {
    let run = run.and_then(|run| run.parse().ok());
    ScalarValue::Utf8(run.and_then(|run| request.view.snapshot.project_of(&run)).map(ToString::to_string))
}

// No energy has no level, and no error.
fn error_sql(rig: &Rig) -> String {
    let rms =
        |column: String| format!("sqrt(avg(power(10 * log10(nullif(p.{column}, 0) / nullif(t.{column}, 0)), 2)))");
    format!(
        "select p.model as model, p.model_version as model_version, max(p.author) as author, count(*) as pairs, \
         {} as rms_db, {} as rms_band_db from predictions p join tnce t on t.surface_id = p.surface_id and \
         t.pair_id = p.pair_id where p.surface_id = $1 and t.run_id = $2 and not is_rejected(t.run_id, t.pair_id) \
         and (p.project is not distinct from $3) group by p.model, p.model_version order by p.model, p.model_version",
        band_list(rig, |band| rms(over_total(band))),
        band_list(rig, |band| rms(over_band(band)))
    )
}

fn over_total(band: &str) -> String {
    format!("tnce_{band}")
}

fn over_band(band: &str) -> String {
    if band == TOTAL_BAND { over_total(band) } else { format!("tnce_band_{band}") }
}
