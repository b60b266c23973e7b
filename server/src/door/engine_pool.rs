//! The engines of a server: one for each client that asks, a spare that is ready for the next, and an end for those
//! that are idle or take too much.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::Thread;
use std::time::{Duration, Instant};

use echolake_access::TokenAccess;
use echolake_lake::{CACHE_MEMORY_BYTES, Lake};
use echolake_service::{ClientIdentity, DoorMessage, Error, RequestFault};
use tokio::sync::Notify;

use super::engine_process::{EndReason, EngineLease, EngineProcess, EngineSettings, EngineStart};
use super::temp_folder::{ServerFolders, disk_space};
use crate::door::activity::ServerActivity;
use crate::metrics::{DiskSpace, PoolGauges};

/// Time without a request after which an engine ends.
const IDLE: Duration = Duration::from_secs(300);
/// Time between two looks at the memory of engines, while one works and while none does.
const LOOK: Duration = Duration::from_millis(10);
const IDLE_LOOK: Duration = Duration::from_millis(250);
/// Time for which an engine may go on with a request that has ended, until it ends itself; longer on a busy machine.
const AFTERWORK: Duration = Duration::from_secs(2);
/// Time for which a client without an engine waits for a place among the engines.
const PLACE_WAIT: Duration = Duration::from_secs(10);
/// Memory of an engine that is not of its queries: footers of files, small tables, what the allocator keeps.
const CACHE_BYTES: usize = 96 << 20;
/// Clients get no engine for so long after the second one that their queries ended, and for twice as long each time.
const FIRST_BACKOFF: Duration = Duration::from_millis(250);
const LONGEST_BACKOFF: Duration = Duration::from_secs(30);
/// Backoff for which a request waits; during a longer one it is refused.
const BACKOFF_WAIT: Duration = Duration::from_secs(1);
/// Time until a spare engine that did not start is started again.
const START_AGAIN: Duration = Duration::from_secs(2);
/// Time without an end after which a client's earlier ones are forgotten.
const FORGIVEN: Duration = Duration::from_secs(60);

/// The engines.
#[derive(Clone)]
pub(crate) struct EnginePool(Arc<EnginePoolState>);

struct EnginePoolState {
    settings: EngineSettings,
    lake: Lake,
    folders: ServerFolders,
    activity: Arc<ServerActivity>,
    access: Arc<TokenAccess>,
    clients: Arc<ClientEngines>,
    spare: Mutex<Option<Arc<EngineProcess>>>,
    spare_taken: Notify,
    freed: Notify,
    started: AtomicUsize,
    failed: AtomicU64,
    /// Outcome of the last start of an engine; None before the first.
    last_start: Mutex<Option<StartOutcome>>,
    memory_watcher: Thread,
}

/// The engines of clients, by the clients' names.
type ClientEngines = Mutex<HashMap<String, Arc<ClientEngine>>>;

/// Outcome of an engine's start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum StartOutcome {
    Ready,
    Failed,
}

/// A client's engine. The lock is held while one is started, so that a client's requests wait for the same.
#[derive(Default)]
struct ClientEngine {
    state: tokio::sync::Mutex<ClientState>,
    current: Mutex<Option<Arc<EngineProcess>>>,
}

#[derive(Default)]
struct ClientState {
    /// Engines in a row that ended while they answered.
    ends: u32,
    last_end: Option<Instant>,
}

impl EnginePool {
    pub fn new(
        lake: &Lake,
        settings: EngineSettings,
        activity: Arc<ServerActivity>,
        access: Arc<TokenAccess>,
    ) -> Result<Self, Error> {
        let folders = ServerFolders::new(lake, settings.temp.as_deref())?;
        let clients = Arc::<ClientEngines>::default();
        let blocks = if lake.is_remote() { CACHE_MEMORY_BYTES as usize } else { 0 };
        let memory = settings.memory;
        let uncounted = CACHE_BYTES + blocks;
        // A thread of its own: it must not wait for what the door does for clients.
        let watched = Arc::downgrade(&clients);
        let watch = move || {
            while let Some(clients) = watched.upgrade() {
                let is_busy = end_large_engines(&clients, memory, uncounted);
                drop(clients);
                std::thread::sleep(LOOK);
                if !is_busy {
                    // Until the next request, at most.
                    std::thread::park_timeout(IDLE_LOOK);
                }
            }
        };
        let watcher =
            std::thread::Builder::new().name("memory-watch".to_owned()).spawn(watch).map_err(Error::System)?;
        Ok(Self(Arc::new(EnginePoolState {
            settings,
            lake: lake.clone(),
            folders,
            activity,
            access,
            clients,
            spare: Mutex::default(),
            spare_taken: Notify::new(),
            freed: Notify::new(),
            started: AtomicUsize::new(0),
            failed: AtomicU64::new(0),
            last_start: Mutex::default(),
            memory_watcher: watcher.thread().clone(),
        })))
    }

    /// Leases a client's engine for one request. It is started if there is none; a client whose engines end again and
    /// again gets none for longer each time (backoff), which no request prolongs.
    ///
    /// # Errors
    /// [`RequestFault::Unauthenticated`] if the client's token is no longer one; [`RequestFault::TooMany`] if other
    /// clients' engines are all answering; [`RequestFault::Backoff`]; [`RequestFault::EngineEnded`].
    pub async fn lease_for(&self, client: &ClientIdentity) -> Result<EngineLease, RequestFault> {
        let lease = self.lease_engine(client).await?;
        self.0.memory_watcher.unpark();
        Ok(lease)
    }

    async fn lease_engine(&self, client: &ClientIdentity) -> Result<EngineLease, RequestFault> {
        self.0.access.check_current(client)?;
        let own = self.client_engine(&client.name);
        if let Some(lease) = own.lease_current(client) {
            return Ok(lease);
        }
        let mut state = own.state.lock().await;
        // Another request that held the lock may have started one.
        if let Some(lease) = own.lease_current(client) {
            return Ok(lease);
        }
        own.end_outdated(client);
        self.count_end(&own, &mut state).await;
        match state.backoff_left() {
            wait if wait > BACKOFF_WAIT => return Err(RequestFault::Backoff { ends: state.ends, wait }),
            wait => tokio::time::sleep(wait).await,
        }
        self.make_room(&own).await?;
        let engine = self.take_spare().map_err(RequestFault::defect("no engine can be started"))?;
        if let Err(EndReason::Failed(reason)) = engine.assign_client(client).await {
            self.record_start(false);
            state.ends += 1;
            state.last_end = Some(Instant::now());
            tracing::error!(reason, "an engine did not start");
            return Err(RequestFault::EngineEnded { reason });
        }
        let lease = engine
            .hold_for_request()
            .ok_or_else(|| RequestFault::EngineEnded { reason: "it ended at once".to_owned() })?;
        self.record_start(true);
        // The file of tokens may have changed while the engine started.
        if let Err(refused) = self.0.access.check_current(client) {
            engine.kill_process(EndReason::Retired);
            return Err(refused);
        }
        *lock_mutex(&own.current) = Some(engine);
        Ok(lease)
    }

    fn client_engine(&self, name: &str) -> Arc<ClientEngine> {
        lock_mutex(&self.0.clients).entry(name.to_owned()).or_default().clone()
    }

    async fn count_end(&self, own: &ClientEngine, state: &mut ClientState) {
        let ended = lock_mutex(&own.current).take();
        let Some(ended) = ended else { return };
        if let Some(EndReason::Failed(reason)) = ended.why_ended().await {
            tracing::warn!(reason, "an engine ended");
            self.0.failed.fetch_add(1, Ordering::Relaxed);
            if state.last_end.is_some_and(|at| at.elapsed() > FORGIVEN) {
                state.ends = 0;
            }
            state.ends += 1;
            state.last_end = Some(Instant::now());
        }
    }

    // Waits until there is a place among the engines: the one that is idle for longest makes room, with the connections
    // whose clients are silent.
    async fn make_room(&self, own: &Arc<ClientEngine>) -> Result<(), RequestFault> {
        let free = async {
            loop {
                let freed = self.0.freed.notified();
                let live = self.list_live();
                if live.len() < self.0.settings.count {
                    return;
                }
                let idle = live.into_iter().filter_map(|engine| Some((engine.idle_time()?, engine)));
                // One that is asked something meanwhile stays.
                match idle.max_by_key(|(time, _)| *time).filter(|(_, engine)| engine.retire_after(Duration::ZERO)) {
                    Some((_, engine)) => engine.wait_for_end().await,
                    None => drop(tokio::time::timeout(LOOK, freed).await),
                }
            }
        };
        debug_assert!(lock_mutex(&own.current).is_none());
        let limit = self.0.settings.count;
        tokio::time::timeout(PLACE_WAIT, free).await.map_err(|_| RequestFault::TooMany { what: "clients", limit })
    }

    fn list_live(&self) -> Vec<Arc<EngineProcess>> {
        live_engines(&self.0.clients)
    }

    fn take_spare(&self) -> std::io::Result<Arc<EngineProcess>> {
        let spare = lock_mutex(&self.0.spare).take().filter(|engine| !engine.has_ended());
        self.0.spare_taken.notify_one();
        spare.map_or_else(|| self.start_engine(), Ok)
    }

    fn start_engine(&self) -> std::io::Result<Arc<EngineProcess>> {
        let name = format!("engine-{}", self.0.started.fetch_add(1, Ordering::Relaxed));
        let start = EngineStart {
            settings: &self.0.settings,
            lake: self.0.lake.location(),
            lake_folder: self.0.lake.folder(),
            sockets: self.0.folders.sockets.path().join(&name),
            spills: self.0.folders.spills.path().join(&name),
        };
        EngineProcess::spawn_process(start, self.0.activity.clone())
    }

    /// Keeps a spare engine, and ends idle ones; never ends.
    pub async fn keep_up(self) {
        tokio::join!(self.keep_spare(), self.clone().retire_idle());
    }

    /// Checks that engines can be started, by how the last start went.
    ///
    /// # Errors
    /// [`RequestFault::NotReady`].
    pub fn check_start(&self) -> Result<(), RequestFault> {
        let reason = match *lock_mutex(&self.0.last_start) {
            Some(StartOutcome::Ready) => return Ok(()),
            Some(StartOutcome::Failed) => "no engine can be started",
            None => "its first engine is starting",
        };
        Err(RequestFault::NotReady { reason })
    }

    fn record_start(&self, is_ready: bool) {
        *lock_mutex(&self.0.last_start) = Some(if is_ready { StartOutcome::Ready } else { StartOutcome::Failed });
    }

    async fn keep_spare(&self) {
        loop {
            let taken = self.0.spare_taken.notified();
            let spare = match self.spare_or_start() {
                Ok(spare) => spare,
                Err(failed) => {
                    self.record_start(false);
                    tracing::error!(error = &failed as &dyn std::error::Error, "no spare engine can be started");
                    tokio::time::sleep(START_AGAIN).await;
                    continue;
                }
            };
            let watch = async {
                if let Err(reason) = spare.wait_until_ready().await {
                    self.record_start(false);
                    tracing::error!(?reason, "a spare engine did not start");
                    tokio::time::sleep(START_AGAIN).await;
                    return;
                }
                self.record_start(true);
                spare.wait_for_end().await;
            };
            tokio::select! {
                () = taken => {}
                () = watch => {}
            }
        }
    }

    fn spare_or_start(&self) -> std::io::Result<Arc<EngineProcess>> {
        let spare = lock_mutex(&self.0.spare).clone().filter(|spare| !spare.has_ended());
        if let Some(spare) = spare {
            return Ok(spare);
        }
        let started = self.start_engine()?;
        *lock_mutex(&self.0.spare) = Some(started.clone());
        Ok(started)
    }

    /// Ends the engines that are idle; never ends.
    pub async fn retire_idle(self) {
        loop {
            tokio::time::sleep(IDLE / 10).await;
            // One with connections stays until its place is needed.
            for engine in self.list_live().into_iter().filter(|engine| !engine.has_requests()) {
                engine.retire_after(IDLE);
            }
            // Clients may come under any number of names.
            lock_mutex(&self.0.clients).retain(|_, client| client.is_known() || Arc::strong_count(client) > 1);
        }
    }

    /// Ends a client's engine, with all that it answers.
    pub fn end_client(&self, name: &str) {
        let own = lock_mutex(&self.0.clients).get(name).cloned();
        if let Some(engine) = own.and_then(|own| lock_mutex(&own.current).clone()) {
            engine.kill_process(EndReason::Retired);
        }
    }

    /// Ends all engines.
    pub async fn end_all(&self) {
        let spare = lock_mutex(&self.0.spare).take();
        for engine in self.list_live().into_iter().chain(spare) {
            engine.kill_process(EndReason::Retired);
            engine.wait_for_end().await;
        }
    }

    /// Cancels a query of an engine's process by its number there.
    pub async fn cancel_query(&self, pid: u32, number: u64) {
        let engine = self.list_live().into_iter().find(|engine| engine.pid() == pid);
        if let Some(engine) = engine {
            // One that ends meanwhile runs nothing.
            let _ = engine.send_message(&DoorMessage::Cancel(number)).await;
        }
    }

    /// Gauges of the engines.
    pub fn pool_gauges(&self) -> PoolGauges {
        let live = self.list_live();
        PoolGauges {
            engines: live.len(),
            most_engines: self.0.settings.count,
            bytes: live.iter().map(|engine| engine.grown_bytes()).sum(),
            most_bytes: self.0.settings.memory,
            started: self.0.started.load(Ordering::Relaxed),
            failed: self.0.failed.load(Ordering::Relaxed),
        }
    }

    /// Space on the disks of the lake, if it is in a folder, and of temporary files.
    pub fn disk_spaces(&self) -> Vec<(&'static str, DiskSpace)> {
        let folders = [("lake", self.0.lake.folder()), ("temp", Some(self.0.folders.spills.path()))];
        folders.into_iter().filter_map(|(name, folder)| Some((name, disk_space(folder?)?))).collect()
    }
}

impl ClientEngine {
    fn lease_current(&self, client: &ClientIdentity) -> Option<EngineLease> {
        lock_mutex(&self.current)
            .as_ref()
            .filter(|engine| engine.is_of(client))
            .and_then(EngineProcess::hold_for_request)
    }

    // An engine knows what its client may do from its start.
    fn end_outdated(&self, client: &ClientIdentity) {
        if let Some(engine) = lock_mutex(&self.current).as_ref().filter(|engine| !engine.is_of(client)) {
            engine.kill_process(EndReason::Retired);
        }
    }

    // Whether it has an engine, or had ones that ended and are not forgotten.
    fn is_known(&self) -> bool {
        let has_engine = lock_mutex(&self.current).as_ref().is_some_and(|engine| !engine.has_ended());
        let last_end = self.state.try_lock().ok().and_then(|state| state.last_end);
        has_engine || last_end.is_some_and(|at| at.elapsed() < FORGIVEN)
    }
}

impl ClientState {
    // Time that is left of the backoff.
    fn backoff_left(&self) -> Duration {
        let whole = match self.ends {
            0 | 1 => Duration::ZERO,
            ends => LONGEST_BACKOFF.min(FIRST_BACKOFF * 2_u32.saturating_pow(ends - 2)),
        };
        whole.saturating_sub(self.last_end.map_or(Duration::ZERO, |at| at.elapsed()))
    }
}

// The engines that have a client.
fn live_engines(clients: &ClientEngines) -> Vec<Arc<EngineProcess>> {
    let clients = lock_mutex(clients);
    let engines = clients.values().filter_map(|client| lock_mutex(&client.current).clone());
    engines.filter(|engine| !engine.has_ended()).collect()
}

// Ends engines that take more memory than they may, beside `uncounted` bytes each; returns whether an engine works.
fn end_large_engines(clients: &ClientEngines, memory: usize, uncounted: usize) -> bool {
    let size = |engine: &EngineProcess| engine.grown_bytes().saturating_sub(uncounted);
    let sizes: Vec<_> = live_engines(clients).into_iter().map(|engine| (size(&engine), engine)).collect();
    for (bytes, engine) in &sizes {
        if let Some(limit) = engine.memory_limit().filter(|limit| bytes > limit) {
            engine.kill_process(EndReason::Failed(format!(
                "its client's queries took more than {} MB",
                limit / 1_000_000
            )));
        }
    }
    if sizes.iter().map(|(bytes, _)| bytes).sum::<usize>() > memory
        && let Some((_, largest)) = sizes.iter().max_by_key(|(bytes, _)| *bytes)
        // One that only keeps what it once had has done nothing wrong.
        && (largest.has_queries() || !largest.retire_after(Duration::ZERO))
    {
        let reason = format!("queries took more than {} MiB, and its client's the most", memory >> 20);
        largest.kill_process(EndReason::Failed(reason));
    }
    let is_working = |engine: &EngineProcess| engine.idle_time().is_none_or(|idle| idle < AFTERWORK);
    sizes.iter().any(|(_, engine)| engine.has_queries() || is_working(engine))
}

fn lock_mutex<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waits_grow_to_a_limit_and_pass() {
        let waits = |ends| ClientState { ends, last_end: None }.backoff_left();
        assert_eq!([0, 1, 2, 3].map(waits), [0, 0, 250, 500].map(Duration::from_millis));
        assert_eq!(waits(u32::MAX), LONGEST_BACKOFF);
        let ago = |secs| Instant::now().checked_sub(Duration::from_secs(secs));
        let left = |secs| ClientState { ends: 9, last_end: ago(secs) }.backoff_left();
        assert!(left(20) <= Duration::from_secs(10) && left(20) > Duration::from_secs(9));
        assert_eq!(left(30), Duration::ZERO, "whoever asked meanwhile");
    }
}
