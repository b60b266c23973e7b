//! What all connections of the door share.

use std::sync::Arc;

use echolake_lake::Lake;

use super::engine_pool::EnginePool;
use super::engine_process::EngineSettings;
use crate::Error;
use crate::metrics::ServerMetrics;
use crate::tokens::{TokenAccess, TokenFile};

/// State shared by all connections.
#[derive(Clone)]
pub(crate) struct ServerDoor(Arc<DoorState>);

struct DoorState {
    access: TokenAccess,
    metrics: Arc<ServerMetrics>,
    engines: EnginePool,
}

impl ServerDoor {
    /// The door of a lake.
    ///
    /// # Errors
    /// [`Error::Temp`].
    pub(super) fn new(lake: &Lake, tokens: Option<TokenFile>, settings: EngineSettings) -> Result<Self, Error> {
        let metrics = Arc::new(ServerMetrics::default());
        let engines = EnginePool::new(lake, settings, metrics.clone())?;
        Ok(Self(Arc::new(DoorState { access: TokenAccess::new(tokens), metrics, engines })))
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

    /// The engines.
    pub(super) fn engines(&self) -> &EnginePool {
        &self.0.engines
    }
}
