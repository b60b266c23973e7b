//! A worker: it runs the stages that engines send it, with the functions of its own engine and a store that reads only.

use async_trait::async_trait;
use datafusion::error::{DataFusionError, Result};
use datafusion::execution::session_state::SessionState;
use datafusion_distributed::{DistributedExt as _, Worker, WorkerQueryContext, WorkerSessionBuilder};
use tonic::codegen::http::HeaderMap;
use tonic::service::Routes;

use super::channels::WorkerChannels;
use super::guard::SpreadTasks;
use super::{MEMORY_HEADER, WorkerIdentity, WorkerLink};
use crate::mcap::McapCodec;
use crate::{Error, QueryEngine};

/// A worker's service. Who may use it is for the server that offers it to check.
pub struct SpreadWorker {
    worker: Worker,
    tasks: SpreadTasks,
}

impl SpreadWorker {
    /// Makes the service of an engine; `link` is to the other workers that a stage reads from.
    ///
    /// # Errors
    /// [`Error::Execution`] if the token cannot be sent.
    pub fn new(engine: &QueryEngine, identity: &WorkerIdentity, link: &WorkerLink) -> Result<Self, Error> {
        let channels = WorkerChannels::new(link).map_err(|e| Error::execution(&e))?;
        let tasks = SpreadTasks::default();
        let sessions = TaskSessions { engine: engine.clone(), channels, tasks: tasks.clone() };
        let worker = Worker::from_session_builder(sessions)
            .with_runtime_env(engine.template().runtime_env().clone())
            .with_version(identity.to_line());
        Ok(Self { worker, tasks })
    }

    /// Returns its tasks, which a server begins with each call of the method `CoordinatorChannel`.
    pub fn tasks(&self) -> &SpreadTasks {
        &self.tasks
    }

    /// Returns the service for a gRPC server.
    pub fn into_routes(self) -> Routes {
        Routes::new(self.worker.into_worker_server())
    }
}

/// Makes the state of each task.
struct TaskSessions {
    engine: QueryEngine,
    channels: WorkerChannels,
    tasks: SpreadTasks,
}

#[async_trait]
impl WorkerSessionBuilder for TaskSessions {
    async fn build_session_state(&self, context: WorkerQueryContext) -> Result<SessionState> {
        let memory = memory_limit(&context.headers)?;
        let mut builder = context
            .builder
            .with_distributed_user_codec(McapCodec::new(self.engine.catalog().run_files().clone()))
            .with_distributed_channel_resolver(self.channels.clone());
        if let Some(guard) = self.tasks.guard(&context.headers) {
            builder.set_distributed_worker_plan_rewrite_handler(guard);
        }
        self.engine.task_state(builder, memory)
    }
}

fn memory_limit(headers: &HeaderMap) -> Result<Option<usize>> {
    let Some(value) = headers.get(MEMORY_HEADER) else { return Ok(None) };
    let limit = value.to_str().ok().and_then(|text| text.parse().ok());
    let wrong = || DataFusionError::Execution(format!("the header {MEMORY_HEADER} is {value:?}, expected bytes"));
    limit.map(Some).ok_or_else(wrong)
}
