# What one does with this checkout; `just` alone lists it. Each recipe is a line that works without just, too.

_list:
    @{{ just_executable() }} --list --unsorted

# All tests, as in the README.
test:
    cargo test --profile quick --workspace --locked

# Rust's format and lints, and all tests but the slow ones: what to run between two edits.
quick:
    cargo fmt --all --check
    cargo clippy --profile quick --workspace --all-targets --locked -- -D warnings
    cargo test --profile quick --workspace --tests --locked -- --skip slow

# Tests of one member's library, as `just member query views`: nothing but the member is compiled.
member MEMBER *NAMES:
    cargo test --profile quick -p echolake -p echolake-{{ MEMBER }} --lib --locked -- {{ NAMES }}

# How long that takes after a change of one line, for all members.
inner-loop *FOLDERS:
    tests/inner_loop.sh {{ FOLDERS }}

# Formats Rust, the pages and the Python package.
fmt:
    cargo fmt --all
    .ci/lint --fix

# Lints of all three, formatting and types of the pages and the Python package.
lint:
    cargo clippy --profile quick --workspace --all-targets --locked -- -D warnings
    .ci/lint

# Writes docs/functions.md from what the functions say of themselves.
docs:
    ECHOLAKE_RENEW=1 cargo test --profile quick --workspace --locked manual

# Writes the types of the API for the pages, from web/openapi.json.
api:
    npm run --silent --prefix web api

# Measures the paper's panels on the simulated rig and writes the figures and tables of docs/paper.md.
paper *LAKE:
    docs/paper/make.sh {{ LAKE }}

# A long form of what tests try in short: docs/testing.md lists them.
stress NAME *OPTIONS:
    cargo run --profile quick --locked -p echolake-stress -- {{ NAME }} {{ OPTIONS }}

# Fuzzes a reader of foreign bytes with coverage, as `just fuzz sofa 3600`; targets are in fuzz/targets/ and fuzz/wires/targets/.
fuzz TARGET *OPTIONS:
    fuzz/run {{ TARGET }} {{ OPTIONS }}

# A benchmark, built as packages are, as `just bench all --quick`; `kernels` are criterion's.
bench NAME *OPTIONS:
    {{ if NAME == "kernels" { "cargo bench --manifest-path stress/kernels/Cargo.toml --locked --" } else { "cargo build --profile dist --locked -p echolake -p echolake-stress && target/dist/stress bench " + NAME } }} {{ OPTIONS }}

# A server with so many workers on this machine, on the lake of $ECHOLAKE_LAKE or ./lake; all end with Ctrl-C.
cluster WORKERS="3" *OPTIONS:
    packaging/cluster.sh {{ WORKERS }} {{ OPTIONS }}

# What a change must pass.
ci:
    .ci/run

# Wheel, Debian package, sources and inventory of HEAD in dist/, for this machine only.
wheel:
    ECHOLAKE_TARGETS="$(uname -m)-unknown-linux-gnu" packaging/package.sh HEAD

# The same: the Debian package has the program of the wheel.
deb: wheel

# All packages of HEAD in dist/, for every target that is installed.
package:
    packaging/package.sh HEAD

# An image of dist/'s Debian package, by buildah or podman.
container *OPTIONS:
    "$(command -v buildah || command -v podman)" build --format docker --tag echolake --file packaging/Containerfile {{ OPTIONS }} .

# Cuts the changelog, sets the version, commits, makes dist/ and tags; publishes nothing.
release VERSION:
    packaging/release.sh {{ VERSION }}
