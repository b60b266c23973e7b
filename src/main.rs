//! The `echolake` command.
fn main() {}
