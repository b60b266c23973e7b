//! Responses of REW as text. A refused import leaves nothing behind.
#![no_main]

use std::path::PathBuf;
use std::sync::LazyLock;

use echolake_fuzz::{ImportFolder, REW_MANIFEST, three_points};
use echolake_import::import_rew;
use echolake_schema::Rig;
use libfuzzer_sys::fuzz_target;

static PLACE: LazyLock<(ImportFolder, PathBuf, Rig)> = LazyLock::new(|| {
    let folder = ImportFolder::new();
    let manifest = folder.write("manifest.csv", REW_MANIFEST.as_bytes());
    (folder, manifest, three_points())
});

fuzz_target!(init: echolake_fuzz::write_seeds_on_request(), |bytes: &[u8]| {
    let (folder, manifest, rig) = &*PLACE;
    folder.write("input.txt", bytes);
    let imported = import_rew(manifest, rig, folder.options(), &mut |_, _| {});
    assert_eq!(folder.clear(), imported.map_or(0, |runs| runs.len()));
});
