#!/usr/bin/env bash
# Runs the README's test command again and again: tests/repeat.sh [RUNS [BUSY [LIMIT_SECS]]].
#
# Every second run inherits an ignored SIGINT, as from a shell's background job. The last BUSY runs share the machine
# with two busy loops per core. A run that takes longer than LIMIT_SECS is killed and counts as failed. Prints a line per
# run, and fails if any run failed; the output of failed runs is kept.
set -uo pipefail
cd "$(dirname "$0")/.."
runs=${1:-20} busy=${2:-4} limit=${3:-3600}
logs=$(mktemp -d)
loops=()
failed=0
trap 'kill "${loops[@]}" 2>/dev/null' EXIT
TIMEFORMAT='%R s, %U s user, %S s system'

for run in $(seq "$runs"); do
    sigint=default before=:
    # Within timeout, which gives its child the default again.
    if [ $((run % 2)) = 0 ]; then sigint=ignored before="trap '' INT"; fi
    if [ "$run" -gt $((runs - busy)) ] && [ "${#loops[@]}" = 0 ]; then
        for _ in $(seq $((2 * $(nproc)))); do
            while :; do :; done &
            loops+=("$!")
        done
    fi
    log="$logs/$run.log"
    command="$before; exec cargo test --profile quick --workspace --locked"
    if { time timeout --kill-after=60 "$limit" bash -c "$command" >"$log" 2>&1; } 2>"$logs/time"; then
        outcome=passed
        rm "$log"
    else
        outcome="FAILED, see $log"
        failed=$((failed + 1))
    fi
    echo "run $run of $runs: SIGINT $sigint, ${#loops[@]} busy loops, $(cat "$logs/time"): $outcome"
done
echo "$((runs - failed)) of $runs passed"
[ "$failed" = 0 ]
