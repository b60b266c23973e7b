//! Looks at the lake for `/ready`, as seldom as operators need it: whoever reaches the server may ask.

use std::time::{Duration, Instant};

use echolake_lake::Lake;
use echolake_service::RequestFault;
use tokio::sync::Mutex;

use crate::door::activity::ServerActivity;

/// Time for which a look is good.
const LOOK_LASTS: Duration = Duration::from_secs(2);
/// Time limit for a look.
const LOOK_LIMIT: Duration = Duration::from_secs(5);

/// The lake cannot be read.
const UNREADABLE: RequestFault = RequestFault::NotReady { reason: "the lake cannot be read" };

/// Finds out if the lake can be read.
pub(super) struct ReadinessCheck {
    lake: Lake,
    last: Mutex<Option<(Instant, bool)>>,
}

impl ReadinessCheck {
    pub fn new(lake: &Lake) -> Self {
        Self { lake: lake.clone(), last: Mutex::default() }
    }

    /// Checks that the lake can be read, or could a moment ago.
    ///
    /// # Errors
    /// [`RequestFault::NotReady`].
    pub async fn check_lake(&self, activity: &ServerActivity) -> Result<(), RequestFault> {
        // Its logs are looked at by an engine, now and then.
        if activity.is_lake_unreadable() {
            return Err(UNREADABLE);
        }
        let mut last = self.last.lock().await;
        let is_readable = match *last {
            Some((at, is_readable)) if at.elapsed() < LOOK_LASTS => is_readable,
            _ => {
                let is_readable = self.is_lake_readable().await;
                *last = Some((Instant::now(), is_readable));
                is_readable
            }
        };
        is_readable.then_some(()).ok_or(UNREADABLE)
    }

    async fn is_lake_readable(&self) -> bool {
        match tokio::time::timeout(LOOK_LIMIT, self.lake.check_readable()).await {
            Ok(Ok(())) => true,
            Ok(Err(failed)) => {
                tracing::warn!(error = &failed as &dyn std::error::Error, "the lake cannot be read");
                false
            }
            Err(_) => {
                tracing::warn!("the lake was not read within {LOOK_LIMIT:?}");
                false
            }
        }
    }
}
