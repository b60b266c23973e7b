//! Runs: a page of them, and one with topics and sizes, quality, repeats and log.

use axum::Extension;
use datafusion::common::ScalarValue;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::super::extract::{PathParams, QueryParams, WholeNumber};
use super::content::{AnswerContent, EndpointAnswer};
use super::request::{CatalogueRequest, RunPath, missing_item, text_value};

/// Lines of a run's log that are answered.
const MOST_EVENTS: usize = 200;

/// A run.
#[derive(Deserialize, Serialize, ToSchema)]
#[schema(as = Run)]
struct RunRecord {
    surface_id: String,
    run_id: String,
    state: String,
    missing: String,
    origin: String,
    rig: String,
    #[schema(format = DateTime)]
    started: String,
    #[schema(format = DateTime)]
    ended: String,
    measurements: i64,
    rejected: i64,
    attempts: i64,
    damaged: i64,
    temperature_min_c: Option<f32>,
    temperature_max_c: Option<f32>,
    humidity_min_pct: Option<f32>,
    humidity_max_pct: Option<f32>,
    pressure_min_hpa: Option<f32>,
    pressure_max_hpa: Option<f32>,
    file: String,
    file_bytes: i64,
    file_sha256: String,
    recorded_by: String,
    flat_version: Option<String>,
    foam_version: Option<String>,
    code_version: String,
}

/// A log message of a run.
#[derive(Deserialize, Serialize, ToSchema)]
#[schema(as = Event)]
pub(super) struct RunLogEntry {
    #[schema(format = DateTime)]
    log_time: String,
    level: String,
    name: String,
    message: String,
}

const COLUMNS: &str = "surface_id, run_id, state, missing, origin, rig, started, ended, measurements, rejected, \
    attempts, damaged, temperature_min_c, temperature_max_c, humidity_min_pct, humidity_max_pct, pressure_min_hpa, \
    pressure_max_hpa, file, file_bytes, file_sha256, recorded_by, flat_version, foam_version, code_version";
/// An empty text switches its condition off.
const CHOSEN: &str = "($1 = '' or strpos(lower(concat(run_id, ' ', surface_id, ' ', state)), $1) > 0) \
    and ($2 = '' or surface_id = $2) and ($3 = '' or state = $3)";

/// Filters, order and part of a page of runs.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct RunsQuery {
    /// Text in id, surface and state.
    q: String,
    surface_id: String,
    state: String,
    #[param(inline)]
    sort: RunSort,
    #[param(inline)]
    order: RunDirection,
    #[param(inline)]
    offset: WholeNumber<0, { usize::MAX }, 0>,
    #[param(inline)]
    limit: WholeNumber<1, 500, 100>,
}

#[derive(Clone, Copy, Default, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(default = "started")]
enum RunSort {
    #[default]
    Started,
    RunId,
    SurfaceId,
    State,
    Duration,
    Measurements,
    /// Attempts beyond the measurements.
    Repeats,
    Attempts,
    Damaged,
    Temperature,
    FileBytes,
}

impl RunSort {
    fn sort_expression(self) -> &'static str {
        match self {
            Self::Started => "started_ns",
            Self::RunId => "run_id",
            Self::SurfaceId => "surface_id",
            Self::State => "state",
            Self::Duration => "ended_ns - started_ns",
            Self::Measurements => "measurements",
            Self::Repeats => "attempts - measurements",
            Self::Attempts => "attempts",
            Self::Damaged => "damaged",
            Self::Temperature => "temperature_min_c",
            Self::FileBytes => "file_bytes",
        }
    }
}

#[derive(Clone, Copy, Default, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(default = "desc")]
enum RunDirection {
    #[default]
    Desc,
    Asc,
}

/// A page of runs.
#[derive(Serialize, ToSchema)]
struct RunPage {
    total: i64,
    offset: usize,
    items: Vec<RunRecord>,
}

#[derive(Deserialize)]
struct RunCount {
    total: i64,
}

/// A page of runs, the newest first.
#[utoipa::path(
    get,
    path = "/api/v1/runs",
    tag = "runs",
    params(RunsQuery),
    responses((status = 200, description = "OK", body = RunPage)),
    extensions(("x-sql" = json!(["select * from runs order by started_ns desc"])))
)]
pub(super) async fn runs(
    Extension(request): Extension<CatalogueRequest>,
    QueryParams(query): QueryParams<RunsQuery>,
) -> EndpointAnswer {
    let column = query.sort.sort_expression();
    let order = match query.order {
        RunDirection::Desc => "desc",
        RunDirection::Asc => "asc",
    };
    let chosen = vec![text_value(&query.q.to_lowercase()), text_value(&query.surface_id), text_value(&query.state)];
    let page = format!(
        "select {COLUMNS} from runs where {CHOSEN} order by {column} {order} nulls last, run_id limit $5 offset $4"
    );
    let count = format!("select count(*) as total from runs where {CHOSEN}");
    let whole = |n: usize| ScalarValue::Int64(Some(i64::try_from(n).unwrap_or(i64::MAX)));
    let part = [whole(query.offset.get()), whole(query.limit.get())];
    let values = chosen.iter().cloned().chain(part).collect();
    let (items, total) =
        tokio::try_join!(request.read_rows::<RunRecord>(&page, values), request.read_rows::<RunCount>(&count, chosen))?;
    let total = total.first().map_or(0, |c| c.total);
    Ok(AnswerContent::encode_json(&RunPage { total, offset: query.offset.get(), items })?)
}

/// One run.
#[derive(Serialize, ToSchema)]
struct RunDetail {
    run: RunRecord,
    topics: Vec<RunTopic>,
    attachments: Vec<RunAttachment>,
    quality: Vec<QualityCount>,
    repeats: Vec<AttemptCount>,
    /// In the order of time, at most 200: warnings and errors before others.
    events: Vec<RunLogEntry>,
}

/// A topic of a run.
#[derive(Serialize, ToSchema)]
#[schema(as = Topic)]
struct RunTopic {
    topic: String,
    schema: String,
    encoding: String,
    messages: u64,
    /// Of the messages before compression, from the message index.
    bytes: Option<u64>,
}

/// A file within a run's file.
#[derive(Serialize, ToSchema)]
struct RunAttachment {
    name: String,
    media_type: String,
    bytes: u64,
}

/// Measurements with a flag.
#[derive(Serialize, ToSchema)]
#[schema(as = Quality)]
struct QualityCount {
    flag: &'static str,
    label: String,
    measurements: i64,
}

/// Measurements that took this attempt.
#[derive(Deserialize, Serialize, ToSchema)]
struct AttemptCount {
    attempt: i64,
    measurements: i64,
}

#[derive(Deserialize)]
struct QualityFlags {
    clipped: i64,
    snr: i64,
    arrival: i64,
    outside: i64,
}

const REPEATS: &str = "select attempt, count(*) as measurements from measurements where run_id = $1 \
    group by attempt order by attempt";
const FLAGS: &str = "select count(*) filter (where clipped_samples > 0) as clipped, \
    count(*) filter (where snr_db < $2) as snr, count(*) filter (where abs(arrival_error_us) > $3) as arrival, \
    count(*) filter (where outside_level_db > $4) as outside from measurements where run_id = $1";

/// One run: topics and sizes from the file's summary, quality flags, repeats, log.
#[utoipa::path(
    get,
    path = "/api/v1/runs/{run_id}",
    tag = "runs",
    params(RunPath),
    responses((status = 200, description = "OK", body = RunDetail)),
    extensions(("x-sql" = json!([
        "select * from runs where run_id = $1",
        "select attempt, count(*) from measurements where run_id = $1 group by attempt",
        "select count(*) filter (where clipped_samples > 0), count(*) filter (where snr_db < 30), count(*) filter \
         (where abs(arrival_error_us) > 20), count(*) filter (where outside_level_db > 65) from measurements where \
         run_id = $1 (limits: [rig.validation])",
        "select * from (select * from events where run_id = $1 order by level = 'info', log_time_ns limit 200) \
         order by log_time_ns",
    ])))
)]
pub(super) async fn run(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<RunPath>,
) -> EndpointAnswer {
    let visible = request.find_run(&path.run_id)?.clone();
    let id = text_value(visible.run.as_str());
    let limits = &request.catalogue.lake().rig().validation;
    let real = |value: f64| ScalarValue::Float64(Some(value));
    let flags = vec![id.clone(), real(limits.snr_db), real(limits.arrival_us), real(limits.outside_level_db)];
    let one = format!("select {COLUMNS} from runs where run_id = $1");
    let log = format!(
        "select log_time, level, name, message from (select * from events where run_id = $1 \
         order by level in ('debug', 'info', 'unknown'), log_time_ns limit {MOST_EVENTS}) order by log_time_ns"
    );
    let session = request.view.session.clone();
    let service = request.catalogue.service();
    let (contents, run, repeats, flags, events) = tokio::try_join!(
        service.plan_query(request.view.session.client(), async move { Ok(session.read_contents(&visible).await?) }),
        request.read_rows::<RunRecord>(&one, vec![id.clone()]),
        request.read_rows::<AttemptCount>(REPEATS, vec![id.clone()]),
        request.read_rows::<QualityFlags>(FLAGS, flags),
        request.read_rows::<RunLogEntry>(&log, vec![id.clone()]),
    )?;
    let run = run.into_iter().next().ok_or_else(|| missing_item("this run".into(), "ask again"))?;
    let topic = |t: echolake_query::Topic| RunTopic {
        topic: t.topic,
        schema: t.schema,
        encoding: t.encoding,
        messages: t.messages.unwrap_or(0),
        bytes: t.bytes,
    };
    let attachment =
        |a: echolake_query::Attachment| RunAttachment { name: a.name, media_type: a.media_type, bytes: a.bytes };
    Ok(AnswerContent::encode_json(&RunDetail {
        run,
        topics: contents.topics.into_iter().map(topic).collect(),
        attachments: contents.attachments.into_iter().map(attachment).collect(),
        quality: flags.first().map_or_else(Vec::new, |flags| quality_counts(flags, limits)),
        repeats,
        events,
    })?)
}

fn quality_counts(flags: &QualityFlags, limits: &echolake_schema::rig::Validation) -> Vec<QualityCount> {
    let flag = |flag, label, measurements| QualityCount { flag, label, measurements };
    vec![
        flag("clipped", "clipped samples".to_owned(), flags.clipped),
        flag("snr", format!("signal to noise below {} dB", limits.snr_db), flags.snr),
        flag("arrival", format!("arrival off by more than {} \u{b5}s", limits.arrival_us), flags.arrival),
        flag("outside", format!("over {} dB outside", limits.outside_level_db), flags.outside),
    ]
}
