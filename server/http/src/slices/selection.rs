//! The measurements of a slice: found by the engine, within the client's limits, and cached for the ranges that follow.

use std::sync::Arc;

use arrow::record_batch::RecordBatch;
use echolake_export::Taken;
use echolake_service::running::{BatchEncoder, RunningQuery};
use echolake_service::{QueryService, QueryWork, RequestFault};
use quick_cache::Weighter;
use quick_cache::sync::Cache;
use sha2::{Digest as _, Sha256};

use super::super::catalogue::{AnswerContents, LakeCatalogue, SnapshotView};
use super::{SliceQuery, SliceRequest};
use crate::request_protocol::http_job;

/// Measurements of a slice, of a hundred runs and more.
const MOST: usize = 400_000;
/// Maximum number of cached measurements: some 80 bytes each.
const CACHED: u64 = 800_000;
/// Bytes of a digest that tell it from all others.
const DIGEST_BYTES: usize = 16;
/// Changes with what slices of the same measurements are.
const FORMAT: &str = concat!("slice 1, echolake ", env!("CARGO_PKG_VERSION"));

/// The input of a slice.
pub(super) struct SliceSelection {
    /// By run, time and pair.
    pub taken: Vec<Taken>,
    /// Says which slice it is: the same measurements, topics and layout, the same bytes.
    pub digest: String,
}

/// The client's name, the lake's version, and the question with all that is in it.
type SelectionKey = (String, String, String);

/// Cache of selections.
pub(super) struct SelectionCache(Cache<SelectionKey, Arc<SliceSelection>, SelectionWeighter>);

/// Weighs selections by their measurements; an empty one has a weight, too.
#[derive(Clone)]
struct SelectionWeighter;

impl Weighter<SelectionKey, Arc<SliceSelection>> for SelectionWeighter {
    fn weight(&self, _: &SelectionKey, selection: &Arc<SliceSelection>) -> u64 {
        selection.taken.len() as u64 + 100
    }
}

impl Default for SelectionCache {
    fn default() -> Self {
        // So few items are one shard, in which a selection may take all the room.
        Self(Cache::with_weighter(32, CACHED, SelectionWeighter))
    }
}

impl SelectionCache {
    /// The measurements that a request is for.
    ///
    /// # Errors
    /// A defect of the predicate, or what ended its query; [`RequestFault::NoData`] if it selects nothing.
    pub async fn get_or_select(
        &self,
        catalogue: &LakeCatalogue,
        request: &SliceRequest,
    ) -> Result<Arc<SliceSelection>, RequestFault> {
        let SliceRequest { client, view, question } = request;
        let asked = format!("{:?} {} {}", question.form, question.select_clause(), question.predicate());
        let described = format!("{} {} {asked}", question.layout_name(), question.topics.join(","));
        let key = (client.name().to_owned(), view.content_version(AnswerContents::Contributions), described);
        let select = async {
            let mut taken = select_measurements(catalogue, request).await?;
            taken.sort_by(|a, b| (&a.run, a.log_time_ns, a.pair).cmp(&(&b.run, b.log_time_ns, b.pair)));
            let digest = slice_digest(view, question, &taken);
            Ok(Arc::new(SliceSelection { taken, digest }))
        };
        self.0.get_or_insert_async(&key, select).await
    }
}

impl SliceRequest {
    /// Begins the client's query for the rows that the request selects.
    ///
    /// # Errors
    /// A defect of the predicate, or a limit.
    pub async fn begin_query(
        &self,
        service: &QueryService,
        select: String,
    ) -> Result<RunningQuery<RecordBatch>, RequestFault> {
        let session = Arc::new(service.begin_session(&self.client));
        let asking = session.clone();
        let predicate = self.question.predicate().to_owned();
        let form = self.question.form;
        let sql = service
            .plan_query(&self.client, async move { Ok(asking.append_predicate(&select, &predicate, form)?) })
            .await?;
        service.begin_query(http_job(session, QueryWork::Sql(sql)), |_| Ok(BatchEncoder)).await
    }
}

async fn select_measurements(catalogue: &LakeCatalogue, request: &SliceRequest) -> Result<Vec<Taken>, RequestFault> {
    let mut running = request.begin_query(catalogue.service(), request.question.select_clause()).await?;
    let mut taken = Vec::new();
    while let Some(batch) = running.next_part().await? {
        taken.extend(Taken::of_batch(&batch)?);
        if taken.len() > MOST {
            return Err(RequestFault::SliceTooLarge { limit: MOST });
        }
    }
    match taken.is_empty() {
        false => Ok(taken),
        true => {
            let hint = "POST /api/v1/sql tries predicates over `measurements`";
            Err(RequestFault::NoData { what: "what `where` selects".to_owned(), data: "measurements", hint })
        }
    }
}

/// Says which slice measurements make: they are sorted by run, time and pair.
// A run's derivation is a digest of its file, among others.
pub(super) fn slice_digest(view: &SnapshotView, question: &SliceQuery, taken: &[Taken]) -> String {
    let mut digest = Sha256::new();
    let mut add = |text: &str| {
        digest.update((text.len() as u64).to_le_bytes());
        digest.update(text);
    };
    add(FORMAT);
    add(question.layout_name());
    add(&question.topics.join(","));
    for of_run in taken.chunk_by(|a, b| a.run == b.run) {
        let run = &of_run[0].run;
        add(run.as_str());
        add(view.snapshot.run(run).map_or("", |visible| &visible.run_derivation));
        for one in of_run {
            add(&format!("{} {} {}", one.pair, one.attempt, one.log_time_ns));
        }
    }
    hex::encode(&digest.finalize()[..DIGEST_BYTES])
}
