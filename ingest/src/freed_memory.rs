//! Memory that an ingest frees and takes again for the next run.

use std::env;
use std::os::unix::process::CommandExt as _;
use std::process::Command;

/// The variable in which mimalloc finds, when a process starts, after how many milliseconds it gives freed memory back
/// to the system.
const PURGE_DELAY: &str = "MIMALLOC_PURGE_DELAY";
/// Longer than a run takes. By default it is a second.
const KEPT_MS: &str = "10000";

/// Starts this program again within its process, so that mimalloc keeps freed memory for longer. The system clears what
/// is given back after each run before the next one has it: half of an ingest where clearing is slow.
///
/// It is for programs whose allocator is mimalloc, before they have threads. It does nothing if the variable is set, as
/// it is the second time, or if the program cannot be started again.
pub fn keep_freed_memory() {
    let mut args = env::args_os();
    if let (None, Ok(program), Some(name)) = (env::var_os(PURGE_DELAY), env::current_exe(), args.next()) {
        // Returns only if it fails, and then the ingest is slower.
        let _ = Command::new(program).arg0(name).args(args).env(PURGE_DELAY, KEPT_MS).exec();
    }
}
