//! Watches the size of the process, since not all memory of a query is counted: the largest query ends first.

use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use super::{Stop, Ticket};

/// Time between two looks.
const EVERY: Duration = Duration::from_millis(50);
/// Looks after an ended query until the next may be ended: its memory needs time to come back.
const PATIENCE: u32 = 6;

/// The queries that run now.
#[derive(Debug, Default)]
pub(crate) struct Running(Mutex<Vec<Weak<Ticket>>>);

impl Running {
    pub(crate) fn add(&self, ticket: &Arc<Ticket>) {
        let mut tickets = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        tickets.retain(|t| t.strong_count() > 0);
        tickets.push(Arc::downgrade(ticket));
    }

    /// Queries that run or wait.
    pub(crate) fn count(&self) -> usize {
        self.live().len()
    }

    fn live(&self) -> Vec<Arc<Ticket>> {
        let tickets = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        tickets.iter().filter_map(Weak::upgrade).filter(|t| t.why().is_none()).collect()
    }

    // The one that counts the most; of those that count nothing, the youngest.
    fn largest(&self) -> Option<Arc<Ticket>> {
        self.live().into_iter().max_by_key(|t| t.held())
    }
}

/// Ends queries while the process is larger than `limit` bytes, until `running` is dropped.
pub(crate) async fn govern(running: Weak<Running>, limit: usize) {
    let mut patience = 0;
    loop {
        tokio::time::sleep(EVERY).await;
        let Some(running) = running.upgrade() else { return };
        let Some(size) = resident_bytes() else { return };
        if size <= limit {
            patience = 0;
        } else if patience > 0 {
            patience -= 1;
        } else if let Some(ticket) = running.largest() {
            ticket.stop(Stop::Memory);
            patience = PATIENCE;
        }
    }
}

/// Bytes of memory that the process occupies; None where the system does not tell.
pub(crate) fn resident_bytes() -> Option<usize> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmRSS:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<usize>().ok().map(|kib| kib << 10)
}
