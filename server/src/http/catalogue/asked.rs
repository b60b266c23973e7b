//! A request to an endpoint, and its queries of the lake: values are bound or validated, never part of a text.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::record_batch::RecordBatch;
use datafusion::common::{ParamValues, ScalarValue};
use echolake_lake::VisibleRun;
use echolake_query::output::AnswerFormat;
use echolake_schema::{RunId, SurfaceId};
use serde::de::DeserializeOwned;

use super::super::format::FormatEncoder;
use super::LakeCatalogue;
use super::map::SurfacePositions;
use super::params::RequestParams;
use super::summary::{CatalogueSummary, SurfaceEntry};
use super::view::SnapshotView;
use crate::fault::RequestFault;
use crate::metrics::ServerProtocol;
use crate::running::{AnswerEncoder, BatchEncoder, RunningQuery, StopSignal};
use crate::service::{QueryJob, QueryWork};

/// Bytes of one query's rows, as JSON; the largest that endpoints ask for are a run's events or a few responses.
const MOST_BYTES: usize = 64 << 20;

/// A request to an endpoint.
pub(in super::super) struct CatalogueRequest {
    pub(super) catalogue: LakeCatalogue,
    pub(super) view: Arc<SnapshotView>,
    /// The path's parts that have a name.
    pub(super) path: HashMap<String, String>,
    pub(super) params: RequestParams,
    /// True if an Arrow stream is preferred to JSON.
    pub(super) as_arrow: bool,
}

/// A text, to be bound.
pub(in super::super) fn text(value: &str) -> ScalarValue {
    ScalarValue::Utf8(Some(value.to_owned()))
}

/// A number of a point or a pair, to be bound.
pub(super) fn number(value: usize) -> ScalarValue {
    ScalarValue::Int32(i32::try_from(value).ok())
}

/// A time or a duration in nanoseconds, to be bound.
pub(super) fn long(value: i64) -> ScalarValue {
    ScalarValue::Int64(Some(value))
}

impl CatalogueRequest {
    /// A request without path and parameters, for queries of one snapshot.
    pub(in super::super) fn of(catalogue: &LakeCatalogue, view: &Arc<SnapshotView>) -> Self {
        let (catalogue, view) = (catalogue.clone(), view.clone());
        Self { catalogue, view, path: HashMap::new(), params: RequestParams::default(), as_arrow: false }
    }

    /// A part of the path.
    pub(super) fn part(&self, name: &str) -> &str {
        self.path.get(name).map_or("", String::as_str)
    }

    /// All surfaces in short.
    pub(super) async fn summary(&self) -> Result<&CatalogueSummary, RequestFault> {
        self.view.summary.get_or_try_init(|| CatalogueSummary::read(self)).await
    }

    /// The surfaces' places on the map.
    pub(super) async fn places(&self) -> Result<&SurfacePositions, RequestFault> {
        self.view.places.get_or_try_init(|| SurfacePositions::find(self)).await
    }

    /// The surface that the path names.
    pub(super) async fn surface(&self) -> Result<&SurfaceEntry, RequestFault> {
        let name = self.part("surface_id");
        let known = name.parse::<SurfaceId>().ok();
        let found = match known {
            Some(id) => self.summary().await?.entry(id.as_str()),
            None => None,
        };
        found.ok_or_else(|| missing(format!("surface `{name}`"), "GET /api/v1/surfaces lists what there is"))
    }

    /// The run that the path names, as the snapshot shows it.
    pub(super) fn run(&self) -> Result<&VisibleRun, RequestFault> {
        run(&self.view, self.part("run_id"))
    }

    /// Returns the grid point of the parameter `microphone`, if it is given.
    pub(super) fn microphone(&self) -> Result<Option<usize>, RequestFault> {
        self.params.whole("microphone", 0..=self.catalogue.lake().grid().points().len().saturating_sub(1))
    }

    /// The rows of a query. `sql` is a text of the program's own; what came with the request is among `values`.
    pub(in super::super) async fn rows<T: DeserializeOwned>(
        &self,
        sql: &str,
        values: Vec<ScalarValue>,
    ) -> Result<Vec<T>, RequestFault> {
        let mut running = self.begin(sql, values, |schema| FormatEncoder::new(AnswerFormat::Json, schema)).await?;
        let mut json = Vec::new();
        while let Some(part) = running.next().await? {
            json.extend_from_slice(&part);
            if json.len() > MOST_BYTES {
                return Err(RequestFault::TooLarge { limit: MOST_BYTES });
            }
        }
        if json.iter().all(u8::is_ascii_whitespace) {
            return Ok(Vec::new());
        }
        serde_json::from_slice(&json).map_err(|e| {
            eprintln!("the rows of `{sql}` are not as expected: {e}");
            RequestFault::Internal
        })
    }

    /// The batches of a query, as they come.
    pub(super) async fn batches(
        &self,
        sql: &str,
        values: Vec<ScalarValue>,
    ) -> Result<RunningQuery<RecordBatch>, RequestFault> {
        self.begin(sql, values, |_| Ok(BatchEncoder)).await
    }

    async fn begin<E: AnswerEncoder>(
        &self,
        sql: &str,
        values: Vec<ScalarValue>,
        encode: impl FnOnce(&arrow::datatypes::SchemaRef) -> Result<E, RequestFault> + Send + 'static,
    ) -> Result<RunningQuery<E::Item>, RequestFault> {
        let service = self.catalogue.service();
        let prepared = match self.view.prepared(sql) {
            Some(prepared) => prepared,
            None => {
                let (session, text) = (self.view.session.clone(), sql.to_owned());
                let planned =
                    service.plan(self.view.session.client(), async move { Ok(session.prepare(&text).await?) }).await?;
                let planned = Arc::new(planned);
                self.view.keep_prepared(sql, planned.clone());
                planned
            }
        };
        let job = QueryJob {
            protocol: ServerProtocol::Http,
            session: self.view.session.clone(),
            work: QueryWork::Prepared(prepared, ParamValues::from(values)),
            limit: None,
            stop: StopSignal::new(),
        };
        service.begin(job, encode).await
    }
}

/// The run of this name.
pub(in super::super) fn run<'a>(view: &'a SnapshotView, name: &str) -> Result<&'a VisibleRun, RequestFault> {
    let found = name.parse::<RunId>().ok().and_then(|id| view.snapshot.run(&id));
    found.ok_or_else(|| missing(format!("run `{name}`"), "GET /api/v1/runs lists what there is"))
}

/// The fault for a missing item.
pub(super) fn missing(what: String, hint: &'static str) -> RequestFault {
    RequestFault::NotFound { what, hint }
}
