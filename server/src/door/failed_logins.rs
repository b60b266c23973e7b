//! Failed logins by address: one that has shown too many wrong tokens is refused for a while, without a look at what it
//! shows.

use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr, SocketAddr};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use echolake_service::RequestFault;

/// Time from an address' first failure until it counts anew.
const WINDOW: Duration = Duration::from_secs(60);
/// Failures in that time.
const MOST_FAILURES: u32 = 20;
/// Addresses that are known at once; beyond them failures are not counted until some are forgotten.
const MOST_ADDRESSES: usize = 10_000;

/// Failed logins of the last minute.
pub(crate) struct FailedLogins {
    is_counted: bool,
    windows: Mutex<HashMap<IpAddr, FailureWindow>>,
}

struct FailureWindow {
    begun: Instant,
    failures: u32,
}

impl FailedLogins {
    /// None so far. Not counted where all clients have the address of a proxy.
    pub fn new(is_counted: bool) -> Self {
        Self { is_counted, windows: Mutex::default() }
    }

    /// Checks that an address may try.
    ///
    /// # Errors
    /// [`RequestFault::FailedLogins`].
    pub fn check_address(&self, peer: SocketAddr) -> Result<(), RequestFault> {
        let Some(address) = self.counted_address(peer) else { return Ok(()) };
        let windows = self.windows.lock().unwrap_or_else(PoisonError::into_inner);
        let window = windows.get(&address).filter(|window| window.failures >= MOST_FAILURES);
        match window.and_then(|window| WINDOW.checked_sub(window.begun.elapsed())) {
            Some(wait) => Err(RequestFault::FailedLogins { wait }),
            None => Ok(()),
        }
    }

    /// Counts a failure.
    pub fn count_failure(&self, peer: SocketAddr) {
        let Some(address) = self.counted_address(peer) else { return };
        let mut windows = self.windows.lock().unwrap_or_else(PoisonError::into_inner);
        if windows.len() >= MOST_ADDRESSES && !windows.contains_key(&address) {
            windows.retain(|_, window| window.begun.elapsed() < WINDOW);
            if windows.len() >= MOST_ADDRESSES {
                return;
            }
        }
        let window = windows.entry(address).or_insert_with(|| FailureWindow { begun: Instant::now(), failures: 0 });
        if window.begun.elapsed() >= WINDOW {
            *window = FailureWindow { begun: Instant::now(), failures: 0 };
        }
        window.failures += 1;
    }

    // Programs of one machine share its loopback addresses; a network of IPv6 has as many addresses as it likes.
    fn counted_address(&self, peer: SocketAddr) -> Option<IpAddr> {
        let address = peer.ip().to_canonical();
        let network = match address {
            IpAddr::V6(address) => IpAddr::V6(Ipv6Addr::from_bits(address.to_bits() >> 64 << 64)),
            IpAddr::V4(_) => address,
        };
        (self.is_counted && !address.is_loopback()).then_some(network)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(text: &str) -> SocketAddr {
        SocketAddr::new(text.parse().expect("an address"), 1)
    }

    fn fail(logins: &FailedLogins, text: &str, times: u32) {
        for _ in 0..times {
            logins.count_failure(address(text));
        }
    }

    #[test]
    fn an_address_is_refused_after_too_many_failures_and_no_other_is() {
        let logins = FailedLogins::new(true);
        fail(&logins, "192.0.2.1", MOST_FAILURES - 1);
        assert!(logins.check_address(address("192.0.2.1")).is_ok());
        fail(&logins, "::ffff:192.0.2.1", 1);
        assert!(
            matches!(logins.check_address(address("192.0.2.1")), Err(RequestFault::FailedLogins { wait }) if wait <= WINDOW)
        );
        assert!(logins.check_address(address("192.0.2.2")).is_ok());
        fail(&logins, "2001:db8::1", MOST_FAILURES);
        assert!(logins.check_address(address("2001:db8::ffff:2")).is_err(), "of the same network");
        assert!(logins.check_address(address("2001:db8:0:1::1")).is_ok());
    }

    #[test]
    fn a_failure_is_forgotten_after_a_while() {
        let logins = FailedLogins::new(true);
        let begun = Instant::now().checked_sub(WINDOW).expect("a system that runs for a minute");
        let old = FailureWindow { begun, failures: MOST_FAILURES };
        logins.windows.lock().expect("no panic").insert(address("192.0.2.1").ip(), old);
        assert!(logins.check_address(address("192.0.2.1")).is_ok());
        fail(&logins, "192.0.2.1", 1);
        assert!(logins.check_address(address("192.0.2.1")).is_ok(), "it counts anew");
    }

    #[test]
    fn this_machine_and_proxies_are_not_counted() {
        let (open, proxied) = (FailedLogins::new(true), FailedLogins::new(false));
        fail(&open, "127.0.0.1", 2 * MOST_FAILURES);
        fail(&proxied, "192.0.2.1", 2 * MOST_FAILURES);
        assert!(
            open.check_address(address("127.0.0.1")).is_ok() && proxied.check_address(address("192.0.2.1")).is_ok()
        );
    }

    #[test]
    fn addresses_are_bounded() {
        let logins = FailedLogins::new(true);
        for number in 0..MOST_ADDRESSES as u32 + 9 {
            logins.count_failure(SocketAddr::new(IpAddr::V4((0x0a00_0000 + number).into()), 1));
        }
        assert_eq!(logins.windows.lock().expect("no panic").len(), MOST_ADDRESSES);
    }
}
