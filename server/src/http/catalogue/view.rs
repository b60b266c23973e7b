//! The lake as one snapshot shows it, with what was computed of it: a new snapshot begins anew.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use echolake_lake::{DataFile, Snapshot};
use echolake_query::{EngineClient, PreparedQuery, QueryQuota, Session};
use echolake_schema::tables::Table;
use object_store::path::Path as StorePath;
use sha2::{Digest as _, Sha256};
use tokio::sync::OnceCell;

use super::kept::Answers;
use super::map::Places;
use super::summary::Summary;
use crate::fault::Fault;
use crate::service::Service;

/// What the catalogue's own queries may take: they read a surface at most, and all surfaces once a snapshot.
const LONGEST: Duration = Duration::from_secs(60);
/// Files of earlier snapshots that are remembered.
const EARLIER: usize = 20_000;
/// Bytes of a version that tell it from all others.
const VERSION_BYTES: usize = 8;

/// One snapshot.
pub(in super::super) struct View {
    /// Changes with every snapshot, and with the program.
    pub(in super::super) version: String,
    pub(in super::super) snapshot: Arc<Snapshot>,
    pub(super) session: Arc<Session>,
    pub(super) answers: Answers,
    pub(super) summary: OnceCell<Summary>,
    pub(super) places: OnceCell<Places>,
    /// By their text, of which there are few: values are bound.
    prepared: Mutex<HashMap<String, Arc<PreparedQuery>>>,
}

impl View {
    fn new(snapshot: Arc<Snapshot>, session: Arc<Session>) -> Self {
        Self {
            version: version(&snapshot),
            snapshot,
            session,
            answers: Answers::default(),
            summary: OnceCell::new(),
            places: OnceCell::new(),
            prepared: Mutex::default(),
        }
    }

    /// The version as a header says it; an Arrow stream is another form of the same.
    pub(super) fn etag(&self, as_arrow: bool) -> String {
        format!("\"{}{}\"", self.version, if as_arrow { "-arrow" } else { "" })
    }

    pub(super) fn prepared(&self, sql: &str) -> Option<Arc<PreparedQuery>> {
        self.prepared.lock().unwrap_or_else(PoisonError::into_inner).get(sql).cloned()
    }

    pub(super) fn keep_prepared(&self, sql: &str, prepared: Arc<PreparedQuery>) {
        self.prepared.lock().unwrap_or_else(PoisonError::into_inner).insert(sql.to_owned(), prepared);
    }
}

// What a snapshot shows is named by its files.
fn version(snapshot: &Snapshot) -> String {
    let mut digest = Sha256::new();
    digest.update(env!("CARGO_PKG_VERSION"));
    for table in Table::ALL {
        for file in snapshot.files(table) {
            digest.update(file.path.as_ref());
            digest.update(file.visible_rows().to_le_bytes());
        }
    }
    hex::encode(&digest.finalize()[..VERSION_BYTES])
}

/// A file of a table.
#[derive(Debug, Clone)]
pub(in super::super) struct Shown {
    table: Table,
    pub(in super::super) path: StorePath,
    pub(in super::super) bytes: u64,
}

impl Shown {
    fn of(table: Table, file: &DataFile) -> Self {
        Self { table, path: file.path.clone(), bytes: file.bytes }
    }

    fn is(&self, table: Table, name: &str) -> bool {
        self.table == table && self.path.filename() == Some(name)
    }
}

/// The newest snapshot that was seen.
#[derive(Default)]
pub(super) struct Views(Mutex<Seen>);

#[derive(Default)]
struct Seen {
    view: Option<Arc<View>>,
    /// Files that earlier snapshots showed: they stay until `vacuum` removes them, and who reads by a manifest of then
    /// goes on.
    earlier: VecDeque<Shown>,
}

impl Views {
    /// The lake as it is now.
    ///
    /// # Errors
    /// Where it cannot be read.
    pub(super) async fn current(&self, service: &Service) -> Result<Arc<View>, Fault> {
        let known = self.seen().view.clone();
        let session = match &known {
            Some(view) => view.session.clone(),
            None => session(service),
        };
        let asking = session.clone();
        let snapshot = service.plan(session.client(), async move { Ok(asking.snapshot().await?) }).await?;
        let mut seen = self.seen();
        match seen.view.as_ref().filter(|view| Arc::ptr_eq(&view.snapshot, &snapshot)) {
            Some(view) => Ok(view.clone()),
            None => {
                let view = Arc::new(View::new(snapshot, session));
                let before = seen.view.replace(view.clone());
                let gone = before.map(|before| gone(&before.snapshot, &view.snapshot)).unwrap_or_default();
                seen.earlier.extend(gone);
                let too_many = seen.earlier.len().saturating_sub(EARLIER);
                seen.earlier.drain(..too_many);
                Ok(view)
            }
        }
    }

    /// A file that a view shows, or that an earlier one did.
    pub(super) fn shown(&self, view: &View, table: Table, name: &str) -> Option<Shown> {
        let now = view.snapshot.files(table).iter().find(|file| file.path.filename() == Some(name));
        let earlier = || self.seen().earlier.iter().find(|file| file.is(table, name)).cloned();
        now.map(|file| Shown::of(table, file)).or_else(earlier)
    }

    fn seen(&self) -> std::sync::MutexGuard<'_, Seen> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

// What a snapshot shows and the next does not.
fn gone(before: &Snapshot, after: &Snapshot) -> Vec<Shown> {
    let mut gone = Vec::new();
    for table in Table::ALL {
        let stay: HashSet<_> = after.files(table).iter().map(|file| &file.path).collect();
        let left = before.files(table).iter().filter(|file| !stay.contains(&file.path));
        gone.extend(left.map(|file| Shown::of(table, file)));
    }
    gone
}

// Who may ask was found out before; how much their queries of their own may take is no matter of these.
fn session(service: &Service) -> Arc<Session> {
    let quota = QueryQuota { time: Some(LONGEST), ..QueryQuota::default() };
    Arc::new(service.session(&Arc::new(EngineClient::new("catalogue", quota))))
}
