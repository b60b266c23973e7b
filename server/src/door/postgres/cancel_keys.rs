//! Keys by which clients cancel. They are random and the door's own; an engine's keys are never sent to a client.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use echolake_service::{ClientIdentity, ConnectionOpening, EngineSocket};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

use super::frames::cancel_message;
use crate::door::engine_process::EngineProcess;

/// The engine of a connection, and the key of its connection there.
#[derive(Clone)]
pub(super) struct CancelTarget {
    pub engine: Arc<EngineProcess>,
    pub client: Arc<ClientIdentity>,
    pub pid: i32,
    pub secret: Vec<u8>,
}

/// A connection's key.
pub(super) struct CancelKey {
    pub pid: i32,
    pub secret: Vec<u8>,
}

/// The keys of all connections.
#[derive(Default)]
pub(super) struct CancelKeys(Mutex<HashMap<(i32, Vec<u8>), CancelTarget>>);

impl CancelKeys {
    /// A number for a connection, random as well.
    ///
    /// # Errors
    /// If the system gives no random bytes.
    pub fn make_pid() -> Result<i32, getrandom::Error> {
        let mut random = [0; 4];
        getrandom::fill(&mut random)?;
        Ok((i32::from_be_bytes(random) & i32::MAX).max(1))
    }

    /// A key of `bytes` random bytes: four in protocol 3.0, more in 3.2. None if the system gives none.
    pub fn make_key(pid: i32, bytes: usize) -> Option<CancelKey> {
        let mut secret = vec![0; bytes.min(32)];
        getrandom::fill(&mut secret).ok()?;
        Some(CancelKey { pid, secret })
    }

    /// Lets this key cancel queries of the target's connection from now on.
    pub fn set_target(&self, key: &CancelKey, target: CancelTarget) {
        self.lock_keys().insert((key.pid, key.secret.clone()), target);
    }

    /// Removes a key.
    pub fn remove_key(&self, key: &CancelKey) {
        self.lock_keys().remove(&(key.pid, key.secret.clone()));
    }

    /// Cancels the query on the connection of a key; false if there is none.
    pub async fn cancel_query(&self, pid: i32, secret: &[u8]) -> bool {
        let found = self.lock_keys().get(&(pid, secret.to_vec())).cloned();
        let Some(target) = found else { return false };
        // An engine that is gone runs nothing.
        if let Ok(mut stream) = target.engine.connect_socket(EngineSocket::Postgres).await
            && ConnectionOpening::new(&target.client, None).write_to(&mut stream).await.is_ok()
            && stream.write_all(&cancel_message(target.pid, &target.secret)).await.is_ok()
        {
            // The engine closes the connection behind it.
            let _ = stream.read(&mut [0]).await;
        }
        true
    }

    fn lock_keys(&self) -> MutexGuard<'_, HashMap<(i32, Vec<u8>), CancelTarget>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
