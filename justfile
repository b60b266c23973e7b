# What one does with this checkout; `just` alone lists it. Each recipe is a line that works without just, too.

_list:
    @{{ just_executable() }} --list --unsorted

# All tests, as in the README.
test:
    cargo test --release --workspace --locked

# Format, lints and all tests but the slow ones: what to run between two edits.
quick:
    cargo fmt --all --check
    cargo clippy --release --workspace --all-targets --locked -- -D warnings
    cargo test --release --workspace --tests --locked -- --skip slow

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
