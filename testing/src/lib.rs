//! What the tests of several members share.

mod child_process;
mod revision_fixture;
mod run_messages;
mod simulated_run;
mod store_double;

pub use child_process::{COMMAND_LIMIT, ChildProcess, LONG_LIMIT, run_command, run_long_command};
pub use revision_fixture::{NumberLine, RevisionFixture};
pub use run_messages::{read_attachment, read_messages};
pub use simulated_run::{SMALL_RIG, simulate_project_run, simulate_run};
pub use store_double::{RequestFate, RequestKind, StoreBehaviour, StoreDouble};
