//! The air: over a run, decimated to means, and as a series that answers share.

use serde::{Deserialize, Serialize};

use super::asked::{CatalogueRequest, long, text};
use super::content::AnswerContent;
use crate::fault::RequestFault;

/// A reading, or the mean of some.
#[derive(Deserialize)]
pub(super) struct AirReading {
    ns: i64,
    temperature_c: Option<f64>,
    humidity_pct: Option<f64>,
    pressure_hpa: Option<f64>,
    outside_level_db: Option<f64>,
}

/// Readings over the time since `start`.
#[derive(Serialize)]
pub(super) struct AirSeries {
    time_s: Vec<f64>,
    start: String,
    temperature_c: Vec<Option<f64>>,
    humidity_pct: Vec<Option<f64>>,
    pressure_hpa: Vec<Option<f64>>,
    outside_level_db: Vec<Option<f64>>,
}

impl AirSeries {
    /// Readings beside a time, which is given as a number and as a text.
    pub(super) fn new(rows: Vec<AirReading>, start_ns: i64, start: &str) -> Self {
        let of = |value: fn(&AirReading) -> Option<f64>| rows.iter().map(value).collect();
        Self {
            time_s: rows.iter().map(|r| r.ns.saturating_sub(start_ns) as f64 / 1e9).collect(),
            start: start.to_owned(),
            temperature_c: of(|r| r.temperature_c),
            humidity_pct: of(|r| r.humidity_pct),
            pressure_hpa: of(|r| r.pressure_hpa),
            outside_level_db: of(|r| r.outside_level_db),
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

/// `GET /api/v1/runs/{run_id}/environment`: means of up to `points` intervals, of the outside level the maxima.
pub(super) async fn environment(asked: CatalogueRequest) -> Result<AnswerContent, RequestFault> {
    let run = asked.run()?.run.to_string();
    let points = asked.params.whole("points", 10..=2000)?.unwrap_or(300);
    let span: Vec<TimeSpan> = asked.rows(SPAN, vec![text(&run)]).await?;
    let none = || RequestFault::NoData {
        what: format!("run `{run}`"),
        data: "readings of the air",
        hint: "imports may have none",
    };
    let Some(TimeSpan { first: Some(first), last: Some(last), start: Some(start) }) = span.into_iter().next() else {
        return Err(none());
    };
    // One more than the last falls into the last interval too.
    let width = (last.saturating_sub(first) / points as i64).saturating_add(1);
    let rows = asked.rows(MEANS, vec![text(&run), long(first), long(width)]).await?;
    AnswerContent::json(&AirSeries::new(rows, first, &start))
}
