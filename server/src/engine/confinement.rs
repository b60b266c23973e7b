//! Limits that the system enforces on an engine: files by Landlock, if the kernel has it, and memory by a resource
//! limit.

use std::io;
use std::path::{Path, PathBuf};

use echolake_lake::RemoteAccess;
use landlock::{
    ABI, Access as _, AccessFs, AccessNet, CompatLevel, Compatible as _, NetPort, Ruleset, RulesetAttr as _,
    RulesetCreated, RulesetCreatedAttr as _, RulesetError, path_beneath_rules,
};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// The newest version of Landlock that is used; of an older kernel, what it has.
const LANDLOCK: ABI = ABI::V5;
/// The process's own figures, those of the processors, and random bytes.
const SYSTEM: [&str; 4] = ["/proc", "/sys/fs/cgroup", "/sys/devices/system/cpu", "/dev/urandom"];
/// Address space over what queries may hold, for a process that is running: stacks of threads that are still to come,
/// caches, what the allocator keeps. The door looks at what is really used; this limit ends one huge allocation at
/// once.
const OVERHEAD_BYTES: u64 = 1 << 30;
/// Place of the writable address space in `/proc/PID/statm`, in pages.
const STATM_DATA: usize = 5;

/// Returns what this machine lacks to confine engines, for people.
pub fn missing_support() -> Option<&'static str> {
    let tried = Ruleset::default()
        .set_compatibility(CompatLevel::HardRequirement)
        .handle_access(AccessFs::from_all(ABI::V1))
        .and_then(Ruleset::create);
    tried.is_err().then_some(
        "this kernel has no Landlock, or a filter keeps it from this program: engines are kept from other files by the \
         program alone, not by the system",
    )
}

/// Lets the process read `lake` and its own program, read and write `own` folders, and nothing else, and connect to no
/// other machine. To be called before there are threads. A kernel without Landlock leaves the process as it is.
///
/// # Errors
/// The system refuses.
pub fn confine_files(lake: &Path, own: &[&Path]) -> io::Result<()> {
    let mut readable = linked_folders(lake);
    readable.push(lake.to_owned());
    confine_process(&readable, own, &[])
}

/// Lets the process read what it needs to reach the lake's object store, read and write `own` folders, and nothing
/// else; connect over TCP to the store's ports alone. Otherwise as [`confine_files`].
///
/// # Errors
/// The system refuses.
pub fn confine_to_store(store: &RemoteAccess, own: &[&Path]) -> io::Result<()> {
    confine_process(&store.files, own, &store.ports)
}

fn confine_process(readable: &[PathBuf], own: &[&Path], ports: &[u16]) -> io::Result<()> {
    let connections = ports.iter().map(|port| Ok::<_, RulesetError>(NetPort::new(*port, AccessNet::ConnectTcp)));
    // The place of a panic in the log has the names of its functions.
    let program = std::env::current_exe();
    let ruleset = || -> Result<RulesetCreated, RulesetError> {
        let read = AccessFs::from_read(LANDLOCK) & !AccessFs::Execute;
        Ruleset::default()
            .handle_access(AccessFs::from_all(LANDLOCK))?
            .handle_access(AccessNet::from_all(LANDLOCK))?
            .create()?
            .add_rules(path_beneath_rules(readable, read))?
            .add_rules(path_beneath_rules(SYSTEM, read))?
            .add_rules(path_beneath_rules(program.as_ref(), read))?
            .add_rules(path_beneath_rules(own, AccessFs::from_all(LANDLOCK)))?
            .add_rules(connections)
    };
    ruleset().and_then(RulesetCreated::restrict_self).map_err(io::Error::other)?;
    // A core file would hold the lake's data, and takes seconds to write.
    set_limit(Resource::Core, 0)
}

// Folders of a lake may be links to other disks.
fn linked_folders(lake: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(lake).into_iter().flatten().flatten();
    entries.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_symlink())).map(|entry| entry.path()).collect()
}

/// Limits what the process can allocate from now on to the `memory` bytes that its queries may hold, and a little
/// besides.
///
/// # Errors
/// The system does not tell what the process has, or refuses.
pub(super) fn limit_memory(memory: usize) -> io::Result<()> {
    let statm = std::fs::read_to_string("/proc/self/statm")?;
    let pages = statm.split_whitespace().nth(STATM_DATA).and_then(|pages| pages.parse::<u64>().ok());
    let pages = pages.ok_or_else(|| io::Error::other(format!("/proc/self/statm is `{statm}`")))?;
    set_limit(Resource::Data, pages * rustix::param::page_size() as u64 + memory as u64 + OVERHEAD_BYTES)
}

// Never above what the process was started with, which only an administrator may raise.
fn set_limit(resource: Resource, most: u64) -> io::Result<()> {
    let maximum = getrlimit(resource).maximum.map_or(most, |maximum| maximum.min(most));
    Ok(setrlimit(resource, Rlimit { current: Some(maximum), maximum: Some(maximum) })?)
}
