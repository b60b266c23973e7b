#!/usr/bin/env bash
# Uploads to Ceph's S3 gateway, and ingests that share them, through a proxy that loses and refuses answers:
# check_uploads.sh ECHOLAKE [SEED] [ROUNDS]
#
# 1. A run of the paper's grid with long sweeps (about 3 GB, some minutes; LARGE_RUN names one that is there) is uploaded, and
#    the upload killed ten times on the way. What the store holds then must have the run's SHA-256.
# 2. ROUNDS (1) times: four ingests take in 40 runs of one inbox while they are killed at random. All tables must hold what a
#    lake in a folder holds.
#
# Installs Ceph from Debian's packages. SEED (1) decides over faults and kills.
set -euo pipefail
echolake=$(realpath "${1:?the program}")
seed=${2:-1}
rounds=${3:-1}
here=$(cd "$(dirname "$0")" && pwd)
port=${CEPH_RGW_PORT:-7480}
work=$(mktemp -d)
proxy=
finish() {
    [ -z "$proxy" ] || kill "$proxy" 2>/dev/null || true
    rm -rf "$work"
}
trap finish EXIT
fail() {
    echo "FAILED: $*; seed $seed" >&2
    exit 1
}
export CEPH_RGW_BYTES=${CEPH_RGW_BYTES:-$((8 << 30))}
"$here/ceph_rgw.sh" start >"$work/store.env"
set -a
# shellcheck disable=SC1091
. "$work/store.env"
set +a
direct=$AWS_ENDPOINT_URL
listen=$((port + 10))
python3 "$here/s3_fault_proxy.py" --listen $listen --upstream "127.0.0.1:$port" --seed "$seed" \
    --fault 'put,partNumber,0.03,reply-lost' --fault 'put,partNumber,0.03,half-request' --fault 'post,uploadId,0.5,done-500' \
    --fault 'put,_claims,0.10,reply-lost' --fault 'put,_delta_log,0.10,reply-lost' --fault 'put,_delta_log,0.10,409' \
    --fault 'get,prefix=,0.05,half-answer' --fault 'get,,0.03,503' --fault '*,,0.01,reset' >"$work/proxy.log" &
proxy=$!
export AWS_ENDPOINT_URL=http://127.0.0.1:$listen
cd "$work"
RANDOM=$seed

upload_large_run() {
    local run=${LARGE_RUN:-} lines parts cut upload path
    if [ -z "$run" ]; then
        printf '[sweep]\nduration_secs = 1.8\n' >long_rig.toml
        run=$("$echolake" --lake large acquire --surface flat --rig long_rig.toml 2>/dev/null)
    fi
    parts=$((($(stat -c %s "$run") + 8388607) / 8388608))
    export ECHOLAKE_LAKE=s3://$S3_BUCKET/upload-$seed-$$
    for cut in $(seq 10); do
        "$echolake" upload "$run" 2>/dev/null &
        upload=$!
        lines=$((cut * parts / 12))
        until [ -e "$run.upload" ] && [ "$(wc -l <"$run.upload")" -gt $lines ]; do
            kill -0 $upload 2>/dev/null || fail "the upload ended before its cut $cut"
            sleep 0.05
        done
        kill -KILL $upload
        wait $upload 2>/dev/null || true
    done
    path=$("$echolake" upload "$run")
    curl -sf --aws-sigv4 aws:amz:us-east-1:s3 -H 'x-amz-content-sha256: UNSIGNED-PAYLOAD' \
        --user "$AWS_ACCESS_KEY_ID:$AWS_SECRET_ACCESS_KEY" "$direct/${ECHOLAKE_LAKE#s3://}/$path" | sha256sum >there
    [ "$(cut -c -64 there)" = "$(sha256sum "$run" | cut -c -64)" ] || fail "the store holds another file"
    echo "uploaded $(stat -c %s "$run") bytes in $parts parts, cut off ten times: same SHA-256"
}

tables() {
    local table
    for table in runs surfaces measurements nce tnce tnce_d4 surface_stats environment events heightmaps points pairs; do
        echo "$table"
        "$echolake" --lake "$1" sql --format csv "select * from $table" 2>/dev/null | sort
    done
}

# An ingest that is begun again when it was killed.
ingest() {
    local code=0
    while :; do
        "$echolake" ingest 2>>"ingest.$1" &
        echo $! >"pid.$1"
        wait $! 2>/dev/null && code=0 || code=$?
        [ $code = 137 ] || return $code
    done
}

share_inbox() {
    local round=$1 number kill
    export ECHOLAKE_LAKE=s3://$S3_BUCKET/share-$seed-$round-$$
    "$echolake" upload copies >/dev/null 2>&1
    rm -f ingest.* pid.*
    local ingests=()
    for number in 1 2 3 4; do
        ingest $number &
        ingests+=($!)
    done
    for kill in 1 2 3; do
        sleep "$((RANDOM % 3)).$((RANDOM % 10))"
        kill -KILL "$(cat "pid.$((RANDOM % 4 + 1))")" 2>/dev/null || true
    done
    for number in "${ingests[@]}"; do
        wait "$number" || fail "an ingest ended with $? in round $round: $(tail -n 3 ingest.*)"
    done
    tables "$ECHOLAKE_LAKE" >seen
    cmp expected seen || fail "other rows in round $round"
    # A run whose ingest was killed is taken by another one.
    local taken runs
    taken=$(cat ingest.* | grep -c ' measurements$' || true)
    runs=$(cat ingest.* | grep ' measurements$' | sort -u | wc -l)
    echo "round $round: as in a folder; $taken runs were read and reported, $runs of them different"
}

upload_large_run
unset ECHOLAKE_LAKE
cp "$here/../fixtures/small_rig.toml" rig.toml
mkdir copies
for number in $(seq 0 39); do
    surfaces=(flat foam wood prd brick wavy)
    surface=${surfaces[$((number % 6))]}
    [ "$number" -lt 6 ] || surface=${surface}_$number
    cp "$("$echolake" acquire --surface "$surface" --rig rig.toml --ir-only --seed "$number" 2>/dev/null)" copies/
done
"$echolake" ingest 2>/dev/null
tables lake >expected
for round in $(seq "$rounds"); do
    share_inbox "$round"
done
curl -sf "http://127.0.0.1:$listen/__proxy/stats"
echo
