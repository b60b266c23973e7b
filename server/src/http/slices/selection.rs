//! The measurements of a slice: found by the engine, within the client's limits, and cached for the ranges that follow.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use echolake_export::Taken;
use sha2::{Digest as _, Sha256};

use super::super::catalogue::{Catalogue, View};
use super::{Question, Request};
use crate::fault::Fault;
use crate::metrics::Protocol;
use crate::running::{Batches, Stop};
use crate::service::{Job, Work};

/// Measurements of a slice, of a hundred runs and more.
const MOST: usize = 400_000;
/// Measurements that are kept: some 80 bytes each.
const KEPT: usize = 800_000;
/// Bytes of a digest that tell it from all others.
const DIGEST_BYTES: usize = 16;
/// Changes with what slices of the same measurements are.
const FORMAT: &str = concat!("slice 1, echolake ", env!("CARGO_PKG_VERSION"));

/// The input of a slice.
pub(super) struct Selection {
    /// By run, time and pair.
    pub(super) taken: Vec<Taken>,
    /// Says which slice it is: the same measurements, topics and layout, the same bytes.
    pub(super) digest: String,
}

/// The client's name, the lake's version, and the question with all that is in it.
type Key = (String, String, String);

/// Selections of the last questions.
#[derive(Default)]
pub(super) struct Selections(Mutex<VecDeque<(Key, Arc<Selection>)>>);

impl Selections {
    /// The measurements that a request is for.
    ///
    /// # Errors
    /// A defect of the predicate, or what ended its query; [`Fault::NoData`] if it selects nothing.
    pub(super) async fn of(&self, catalogue: &Catalogue, request: &Request) -> Result<Arc<Selection>, Fault> {
        let Request { client, view, question } = request;
        let asked = format!("{:?} {} {}", question.form, question.select(), question.predicate());
        let described = format!("{} {} {asked}", question.layout_name(), question.topics.join(","));
        let key = (client.name().to_owned(), view.version.clone(), described);
        if let Some(known) = self.known(&key) {
            return Ok(known);
        }
        let mut taken = taken(catalogue, request).await?;
        taken.sort_by(|a, b| (&a.run, a.log_time_ns, a.pair).cmp(&(&b.run, b.log_time_ns, b.pair)));
        let digest = digest(view, question, &taken);
        let selection = Arc::new(Selection { taken, digest });
        self.keep(key, &selection);
        Ok(selection)
    }

    fn known(&self, key: &Key) -> Option<Arc<Selection>> {
        let kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        kept.iter().find(|(known, _)| known == key).map(|(_, selection)| selection.clone())
    }

    fn keep(&self, key: Key, selection: &Arc<Selection>) {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        kept.push_back((key, selection.clone()));
        // One that is small weighs something too.
        let weight =
            |kept: &VecDeque<(Key, Arc<Selection>)>| kept.iter().map(|(_, s)| s.taken.len() + 100).sum::<usize>();
        while weight(&kept) > KEPT && kept.len() > 1 {
            kept.pop_front();
        }
    }
}

async fn taken(catalogue: &Catalogue, request: &Request) -> Result<Vec<Taken>, Fault> {
    let Request { client, question, .. } = request;
    let (service, predicate) = (catalogue.service(), question.predicate().to_owned());
    let session = Arc::new(service.session(client));
    let (asking, select, form) = (session.clone(), question.select(), question.form);
    let sql = service.plan(client, async move { Ok(asking.selecting(&select, &predicate, form)?) }).await?;
    let job = Job { protocol: Protocol::Http, session, work: Work::Sql(sql), limit: None, stop: Stop::new() };
    let mut running = service.begin(job, |_| Ok(Batches)).await?;
    let mut taken = Vec::new();
    while let Some(batch) = running.next().await? {
        taken.extend(Taken::of_batch(&batch)?);
        if taken.len() > MOST {
            return Err(Fault::SliceTooLarge { limit: MOST });
        }
    }
    match taken.is_empty() {
        false => Ok(taken),
        true => {
            let hint = "POST /api/v1/sql tries predicates over `measurements`";
            Err(Fault::NoData { what: "what `where` selects".to_owned(), data: "measurements", hint })
        }
    }
}

/// Says which slice measurements make: they are sorted by run, time and pair.
// A run's derivation is a digest of its file, among others.
pub(super) fn digest(view: &View, question: &Question, taken: &[Taken]) -> String {
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
