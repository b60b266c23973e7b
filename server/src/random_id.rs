//! Numbers that clients see.

/// Returns a random number of a query or connection: one that is counted would tell a client how much others ask. It
/// has 53 bits, so that a page's numbers hold it, and is not 0.
pub(crate) fn random_id() -> u64 {
    (getrandom::u64().unwrap_or(0) >> 11).max(1)
}
