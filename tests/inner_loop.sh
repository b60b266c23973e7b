#!/usr/bin/env bash
# Measures the inner loop: tests/inner_loop.sh [FOLDER...], by default of all members that have tests of their own.
#
# Adds a line to a member's library and times how long cargo takes to compile the member's tests and to run them, slow
# ones aside. Prints a Markdown table for CONTRIBUTING.md. Each file is as before afterwards.
set -euo pipefail
cd "$(dirname "$0")/.."
members=("$@")
[ $# -gt 0 ] || members=(
    schema dsp recording storage acquisition acquisition/{import,panel} ingest query query/{functions,mcap} export
    server server/{access,flight,http,postgres,service}
)
logs=$(mktemp -d)
file=
restore() {
    # A new time, so that the next build does not take what was compiled for this file's.
    [ -z "$file" ] || { cp "$logs/before" "$file" && touch "$file"; }
    file=
}
trap restore EXIT
TIMEFORMAT=%R
# For what goes wrong, because stderr is timed.
exec 3>&2

# Beside the command, a member has the features of the whole workspace, and nothing else is compiled for it.
tests() {
    local package
    package=$(sed -n 's/^name = "\(.*\)"/\1/p' "$1/Cargo.toml" | head -n 1)
    shift
    cargo test --profile quick -p echolake -p "$package" --lib --locked "$@" >"$logs/cargo.log" 2>&1 ||
        { cat "$logs/cargo.log" >&3 && false; }
}

echo "| a line more in | compiles for, s | tests run for, s |"
echo "| --- | --- | --- |"
for member in "${members[@]}"; do
    tests "$member" --no-run
    cp "$member/src/lib.rs" "$logs/before"
    file="$member/src/lib.rs"
    echo "const _: u32 = $RANDOM;" >>"$file"
    compiled=$({ time tests "$member" --no-run; } 2>&1)
    tested=$({ time tests "$member" -- --skip slow; } 2>&1)
    restore
    echo "| \`$member/\` | $compiled | $tested |"
done
