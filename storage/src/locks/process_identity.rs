//! The process that holds a lease or a claim, so that what runs on its machine can tell when it has ended.

use std::fs;
use std::io::ErrorKind;

use serde::{Deserialize, Serialize};

/// A process among all that ever ran on any machine.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct ProcessIdentity {
    /// Random number of one start of one machine's system.
    boot: String,
    /// Namespace of process ids: containers on one machine have their own.
    namespace: String,
    pid: u32,
    /// Time from the system's start to that of the process, because ids are used again.
    started_ticks: u64,
}

/// State of a process id.
enum ProcessState {
    Absent,
    Running { started_ticks: u64 },
    Unknown,
}

impl ProcessIdentity {
    /// Returns the identity of this process; None if the system does not tell.
    pub fn current() -> Option<Self> {
        Self::from_pid(std::process::id())
    }

    /// Returns the identity of a running process of this machine.
    pub fn from_pid(pid: u32) -> Option<Self> {
        let ProcessState::Running { started_ticks } = process_state(pid) else { return None };
        let boot = fs::read_to_string("/proc/sys/kernel/random/boot_id").ok()?.trim().to_owned();
        let namespace = fs::read_link("/proc/self/ns/pid").ok()?.to_string_lossy().into_owned();
        Some(Self { boot, namespace, pid, started_ticks })
    }

    /// Returns whether the process has ended. False for processes of other machines, of which this one cannot tell.
    pub fn has_ended(&self) -> bool {
        let is_here = Self::current().is_some_and(|here| here.boot == self.boot && here.namespace == self.namespace);
        is_here
            && match process_state(self.pid) {
                // Some systems hide the processes of others; the first one is hidden then, too.
                ProcessState::Absent => matches!(process_state(1), ProcessState::Running { .. }),
                ProcessState::Running { started_ticks } => started_ticks != self.started_ticks,
                ProcessState::Unknown => false,
            }
    }
}

// One that was killed and that its parent has not waited for yet counts as absent.
fn process_state(pid: u32) -> ProcessState {
    let text = match fs::read_to_string(format!("/proc/{pid}/stat")) {
        Ok(text) => text,
        Err(error) if error.kind() == ErrorKind::NotFound => return ProcessState::Absent,
        Err(_) => return ProcessState::Unknown,
    };
    // The name before may contain anything.
    let fields: Vec<_> = text.rsplit_once(')').map_or("", |(_, fields)| fields).split_whitespace().collect();
    match (fields.first(), fields.get(19).and_then(|ticks| ticks.parse().ok())) {
        (Some(&("Z" | "X")), _) => ProcessState::Absent,
        (Some(_), Some(started_ticks)) => ProcessState::Running { started_ticks },
        _ => ProcessState::Unknown,
    }
}

/// Returns the name of this machine, for people.
pub(super) fn host_name() -> String {
    let named = std::fs::read_to_string("/proc/sys/kernel/hostname").ok().or_else(|| std::env::var("HOSTNAME").ok());
    named.map_or_else(|| "this machine".to_owned(), |name| name.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::*;

    #[test]
    fn what_runs_has_not_ended_and_what_was_killed_has() {
        assert!(!ProcessIdentity::current().expect("Linux tells").has_ended());
        let mut child = Command::new("sleep").arg("600").spawn().expect("it starts");
        let identity = ProcessIdentity::from_pid(child.id()).expect("it runs");
        assert!(!identity.has_ended());
        let successor = ProcessIdentity { started_ticks: identity.started_ticks + 1, ..identity.clone() };
        assert!(successor.has_ended(), "its id is another process's by now");
        child.kill().expect("killed");
        child.wait().expect("ended");
        assert!(identity.has_ended());
        for elsewhere in [
            ProcessIdentity { boot: "another".into(), ..identity.clone() },
            ProcessIdentity { namespace: "another".into(), ..identity },
        ] {
            assert!(!elsewhere.has_ended(), "{elsewhere:?}");
        }
    }
}
