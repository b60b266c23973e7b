//! Browser sessions: a secret in a cookie replaces the token that was sent once, because pictures and downloads of a
//! page can send no `Authorization` header. Kept in memory, as hashes, for half a day.

use std::io;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use sha2::{Digest as _, Sha256};

/// Lifetime of a session.
pub const LIFETIME: Duration = Duration::from_secs(12 * 3600);
/// Sessions that are kept; the oldest is evicted first.
const MOST: usize = 1000;

/// The sessions of a server.
#[derive(Default)]
pub(crate) struct BrowserSessions(Mutex<Vec<BrowserSession>>);

struct BrowserSession {
    // The time of comparing hashes reveals nothing of the secret.
    hash: [u8; 32],
    /// Hash of the token that began it.
    holder: [u8; 32],
    begun: Instant,
}

impl BrowserSessions {
    /// Begins a session of the holder of the token with this hash; returns its secret.
    ///
    /// # Errors
    /// The system gives no random bytes.
    pub fn begin_session(&self, holder: [u8; 32]) -> io::Result<String> {
        let mut random = [0; 32];
        getrandom::fill(&mut random)?;
        let secret = hex::encode(random);
        let mut sessions = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        sessions.retain(|s| s.begun.elapsed() < LIFETIME);
        if sessions.len() >= MOST {
            sessions.remove(0);
        }
        sessions.push(BrowserSession { hash: Sha256::digest(&secret).into(), holder, begun: Instant::now() });
        Ok(secret)
    }

    /// Returns the hash of the token of the session with this secret.
    pub fn find_holder(&self, secret: &str) -> Option<[u8; 32]> {
        let hash: [u8; 32] = Sha256::digest(secret).into();
        let sessions = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        sessions.iter().find(|s| s.hash == hash && s.begun.elapsed() < LIFETIME).map(|s| s.holder)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_goes_first() {
        let sessions = BrowserSessions::default();
        let first = sessions.begin_session([1; 32]).expect("random bytes");
        assert_eq!((sessions.find_holder(&first), sessions.find_holder("")), (Some([1; 32]), None));
        for _ in 0..MOST {
            sessions.begin_session([2; 32]).expect("random bytes");
        }
        assert_eq!(sessions.find_holder(&first), None);
    }
}
