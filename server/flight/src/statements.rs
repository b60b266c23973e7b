//! Statements that clients hold handles of. A handle begins with a random number, under which the statement is kept
//! until it is not used any more, and continues with its text, so that another engine of the same client can plan it
//! again.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use arrow::datatypes::SchemaRef;
use bytes::Bytes;
use datafusion::common::ParamValues;
use echolake_query::{PreparedQuery, Session};
use echolake_service::{RequestFault, StopSignal};

/// Bytes of a text up to which handles carry it.
const CARRIED_BYTES: usize = 32 << 10;
/// Time after which an unused handle expires.
const KEPT: Duration = Duration::from_secs(600);
/// Handles of one client; the least recently used is evicted.
const HELD: usize = 256;

type StatementHandle = [u8; 16];

/// The statement of a handle.
#[derive(Clone)]
pub(super) struct HeldStatement {
    /// The session it was planned in; its client owns the handle.
    pub session: Arc<Session>,
    pub sql: Arc<str>,
    pub prepared: Arc<PreparedQuery>,
    /// Columns as they were announced to the client.
    pub schema: SchemaRef,
    /// Values of its placeholders.
    pub values: ParamValues,
    /// Ends its run.
    pub stop: StopSignal,
}

/// The statements of all clients.
#[derive(Default)]
pub(super) struct HeldStatements(Mutex<HashMap<StatementHandle, StatementEntry>>);

struct StatementEntry {
    statement: HeldStatement,
    used: Instant,
}

impl HeldStatements {
    /// Keeps a statement.
    pub fn keep_statement(&self, statement: HeldStatement) -> Result<Bytes, RequestFault> {
        let mut handle = StatementHandle::default();
        getrandom::fill(&mut handle).map_err(RequestFault::defect("no random bytes"))?;
        let sql = Some(statement.sql.clone()).filter(|sql| sql.len() <= CARRIED_BYTES);
        let whole = [&handle, sql.as_deref().unwrap_or_default().as_bytes()].concat();
        self.insert(handle, statement);
        Ok(whole.into())
    }

    /// Keeps a statement under a handle that another engine made.
    pub fn keep_as(&self, handle: &[u8], statement: HeldStatement) -> Result<(), RequestFault> {
        let (handle, _) = handle.split_first_chunk().ok_or_else(missing_statement)?;
        self.insert(*handle, statement);
        Ok(())
    }

    /// The text that a handle carries.
    pub fn carried_text(handle: &[u8]) -> Option<String> {
        let (_, sql) = handle.split_first_chunk::<{ size_of::<StatementHandle>() }>()?;
        String::from_utf8(sql.to_vec()).ok().filter(|sql| !sql.is_empty())
    }

    fn insert(&self, handle: StatementHandle, statement: HeldStatement) {
        let mut all = self.lock_statements();
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
        all.insert(handle, StatementEntry { statement, used: Instant::now() });
    }

    /// The statement of a client's handle.
    pub fn find_statement(&self, client: &str, handle: &[u8]) -> Result<HeldStatement, RequestFault> {
        self.with_entry(client, handle, |kept| kept.statement.clone())
    }

    /// Sets the values of its placeholders.
    pub fn bind_values(&self, client: &str, handle: &[u8], values: ParamValues) -> Result<(), RequestFault> {
        self.with_entry(client, handle, |kept| kept.statement.values = values)
    }

    /// Forgets it; a running query continues.
    pub fn forget_statement(&self, client: &str, handle: &[u8]) {
        if self.find_statement(client, handle).is_ok() {
            self.lock_statements().retain(|known, _| !handle.starts_with(known));
        }
    }

    fn with_entry<T>(
        &self,
        client: &str,
        handle: &[u8],
        act: impl FnOnce(&mut StatementEntry) -> T,
    ) -> Result<T, RequestFault> {
        let (handle, _) = handle.split_first_chunk().ok_or_else(missing_statement)?;
        let mut all = self.lock_statements();
        let kept = all.get_mut(handle).filter(|kept| kept.statement.session.client().name() == client);
        let kept = kept.filter(|kept| kept.used.elapsed() < KEPT).ok_or_else(missing_statement)?;
        kept.used = Instant::now();
        Ok(act(kept))
    }

    fn lock_statements(&self) -> MutexGuard<'_, HashMap<StatementHandle, StatementEntry>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn missing_statement() -> RequestFault {
    RequestFault::NotFound { what: "this statement".to_owned(), hint: "ask again: it may have expired" }
}
