//! Claims on work: of several ingesters on one object store, one takes in a run, the others leave it to it.
//!
//! A claim is a row of numbered objects in `tables/_claims/`. To claim work is to create its number 1, which one
//! process alone can. The holder creates the next number every few seconds; who waits sees the highest number change. A
//! claim is dead if its number has not changed for a while by the clock of the one who waits, so that no two clocks
//! need agree, or if its holder ran on the machine of the one who waits and has ended; who takes it over creates the
//! next number. At its end the holder deletes the numbers, the first of them last.
//!
//! A claim saves work, and nothing rests on it: if the store fails, or a holder was stopped for long, two do the same
//! work, and commits add it once.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures::TryStreamExt as _;
use futures::future::join_all;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _, Result as StoreResult};
use sha2::{Digest as _, Sha256};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use uuid::Uuid;

use super::process_identity::{ProcessIdentity, host_name};
use crate::Lake;
use crate::remote::create_object;

/// Folder of the claims' objects.
pub(crate) const FOLDER: &str = "tables/_claims";
/// Hexadecimal digits of the digest that names the work.
const KEY_DIGITS: usize = 24;

/// Times of claims.
#[derive(Debug, Clone, Copy)]
pub struct ClaimTimes {
    /// Time between two renewals of a claim.
    pub renew_every: Duration,
    /// Time for which the number of a live claim may stay the same.
    pub dead_after: Duration,
}

impl Default for ClaimTimes {
    fn default() -> Self {
        Self { renew_every: Duration::from_secs(10), dead_after: Duration::from_secs(45) }
    }
}

/// Outcome of an attempt to claim work.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ClaimOutcome {
    /// It is claimed for this process, or the store does not say and it may as well do the work.
    Granted,
    /// Another process is at it.
    Denied,
}

/// The claims of one process on a lake's work. Dropped, or closed, it gives back what it holds.
#[derive(Debug)]
pub struct WorkClaims {
    state: Arc<ClaimState>,
    ended: mpsc::UnboundedSender<String>,
    keeper: JoinHandle<()>,
}

#[derive(Debug)]
struct ClaimState {
    store: Arc<dyn ObjectStore>,
    /// Distinguishes all that ever claimed work; for people, too.
    holder: String,
    /// Its identity as JSON, `null` if the system does not tell.
    process: String,
    times: ClaimTimes,
    board: Mutex<ClaimBoard>,
}

#[derive(Debug, Default)]
struct ClaimBoard {
    /// Others' claims by key.
    seen: HashMap<String, SeenClaim>,
    /// Highest numbers of the own claims, by key.
    held: HashMap<String, u64>,
}

/// A claim of another process.
#[derive(Debug, Clone)]
struct SeenClaim {
    /// Its highest number.
    number: u64,
    /// The time at which that was first seen.
    since: Instant,
    /// Its holder, if the system there tells.
    holder: Option<ProcessIdentity>,
}

impl SeenClaim {
    fn has_ended(&self) -> bool {
        self.holder.as_ref().is_some_and(ProcessIdentity::has_ended)
    }
}

impl WorkClaims {
    /// Starts to hold claims on a lake's work; needs a Tokio runtime.
    pub fn start(lake: &Lake, times: ClaimTimes) -> Self {
        let holder = format!("{} {} {}", host_name(), std::process::id(), Uuid::new_v4().simple());
        // A struct of texts and numbers always has a JSON form.
        let process = serde_json::to_string(&ProcessIdentity::current()).unwrap_or_default();
        let state = Arc::new(ClaimState { store: lake.store(), holder, process, times, board: Mutex::default() });
        let (ended, released) = mpsc::unbounded_channel();
        let keeper = tokio::spawn(keep_claims(state.clone(), released));
        Self { state, ended, keeper }
    }

    /// Claims work by its name.
    pub async fn claim_work(&self, work: &str) -> ClaimOutcome {
        let key = key_of(work);
        // A store that fails will fail the work, too, and say so.
        self.state.claim_key(&key).await.unwrap_or(ClaimOutcome::Granted)
    }

    /// Gives work back, soon.
    pub fn release_work(&self, work: &str) {
        // Without its keeper, all is given back already.
        let _ = self.ended.send(key_of(work));
    }

    /// Looks at all claims, in one request and one for each claim that is new.
    pub async fn refresh_claims(&self) {
        // A store that fails will fail the work, too, and say so.
        let _ = self.state.refresh_claims().await;
    }

    /// Returns whether, at the last look, nobody alive held this work, this process included.
    pub fn is_free(&self, work: &str) -> bool {
        let key = key_of(work);
        let board = self.state.lock_board();
        !board.held.contains_key(&key) && board.seen.get(&key).is_none_or(|seen| self.state.is_dead(seen))
    }

    /// Gives back all that is held.
    pub async fn release_all(self) {
        drop(self.ended);
        // A panic there has nothing to do with the work.
        let _ = self.keeper.await;
    }
}

impl ClaimState {
    fn lock_board(&self) -> MutexGuard<'_, ClaimBoard> {
        self.board.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn is_dead(&self, claim: &SeenClaim) -> bool {
        claim.has_ended() || claim.since.elapsed() >= self.times.dead_after
    }

    async fn claim_key(&self, key: &str) -> StoreResult<ClaimOutcome> {
        let dead = || self.lock_board().seen.get(key).filter(|claim| self.is_dead(claim)).cloned();
        // What was seen long ago may be gone since.
        if dead().is_some() {
            self.refresh_claims().await?;
        }
        let mut number = dead().map_or(1, |claim| claim.number + 1);
        if !self.create_claim(key, number).await? {
            self.refresh_claims().await?;
            let ended = self.lock_board().seen.get(key).filter(|claim| claim.has_ended()).map(|claim| claim.number);
            let Some(last) = ended else { return Ok(ClaimOutcome::Denied) };
            number = last + 1;
            if !self.create_claim(key, number).await? {
                return Ok(ClaimOutcome::Denied);
            }
        }
        let mut board = self.lock_board();
        board.seen.remove(key);
        board.held.insert(key.to_owned(), number);
        Ok(ClaimOutcome::Granted)
    }

    // Notes the highest number of each claim of others, and when it was first seen.
    async fn refresh_claims(&self) -> StoreResult<()> {
        let mut highest: HashMap<String, u64> = HashMap::new();
        for (key, number) in self.list_claims().await? {
            let last = highest.entry(key).or_default();
            *last = number.max(*last);
        }
        let news: Vec<_> = {
            let mut board = self.lock_board();
            let ClaimBoard { seen, held } = &mut *board;
            seen.retain(|key, claim| highest.get(key) == Some(&claim.number));
            highest.retain(|key, _| !held.contains_key(key) && !seen.contains_key(key));
            highest.into_iter().collect()
        };
        let claims = news.iter().map(|(key, number)| self.read_claim(key, *number));
        let claims = join_all(claims).await;
        let mut board = self.lock_board();
        let claims = news.into_iter().zip(claims).filter(|((key, _), _)| !board.held.contains_key(key));
        let claims: Vec<_> = claims.map(|((key, _), claim)| (key, claim)).collect();
        board.seen.extend(claims);
        Ok(())
    }

    // One that cannot be read lives until its time is over.
    async fn read_claim(&self, key: &str, number: u64) -> SeenClaim {
        let since = Instant::now();
        let text = async { self.store.get(&claim_path(key, number)).await?.bytes().await };
        let process = |text: &Bytes| serde_json::from_slice(text.split(|byte| *byte == b'\n').nth(1)?).ok();
        SeenClaim { number, since, holder: text.await.ok().as_ref().and_then(process) }
    }

    // Returns whether it was created; false if another process has the number.
    async fn create_claim(&self, key: &str, number: u64) -> StoreResult<bool> {
        let text = format!("{} {number}\n{}\n", self.holder, self.process);
        create_object(self.store.as_ref(), &claim_path(key, number), text.into()).await
    }

    async fn list_claims(&self) -> StoreResult<Vec<(String, u64)>> {
        let there: Vec<_> = self.store.list(Some(&Path::from(FOLDER))).try_collect().await?;
        Ok(there.iter().filter_map(|meta| claim_of(&meta.location)).collect())
    }

    // The first number stays until the end, so that to create it is to find the work free.
    async fn renew_claims(&self) {
        let held: Vec<_> = self.lock_board().held.iter().map(|(key, number)| (key.clone(), *number)).collect();
        for (key, number) in held {
            match self.create_claim(&key, number + 1).await {
                Ok(true) => {
                    self.lock_board().held.insert(key.clone(), number + 1);
                    if number > 1 {
                        let _ = self.store.delete(&claim_path(&key, number)).await;
                    }
                }
                // Another process took it over, or its objects were deleted; the work goes on.
                Ok(false) => drop(self.lock_board().held.remove(&key)),
                Err(_) => {}
            }
        }
    }

    async fn give_back(&self, keys: &[String]) {
        let held: Vec<_> = keys.iter().filter(|key| self.lock_board().held.remove(*key).is_some()).collect();
        if held.is_empty() {
            return;
        }
        let mut numbers = self.list_claims().await.unwrap_or_default();
        numbers.sort_unstable_by_key(|(_, number)| std::cmp::Reverse(*number));
        for (key, number) in numbers.iter().filter(|(key, _)| held.contains(&key)) {
            // One that stays is dead after a while.
            let _ = self.store.delete(&claim_path(key, *number)).await;
        }
    }
}

async fn keep_claims(state: Arc<ClaimState>, mut released: mpsc::UnboundedReceiver<String>) {
    let mut renewals = tokio::time::interval(state.times.renew_every);
    renewals.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    renewals.tick().await;
    loop {
        tokio::select! {
            key = released.recv() => match key {
                Some(key) => {
                    let mut keys = vec![key];
                    while let Ok(more) = released.try_recv() {
                        keys.push(more);
                    }
                    state.give_back(&keys).await;
                }
                None => break,
            },
            _ = renewals.tick() => state.renew_claims().await,
        }
    }
    let held: Vec<_> = state.lock_board().held.keys().cloned().collect();
    state.give_back(&held).await;
}

fn key_of(work: &str) -> String {
    hex::encode(Sha256::digest(work.as_bytes()))[..KEY_DIGITS].to_owned()
}

fn claim_path(key: &str, number: u64) -> Path {
    Path::from(format!("{FOLDER}/{key}.{number:020}"))
}

fn claim_of(path: &Path) -> Option<(String, u64)> {
    let (key, number) = path.filename()?.split_once('.')?;
    Some((key.to_owned(), number.parse().ok()?))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use echolake_schema::Rig;

    use super::*;
    use crate::ReferenceSurfaces;

    const WORK: &str = "r.mcap";
    /// Renewals never come, others' claims die at once.
    const STOPPED: ClaimTimes = ClaimTimes { renew_every: Duration::from_secs(3600), dead_after: Duration::ZERO };
    const LIVELY: ClaimTimes =
        ClaimTimes { renew_every: Duration::from_millis(10), dead_after: Duration::from_secs(3600) };

    async fn lake() -> Lake {
        Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake")
    }

    async fn objects(lake: &Lake) -> Vec<Path> {
        let there: Vec<_> = lake.store().list(Some(&Path::from(FOLDER))).try_collect().await.expect("listed");
        there.into_iter().map(|meta| meta.location).collect()
    }

    #[tokio::test]
    async fn of_many_one_is_granted_and_after_its_end_another() {
        let lake = lake().await;
        let claimers: Vec<_> = (0..8).map(|_| WorkClaims::start(&lake, ClaimTimes::default())).collect();
        let outcomes = futures::future::join_all(claimers.iter().map(|claims| claims.claim_work(WORK))).await;
        let granted: Vec<_> = (0..8).filter(|n| outcomes[*n] == ClaimOutcome::Granted).collect();
        assert_eq!(granted.len(), 1, "{outcomes:?}");
        let other = &claimers[(granted[0] + 1) % 8];
        assert_eq!(other.claim_work("another.mcap").await, ClaimOutcome::Granted);
        let third = &claimers[(granted[0] + 2) % 8];
        for claims in [third, &claimers[granted[0]]] {
            claims.refresh_claims().await;
            assert!(!claims.is_free(WORK) && claims.is_free("free.mcap"));
        }
        for claims in claimers {
            claims.release_all().await;
        }
        assert!(objects(&lake).await.is_empty());
        let next = WorkClaims::start(&lake, ClaimTimes::default());
        assert_eq!(next.claim_work(WORK).await, ClaimOutcome::Granted);
    }

    #[tokio::test]
    async fn a_claim_of_a_process_that_was_killed_on_this_machine_is_dead_at_once() {
        let lake = lake().await;
        let mut child = std::process::Command::new("sleep").arg("600").spawn().expect("it starts");
        let running = ProcessIdentity::from_pid(child.id()).expect("it runs");
        let text = format!("host 1 x 1\n{}\n", serde_json::to_string(&running).expect("text"));
        lake.store().put(&claim_path(&key_of(WORK), 1), text.into()).await.expect("written");
        let patient = || WorkClaims::start(&lake, ClaimTimes { renew_every: Duration::from_secs(3600), ..LIVELY });
        let first = patient();
        assert_eq!(first.claim_work(WORK).await, ClaimOutcome::Denied);
        assert!(!first.is_free(WORK));
        child.kill().expect("killed");
        child.wait().expect("ended");
        assert!(first.is_free(WORK), "it looked before");
        let (second, third) = (patient(), patient());
        assert_eq!(second.claim_work(WORK).await, ClaimOutcome::Granted);
        assert_eq!(third.claim_work(WORK).await, ClaimOutcome::Denied, "the second one runs");
    }

    #[tokio::test]
    async fn a_claim_is_dead_if_its_number_stays_the_same_and_alive_if_it_changes() {
        let lake = lake().await;
        let dead = WorkClaims::start(&lake, STOPPED);
        assert_eq!(dead.claim_work(WORK).await, ClaimOutcome::Granted);
        let second = WorkClaims::start(&lake, STOPPED);
        assert_eq!(second.claim_work(WORK).await, ClaimOutcome::Denied, "seen for the first time");
        second.refresh_claims().await;
        assert!(second.is_free(WORK));
        assert_eq!(second.claim_work(WORK).await, ClaimOutcome::Granted, "its number did not change");
        // It was not dead: it finds its number taken, and gives back nothing of the other's.
        dead.state.renew_claims().await;
        dead.release_all().await;
        let third = WorkClaims::start(&lake, ClaimTimes::default());
        assert_eq!(third.claim_work(WORK).await, ClaimOutcome::Denied);
        second.release_all().await;
        assert!(objects(&lake).await.is_empty());

        let alive = WorkClaims::start(&lake, LIVELY);
        assert_eq!(alive.claim_work(WORK).await, ClaimOutcome::Granted);
        let patient = ClaimTimes { dead_after: Duration::from_millis(500), ..STOPPED };
        let other = WorkClaims::start(&lake, patient);
        for _ in 0..10 {
            tokio::time::sleep(Duration::from_millis(100)).await;
            assert_eq!(other.claim_work(WORK).await, ClaimOutcome::Denied);
        }
        alive.release_work(WORK);
        for _ in 0..500 {
            if other.claim_work(WORK).await == ClaimOutcome::Granted {
                return;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        panic!("it was never given back");
    }
}
