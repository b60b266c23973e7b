//! The end of a statement, as its threads see it: a call of a function asks before it begins. Operators and the planner
//! do not ask while they call functions, so that without this a statement with ten thousand constant calls is not
//! cancelled before the last of them.

use std::cell::RefCell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use datafusion::error::{DataFusionError, Result};

/// Bytes that constant calls of a statement may return while it is planned: the plan keeps all of them.
const MOST_PLANNED_BYTES: usize = 64 << 20;

thread_local! {
    /// The flag of the statement that has this thread.
    static FLAG: RefCell<Option<StopFlag>> = const { RefCell::new(None) };
}

/// Tells threads whether the statement that they compute for has ended.
///
/// ```
/// use echolake_functions::{StopFlag, check_stop};
///
/// let flag = StopFlag::default();
/// flag.watch_thread();
/// assert!(check_stop().is_ok());
/// flag.set_stopped(true);
/// assert!(check_stop().is_err());
/// ```
#[derive(Debug, Clone, Default)]
pub struct StopFlag(Arc<StatementState>);

#[derive(Debug, Default)]
struct StatementState {
    is_stopped: AtomicBool,
    is_planned: AtomicBool,
    /// Bytes that its constant calls have returned since its planning began.
    planned_bytes: AtomicUsize,
}

impl StopFlag {
    /// Makes calls on this thread ask this flag.
    pub fn watch_thread(&self) {
        FLAG.set(Some(self.clone()));
    }

    /// Sets whether the statement has ended. Where it has not, it is another one, which is not planned yet.
    pub fn set_stopped(&self, is_stopped: bool) {
        self.0.is_stopped.store(is_stopped, Ordering::Relaxed);
        self.0.is_planned.store(false, Ordering::Relaxed);
    }
}

/// Checks that the statement of this thread goes on.
///
/// # Errors
/// It has ended. The client is told why by whoever ended it.
pub fn check_stop() -> Result<()> {
    match FLAG.with_borrow(|flag| flag.as_ref().is_some_and(|flag| flag.0.is_stopped.load(Ordering::Relaxed))) {
        true => Err(DataFusionError::Execution("the query was ended".to_owned())),
        false => Ok(()),
    }
}

/// Sets whether the statement of this thread is being planned, so that what its constant calls return stays in the
/// plan.
pub fn set_planning(is_planned: bool) {
    FLAG.with_borrow(|flag| {
        if let Some(StopFlag(statement)) = flag {
            statement.planned_bytes.store(0, Ordering::Relaxed);
            statement.is_planned.store(is_planned, Ordering::Relaxed);
        }
    });
}

/// Counts what a constant call has returned.
///
/// # Errors
/// The statement is being planned, and its calls have returned too much.
pub(super) fn count_planned_bytes(bytes: usize) -> Result<()> {
    let total = FLAG.with_borrow(|flag| match flag {
        Some(StopFlag(statement)) if statement.is_planned.load(Ordering::Relaxed) => {
            statement.planned_bytes.fetch_add(bytes, Ordering::Relaxed) + bytes
        }
        _ => 0,
    });
    match total <= MOST_PLANNED_BYTES {
        true => Ok(()),
        false => Err(DataFusionError::Execution(format!(
            "constant calls would return more than {} MiB for the plan of the query; hint: shorter values",
            MOST_PLANNED_BYTES >> 20
        ))),
    }
}
