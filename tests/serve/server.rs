//! A server of the test's own, on ports that are free.

use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};

/// A server; dropping it ends it.
pub(crate) struct Served {
    child: Child,
    said: Arc<Mutex<Vec<String>>>,
    /// `host:port` of each protocol.
    pub(crate) http: String,
    pub(crate) flight_sql: String,
    pub(crate) postgres: String,
}

impl Served {
    /// Serves the lake `lake` of a folder.
    pub(crate) fn start(binary: &Path, folder: &Path, more: &[&str]) -> Self {
        let any = "127.0.0.1:0";
        let mut child = Command::new(binary)
            .args(["--lake", "lake", "serve", "--listen", any, "--flight-sql", any, "--postgres", any])
            .args(more)
            .current_dir(folder)
            .env_remove("ECHOLAKE_LAKE")
            // Where something panics, who called it is told.
            .env("RUST_BACKTRACE", "1")
            .stderr(Stdio::piped())
            .spawn()
            .expect("the command starts");
        let mut lines = BufReader::new(child.stderr.take().expect("stderr")).lines().map(|l| l.expect("a line"));
        let mut address = |scheme: &str| {
            let line = lines.find(|l| l.contains(scheme)).unwrap_or_else(|| panic!("no {scheme} is served"));
            let rest = line.split_once("://").expect("a URL").1;
            rest.split('/').next().expect("host and port").to_owned()
        };
        let (http, flight_sql, postgres) = (address("http://"), address("grpc://"), address("postgresql://"));
        // What it says later must not fill the pipe.
        let said = Arc::new(Mutex::new(Vec::new()));
        let heard = said.clone();
        std::thread::spawn(move || lines.for_each(|line| heard.lock().expect("lines").push(line)));
        Self { child, said, http, flight_sql, postgres }
    }

    /// What it said on stderr since it listens.
    pub(crate) fn said(&self) -> Vec<String> {
        self.said.lock().expect("lines").clone()
    }

    /// Whether its process is there.
    pub(crate) fn is_up(&mut self) -> bool {
        self.child.try_wait().expect("its state").is_none()
    }

    /// What its process weighs.
    pub(crate) fn resident_kib(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap_or_default();
        let line = status.lines().find_map(|l| l.strip_prefix("VmRSS:"));
        line.and_then(|l| l.trim().split(' ').next()).and_then(|n| n.parse().ok()).unwrap_or(0)
    }

    /// Tells it to stop; returns its exit code.
    pub(crate) fn terminate(&mut self) -> Option<i32> {
        let told = Command::new("kill").arg(self.child.id().to_string()).status().expect("kill starts");
        assert!(told.success());
        self.child.wait().expect("its end").code()
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
