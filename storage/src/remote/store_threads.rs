//! Threads for the requests to object stores, apart from those of the callers: a connection stays open behind a request
//! and serves the next one, whoever's it is, so that no caller's threads may own it.

use std::sync::LazyLock;

use echolake_schema::ErrorCause;
use object_store::client::SpawnedReqwestConnector;
use tokio::runtime::{Builder, Runtime};

/// They encrypt and copy, and wait for the rest of the time.
const THREADS: usize = 2;

// A thread inherits what the process may do when it is started, so that none is before the first store is opened.
static RUNTIME: LazyLock<std::io::Result<Runtime>> =
    LazyLock::new(|| Builder::new_multi_thread().worker_threads(THREADS).thread_name("store").enable_all().build());

/// Returns what makes the connections of a store.
pub(super) fn store_connector() -> Result<SpawnedReqwestConnector, ErrorCause> {
    let runtime = RUNTIME.as_ref().map_err(|e| format!("the system gives no threads for it: {e}"))?;
    Ok(SpawnedReqwestConnector::new(runtime.handle().clone()))
}
