//! The air: over a run, decimated to means, and as a series that answers share.

use axum::Extension;
use echolake_service::RequestFault;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::super::extract::{PathParams, QueryParams, WholeNumber};
use super::content::{AnswerContent, EndpointAnswer};
use super::request::{CatalogueRequest, RunPath, nanos_value, text_value};

/// A reading, or the mean of some.
#[derive(Deserialize)]
pub(super) struct AirReading {
    #[serde(alias = "log_time_ns")]
    ns: i64,
    temperature_c: Option<f64>,
    humidity_pct: Option<f64>,
    pressure_hpa: Option<f64>,
    outside_level_db: Option<f32>,
}

/// Readings over the time since `start`.
#[derive(Serialize, ToSchema)]
#[schema(as = EnvironmentSeries)]
pub(super) struct AirSeries {
    /// Since `start`.
    time_s: Vec<f64>,
    #[schema(format = DateTime)]
    start: String,
    temperature_c: Vec<Option<f64>>,
    humidity_pct: Vec<Option<f64>>,
    pressure_hpa: Vec<Option<f64>>,
    /// The loudest of each interval.
    outside_level_db: Vec<Option<f32>>,
}

impl AirSeries {
    /// Readings beside a time, which is given as a number and as a text.
    pub fn new(rows: Vec<AirReading>, start_ns: i64, start: &str) -> Self {
        let of = |value: fn(&AirReading) -> Option<f64>| rows.iter().map(value).collect();
        Self {
            time_s: rows.iter().map(|r| r.ns.saturating_sub(start_ns) as f64 / 1e9).collect(),
            start: start.to_owned(),
            temperature_c: of(|r| r.temperature_c),
            humidity_pct: of(|r| r.humidity_pct),
            pressure_hpa: of(|r| r.pressure_hpa),
            outside_level_db: rows.iter().map(|r| r.outside_level_db).collect(),
        }
    }
}

#[derive(Deserialize)]
struct TimeSpan {
    first: Option<i64>,
    last: Option<i64>,
    start: Option<String>,
}

const SPAN: &str = "select min(log_time_ns) as first, max(log_time_ns) as last, min(log_time) as start \
    from environment where run_id = $1";
const MEANS: &str = "select min(log_time_ns) as ns, avg(temperature_c) as temperature_c, \
    avg(humidity_pct) as humidity_pct, avg(pressure_hpa) as pressure_hpa, max(outside_level_db) as outside_level_db \
    from environment where run_id = $1 group by (log_time_ns - $2) / $3 order by 1";

/// The number of means.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct EnvironmentQuery {
    #[param(inline)]
    points: WholeNumber<10, 2000, 300>,
}

/// The air over a run, decimated to `points` means; of the outside level, maxima.
#[utoipa::path(
    get,
    path = "/api/v1/runs/{run_id}/environment",
    tag = "runs",
    params(RunPath, EnvironmentQuery),
    responses((status = 200, description = "OK", body = AirSeries)),
    extensions(("x-sql" = json!([
        "select (log_time_ns - $start) / $width as bucket, avg(temperature_c), avg(humidity_pct), avg(pressure_hpa), \
         max(outside_level_db) from environment where run_id = $1 group by 1 order by 1",
    ])))
)]
pub(super) async fn environment(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<RunPath>,
    QueryParams(query): QueryParams<EnvironmentQuery>,
) -> EndpointAnswer {
    let run = request.find_run(&path.run_id)?.run.to_string();
    let span: Vec<TimeSpan> = request.read_rows(SPAN, vec![text_value(&run)]).await?;
    let none = || RequestFault::NoData {
        what: format!("run `{run}`"),
        data: "readings of the air",
        hint: "imports may have none",
    };
    let Some(TimeSpan { first: Some(first), last: Some(last), start: Some(start) }) = span.into_iter().next() else {
        return Err(none().into());
    };
    // One more than the last falls into the last interval too.
    let width = (last.saturating_sub(first) / query.points.get() as i64).saturating_add(1);
    let rows = request.read_rows(MEANS, vec![text_value(&run), nanos_value(first), nanos_value(width)]).await?;
    Ok(AnswerContent::encode_json(&AirSeries::new(rows, first, &start))?)
}
