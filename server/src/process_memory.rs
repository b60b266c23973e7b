//! Memory of a process, as the system counts it.

use std::path::Path;

/// Returns the bytes that a process occupies: resident pages without those of files, which all engines share. `process`
/// is its number, or `self`; None if there is no such process.
pub(crate) fn private_bytes(process: &str) -> Option<usize> {
    let text = std::fs::read_to_string(Path::new("/proc").join(process).join("statm")).ok()?;
    let mut pages = text.split(' ').skip(1).map_while(|n| n.parse::<usize>().ok());
    let resident = pages.next()?;
    let shared = pages.next()?;
    Some(resident.saturating_sub(shared) * rustix::param::page_size())
}
