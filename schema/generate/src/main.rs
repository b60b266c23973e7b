//! Compiles the messages of `schema/proto` into `schema/src/messages`; with `--check` it only says whether they are
//! those.
//!
//! Their result is kept beside the sources, so that building echolake needs no compiler of protobuf: protox and
//! prost-build were a tenth of the build of the program for the rig.
use std::path::Path;

use prost::Message as _;

const FILES: [&str; 4] = [
    "echolake/v1/ambient_sample.proto",
    "echolake/v1/impulse_response.proto",
    "echolake/v1/measurement.proto",
    "echolake/v1/sweep_recording.proto",
];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let check = match std::env::args().skip(1).collect::<Vec<_>>().as_slice() {
        [] => false,
        [option] if option == "--check" => true,
        other => return Err(format!("expected --check or nothing, not {other:?}").into()),
    };
    // Of this run: checkouts that share a folder of build products share this program.
    let manifest =
        std::env::var_os("CARGO_MANIFEST_DIR").ok_or("no CARGO_MANIFEST_DIR; hint: start it by cargo run")?;
    let schema = Path::new(&manifest).join("..");
    let descriptors = protox::compile(FILES, [schema.join("proto")])?;
    let compiled = tempfile::tempdir()?;
    std::fs::write(compiled.path().join("echolake.v1.fds"), descriptors.encode_to_vec())?;
    // Decoded samples share the buffer that a message is decoded from.
    prost_build::Config::new().bytes(["."]).out_dir(compiled.path()).compile_fds(descriptors)?;
    for entry in std::fs::read_dir(compiled.path())? {
        let new = entry?;
        let kept = schema.join("src/messages").join(new.file_name());
        let bytes = std::fs::read(new.path())?;
        if !check {
            std::fs::write(&kept, bytes)?;
        } else if std::fs::read(&kept).ok().as_ref() != Some(&bytes) {
            let hint = "hint: cargo run --manifest-path schema/generate/Cargo.toml";
            return Err(format!("`{}` is not what the messages of schema/proto make; {hint}", kept.display()).into());
        }
    }
    Ok(())
}
