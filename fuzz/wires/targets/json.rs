//! Messages of MCAP files in JSON, with a schema or without, with their schemas.
#![no_main]

use echolake_fuzz_wires::MessageInput;
use libfuzzer_sys::fuzz_target;

fuzz_target!(init: echolake_fuzz_wires::write_seeds_on_request(), |bytes: &[u8]| {
    let _ = MessageInput::parse(bytes).and_then(|input| input.with_encodings("json", "jsonschema").decode());
});
