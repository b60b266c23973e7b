//! What an endpoint is asked, and how it asks the lake: values are bound or validated, never part of a text.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::record_batch::RecordBatch;
use datafusion::common::{ParamValues, ScalarValue};
use echolake_lake::VisibleRun;
use echolake_query::output::AnswerFormat;
use echolake_schema::{RunId, SurfaceId};
use serde::de::DeserializeOwned;

use super::super::format::Written;
use super::Catalogue;
use super::map::Places;
use super::params::Params;
use super::summary::{Entry, Summary};
use super::view::View;
use crate::fault::Fault;
use crate::metrics::Protocol;
use crate::running::{Batches, Encode, Running, Stop};
use crate::service::{Job, Work};

/// Bytes of one query's rows, as JSON; the largest that endpoints ask for are a run's events or a few responses.
const MOST_BYTES: usize = 64 << 20;

/// A request to an endpoint.
pub(in super::super) struct Asked {
    pub(super) catalogue: Catalogue,
    pub(super) view: Arc<View>,
    /// The path's parts that have a name.
    pub(super) path: HashMap<String, String>,
    pub(super) params: Params,
    /// Whether an Arrow stream is liked better than JSON.
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

impl Asked {
    /// Nothing but the lake as a snapshot shows it.
    pub(in super::super) fn of(catalogue: &Catalogue, view: &Arc<View>) -> Self {
        let (catalogue, view) = (catalogue.clone(), view.clone());
        Self { catalogue, view, path: HashMap::new(), params: Params::default(), as_arrow: false }
    }

    /// A part of the path.
    pub(super) fn part(&self, name: &str) -> &str {
        self.path.get(name).map_or("", String::as_str)
    }

    /// All surfaces in short.
    pub(super) async fn summary(&self) -> Result<&Summary, Fault> {
        self.view.summary.get_or_try_init(|| Summary::read(self)).await
    }

    /// The surfaces' places on the map.
    pub(super) async fn places(&self) -> Result<&Places, Fault> {
        self.view.places.get_or_try_init(|| Places::find(self)).await
    }

    /// The surface that the path names.
    pub(super) async fn surface(&self) -> Result<&Entry, Fault> {
        let name = self.part("surface_id");
        let known = name.parse::<SurfaceId>().ok();
        let found = match known {
            Some(id) => self.summary().await?.entry(id.as_str()),
            None => None,
        };
        found.ok_or_else(|| missing(format!("surface `{name}`"), "GET /api/v1/surfaces lists what there is"))
    }

    /// The run that the path names, as the snapshot shows it.
    pub(super) fn run(&self) -> Result<&VisibleRun, Fault> {
        run(&self.view, self.part("run_id"))
    }

    /// The grid point of a parameter, where it is given.
    pub(super) fn microphone(&self) -> Result<Option<usize>, Fault> {
        self.params.whole("microphone", 0..=self.catalogue.lake().grid().points().len().saturating_sub(1))
    }

    /// The rows of a query. `sql` is a text of the program's own; what came with the request is among `values`.
    pub(in super::super) async fn rows<T: DeserializeOwned>(
        &self,
        sql: &str,
        values: Vec<ScalarValue>,
    ) -> Result<Vec<T>, Fault> {
        let mut running = self.begin(sql, values, |schema| Written::new(AnswerFormat::Json, schema)).await?;
        let mut json = Vec::new();
        while let Some(part) = running.next().await? {
            json.extend_from_slice(&part);
            if json.len() > MOST_BYTES {
                return Err(Fault::TooLarge { limit: MOST_BYTES });
            }
        }
        if json.iter().all(u8::is_ascii_whitespace) {
            return Ok(Vec::new());
        }
        serde_json::from_slice(&json).map_err(|e| {
            eprintln!("the rows of `{sql}` are not as expected: {e}");
            Fault::Internal
        })
    }

    /// The batches of a query, as they come.
    pub(super) async fn batches(&self, sql: &str, values: Vec<ScalarValue>) -> Result<Running<RecordBatch>, Fault> {
        self.begin(sql, values, |_| Ok(Batches)).await
    }

    async fn begin<E: Encode>(
        &self,
        sql: &str,
        values: Vec<ScalarValue>,
        encode: impl FnOnce(&arrow::datatypes::SchemaRef) -> Result<E, Fault> + Send + 'static,
    ) -> Result<Running<E::Item>, Fault> {
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
        let job = Job {
            protocol: Protocol::Http,
            session: self.view.session.clone(),
            work: Work::Prepared(prepared, ParamValues::from(values)),
            limit: None,
            stop: Stop::new(),
        };
        service.begin(job, encode).await
    }
}

/// The run of this name.
pub(in super::super) fn run<'a>(view: &'a View, name: &str) -> Result<&'a VisibleRun, Fault> {
    let found = name.parse::<RunId>().ok().and_then(|id| view.snapshot.run(&id));
    found.ok_or_else(|| missing(format!("run `{name}`"), "GET /api/v1/runs lists what there is"))
}

/// What is not there.
pub(super) fn missing(what: String, hint: &'static str) -> Fault {
    Fault::NotFound { what, hint }
}
