//! Statements that clients hold handles of. A handle is random, belongs to the client that made it, and is forgotten
//! when it is not used: a stolen or invented one leads to nothing.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use arrow::datatypes::SchemaRef;
use bytes::Bytes;
use datafusion::common::ParamValues;
use echolake_query::{Prepared, Session};

use crate::fault::Fault;
use crate::random;
use crate::running::Stop;

/// How long an unused handle is good for.
const KEPT: Duration = Duration::from_secs(600);
/// Handles of one client; the one not used for longest makes room.
const HELD: usize = 256;

type Handle = [u8; 16];

/// What a handle stands for.
#[derive(Clone)]
pub(super) struct Statement {
    /// The session it was planned in; its client owns the handle.
    pub(super) session: Arc<Session>,
    pub(super) sql: Arc<str>,
    pub(super) prepared: Arc<Prepared>,
    /// When: it sees the lake as it was then.
    pub(super) planned: Instant,
    /// Columns as they were told to the client.
    pub(super) schema: SchemaRef,
    /// Values of its placeholders.
    pub(super) values: ParamValues,
    /// Ends its run.
    pub(super) stop: Stop,
}

/// The statements of all clients.
#[derive(Default)]
pub(super) struct Statements(Mutex<HashMap<Handle, Kept>>);

struct Kept {
    statement: Statement,
    used: Instant,
}

impl Statements {
    /// Keeps a statement.
    pub(super) fn keep(&self, statement: Statement) -> Result<Bytes, Fault> {
        let handle: Handle = random::bytes().map_err(|failed| {
            eprintln!("no random bytes: {failed}");
            Fault::Internal
        })?;
        let mut all = self.lock();
        all.retain(|_, kept| kept.used.elapsed() < KEPT);
        let owner = statement.session.client().name();
        let mut own: Vec<_> = all
            .iter()
            .filter(|(_, kept)| kept.statement.session.client().name() == owner)
            .map(|(handle, kept)| (kept.used, *handle))
            .collect();
        own.sort_unstable();
        for (_, oldest) in own.iter().take((own.len() + 1).saturating_sub(HELD)) {
            all.remove(oldest);
        }
        all.insert(handle, Kept { statement, used: Instant::now() });
        Ok(Bytes::copy_from_slice(&handle))
    }

    /// The statement of a client's handle.
    pub(super) fn find(&self, client: &str, handle: &[u8]) -> Result<Statement, Fault> {
        self.with(client, handle, |kept| kept.statement.clone())
    }

    /// Sets the values of its placeholders.
    pub(super) fn bind(&self, client: &str, handle: &[u8], values: ParamValues) -> Result<(), Fault> {
        self.with(client, handle, |kept| kept.statement.values = values)
    }

    /// Forgets it; what runs goes on.
    pub(super) fn forget(&self, client: &str, handle: &[u8]) {
        if self.find(client, handle).is_ok() {
            self.lock().retain(|known, _| known[..] != *handle);
        }
    }

    fn with<T>(&self, client: &str, handle: &[u8], act: impl FnOnce(&mut Kept) -> T) -> Result<T, Fault> {
        let gone = || Fault::NotFound { what: "this statement".to_owned(), hint: "ask again: it may have expired" };
        let handle = Handle::try_from(handle).map_err(|_| gone())?;
        let mut all = self.lock();
        let kept = all.get_mut(&handle).filter(|kept| kept.statement.session.client().name() == client);
        let kept = kept.filter(|kept| kept.used.elapsed() < KEPT).ok_or_else(gone)?;
        kept.used = Instant::now();
        Ok(act(kept))
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<Handle, Kept>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
