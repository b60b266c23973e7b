//! What all connections of the door share.

use std::sync::Arc;
use std::time::Duration;

use echolake_access::{TokenAccess, TokenFileState};
use echolake_http::layout::ViewerLayout;
use echolake_lake::Lake;
use echolake_service::{ClientIdentity, Error, RequestFault, ServerProtocol, TokenScope};

use super::audit;
use super::connection_places::PlaceWork;
use super::drain::ServerDrain;
use super::engine_process::EngineSettings;
use super::failed_logins::FailedLogins;
use super::http::answer_cache::AnswerCache;
use super::readiness::ReadinessCheck;
use super::server_engines::ServerEngines;
use crate::door::activity::ServerActivity;
use crate::metrics::{ServerGauges, ServerMetrics};

/// Time between two looks at the file of tokens.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// State shared by all connections.
#[derive(Clone)]
pub(crate) struct ServerDoor(Arc<DoorState>);

struct DoorState {
    lake: Lake,
    access: Arc<TokenAccess>,
    activity: Arc<ServerActivity>,
    engines: ServerEngines,
    answers: AnswerCache,
    readiness: ReadinessCheck,
    drain: ServerDrain,
    layout: ViewerLayout,
    failed_logins: FailedLogins,
}

impl ServerDoor {
    /// The door of a lake.
    ///
    /// # Errors
    /// [`Error::Temp`].
    pub fn new(
        lake: &Lake,
        access: Arc<TokenAccess>,
        is_behind_proxy: bool,
        settings: EngineSettings,
    ) -> Result<Self, Error> {
        let failed_logins = FailedLogins::new(!access.is_open() && !is_behind_proxy);
        let activity = Arc::new(ServerActivity::new()?);
        let engines = ServerEngines::new(lake, settings, activity.clone(), access.clone())?;
        let answers = AnswerCache::new(lake);
        let layout = ViewerLayout::new(lake.rig());
        let readiness = ReadinessCheck::new(lake);
        let drain = ServerDrain::default();
        let lake = lake.clone();
        Ok(Self(Arc::new(DoorState {
            lake,
            access,
            activity,
            engines,
            answers,
            readiness,
            drain,
            layout,
            failed_logins,
        })))
    }

    /// The lake, all of it.
    pub fn lake(&self) -> &Lake {
        &self.0.lake
    }

    /// Failed logins of the last minute.
    pub fn failed_logins(&self) -> &FailedLogins {
        &self.0.failed_logins
    }

    pub fn access(&self) -> &TokenAccess {
        &self.0.access
    }

    /// Cached answers of engines.
    pub fn answers(&self) -> &AnswerCache {
        &self.0.answers
    }

    pub fn metrics(&self) -> &ServerMetrics {
        &self.0.activity.metrics
    }

    /// Queries and connections of the server.
    pub fn activity(&self) -> &ServerActivity {
        &self.0.activity
    }

    /// The figures of the door and of all engines, in Prometheus' text format.
    ///
    /// # Errors
    /// [`RequestFault::Internal`].
    pub async fn gather_figures(&self) -> Result<String, RequestFault> {
        let activity = self.activity();
        let is_ready = self.check_ready().await.is_ok();
        let gauges = ServerGauges {
            engines: self.0.engines.engine_gauges(),
            connections: activity.connections.protocol_counts(),
            // A lake that does not answer may be on a disk that does not answer either.
            disks: if is_ready { self.0.engines.disk_spaces() } else { Vec::new() },
            lake: activity.lake_figures().map(|(at, figures)| (at.elapsed(), figures)),
            is_ready,
            process_start: activity.start_time().timestamp_micros() as f64 / 1e6,
        };
        activity.metrics.prometheus_text(&gauges).map_err(RequestFault::defect("the figures cannot be written"))
    }

    /// Reads the file of tokens again when it changes, and ends what clients without a token were doing; never ends.
    pub async fn watch_tokens(self) {
        let mut known = TokenFileState::default();
        let mut ended: Vec<String> = Vec::new();
        loop {
            let gone = self.0.access.reload_changed(&mut known);
            gone.iter().for_each(|client| tracing::warn!(client, "it may no longer ask, or may do other things now"));
            // Those of the last look again: a request may have begun between its check and its engine's end.
            for client in ended.iter().chain(&gone) {
                self.0.engines.end_client(client).await;
            }
            ended = gone;
            tokio::time::sleep(LOOK_EVERY).await;
        }
    }

    /// Checks that requests can be answered.
    ///
    /// # Errors
    /// [`RequestFault::Draining`], [`RequestFault::NotReady`].
    pub async fn check_ready(&self) -> Result<(), RequestFault> {
        if self.0.drain.is_begun() {
            return Err(RequestFault::Draining);
        }
        self.0.engines.check_start()?;
        self.0.readiness.check_lake(self.activity()).await
    }

    /// Ends a query of a client, or of any if the client may see the server's figures.
    ///
    /// # Errors
    /// [`RequestFault::NotFound`] if none that the client may end runs.
    pub async fn cancel_query(&self, client: &ClientIdentity, id: u64) -> Result<(), RequestFault> {
        let may_any = client.require_scope(TokenScope::Metrics).is_ok();
        let running = self.activity().queries.find_running(id).filter(|query| may_any || query.client == client.name);
        let Some(query) = running else {
            let hint = "select id from system.queries where outcome = 'running'";
            return Err(RequestFault::NotFound { what: format!("query {id}"), hint });
        };
        self.0.engines.cancel_query(query.engine, query.number).await;
        Ok(())
    }

    /// The server's end.
    pub fn drain(&self) -> &ServerDrain {
        &self.0.drain
    }

    /// Takes note of who asks on a connection, or of a refusal; returns `found`.
    pub fn note_client(
        &self,
        work: &PlaceWork,
        protocol: ServerProtocol,
        found: Result<Arc<ClientIdentity>, RequestFault>,
    ) -> Result<Arc<ClientIdentity>, RequestFault> {
        let is_audited = !self.0.access.is_open();
        match &found {
            Ok(client) => {
                if work.name_client(&client.name) && is_audited {
                    audit::record_login(work.peer(), protocol, &client.name);
                }
            }
            Err(fault) if is_audited => audit::record_refusal(work.peer(), protocol, fault.code()),
            Err(_) => {}
        }
        found
    }

    /// The layout of its lake's runs.
    pub fn layout(&self) -> &ViewerLayout {
        &self.0.layout
    }

    /// The engines.
    pub fn engines(&self) -> &ServerEngines {
        &self.0.engines
    }
}
