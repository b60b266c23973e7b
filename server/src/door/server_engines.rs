//! The engines of a server: one of pages, one of statements, and a warmed spare of the latter. All clients share them.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use echolake_access::TokenAccess;
use echolake_lake::Lake;
use echolake_service::{ClientIdentity, DoorMessage, EngineRole, Error, RequestFault};
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;

use super::engine_ends::EngineEnds;
use super::engine_process::{EndReason, EngineProcess, EngineSettings, EngineStart};
use super::temp_folder::{ServerFolders, disk_space};
use crate::door::activity::ServerActivity;
use crate::metrics::{DiskSpace, EngineGauges};

/// Time until an engine that did not start is started again.
const START_AGAIN: Duration = Duration::from_secs(2);
/// Engines of a server: both roles, and the spare.
const MOST_ENGINES: usize = EngineRole::ALL.len() + 1;

/// The engines. Clones are the same.
#[derive(Clone)]
pub(crate) struct ServerEngines(Arc<EnginesState>);

struct EnginesState {
    settings: EngineSettings,
    lake: Lake,
    folders: ServerFolders,
    activity: Arc<ServerActivity>,
    access: Arc<TokenAccess>,
    pages: EnginePlace,
    statements: EnginePlace,
    /// An engine of statements that is ready for the end of the other.
    spare: Mutex<Option<Arc<EngineProcess>>>,
    spare_taken: Notify,
    ends: EngineEnds,
    /// Requests that were asked when an engine ended without naming a culprit are repeated one after the other, so that
    /// the one that ends the next engine is known.
    suspects: tokio::sync::Mutex<()>,
    /// What ends with a client, by its name.
    client_ends: Mutex<HashMap<String, CancellationToken>>,
    started: AtomicUsize,
    failed: AtomicU64,
    /// Outcome of the last start of an engine; None before the first.
    last_start: Mutex<Option<StartOutcome>>,
}

/// The place of the engine of a role.
#[derive(Default)]
struct EnginePlace {
    current: Mutex<Option<Arc<EngineProcess>>>,
    /// Held while one is started, so that all requests wait for the same.
    starting: tokio::sync::Mutex<()>,
}

/// Outcome of an engine's start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum StartOutcome {
    Ready,
    Failed,
}

impl ServerEngines {
    /// The engines of a lake; none is started yet.
    ///
    /// # Errors
    /// [`Error::Temp`].
    pub fn new(
        lake: &Lake,
        settings: EngineSettings,
        activity: Arc<ServerActivity>,
        access: Arc<TokenAccess>,
    ) -> Result<Self, Error> {
        let folders = ServerFolders::new(lake, settings.temp.as_deref())?;
        Ok(Self(Arc::new(EnginesState {
            settings,
            lake: lake.clone(),
            folders,
            activity,
            access,
            pages: EnginePlace::default(),
            statements: EnginePlace::default(),
            spare: Mutex::default(),
            spare_taken: Notify::new(),
            ends: EngineEnds::default(),
            suspects: tokio::sync::Mutex::default(),
            client_ends: Mutex::default(),
            started: AtomicUsize::new(0),
            failed: AtomicU64::new(0),
            last_start: Mutex::default(),
        })))
    }

    /// Finds the engine of a role for one request of a client, and starts it if there is none. A client whose
    /// statements end engines again and again waits for longer each time (backoff), which no request prolongs.
    ///
    /// # Errors
    /// [`RequestFault::Unauthenticated`] if the client's token is no longer one; [`RequestFault::Backoff`];
    /// [`RequestFault::EngineLost`].
    pub async fn engine_for(
        &self,
        role: EngineRole,
        client: &ClientIdentity,
    ) -> Result<Arc<EngineProcess>, RequestFault> {
        self.0.access.check_current(client)?;
        if role == EngineRole::Statements {
            self.0.ends.wait_for_turn(&client.name).await?;
        }
        // An engine that was killed while it started is started once more.
        let engine = match self.started_engine(role).await {
            Err(RequestFault::EngineLost { .. }) => self.started_engine(role).await?,
            started => started?,
        };
        // The file of tokens may have changed while the engine started.
        self.0.access.check_current(client)?;
        Ok(engine)
    }

    async fn started_engine(&self, role: EngineRole) -> Result<Arc<EngineProcess>, RequestFault> {
        let place = self.place_of(role);
        let live = match place.live_engine() {
            Some(engine) => engine,
            None => {
                let _starting = place.starting.lock().await;
                // Another request that held the lock may have started one.
                match place.live_engine() {
                    Some(engine) => engine,
                    None => {
                        let failed = RequestFault::defect("no engine can be started");
                        let engine = self.take_or_start(role).map_err(failed)?;
                        // Set at once: a request that is dropped while the engine starts leaves it to the next, and to
                        // the server's end.
                        *lock_mutex(&place.current) = Some(engine.clone());
                        engine
                    }
                }
            }
        };
        self.wait_for_start(&live).await?;
        Ok(live)
    }

    // Waits until an engine of the place is ready; it is in its place already.
    async fn wait_for_start(&self, engine: &EngineProcess) -> Result<(), RequestFault> {
        let started = engine.wait_until_ready().await;
        self.record_start(started.is_ok());
        started.map_err(|why| {
            let reason = why.text();
            tracing::error!(reason, "an engine did not start");
            RequestFault::EngineLost { reason }
        })
    }

    /// Counts an engine that ended without naming a culprit against a client whose request it had alone.
    pub fn count_lone_end(&self, client: &ClientIdentity) {
        self.0.ends.count_end(&client.name);
    }

    /// The turn of a request that is repeated because an engine ended without naming a culprit.
    pub async fn suspect_turn(&self) -> tokio::sync::MutexGuard<'_, ()> {
        self.0.suspects.lock().await
    }

    /// What is cancelled when the client of this name may no longer ask, or may do other things.
    pub fn client_end(&self, name: &str) -> CancellationToken {
        // Without tokens clients come under any number of names, and none is ever taken back.
        match self.0.access.is_open() {
            true => CancellationToken::new(),
            false => lock_mutex(&self.0.client_ends).entry(name.to_owned()).or_default().clone(),
        }
    }

    fn place_of(&self, role: EngineRole) -> &EnginePlace {
        match role {
            EngineRole::Pages => &self.0.pages,
            EngineRole::Statements => &self.0.statements,
        }
    }

    fn take_or_start(&self, role: EngineRole) -> std::io::Result<Arc<EngineProcess>> {
        let spare = match role {
            EngineRole::Pages => None,
            EngineRole::Statements => lock_mutex(&self.0.spare).take().filter(|engine| !engine.has_ended()),
        };
        if spare.is_some() {
            self.0.spare_taken.notify_one();
        }
        spare.map_or_else(|| self.start_engine(role), Ok)
    }

    fn start_engine(&self, role: EngineRole) -> std::io::Result<Arc<EngineProcess>> {
        let name = format!("engine-{}", self.0.started.fetch_add(1, Ordering::Relaxed));
        let start = EngineStart {
            settings: &self.0.settings,
            role,
            lake: self.0.lake.location(),
            lake_folder: self.0.lake.folder(),
            sockets: self.0.folders.sockets.path().join(&name),
            spills: self.0.folders.spills.path().join(&name),
        };
        let engine = EngineProcess::spawn_process(start, self.0.activity.clone())?;
        let engines = self.clone();
        let watched = engine.clone();
        tokio::spawn(async move { engines.watch_end(&watched).await });
        Ok(engine)
    }

    // Counts the end of an engine, and whose statement it was.
    async fn watch_end(&self, engine: &EngineProcess) {
        if let EndReason::Failed(end) = engine.wait_for_end().await {
            tracing::warn!(reason = end.reason, culprit = ?end.culprit, "an engine ended");
            self.0.failed.fetch_add(1, Ordering::Relaxed);
            if let Some(culprit) = &end.culprit {
                self.0.ends.count_end(&culprit.client);
            }
        }
    }

    /// Starts both engines and a spare, and starts them again when they end; never ends.
    pub async fn keep_up(self) {
        tokio::join!(self.keep_role(EngineRole::Pages), self.keep_role(EngineRole::Statements), self.keep_spare());
    }

    async fn keep_role(&self, role: EngineRole) {
        let place = self.place_of(role);
        loop {
            let started = {
                let _starting = place.starting.lock().await;
                match place.live_engine() {
                    Some(engine) => Ok(engine),
                    None => self.take_or_start(role).inspect(|engine| {
                        *lock_mutex(&place.current) = Some(engine.clone());
                    }),
                }
            };
            let is_ready = match &started {
                Ok(engine) => self.wait_for_start(engine).await.is_ok(),
                Err(failed) => {
                    tracing::error!(error = failed as &dyn std::error::Error, "no engine can be started");
                    self.record_start(false);
                    false
                }
            };
            match started {
                Ok(engine) if is_ready => drop(engine.wait_for_end().await),
                _ => tokio::time::sleep(START_AGAIN).await,
            }
        }
    }

    async fn keep_spare(&self) {
        // The first engine of statements is no spare.
        while self.0.statements.live_engine().is_none() {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
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
                let is_ready = spare.wait_until_ready().await.is_ok();
                self.record_start(is_ready);
                if !is_ready {
                    tracing::error!("a spare engine did not start");
                    tokio::time::sleep(START_AGAIN).await;
                    return;
                }
                spare.wait_for_end().await;
            };
            tokio::select! {
                () = taken => {}
                () = watch => {}
            }
        }
    }

    fn spare_or_start(&self) -> std::io::Result<Arc<EngineProcess>> {
        let mut spare = lock_mutex(&self.0.spare);
        if let Some(live) = spare.as_ref().filter(|spare| !spare.has_ended()) {
            return Ok(live.clone());
        }
        let started = self.start_engine(EngineRole::Statements)?;
        *spare = Some(started.clone());
        Ok(started)
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

    /// Ends all that a client does, in the engines and on its connections.
    pub async fn end_client(&self, name: &str) {
        if let Some(end) = lock_mutex(&self.0.client_ends).remove(name) {
            end.cancel();
        }
        for engine in self.list_live() {
            // One that ends meanwhile runs nothing.
            let _ = engine.send_message(&DoorMessage::EndClient(name.to_owned())).await;
        }
    }

    /// Ends all engines.
    pub async fn end_all(&self) {
        for engine in self.list_live() {
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

    fn list_live(&self) -> Vec<Arc<EngineProcess>> {
        let spare = lock_mutex(&self.0.spare).clone();
        let current = [&self.0.pages, &self.0.statements].into_iter().filter_map(EnginePlace::live_engine);
        current.chain(spare.filter(|spare| !spare.has_ended())).collect()
    }

    /// Gauges of the engines.
    pub fn engine_gauges(&self) -> EngineGauges {
        let live = self.list_live();
        EngineGauges {
            engines: live.len(),
            most_engines: MOST_ENGINES,
            bytes: live.iter().map(|engine| engine.private_bytes()).sum(),
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

impl EnginePlace {
    fn live_engine(&self) -> Option<Arc<EngineProcess>> {
        lock_mutex(&self.current).clone().filter(|engine| !engine.is_ending())
    }
}

fn lock_mutex<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
