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
/// Files with which names of other machines are looked up.
const NAMES: [&str; 5] =
    ["/etc/resolv.conf", "/etc/hosts", "/etc/nsswitch.conf", "/etc/host.conf", "/run/systemd/resolve"];
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

/// Lets the process read `lake` and its own program, read and write `own` folders, and nothing else; connect over TCP
/// to the ports of `workers` alone. To be called before there are threads. A kernel without Landlock leaves the process
/// as it is.
///
/// # Errors
/// The system refuses.
pub fn confine_files(lake: &Path, own: &[&Path], workers: &[u16]) -> io::Result<()> {
    confine_process(with_names(lake_folders(lake), !workers.is_empty()), own, Some(workers))
}

/// Lets the process read what it needs to reach the lake's object store, read and write `own` folders, and nothing
/// else; connect over TCP to the ports of the store and of `workers` alone. Otherwise as [`confine_files`].
///
/// # Errors
/// The system refuses.
pub fn confine_to_store(store: &RemoteAccess, own: &[&Path], workers: &[u16]) -> io::Result<()> {
    let ports = [store.ports.as_slice(), workers].concat();
    confine_process(with_names(store.files.clone(), !workers.is_empty()), own, Some(&ports))
}

/// Confines a worker to files as an engine; it listens, and connects to other workers, wherever they are.
///
/// # Errors
/// The system refuses.
pub fn confine_worker(readable: Vec<PathBuf>, own: &[&Path]) -> io::Result<()> {
    confine_process(with_names(readable, true), own, None)
}

fn with_names(mut readable: Vec<PathBuf>, has_peers: bool) -> Vec<PathBuf> {
    readable.extend(NAMES.map(PathBuf::from).into_iter().filter(|_| has_peers));
    readable
}

// Without ports, TCP is not confined.
fn confine_process(readable: Vec<PathBuf>, own: &[&Path], ports: Option<&[u16]>) -> io::Result<()> {
    let connect = |port: &u16| Ok::<_, RulesetError>(NetPort::new(*port, AccessNet::ConnectTcp));
    let connections = ports.unwrap_or_default().iter().map(connect);
    // The place of a panic in the log has the names of its functions.
    let program = std::env::current_exe();
    let ruleset = || -> Result<RulesetCreated, RulesetError> {
        let read = AccessFs::from_read(LANDLOCK) & !AccessFs::Execute;
        let mut ruleset = Ruleset::default().handle_access(AccessFs::from_all(LANDLOCK))?;
        if ports.is_some() {
            ruleset = ruleset.handle_access(AccessNet::from_all(LANDLOCK))?;
        }
        ruleset
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

/// Returns the folders that a lake in a folder is in: its own may be links to other disks.
pub fn lake_folders(lake: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(lake).into_iter().flatten().flatten();
    let links = entries.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_symlink()));
    [lake.to_owned()].into_iter().chain(links.map(|entry| entry.path())).collect()
}

/// Limits what the process can allocate from now on to the `memory` bytes that its queries may hold and its
/// caches keep, and a little besides.
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
