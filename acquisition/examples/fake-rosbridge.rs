//! Two fake arms behind a rosbridge, to try clients and rig files with: `fake-rosbridge 127.0.0.1:9090`. It says its
//! address and ends when its input is closed.
//!
//! ```text
//! cargo run --profile quick -p echolake-acquisition --example fake-rosbridge -- 127.0.0.1:0
//! ```

use std::io::{Read as _, Write as _};

use echolake_acquisition::rig::drivers::rosbridge::fake::FakeBridge;

fn main() -> std::io::Result<()> {
    let address = std::env::args().nth(1).unwrap_or_else(|| "127.0.0.1:9090".into());
    let bridge = FakeBridge::start(&address)?;
    let mut out = std::io::stdout();
    writeln!(out, "{}", bridge.url())?;
    out.flush()?;
    std::io::stdin().read_to_end(&mut Vec::new()).map(drop)
}
