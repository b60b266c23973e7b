#!/bin/sh
# Starts workers and a server that uses them on this machine; all end with this script.
#   packaging/cluster.sh WORKERS [options of serve]
set -eu
count=${1:?hint: packaging/cluster.sh 3}
shift
program=${ECHOLAKE:-${CARGO_TARGET_DIR:-target}/release/echolake}
[ -x "$program" ] || { echo "error: $program is missing; hint: cargo build --release" >&2; exit 1; }
folder=$(mktemp -d)
pids=
trap 'kill $pids 2>/dev/null || true; rm -rf "$folder"' EXIT
trap 'exit 0' INT TERM
urls=
for number in $(seq "$count"); do
    "$program" serve --worker 127.0.0.1:0 2>"$folder/$number" &
    pids="$pids $!"
done
for number in $(seq "$count"); do
    tries=0
    until url=$(sed -n 's/^  worker //p' "$folder/$number") && [ -n "$url" ]; do
        tries=$((tries + 1))
        [ "$tries" -lt 300 ] || { cat "$folder/$number" >&2; echo "error: worker $number does not start" >&2; exit 1; }
        sleep 0.1
    done
    urls="$urls${urls:+,}$url"
done
echo "workers $urls" >&2
"$program" serve --workers "$urls" "$@"
