//! MCAP files of anybody in a lake's inbox, as SQL reads them.
#![no_main]

use std::sync::LazyLock;

use echolake_fuzz_wires::FuzzedLake;
use libfuzzer_sys::fuzz_target;

const QUERIES: [&str; 3] = [
    "select * from mcap_topics('inbox/input.mcap')",
    "select * from mcap_messages('inbox/input.mcap')",
    "select * from mcap('inbox/input.mcap', '/sweep')",
];

static LAKE: LazyLock<FuzzedLake> = LazyLock::new(FuzzedLake::new);

fuzz_target!(init: echolake_fuzz_wires::write_seeds_on_request(), |bytes: &[u8]| {
    LAKE.write("inbox/input.mcap", bytes);
    for query in QUERIES {
        LAKE.ask(query);
    }
});
