//! WAV files: recording and loopback are two channels of the input. A refused import leaves nothing behind.
#![no_main]

use std::path::PathBuf;
use std::sync::LazyLock;

use echolake_fuzz::{ImportFolder, WAV_MANIFEST, three_points};
use echolake_import::{import_wav, sampling_rate_of};
use echolake_schema::Rig;
use libfuzzer_sys::fuzz_target;

static PLACE: LazyLock<(ImportFolder, PathBuf, Rig)> = LazyLock::new(|| {
    let folder = ImportFolder::new();
    let manifest = folder.write("manifest.csv", WAV_MANIFEST.as_bytes());
    (folder, manifest, three_points())
});

fuzz_target!(init: echolake_fuzz::write_seeds_on_request(), |bytes: &[u8]| {
    let (folder, manifest, rig) = &*PLACE;
    folder.write("input.wav", bytes);
    let _ = sampling_rate_of(manifest);
    let imported = import_wav(manifest, rig, folder.options(), &mut |_, _| {});
    assert_eq!(folder.clear(), imported.map_or(0, |runs| runs.len()));
});
