//! The checks on Ceph's S3 gateway, in short. Its Debian packages are installed if that is possible; if it is not, the test
//! is skipped and says so, and fails with `ECHOLAKE_NO_SKIP`.

use std::path::{Path, PathBuf};
use std::process::Command;

use super::super::web::{or_skip, run};
use super::ECHOLAKE;

/// A gateway of the test's own; dropping it ends its processes and deletes what they hold.
struct CephGateway {
    folder: tempfile::TempDir,
    port: u32,
}

fn script(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/object_stores").join(name)
}

impl CephGateway {
    fn install() -> Result<Self, String> {
        run(Command::new("bash").arg(script("ceph_rgw.sh")).arg("install"))?;
        let folder = tempfile::tempdir().map_err(|e| e.to_string())?;
        // Below the ports that the system gives to others; the daemons and proxies of one test have 40 of them.
        let port = 20_000 + 40 * (std::process::id() % 250);
        Ok(Self { folder, port })
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
