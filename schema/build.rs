//! Compiles the messages of `proto/` with protox, so that no system protoc is needed.
use std::path::PathBuf;

use prost::Message as _;

const FILES: [&str; 4] = [
    "echolake/v1/ambient_sample.proto",
    "echolake/v1/impulse_response.proto",
    "echolake/v1/measurement.proto",
    "echolake/v1/sweep_recording.proto",
];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo:rerun-if-changed=proto");
    let descriptors = protox::compile(FILES, ["proto"])?;
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    std::fs::write(out.join("echolake.v1.fds"), descriptors.encode_to_vec())?;
    // Samples stay where they are in what a message is decoded from.
    prost_build::Config::new().bytes(["."]).compile_fds(descriptors)?;
    Ok(())
}
