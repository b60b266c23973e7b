//! The maintenance lease: one object that names the process at work on the lake's files.
//!
//! It keeps two processes from doing the same work, and the error of the second one names the first. Correctness does
//! not depend on it: a merge is a commit of its own, which fails if another was faster.

use std::sync::Arc;
use std::time::{Duration, Instant};

use chrono::{DateTime, TimeDelta, Utc};
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _, PutMode};
use serde::{Deserialize, Serialize};

use crate::{Error, Lake, Result};

/// Path of the lease's object.
const PATH: &str = "tables/_maintenance.json";
/// Time that it holds after its last renewal. A dead holder blocks others that long.
const HOLDS: TimeDelta = TimeDelta::minutes(10);
/// Time between two renewals.
const RENEW_EVERY: Duration = Duration::from_secs(60);

/// The lease, held.
#[derive(Debug)]
pub(crate) struct MaintenanceLease {
    store: Arc<dyn ObjectStore>,
    location: String,
    record: LeaseRecord,
    renewed: Instant,
}

/// Contents of the object.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct LeaseRecord {
    /// Distinguishes all that ever held it.
    holder: String,
    host: String,
    pid: u32,
    expires: DateTime<Utc>,
}

impl LeaseRecord {
    fn new() -> Self {
        let (host, pid, now) = (host(), std::process::id(), Utc::now());
        let holder = format!("{host}.{pid}.{}", now.timestamp_nanos_opt().unwrap_or_default());
        Self { holder, host, pid, expires: now + HOLDS }
    }

    fn bytes(&self) -> Vec<u8> {
        // A struct of texts and numbers always has a JSON form.
        serde_json::to_vec_pretty(self).unwrap_or_default()
    }
}

impl MaintenanceLease {
    /// Acquires the lease; an expired one is taken over.
    ///
    /// # Errors
    /// [`Error::Maintained`] if another process holds it, or what the store says.
    pub(crate) async fn take(lake: &Lake) -> Result<Self> {
        let (store, location, record) = (lake.store(), lake.location().to_owned(), LeaseRecord::new());
        let path = Path::from(PATH);
        let failed = |e| Error::store("write", PATH, e);
        if let Some(held) = read(store.as_ref()).await? {
            if held.expires > Utc::now() {
                let until = held.expires.format("%Y-%m-%d %H:%M:%S UTC").to_string();
                return Err(Error::Maintained { location, host: held.host, pid: held.pid, until });
            }
            match store.delete(&path).await {
                Err(e) if !matches!(e, object_store::Error::NotFound { .. }) => return Err(failed(e)),
                _ => {}
            }
        }
        match store.put_opts(&path, record.bytes().into(), PutMode::Create.into()).await {
            Ok(_) => Ok(Self { store, location, record, renewed: Instant::now() }),
            Err(object_store::Error::AlreadyExists { .. }) => {
                let held = read(store.as_ref()).await?.unwrap_or(record);
                let until = held.expires.format("%Y-%m-%d %H:%M:%S UTC").to_string();
                Err(Error::Maintained { location, host: held.host, pid: held.pid, until })
            }
            Err(e) => Err(failed(e)),
        }
    }

    /// Checks that it is still held, and renews it if [`RENEW_EVERY`] has passed.
    ///
    /// # Errors
    /// [`Error::LeaseLost`] if another process has taken it over, or what the store says.
    pub(crate) async fn keep(&mut self) -> Result<()> {
        let held = read(self.store.as_ref()).await?;
        if held.is_none_or(|held| held.holder != self.record.holder) {
            return Err(Error::LeaseLost { location: self.location.clone() });
        }
        if self.renewed.elapsed() >= RENEW_EVERY {
            self.record.expires = Utc::now() + HOLDS;
            let put = self.store.put(&Path::from(PATH), self.record.bytes().into()).await;
            put.map_err(|e| Error::store("write", PATH, e))?;
            self.renewed = Instant::now();
        }
        Ok(())
    }

    /// Gives it back.
    ///
    /// # Errors
    /// What the store says.
    pub(crate) async fn release(self) -> Result<()> {
        match read(self.store.as_ref()).await? {
            Some(held) if held.holder == self.record.holder => {}
            _ => return Ok(()),
        }
        match self.store.delete(&Path::from(PATH)).await {
            Err(e) if !matches!(e, object_store::Error::NotFound { .. }) => Err(Error::store("delete", PATH, e)),
            _ => Ok(()),
        }
    }
}

// One that cannot be read holds from its making on, as any other.
async fn read(store: &dyn ObjectStore) -> Result<Option<LeaseRecord>> {
    let failed = |e| Error::store("read", PATH, e);
    let found = match store.get(&Path::from(PATH)).await {
        Ok(found) => found,
        Err(object_store::Error::NotFound { .. }) => return Ok(None),
        Err(e) => return Err(failed(e)),
    };
    let made = found.meta.last_modified;
    let bytes = match found.bytes().await {
        Ok(bytes) => bytes,
        Err(object_store::Error::NotFound { .. }) => return Ok(None),
        Err(e) => return Err(failed(e)),
    };
    let unreadable = || LeaseRecord { holder: String::new(), host: "?".into(), pid: 0, expires: made + HOLDS };
    Ok(Some(serde_json::from_slice(&bytes).unwrap_or_else(|_| unreadable())))
}

fn host() -> String {
    let named = std::fs::read_to_string("/proc/sys/kernel/hostname").ok().or_else(|| std::env::var("HOSTNAME").ok());
    named.map_or_else(|| "this machine".to_owned(), |name| name.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use echolake_schema::Rig;

    use super::*;
    use crate::ReferenceSurfaces;

    async fn lake() -> Lake {
        Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake")
    }

    #[tokio::test]
    async fn one_holds_it_and_the_second_is_told_who() {
        let lake = lake().await;
        let mut first = MaintenanceLease::take(&lake).await.expect("free");
        first.keep().await.expect("held");
        let error = MaintenanceLease::take(&lake).await.expect_err("held").to_string();
        assert!(error.contains(&format!("process {}", std::process::id())) && error.contains(&host()), "{error}");
        first.release().await.expect("given back");
        MaintenanceLease::take(&lake).await.expect("free again");
    }

    #[tokio::test]
    async fn a_dead_holder_is_followed_and_notices_where_it_was_not_dead() {
        let lake = lake().await;
        let mut first = MaintenanceLease::take(&lake).await.expect("free");
        first.record.expires = Utc::now() - TimeDelta::seconds(1);
        lake.store().put(&Path::from(PATH), first.record.bytes().into()).await.expect("written");
        let mut second = MaintenanceLease::take(&lake).await.expect("run out");
        assert!(matches!(first.keep().await, Err(Error::LeaseLost { .. })));
        first.release().await.expect("not ours, left alone");
        second.keep().await.expect("held");
    }
}
