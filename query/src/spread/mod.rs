//! Queries over several machines. A heavy query is planned a second time by datafusion-distributed, whose stages run on
//! workers: processes of the same program on the same lake. Everything else runs in the engine that was asked.
//!
//! A worker that is lost costs no answer as long as no row was sent: the query then runs once more on the workers that
//! are left, and at last in the engine itself. [`attempt`] has that order.

mod affinity;
pub(crate) mod attempt;
mod channels;
mod cluster;
mod connector;
pub(crate) mod decision;
mod figures;
mod guard;
mod identity;
mod link;
mod loss;
mod planner;
pub(crate) mod read_only;
mod worker;

pub use cluster::{ClusterSettings, SpreadCounts, WorkerCluster, WorkerStatus};
pub use figures::{WORKER_FIGURES_PATH, WorkerFigures};
pub use guard::{SpreadTasks, TASK_HEADER, TaskLease};
pub use identity::{WorkerIdentity, WorkerToken};
pub use link::{WorkerLink, WorkerTrust, is_loopback_url};
pub(crate) use loss::WorkerLoss;
pub use worker::SpreadWorker;

/// The header in which an engine tells workers how many bytes a task of its client's query may hold.
const MEMORY_HEADER: &str = "x-echolake-memory";

#[cfg(test)]
mod hostile_tests;
#[cfg(test)]
mod tests;
