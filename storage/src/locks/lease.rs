//! The maintenance lease: numbered objects, of which the last names the process at work on the lake's files.
//!
//! It keeps two processes from doing the same work, and the error of the second one names the first. Correctness does
//! not depend on it: a merge is a commit of its own, which fails if another was faster.
//!
//! To take the lease, to renew it and to give it back is to create the next number, which one process alone can.
//! Numbers are never used again, so that a holder that was stopped for long cannot take its place a second time.

use std::sync::Arc;
use std::time::{Duration, Instant};

use chrono::{DateTime, TimeDelta, Utc};
use futures::TryStreamExt as _;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _};
use serde::{Deserialize, Serialize};

use super::process_identity::{ProcessIdentity, host_name};
use crate::remote::create_object;
use crate::{Error, Lake, Result};

/// Folder of the lease's objects.
const FOLDER: &str = "tables/_maintenance";
/// Time that it holds after its last renewal. A dead holder blocks other machines that long.
const HOLDS: TimeDelta = TimeDelta::minutes(10);
/// Time between two renewals.
const RENEW_EVERY: Duration = Duration::from_secs(60);
/// Time between two looks at who holds it, if the lake is on an object store.
const LOOK_EVERY: Duration = Duration::from_secs(10);

/// The lease, held.
#[derive(Debug)]
pub(crate) struct MaintenanceLease {
    store: Arc<dyn ObjectStore>,
    location: String,
    record: LeaseRecord,
    number: u64,
    renewed: Instant,
    looked: Instant,
    look_every: Duration,
}

/// Contents of the object.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct LeaseRecord {
    /// Distinguishes all that ever held it.
    holder: String,
    host: String,
    pid: u32,
    /// None if its system does not tell, or an older version wrote it.
    #[serde(default)]
    process: Option<ProcessIdentity>,
    expires: DateTime<Utc>,
}

impl LeaseRecord {
    fn new() -> Self {
        let host = host_name();
        let pid = std::process::id();
        let now = Utc::now();
        let holder = format!("{host}.{pid}.{}", now.timestamp_nanos_opt().unwrap_or_default());
        Self { holder, host, pid, process: ProcessIdentity::current(), expires: now + HOLDS }
    }

    fn is_held(&self) -> bool {
        self.expires > Utc::now() && !self.process.as_ref().is_some_and(ProcessIdentity::has_ended)
    }

    fn to_json(&self) -> Vec<u8> {
        // A struct of texts and numbers always has a JSON form.
        serde_json::to_vec_pretty(self).unwrap_or_default()
    }
}

impl MaintenanceLease {
    /// Acquires the lease; an expired one is taken over.
    ///
    /// # Errors
    /// [`Error::Maintained`] if another process holds it, or what the store says.
    pub async fn acquire(lake: &Lake) -> Result<Self> {
        lake.ensure_exclusive().await?;
        let store = lake.store();
        let location = lake.location().to_owned();
        let record = LeaseRecord::new();
        let last = last_number(store.as_ref()).await?;
        if let Some(held) = read_lease(store.as_ref(), last).await?
            && held.is_held()
        {
            return Err(maintained_error(location, &held));
        }
        let number = last + 1;
        if !create_lease(store.as_ref(), number, &record).await? {
            let held = read_lease(store.as_ref(), number).await?.unwrap_or(record);
            return Err(maintained_error(location, &held));
        }
        delete_before(store.as_ref(), number).await;
        let now = Instant::now();
        let look_every = if lake.is_remote() { LOOK_EVERY } else { Duration::ZERO };
        Ok(Self { store, location, record, number, renewed: now, looked: now, look_every })
    }

    /// Checks that it is still held, and renews it if [`RENEW_EVERY`] has passed.
    ///
    /// # Errors
    /// [`Error::LeaseLost`] if another process has taken it over, or what the store says.
    pub async fn ensure_held(&mut self) -> Result<()> {
        let lost = || Error::LeaseLost { location: self.location.clone() };
        if self.renewed.elapsed() >= RENEW_EVERY {
            self.record.expires = Utc::now() + HOLDS;
            if !create_lease(self.store.as_ref(), self.number + 1, &self.record).await? {
                return Err(lost());
            }
            self.number += 1;
            delete_before(self.store.as_ref(), self.number).await;
            self.renewed = Instant::now();
            self.looked = self.renewed;
        } else if self.looked.elapsed() >= self.look_every {
            if read_lease(self.store.as_ref(), self.number + 1).await?.is_some() {
                return Err(lost());
            }
            self.looked = Instant::now();
        }
        Ok(())
    }

    /// Gives it back, if it is still held: what comes next has expired.
    ///
    /// # Errors
    /// What the store says.
    pub async fn release(mut self) -> Result<()> {
        self.record.expires = DateTime::UNIX_EPOCH;
        if create_lease(self.store.as_ref(), self.number + 1, &self.record).await? {
            delete_before(self.store.as_ref(), self.number + 1).await;
        }
        Ok(())
    }
}

fn maintained_error(location: String, held: &LeaseRecord) -> Error {
    let until = held.expires.format("%Y-%m-%d %H:%M:%S UTC").to_string();
    Error::Maintained { location, host: held.host.clone(), pid: held.pid, until }
}

fn lease_path(number: u64) -> Path {
    Path::from(format!("{FOLDER}/{number:020}.json"))
}

fn number_of(path: &Path) -> Option<u64> {
    path.filename()?.strip_suffix(".json")?.parse().ok()
}

async fn list_numbers(store: &dyn ObjectStore) -> object_store::Result<Vec<u64>> {
    let there: Vec<_> = store.list(Some(&Path::from(FOLDER))).try_collect().await?;
    Ok(there.iter().filter_map(|object| number_of(&object.location)).collect())
}

async fn last_number(store: &dyn ObjectStore) -> Result<u64> {
    let numbers = list_numbers(store).await.map_err(|e| Error::store_failure("list", FOLDER, e))?;
    Ok(numbers.into_iter().max().unwrap_or(0))
}

// Returns whether it was created; false if another process took the number.
async fn create_lease(store: &dyn ObjectStore, number: u64, record: &LeaseRecord) -> Result<bool> {
    let created = create_object(store, &lease_path(number), record.to_json().into()).await;
    created.map_err(|e| Error::store_failure("write", lease_path(number), e))
}

// Lower numbers say nothing any more; those that stay are deleted by the next holder.
async fn delete_before(store: &dyn ObjectStore, number: u64) {
    for old in list_numbers(store).await.unwrap_or_default().into_iter().filter(|old| *old < number) {
        let _ = store.delete(&lease_path(old)).await;
    }
}

// One that cannot be read holds from its making on, as any other.
async fn read_lease(store: &dyn ObjectStore, number: u64) -> Result<Option<LeaseRecord>> {
    let failed = |e| Error::store_failure("read", lease_path(number), e);
    let found = match store.get(&lease_path(number)).await {
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
    let unreadable =
        || LeaseRecord { holder: String::new(), host: "?".into(), pid: 0, process: None, expires: made + HOLDS };
    Ok(Some(serde_json::from_slice(&bytes).unwrap_or_else(|_| unreadable())))
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
        let mut first = MaintenanceLease::acquire(&lake).await.expect("free");
        first.ensure_held().await.expect("held");
        let error = MaintenanceLease::acquire(&lake).await.expect_err("held").to_string();
        assert!(error.contains(&format!("process {}", std::process::id())) && error.contains(&host_name()), "{error}");
        first.release().await.expect("given back");
        MaintenanceLease::acquire(&lake).await.expect("free again");
    }

    #[tokio::test]
    async fn a_holder_that_was_killed_on_this_machine_blocks_nobody() {
        let lake = lake().await;
        let mut first = MaintenanceLease::acquire(&lake).await.expect("free");
        let mut child = std::process::Command::new("sleep").arg("600").spawn().expect("it starts");
        let running = ProcessIdentity::from_pid(child.id()).expect("it runs");
        first.record.process = Some(running);
        lake.store().put(&lease_path(first.number), first.record.to_json().into()).await.expect("written");
        assert!(matches!(MaintenanceLease::acquire(&lake).await, Err(Error::Maintained { .. })));
        child.kill().expect("killed");
        child.wait().expect("ended");
        MaintenanceLease::acquire(&lake).await.expect("at once");
    }

    #[tokio::test]
    async fn a_dead_holder_is_followed_and_notices_where_it_was_not_dead() {
        let lake = lake().await;
        let mut first = MaintenanceLease::acquire(&lake).await.expect("free");
        first.record.expires = Utc::now() - TimeDelta::seconds(1);
        lake.store().put(&lease_path(first.number), first.record.to_json().into()).await.expect("written");
        let mut second = MaintenanceLease::acquire(&lake).await.expect("run out");
        assert!(matches!(first.ensure_held().await, Err(Error::LeaseLost { .. })));
        first.release().await.expect("not ours, left alone");
        second.ensure_held().await.expect("held");
        second.release().await.expect("given back");
        let there = list_numbers(lake.store().as_ref()).await.expect("listed");
        assert_eq!(there, [3], "taken twice and given back, and no number is used again");
    }
}
