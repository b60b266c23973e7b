//! SOFA files. A refused import leaves nothing behind.
#![no_main]

use std::sync::LazyLock;

use echolake_fuzz::{ImportFolder, three_points};
use echolake_import::import_sofa;
use echolake_schema::Rig;
use libfuzzer_sys::fuzz_target;

static PLACE: LazyLock<(ImportFolder, Rig)> = LazyLock::new(|| (ImportFolder::new(), three_points()));

fuzz_target!(init: echolake_fuzz::write_seeds_on_request(), |bytes: &[u8]| {
    let (folder, rig) = &*PLACE;
    let file = folder.write("input.sofa", bytes);
    let imported = import_sofa(&[file], rig, None, folder.options(), &mut |_, _| {});
    assert_eq!(folder.clear(), imported.map_or(0, |runs| runs.len()));
});
