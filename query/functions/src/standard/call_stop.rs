//! The end of a statement, as its threads see it: a call of a function asks before it begins. Operators and the planner
//! do not ask while they call functions, so that without this a statement with ten thousand constant calls is not
//! cancelled before the last of them.

use std::cell::RefCell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use datafusion::error::{DataFusionError, Result};

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
pub struct StopFlag(Arc<AtomicBool>);

impl StopFlag {
    /// Makes calls on this thread ask this flag.
    pub fn watch_thread(&self) {
        FLAG.set(Some(self.clone()));
    }

    /// Sets whether the statement has ended.
    pub fn set_stopped(&self, is_stopped: bool) {
        self.0.store(is_stopped, Ordering::Relaxed);
    }
}

/// Checks that the statement of this thread goes on.
///
/// # Errors
/// It has ended. The client is told why by whoever ended it.
pub fn check_stop() -> Result<()> {
    match FLAG.with_borrow(|flag| flag.as_ref().is_some_and(|flag| flag.0.load(Ordering::Relaxed))) {
        true => Err(DataFusionError::Execution("the query was ended".to_owned())),
        false => Ok(()),
    }
}
