//! What all connections of the door share.

use std::sync::Arc;
use std::time::Duration;

use echolake_lake::Lake;

use super::engine_pool::EnginePool;
use super::engine_process::EngineSettings;
use crate::Error;
use crate::http::ViewerLayout;
use crate::metrics::ServerMetrics;
use crate::tokens::{TokenAccess, TokenFile, TokenFileState};

/// Time between two looks at the file of tokens.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// State shared by all connections.
#[derive(Clone)]
pub(crate) struct ServerDoor(Arc<DoorState>);

struct DoorState {
    access: Arc<TokenAccess>,
    metrics: Arc<ServerMetrics>,
    engines: EnginePool,
    layout: ViewerLayout,
}

impl ServerDoor {
    /// The door of a lake.
    ///
    /// # Errors
    /// [`Error::Temp`].
    pub(super) fn new(lake: &Lake, tokens: Option<TokenFile>, settings: EngineSettings) -> Result<Self, Error> {
        let metrics = Arc::new(ServerMetrics::default());
        let access = Arc::new(TokenAccess::new(tokens));
        let engines = EnginePool::new(lake, settings, metrics.clone(), access.clone())?;
        let layout = ViewerLayout::new(lake.rig());
        Ok(Self(Arc::new(DoorState { access, metrics, engines, layout })))
    }

    pub(crate) fn access(&self) -> &TokenAccess {
        &self.0.access
    }

    pub(crate) fn metrics(&self) -> &ServerMetrics {
        &self.0.metrics
    }

    /// The figures of the door and of all engines, in Prometheus' text format.
    pub(crate) fn figures(&self) -> String {
        self.0.metrics.text() + &self.0.engines.figures()
    }

    /// Reads the file of tokens again when it changes, and ends what clients without a token were doing; never ends.
    pub(super) async fn watch_tokens(self) {
        let mut known = TokenFileState::default();
        let mut ended = Vec::new();
        loop {
            let gone = self.0.access.renew(&mut known);
            gone.iter().for_each(|client| tracing::warn!(client, "its token was taken back or has expired"));
            // Those of the last look again: a request may have begun between its check and its engine's end.
            ended.iter().chain(&gone).for_each(|client: &String| self.0.engines.end_client(client));
            ended = gone;
            tokio::time::sleep(LOOK_EVERY).await;
        }
    }

    /// The layout of its lake's runs.
    pub(crate) fn layout(&self) -> &ViewerLayout {
        &self.0.layout
    }

    /// The engines.
    pub(super) fn engines(&self) -> &EnginePool {
        &self.0.engines
    }
}
