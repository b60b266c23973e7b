#!/usr/bin/env bash
# Uploads a large run to Ceph's S3 gateway, through a proxy that loses and refuses answers: check_uploads.sh ECHOLAKE [SEED]
#
# A run of the paper's grid with long sweeps (about 3 GB, some minutes; LARGE_RUN names one that is there) is uploaded, and
# the upload killed ten times on the way. What the store holds then must have the run's SHA-256.
#
# Installs Ceph from Debian's packages. SEED (1) decides over the faults.
set -euo pipefail
echolake=$(realpath "${1:?the program}")
seed=${2:-1}
fail() {
    echo "FAILED: $*; seed $seed" >&2
    exit 1
}
export CEPH_RGW_BYTES=${CEPH_RGW_BYTES:-$((8 << 30))}
# shellcheck source=tests/object_stores/faulty_gateway.sh
. "$(dirname "$0")/faulty_gateway.sh" "$seed" 'put,partNumber,0.03,reply-lost' 'put,partNumber,0.03,half-request' \
    'post,uploadId,0.5,done-500' 'put,_claims,0.10,reply-lost' 'put,_delta_log,0.10,reply-lost' \
    'put,_delta_log,0.10,409' 'get,prefix=,0.05,half-answer' 'get,,0.03,503' '*,,0.01,reset'

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

upload_large_run
curl -sf "http://127.0.0.1:$listen/__proxy/stats"
echo
