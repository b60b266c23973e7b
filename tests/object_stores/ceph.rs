//! The checks on Ceph's S3 gateway, in short. Its Debian packages are installed if that is possible; if it is not, the
//! test is skipped and says so, and fails with `ECHOLAKE_NO_SKIP`.

use std::fs::File;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Command;

use super::super::web::{or_skip, run};
use super::ECHOLAKE;

/// A gateway of the test's own; dropping it ends its processes and deletes what they hold.
struct CephGateway {
    folder: tempfile::TempDir,
    port: u16,
    _lock: File,
}

fn script(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/object_stores").join(name)
}

/// Ports of a gateway, its proxies and its clients, from the first on; the monitor has one of its own, this far above.
const PORTS: u16 = 40;
const MONITOR_DISTANCE: u16 = 1000;

/// Returns a first port with a lock on it, so that no other test of this machine takes the same, even of another suite.
fn lock_ports() -> Result<(u16, File), String> {
    // Below the ports that the system gives to others, and no monitor among the ports of another.
    let starts = (20_000..30_000).step_by(2 * usize::from(MONITOR_DISTANCE));
    let blocks = starts.flat_map(|start| (start..start + MONITOR_DISTANCE).step_by(usize::from(PORTS)));
    let is_free = |port: u16| TcpListener::bind(("127.0.0.1", port)).is_ok();
    for port in blocks {
        let path = std::env::temp_dir().join(format!("echolake-ports-{port}.lock"));
        // One that cannot be opened is somebody else's.
        let Ok(lock) = File::create(path) else { continue };
        if lock.try_lock().is_ok() && is_free(port) && is_free(port + MONITOR_DISTANCE) {
            return Ok((port, lock));
        }
    }
    Err("no ports are free for Ceph's gateway".to_owned())
}

impl CephGateway {
    fn install() -> Result<Self, String> {
        run(Command::new("bash").arg(script("ceph_rgw.sh")).arg("install"))?;
        let folder = tempfile::tempdir().map_err(|e| e.to_string())?;
        let (port, lock) = lock_ports()?;
        Ok(Self { folder, port, _lock: lock })
    }

    /// A program that finds this gateway, and starts it if it does not run.
    fn command(&self, program: &str, file: &str) -> Command {
        let mut command = Command::new(program);
        command.arg(script(file)).env("CEPH_RGW_DIR", self.folder.path().join("ceph"));
        command.env("CEPH_RGW_PORT", self.port.to_string()).env("PYTHONDONTWRITEBYTECODE", "1");
        command.env_remove("ECHOLAKE_LAKE");
        command
    }

    fn check(&self, program: &str, file: &str, args: &[&str]) {
        let said = run(self.command(program, file).arg(ECHOLAKE).args(args)).unwrap_or_else(|why| panic!("{why}"));
        eprintln!("{said}");
    }
}

impl Drop for CephGateway {
    fn drop(&mut self) {
        // A failure here would hide that of the test.
        let _ = run(self.command("bash", "ceph_rgw.sh").arg("destroy"));
    }
}

mod slow {
    use super::*;

    #[test]
    fn a_bucket_of_ceph_holds_what_a_folder_does_whatever_fails() {
        let Some(gateway) = or_skip("lakes on Ceph's gateway", CephGateway::install()) else { return };
        gateway.check("bash", "check_ceph.sh", &[]);
        gateway.check("python3", "check_ingests.py", &["--rounds", "2", "--first", "4", "--runs", "6", "--lanes", "2"]);
        gateway.check("python3", "check_gateway.py", &["--rounds", "1", "--runs", "6", "--steps", "ingest", "slice"]);
    }
}
