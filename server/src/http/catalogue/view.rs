//! The lake as one snapshot shows it, with what was computed of it: a new snapshot begins anew.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use echolake_lake::Snapshot;
use echolake_query::{Client, Prepared, Quota, Session};
use echolake_schema::tables::Table;
use sha2::{Digest as _, Sha256};
use tokio::sync::OnceCell;

use super::kept::Answers;
use super::map::Places;
use super::summary::Summary;
use crate::fault::Fault;
use crate::random;
use crate::service::Service;

/// What the catalogue's own queries may take: they read a surface at most, and all surfaces once a snapshot.
const LONGEST: Duration = Duration::from_secs(60);
/// Bytes of a version that tell it from all others.
const VERSION_BYTES: usize = 8;

/// One snapshot.
pub(in super::super) struct View {
    /// Changes with every snapshot, and with the program.
    pub(super) version: String,
    pub(in super::super) snapshot: Arc<Snapshot>,
    pub(super) session: Arc<Session>,
    pub(super) answers: Answers,
    pub(super) summary: OnceCell<Summary>,
    pub(super) places: OnceCell<Places>,
    /// By their text, of which there are few: values are bound.
    prepared: Mutex<HashMap<String, Arc<Prepared>>>,
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

    pub(super) fn prepared(&self, sql: &str) -> Option<Arc<Prepared>> {
        self.prepared.lock().unwrap_or_else(PoisonError::into_inner).get(sql).cloned()
    }

    pub(super) fn keep_prepared(&self, sql: &str, prepared: Arc<Prepared>) {
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
    random::hex(&digest.finalize()[..VERSION_BYTES])
}

/// The newest snapshot that was seen.
#[derive(Default)]
pub(super) struct Views(Mutex<Option<Arc<View>>>);

impl Views {
    /// The lake as it is now.
    ///
    /// # Errors
    /// Where it cannot be read.
    pub(super) async fn current(&self, service: &Service) -> Result<Arc<View>, Fault> {
        let known = self.0.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let session = match &known {
            Some(view) => view.session.clone(),
            None => session(service),
        };
        let asking = session.clone();
        let snapshot = service.plan(async move { Ok(asking.snapshot().await?) }).await?;
        let mut current = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        match current.as_ref().filter(|view| Arc::ptr_eq(&view.snapshot, &snapshot)) {
            Some(view) => Ok(view.clone()),
            None => {
                let view = Arc::new(View::new(snapshot, session));
                *current = Some(view.clone());
                Ok(view)
            }
        }
    }
}

// Who may ask was found out before; how much their queries of their own may take is no matter of these.
fn session(service: &Service) -> Arc<Session> {
    let quota = Quota { time: Some(LONGEST), ..Quota::default() };
    Arc::new(service.session(&Arc::new(Client::new("catalogue", quota))))
}
