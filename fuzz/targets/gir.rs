//! Folders of the GIR data set: the first byte says which of the files is the input, the others are good or missing. A
//! refused import leaves nothing behind.
#![no_main]

use std::sync::LazyLock;

use echolake_fuzz::{ImportFolder, three_points};
use echolake_import::import_gir;
use echolake_schema::Rig;
use libfuzzer_sys::fuzz_target;

const NAMES: [&str; 4] = ["a.npz", "a_mat.npz", "combinations.csv", "panel_info.csv"];
static PLACE: LazyLock<(ImportFolder, Vec<u8>, Rig)> =
    LazyLock::new(|| (ImportFolder::new(), echolake_fuzz::gir_surface(), three_points()));

fuzz_target!(init: echolake_fuzz::write_seeds_on_request(), |bytes: &[u8]| {
    let Some((which, bytes)) = bytes.split_first() else { return };
    let (folder, good, rig) = &*PLACE;
    folder.write(NAMES[0], good);
    let file = folder.write(NAMES[usize::from(*which) % NAMES.len()], bytes);
    let imported = import_gir(folder.path(), rig, folder.options(), &mut |_, _| {});
    std::fs::remove_file(file).expect("removed");
    assert_eq!(folder.clear(), imported.map_or(0, |runs| runs.len()));
});
