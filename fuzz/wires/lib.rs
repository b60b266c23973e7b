//! Shared by the targets of messages and wires: a lake of three points in memory, a server of it, and seeds.

mod message_input;
mod seeds;
mod server;

use std::path::Path;

use echolake_fuzz::{ImportFolder, three_points};
use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_query::Session;
use tokio::runtime::Runtime;

pub use message_input::MessageInput;
pub use seeds::write_seeds_on_request;
pub use server::{FuzzedServer, ServerWire};

/// An empty lake of three points, and the runtime of its queries.
pub struct FuzzedLake {
    folder: ImportFolder,
    runtime: Runtime,
    lake: Lake,
    session: Session,
}

impl FuzzedLake {
    /// Makes it.
    ///
    /// # Panics
    /// The system refuses.
    pub fn new() -> Self {
        let folder = ImportFolder::new();
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
        let runtime = runtime.expect("a runtime");
        let location = folder.path().to_str().expect("a path in UTF-8");
        let rig = three_points();
        let references = ReferenceSurfaces::default();
        let made = Lake::open_or_create(location, &rig, &references);
        let lake = runtime.block_on(made).expect("a lake");
        let session = Session::new(&lake).expect("a session");
        Self { folder, runtime, lake, session }
    }

    /// Writes a file of it.
    ///
    /// # Panics
    /// The system refuses.
    pub fn write(&self, name: &str, bytes: &[u8]) {
        self.folder.write(name, bytes);
    }

    /// Reads the whole answer to a query, which may fail.
    pub fn ask(&self, query: &str) {
        self.runtime.block_on(async {
            let Ok(mut answer) = self.session.query(query).await else { return };
            while let Ok(Some(_)) = answer.next().await {}
        });
    }

    /// Its folder.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }
}

impl Default for FuzzedLake {
    fn default() -> Self {
        Self::new()
    }
}
