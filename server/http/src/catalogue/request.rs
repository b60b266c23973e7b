//! A request to an endpoint, and its queries of the lake: values are bound or validated, never part of a text.

use std::collections::BTreeSet;
use std::sync::Arc;

use arrow::record_batch::RecordBatch;
use datafusion::common::{ParamValues, ScalarValue};
use echolake_lake::VisibleRun;
use echolake_query::Error as QueryError;
use echolake_schema::{RunId, SurfaceId, quoted_text};
use echolake_service::running::{AnswerEncoder, BatchEncoder, RunningQuery};
use echolake_service::{QueryWork, RequestFault};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use utoipa::IntoParams;

use super::super::extract::parse_whole;
use super::LakeCatalogue;
use super::rows::RowDecoder;
use super::snapshot::bands::describe_bands;
use super::snapshot::summary::{BAND_STATISTICS, CatalogueSummary, SURFACES, SurfaceEntry};
use super::snapshot::view::SnapshotView;
use crate::request_protocol::http_job;

/// A request to an endpoint.
#[derive(Clone)]
pub(crate) struct CatalogueRequest {
    pub catalogue: LakeCatalogue,
    pub view: Arc<SnapshotView>,
    /// True if an Arrow stream is preferred to JSON.
    pub as_arrow: bool,
}

/// The path of a surface.
#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Path)]
pub(super) struct SurfacePath {
    pub surface_id: String,
}

/// The path of a run.
#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Path)]
pub(crate) struct RunPath {
    pub run_id: String,
}

/// A text, to be bound.
pub(crate) fn text_value(value: &str) -> ScalarValue {
    ScalarValue::Utf8(Some(value.to_owned()))
}

/// A number of a point or a pair, to be bound.
pub(super) fn number_value(value: usize) -> ScalarValue {
    ScalarValue::Int32(i32::try_from(value).ok())
}

/// A time or a duration in nanoseconds, to be bound.
pub(super) fn nanos_value(value: i64) -> ScalarValue {
    ScalarValue::Int64(Some(value))
}

impl CatalogueRequest {
    /// A request for what a snapshot shows.
    pub fn new(catalogue: &LakeCatalogue, view: &Arc<SnapshotView>, as_arrow: bool) -> Self {
        Self { catalogue: catalogue.clone(), view: view.clone(), as_arrow }
    }

    /// All surfaces in short.
    pub async fn read_summary(&self) -> Result<&CatalogueSummary, RequestFault> {
        let read = || async {
            let (surfaces, statistics) =
                tokio::try_join!(self.read_rows(SURFACES, Vec::new()), self.read_rows(BAND_STATISTICS, Vec::new()))?;
            Ok(CatalogueSummary::new(surfaces, statistics, describe_bands(self.catalogue.lake().rig())))
        };
        self.view.results.summary.get_or_try_init(read).await
    }

    /// The runs, of these surfaces or of all, on which verdicts came since the last ingest: statistics do not follow
    /// them yet.
    pub async fn unfollowed_runs(
        &self,
        surfaces: Option<&BTreeSet<SurfaceId>>,
    ) -> Result<Vec<&VisibleRun>, RequestFault> {
        let snapshot = &self.view.snapshot;
        let read = || async { self.catalogue.lake().read_rejections(snapshot).await };
        let rejected = self.view.results.rejected.get_or_try_init(read).await.map_err(QueryError::from)?;
        let is_wanted = |run: &&VisibleRun| surfaces.is_none_or(|surfaces| surfaces.contains(&run.surface));
        Ok(snapshot.unfollowed_runs(rejected).filter(is_wanted).collect())
    }

    /// The surface of this name.
    pub async fn find_surface(&self, name: &str) -> Result<&SurfaceEntry, RequestFault> {
        let known = name.parse::<SurfaceId>().ok();
        let found = match known {
            Some(id) => self.read_summary().await?.find_entry(id.as_str()),
            None => None,
        };
        found.ok_or_else(|| {
            missing_item(format!("surface `{}`", quoted_text(name)), "GET /api/v1/surfaces lists what there is")
        })
    }

    /// The run of this name, as the snapshot shows it.
    pub fn find_run(&self, name: &str) -> Result<&VisibleRun, RequestFault> {
        find_run(&self.view, name)
    }

    /// Reads the parameter `microphone`, a grid point of the lake.
    pub fn parse_microphone(&self, text: &str) -> Result<usize, RequestFault> {
        let last = self.catalogue.lake().grid().points().len().saturating_sub(1);
        parse_whole(text, 0..=last).map_err(|e| RequestFault::bad_request(format!("`microphone`: {e}")))
    }

    /// The rows of a query. `sql` is a text of the program's own; what came with the request is among `values`.
    pub async fn read_rows<T: DeserializeOwned + Send + 'static>(
        &self,
        sql: &str,
        values: Vec<ScalarValue>,
    ) -> Result<Vec<T>, RequestFault> {
        let decoder = RowDecoder::new(sql.to_owned());
        let mut running = self.begin_query(sql, values, |_| Ok(decoder)).await?;
        let mut rows = Vec::new();
        while let Some(part) = running.next_part().await? {
            rows.extend(part);
        }
        Ok(rows)
    }

    /// The batches of a query, as they come.
    pub async fn stream_batches(
        &self,
        sql: &str,
        values: Vec<ScalarValue>,
    ) -> Result<RunningQuery<RecordBatch>, RequestFault> {
        self.begin_query(sql, values, |_| Ok(BatchEncoder)).await
    }

    async fn begin_query<E: AnswerEncoder>(
        &self,
        sql: &str,
        values: Vec<ScalarValue>,
        encode: impl FnOnce(&arrow::datatypes::SchemaRef) -> Result<E, RequestFault> + Send + 'static,
    ) -> Result<RunningQuery<E::Item>, RequestFault> {
        let service = self.catalogue.service();
        let (prepared, types) = match self.view.find_prepared(sql) {
            Some(known) => known,
            None => {
                let session = self.view.session.clone();
                let text = sql.to_owned();
                let plan = async move {
                    let prepared = session.prepare(&text).await?;
                    // A placeholder that stands for several columns has no type of its own: its values come as they
                    // are.
                    Ok(match prepared.parameter_types() {
                        Ok(types) => (Arc::new(prepared.optimize()?), types.into()),
                        Err(_) => (Arc::new(prepared), Arc::default()),
                    })
                };
                let planned = service.plan_query(self.view.session.client(), plan).await?;
                self.view.keep_prepared(sql, planned.clone());
                planned
            }
        };
        let typed = values.into_iter().enumerate().map(|(i, value)| match types.get(i) {
            Some(Some(kind)) => value.cast_to(kind),
            _ => Ok(value),
        });
        let values = typed.collect::<Result<Vec<_>, _>>();
        let values = values.map_err(RequestFault::defect("a value has another type"))?;
        let job = http_job(self.view.session.clone(), QueryWork::Prepared(prepared, ParamValues::from(values)));
        service.begin_query(job, encode).await
    }
}

/// The run of this name.
pub(crate) fn find_run<'a>(view: &'a SnapshotView, name: &str) -> Result<&'a VisibleRun, RequestFault> {
    let found = name.parse::<RunId>().ok().and_then(|id| view.snapshot.run(&id));
    found.ok_or_else(|| missing_item(format!("run `{name}`"), "GET /api/v1/runs lists what there is"))
}

/// The fault for a missing item.
pub(super) fn missing_item(what: String, hint: &'static str) -> RequestFault {
    RequestFault::NotFound { what, hint }
}
