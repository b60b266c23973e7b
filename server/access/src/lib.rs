//! Who may ask a server: its file of tokens, logins by them, and sessions of browsers.

mod scram_verifier;
mod sessions;
mod token_access;
pub mod tokens;

pub use scram_verifier::{METHOD, ScramVerifier};
pub use sessions::LIFETIME;
pub use token_access::{TokenAccess, TokenFileState};
