//! Bytes of a client of HTTP: one request or more.
#![no_main]

use std::sync::LazyLock;

use echolake_fuzz_wires::{FuzzedServer, ServerWire};
use libfuzzer_sys::fuzz_target;

static SERVER: LazyLock<FuzzedServer> = LazyLock::new(FuzzedServer::start);

fuzz_target!(init: echolake_fuzz_wires::write_seeds_on_request(), |bytes: &[u8]| SERVER.send(ServerWire::Http, bytes));
