//! Runs: a page of them, and one with topics and sizes, quality, repeats and log.

use datafusion::common::ScalarValue;
use serde::{Deserialize, Serialize};

use super::asked::{CatalogueRequest, missing, text};
use super::content::AnswerContent;
use crate::fault::RequestFault;

/// Lines of a run's log that are answered.
const MOST_EVENTS: usize = 200;

#[derive(Deserialize, Serialize)]
struct RunRecord {
    surface_id: String,
    run_id: String,
    state: String,
    missing: String,
    origin: String,
    rig: String,
    started: String,
    ended: String,
    measurements: i64,
    rejected: i64,
    attempts: i64,
    damaged: i64,
    temperature_min_c: Option<f64>,
    temperature_max_c: Option<f64>,
    humidity_min_pct: Option<f64>,
    humidity_max_pct: Option<f64>,
    pressure_min_hpa: Option<f64>,
    pressure_max_hpa: Option<f64>,
    file: String,
    file_bytes: i64,
    file_sha256: String,
    recorded_by: String,
    flat_version: Option<String>,
    foam_version: Option<String>,
    code_version: String,
}

/// A log message of a run.
#[derive(Deserialize, Serialize)]
pub(super) struct RunLogEntry {
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

#[derive(Serialize)]
struct RunPage {
    total: i64,
    offset: usize,
    items: Vec<RunRecord>,
}

#[derive(Deserialize)]
struct RunCount {
    total: i64,
}

/// A page of runs, the newest first by default.
pub(super) async fn runs(asked: CatalogueRequest) -> Result<AnswerContent, RequestFault> {
    let params = &asked.params;
    let column = match params.choice("sort", &["started", "surface_id", "attempts", "file_bytes"])? {
        "started" => "started_ns",
        other => other,
    };
    let order = params.choice("order", &["desc", "asc"])?;
    let offset = params.whole("offset", 0..=usize::MAX)?.unwrap_or(0);
    let limit = params.whole("limit", 1..=500)?.unwrap_or(100);
    let one = |name| Ok::<_, RequestFault>(params.one(name)?.unwrap_or_default());
    let chosen = vec![text(&one("q")?.to_lowercase()), text(one("surface_id")?), text(one("state")?)];
    let page =
        format!("select {COLUMNS} from runs where {CHOSEN} order by {column} {order}, run_id limit $5 offset $4");
    let count = format!("select count(*) as total from runs where {CHOSEN}");
    let whole = |n: usize| ScalarValue::Int64(Some(i64::try_from(n).unwrap_or(i64::MAX)));
    let values = chosen.iter().cloned().chain([whole(offset), whole(limit)]).collect();
    let (items, total) =
        tokio::try_join!(asked.rows::<RunRecord>(&page, values), asked.rows::<RunCount>(&count, chosen))?;
    AnswerContent::json(&RunPage { total: total.first().map_or(0, |c| c.total), offset, items })
}

#[derive(Serialize)]
struct RunDetail {
    run: RunRecord,
    topics: Vec<RunTopic>,
    attachments: Vec<RunAttachment>,
    quality: Vec<QualityCount>,
    repeats: Vec<AttemptCount>,
    events: Vec<RunLogEntry>,
}

#[derive(Serialize)]
struct RunTopic {
    topic: String,
    schema: String,
    encoding: String,
    messages: u64,
    bytes: Option<u64>,
}

#[derive(Serialize)]
struct RunAttachment {
    name: String,
    media_type: String,
    bytes: u64,
}

#[derive(Serialize)]
struct QualityCount {
    flag: &'static str,
    label: String,
    measurements: i64,
}

#[derive(Deserialize, Serialize)]
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

/// One run.
pub(super) async fn run(asked: CatalogueRequest) -> Result<AnswerContent, RequestFault> {
    let visible = asked.run()?.clone();
    let id = text(visible.run.as_str());
    let limits = &asked.catalogue.lake().rig().validation;
    let real = |value: f64| ScalarValue::Float64(Some(value));
    let flags = vec![id.clone(), real(limits.snr_db), real(limits.arrival_us), real(limits.outside_level_db)];
    let one = format!("select {COLUMNS} from runs where run_id = $1");
    let log = format!(
        "select log_time, level, name, message from events where run_id = $1 \
         order by level in ('debug', 'info', 'unknown'), log_time_ns limit {MOST_EVENTS}"
    );
    let (session, service) = (asked.view.session.clone(), asked.catalogue.service());
    let (contents, run, repeats, flags, events) = tokio::try_join!(
        service.plan(asked.view.session.client(), async move { Ok(session.contents(&visible).await?) }),
        asked.rows::<RunRecord>(&one, vec![id.clone()]),
        asked.rows::<AttemptCount>(REPEATS, vec![id.clone()]),
        asked.rows::<QualityFlags>(FLAGS, flags),
        asked.rows::<RunLogEntry>(&log, vec![id.clone()]),
    )?;
    let run = run.into_iter().next().ok_or_else(|| missing("this run".into(), "ask again"))?;
    let topic = |t: echolake_query::Topic| RunTopic {
        topic: t.topic,
        schema: t.schema,
        encoding: t.encoding,
        messages: t.messages.unwrap_or(0),
        bytes: t.bytes,
    };
    let attachment =
        |a: echolake_query::Attachment| RunAttachment { name: a.name, media_type: a.media_type, bytes: a.bytes };
    AnswerContent::json(&RunDetail {
        run,
        topics: contents.topics.into_iter().map(topic).collect(),
        attachments: contents.attachments.into_iter().map(attachment).collect(),
        quality: flags.first().map_or_else(Vec::new, |flags| quality(flags, limits)),
        repeats,
        events,
    })
}

fn quality(flags: &QualityFlags, limits: &echolake_schema::rig::Validation) -> Vec<QualityCount> {
    let flag = |flag, label, measurements| QualityCount { flag, label, measurements };
    vec![
        flag("clipped", "clipped samples".to_owned(), flags.clipped),
        flag("snr", format!("signal to noise below {} dB", limits.snr_db), flags.snr),
        flag("arrival", format!("arrival off by more than {} \u{b5}s", limits.arrival_us), flags.arrival),
        flag("outside", format!("over {} dB outside", limits.outside_level_db), flags.outside),
    ]
}
