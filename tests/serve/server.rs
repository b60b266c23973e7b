//! A server of the test's own, on ports that are free.

use std::net::TcpStream;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use echolake_testing::{ChildProcess, run_command};
use rustix::process::{Pid, Signal, kill_process};

use super::tunnel::{CERTIFIED_NAME, ServerTunnels, TunnelOpening};

/// Time for which a client waits for the next bytes of an answer, or until it may send more of a request.
pub(crate) const ANSWER_LIMIT: Duration = Duration::from_secs(120);

/// The variable by which servers have certificates, and their clients are encrypted: campaigns and tests with TLS.
const ENCRYPTED_VARIABLE: &str = "ECHOLAKE_ENCRYPTED";

/// A server; dropping it ends it.
pub(crate) struct ServedLake {
    child: ChildProcess,
    /// Tunnels that its addresses lead through if it is encrypted.
    _tunnels: Option<ServerTunnels>,
    /// `host:port` of each protocol.
    pub http: String,
    pub flight_sql: String,
    pub postgres: String,
}

impl ServedLake {
    /// Serves the lake `lake` of a folder.
    pub fn start(binary: &Path, folder: &Path, more: &[&str]) -> Self {
        if std::env::var_os(ENCRYPTED_VARIABLE).is_some() {
            return Self::start_encrypted(binary, folder, more);
        }
        Self::start_in(binary, folder, more)
    }

    /// Serves it with a certificate; the addresses are those of tunnels, which encrypt what clients send.
    pub fn start_encrypted(binary: &Path, folder: &Path, more: &[&str]) -> Self {
        // A server that is started again keeps its certificate.
        if !folder.join("tls").exists() {
            let mut command = Command::new(binary);
            let made = run_command(command.args(["certificate", CERTIFIED_NAME, "-o", "tls"]).current_dir(folder));
            assert!(made.is_ok_and(|made| made.status.success()), "a certificate");
        }
        let encrypted = ["--certificate", "tls/certificate.pem", "--key", "tls/key.pem"];
        let mut served = Self::start_in(binary, folder, &[&encrypted, more].concat());
        let tunnels = ServerTunnels::new(&folder.join("tls/certificate.pem")).expect("tunnels");
        for (address, opening) in [
            (&mut served.http, TunnelOpening::Http),
            (&mut served.flight_sql, TunnelOpening::FlightSql),
            (&mut served.postgres, TunnelOpening::Postgres),
        ] {
            *address = tunnels.open(std::mem::take(address), opening).expect("a port");
        }
        served._tunnels = Some(tunnels);
        served
    }

    fn start_in(binary: &Path, folder: &Path, more: &[&str]) -> Self {
        let mut command = Command::new(binary);
        command.args(["--lake", "lake"]).current_dir(folder).env_remove("ECHOLAKE_LAKE");
        Self::start_command(&mut command, more)
    }

    /// Serves the lake that a command's first arguments name.
    pub fn start_command(command: &mut Command, more: &[&str]) -> Self {
        let any = "127.0.0.1:0";
        command
            .args(["serve", "--listen", any, "--flight-sql", any, "--postgres", any])
            .args(more)
            // If something panics, its caller is printed.
            .env("RUST_BACKTRACE", "1");
        let mut child = ChildProcess::start(command).expect("the command starts");
        let mut address = |scheme: &str| {
            let line = child.wait_for_line(scheme);
            let rest = line.split_once("://").expect("a URL").1;
            rest.split('/').next().expect("host and port").to_owned()
        };
        let (http, flight_sql, postgres) = (address("  http"), address("  grpc"), address("  postgresql"));
        Self { child, _tunnels: None, http, flight_sql, postgres }
    }

    /// A connection to one of its addresses, on which nothing is waited for without a limit.
    pub fn connect(address: &str) -> TcpStream {
        let stream = TcpStream::connect(address).expect("connected");
        stream.set_read_timeout(Some(ANSWER_LIMIT)).expect("a limit of time");
        stream.set_write_timeout(Some(ANSWER_LIMIT)).expect("a limit of time");
        stream
    }

    /// Its process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Sends a signal to its engines, the spare one, too.
    pub fn signal_engines(&self, signal: Signal) {
        let pids = self.engine_ids();
        assert!(!pids.is_empty(), "it has engines");
        for pid in pids {
            // One may have ended by itself.
            let _ = kill_process(Pid::from_raw(pid).expect("a process"), signal);
        }
    }

    /// Kills one of its two engines of statements, of which one is a spare.
    pub fn kill_statement_engine(&self) {
        let arguments = |pid: &i32| std::fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        let found = self.engine_ids().into_iter().find(|pid| arguments(pid).contains("statements"));
        kill_process(Pid::from_raw(found.expect("an engine")).expect("a process"), Signal::KILL).expect("it runs");
    }

    /// Returns the most memory that one of its engines had at a time, in KiB.
    pub fn engine_kib(&self) -> u64 {
        self.engine_ids().into_iter().map(|pid| memory_kib(pid as u32, "VmHWM:")).max().unwrap_or(0)
    }

    fn engine_ids(&self) -> Vec<i32> {
        let all = std::fs::read_dir(format!("/proc/{}/task", self.id())).expect("threads");
        let lists = all.map(|thread| std::fs::read_to_string(thread.expect("a thread").path().join("children")));
        let split =
            |list: String| list.split_whitespace().map(|pid| pid.parse().expect("a number")).collect::<Vec<_>>();
        lists.filter_map(Result::ok).flat_map(split).collect()
    }

    /// Returns the lines it wrote to stderr so far.
    pub fn said(&self) -> Vec<String> {
        self.child.stderr().lines().map(str::to_owned).collect()
    }

    /// Returns whether its process is running.
    pub fn is_up(&mut self) -> bool {
        self.child.is_running()
    }

    /// Returns the resident memory of its process, in KiB.
    pub fn resident_kib(&self) -> u64 {
        memory_kib(self.id(), "VmRSS:")
    }

    /// Stops it; returns its exit code.
    pub fn terminate(&mut self) -> Option<i32> {
        self.signal("TERM");
        self.wait()
    }

    /// Sends it a signal.
    pub fn signal(&self, name: &str) {
        self.child.signal(name);
    }

    /// Waits for a line on stderr with this text in it.
    pub fn wait_for_line(&mut self, part: &str) {
        self.child.wait_for_line(part);
    }

    /// Waits for its end; returns its exit code.
    pub fn wait(&mut self) -> Option<i32> {
        self.child.wait().status.code()
    }
}

fn memory_kib(pid: u32, line: &str) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let found = status.lines().find_map(|l| l.strip_prefix(line));
    found.and_then(|l| l.trim().split(' ').next()).and_then(|n| n.parse().ok()).unwrap_or(0)
}
