//! The build and the lake of this process, as workers and engines compare them.

use std::fs::File;
use std::io::{self, BufReader, Read as _};

use echolake_lake::Lake;
use echolake_query::WorkerIdentity;

use crate::Error;

/// The running program, even if its file was replaced.
const PROGRAM: &str = "/proc/self/exe";

/// Returns the version of this program with a checksum of its file: two builds of one version may plan differently.
///
/// # Errors
/// The program's file cannot be read.
pub fn program_build() -> io::Result<String> {
    let mut file = BufReader::with_capacity(1 << 20, File::open(PROGRAM)?);
    let mut checksum = crc32fast::Hasher::new();
    let mut block = vec![0; 1 << 20];
    loop {
        match file.read(&mut block)? {
            0 => break,
            read => checksum.update(&block[..read]),
        }
    }
    Ok(format!("{}-{:08x}", env!("CARGO_PKG_VERSION"), checksum.finalize()))
}

/// Returns the identity of a process of this build with a lake.
///
/// # Errors
/// [`Error::Lake`]; [`Error::NoTables`] if the lake has no tables yet.
pub(super) async fn worker_identity(lake: &Lake, build: String) -> Result<WorkerIdentity, Error> {
    let id = lake.id().await?;
    let lake = id.ok_or_else(|| Error::NoTables { location: lake.location().to_owned() })?;
    Ok(WorkerIdentity { build, lake })
}
