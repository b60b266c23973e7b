//! HDF5 files behind a mapping. A refused import leaves nothing behind.
#![no_main]

use std::path::PathBuf;
use std::sync::LazyLock;

use echolake_fuzz::{ImportFolder, MAPPING, three_points};
use echolake_import::import_hdf5;
use echolake_schema::Rig;
use libfuzzer_sys::fuzz_target;

static PLACE: LazyLock<(ImportFolder, PathBuf, Rig)> = LazyLock::new(|| {
    let folder = ImportFolder::new();
    let mapping = folder.write("mapping.toml", MAPPING.as_bytes());
    (folder, mapping, three_points())
});

fuzz_target!(init: echolake_fuzz::write_seeds_on_request(), |bytes: &[u8]| {
    let (folder, mapping, rig) = &*PLACE;
    folder.write("input.h5", bytes);
    let imported = import_hdf5(mapping, rig, None, folder.options(), &mut |_, _| {});
    assert_eq!(folder.clear(), imported.map_or(0, |runs| runs.len()));
});
