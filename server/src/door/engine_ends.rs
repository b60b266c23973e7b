//! Clients whose statements have ended engines: each waits longer each time, so that the others are answered.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use echolake_service::RequestFault;

/// A client waits for so long after the second engine that its statements ended, and for twice as long each time.
const FIRST_BACKOFF: Duration = Duration::from_millis(250);
const LONGEST_BACKOFF: Duration = Duration::from_secs(30);
/// Backoff for which a request waits; during a longer one it is refused.
const BACKOFF_WAIT: Duration = Duration::from_secs(1);
/// Time without an end after which a client's earlier ones are forgotten.
const FORGIVEN: Duration = Duration::from_secs(60);

/// The engines that clients have ended, by the clients' names.
#[derive(Default)]
pub(super) struct EngineEnds(Mutex<HashMap<String, ClientEnds>>);

#[derive(Debug, Clone, Copy)]
struct ClientEnds {
    /// Engines that ended within [`FORGIVEN`] of each other.
    ends: u32,
    last_end: Instant,
}

impl EngineEnds {
    /// Counts an engine that a client's statement has ended.
    pub fn count_end(&self, client: &str) {
        let mut clients = self.lock_clients();
        // Clients may come under any number of names.
        clients.retain(|_, known| known.last_end.elapsed() < FORGIVEN);
        let known = clients.entry(client.to_owned()).or_insert(ClientEnds { ends: 0, last_end: Instant::now() });
        *known = ClientEnds { ends: known.ends + 1, last_end: Instant::now() };
    }

    /// Waits until a client may ask.
    ///
    /// # Errors
    /// [`RequestFault::Backoff`] if that takes long.
    pub async fn wait_for_turn(&self, client: &str) -> Result<(), RequestFault> {
        let Some(known) = self.lock_clients().get(client).copied() else { return Ok(()) };
        match known.backoff_left() {
            wait if wait > BACKOFF_WAIT => Err(RequestFault::Backoff { ends: known.ends, wait }),
            wait => {
                tokio::time::sleep(wait).await;
                Ok(())
            }
        }
    }

    fn lock_clients(&self) -> MutexGuard<'_, HashMap<String, ClientEnds>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ClientEnds {
    // Time that is left of the backoff.
    fn backoff_left(&self) -> Duration {
        let whole = match self.ends {
            0 | 1 => Duration::ZERO,
            ends => LONGEST_BACKOFF.min(FIRST_BACKOFF * 2_u32.saturating_pow(ends - 2)),
        };
        whole.saturating_sub(self.last_end.elapsed())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waits_grow_to_a_limit_and_pass() {
        let ago = |secs| Instant::now().checked_sub(Duration::from_secs(secs)).expect("a time");
        let left = |ends, secs| ClientEnds { ends, last_end: ago(secs) }.backoff_left();
        for (ends, whole) in [(0, 0), (1, 0), (2, 250), (3, 500)] {
            let left = left(ends, 0);
            assert!(
                left <= Duration::from_millis(whole)
                    && left + Duration::from_millis(200) > Duration::from_millis(whole)
            );
        }
        assert!(left(u32::MAX, 0) <= LONGEST_BACKOFF && left(u32::MAX, 0) > Duration::from_secs(29));
        assert!(left(9, 20) <= Duration::from_secs(10) && left(9, 20) > Duration::from_secs(9));
        assert_eq!(left(9, 30), Duration::ZERO, "whoever asked meanwhile");
    }

    #[tokio::test]
    async fn a_client_waits_from_its_second_end_on_and_no_other_does() {
        let ends = EngineEnds::default();
        ends.count_end("ann");
        let begun = Instant::now();
        ends.wait_for_turn("ann").await.expect("at once");
        assert!(begun.elapsed() < FIRST_BACKOFF);
        ends.count_end("ann");
        ends.wait_for_turn("ann").await.expect("after a moment");
        assert!(begun.elapsed() >= FIRST_BACKOFF);
        for _ in 0..5 {
            ends.count_end("ann");
        }
        assert!(matches!(ends.wait_for_turn("ann").await, Err(RequestFault::Backoff { ends: 7, .. })));
        ends.wait_for_turn("bob").await.expect("another client");
    }
}
