//! A server of the test's own, on ports that are free.

use std::io::{BufRead as _, BufReader};
use std::process::{Child, Command, Stdio};

use crate::Place;

/// A server; dropping it ends it.
pub(crate) struct Served {
    child: Child,
    /// `host:port` of each protocol.
    pub(crate) http: String,
    pub(super) postgres: String,
}

impl Served {
    pub(crate) fn start(place: &Place, more: &[&str]) -> Self {
        let any = "127.0.0.1:0";
        let mut child = Command::new(env!("CARGO_BIN_EXE_echolake"))
            .args(["--lake", "lake", "serve", "--listen", any, "--flight-sql", any, "--postgres", any])
            .args(more)
            .current_dir(place.path(""))
            .env_remove("ECHOLAKE_LAKE")
            .stderr(Stdio::piped())
            .spawn()
            .expect("the command starts");
        let mut lines = BufReader::new(child.stderr.take().expect("stderr")).lines().map(|l| l.expect("a line"));
        let mut address = |scheme: &str| {
            let line = lines.find(|l| l.contains(scheme)).unwrap_or_else(|| panic!("no {scheme} is served"));
            let rest = line.split_once("://").expect("a URL").1;
            rest.split('/').next().expect("host and port").to_owned()
        };
        let (http, _, postgres) = (address("http://"), address("grpc://"), address("postgresql://"));
        // What it says later must not fill the pipe.
        std::thread::spawn(move || lines.for_each(drop));
        Self { child, http, postgres }
    }

    /// Tells it to stop; returns its exit code.
    pub(super) fn terminate(&mut self) -> Option<i32> {
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
