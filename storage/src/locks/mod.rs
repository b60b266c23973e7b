//! Locks between processes that save work twice done; no row depends on them.

mod claims;
mod lease;
mod process_identity;

pub(crate) use claims::FOLDER as CLAIMS_FOLDER;
pub use claims::{ClaimOutcome, ClaimTimes, WorkClaims};
pub(crate) use lease::MaintenanceLease;
