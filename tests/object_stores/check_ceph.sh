#!/usr/bin/env bash
# Lakes on Ceph's S3 gateway, through a proxy that loses, cuts off and refuses answers: check_ceph.sh ECHOLAKE [SEED]
#
# Two ingests at once, one clock five minutes ahead and the other five behind, take in the same runs, by copying them and
# from the bucket's inbox; then files are merged and deleted. Afterwards all tables must hold what a lake in a folder
# holds. Installs Ceph and faketime from Debian's packages. ECHOLAKE is the program; SEED (1) decides over the faults.
set -euo pipefail
echolake=$(realpath "${1:?the program}")
seed=${2:-1}
# shellcheck source=tests/object_stores/faulty_gateway.sh
. "$(dirname "$0")/faulty_gateway.sh" "$seed" 'put,_delta_log,0.15,reply-lost' 'put,_delta_log,0.10,done-500' \
    'put,_delta_log,0.10,409' 'get,prefix=,0.08,half-answer' 'get,parquet,0.05,half-answer' \
    'put,parquet,0.05,half-request' 'get,,0.05,503' '*,,0.02,reset'

cp "$here/../fixtures/small_rig.toml" rig.toml
mkdir copies
for surface in flat foam wood prd brick wavy; do
    cp "$("$echolake" acquire --surface $surface --rig rig.toml --ir-only 2>/dev/null)" copies/
done
"$echolake" ingest 2>/dev/null
runs=(copies/*.mcap)
export ECHOLAKE_LAKE=s3://$S3_BUCKET/check-$seed-$$
"$echolake" ingest "${runs[0]}"
for run in "${runs[@]:3}"; do
    curl -sf -T "$run" --aws-sigv4 aws:amz:us-east-1:s3 -H 'x-amz-content-sha256: UNSIGNED-PAYLOAD' \
        --user "$AWS_ACCESS_KEY_ID:$AWS_SECRET_ACCESS_KEY" "$direct/${ECHOLAKE_LAKE#s3://}/inbox/$(basename "$run")"
done
faketime -f +5m "$echolake" ingest "${runs[@]:1}" &
ahead=$!
faketime -f -5m "$echolake" ingest &
behind=$!
wait $ahead
wait $behind
"$echolake" ingest
tables() {
    for table in runs surfaces measurements nce tnce tnce_d4 surface_stats environment events heightmaps points pairs; do
        echo "$table"
        "$echolake" --lake "$1" sql --format csv "select * from $table" 2>/dev/null | sort
    done
}
tables lake >expected
compare() {
    tables "$ECHOLAKE_LAKE" >seen
    cmp expected seen || { echo "FAILED: other rows $1; seed $seed" >&2; exit 1; }
}
compare "after ingest"
"$echolake" optimize
"$echolake" vacuum --keep-hours 1
compare "after upkeep"
curl -sf "http://127.0.0.1:$listen/__proxy/stats"
echo
echo "as in a folder: $(wc -l <expected) lines of all tables, seed $seed"
