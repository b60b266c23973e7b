//! Queries over several machines. A heavy query is planned a second time by datafusion-distributed, whose stages run on
//! workers: processes of the same program on the same lake. Everything else runs in the engine that was asked.
//!
//! A worker that is lost costs no answer as long as no row was sent: the query then runs once more on the remaining
//! workers, and at last in the engine itself. [`attempts`] has that order, [`decision`] what is spread, [`worker`] the
//! far end.

mod affinity;
pub(crate) mod attempts;
mod calls;
mod channels;
mod cluster;
mod decision;
mod links;
mod loss;
mod options;
mod read_only;
mod tasks;
mod worker;

pub use cluster::{ClusterSettings, SpreadCounts, WorkerCluster, WorkerState};
use links::WorkerIdentity;
pub use links::{WorkerFault, WorkerLink, WorkerToken};
pub(crate) use loss::WorkerLoss;
pub(crate) use read_only::ReadOnlyStore;
pub use tasks::WorkerFigures;
pub use worker::WorkerService;

#[cfg(test)]
mod hostile_tests;
#[cfg(test)]
mod tests;
