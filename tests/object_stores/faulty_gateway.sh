# shellcheck shell=bash
# Sourced by checks: `. faulty_gateway.sh SEED FAULT...` starts Ceph's S3 gateway and a proxy with these faults before it.
#
# $AWS_ENDPOINT_URL and the credentials are then those of the proxy, $direct and $listen the gateway's address and the
# proxy's port, and the working directory a temporary one, which is removed at the end as the proxy is.
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
port=${CEPH_RGW_PORT:-7480}
work=$(mktemp -d)
proxy=
finish() {
    [ -z "$proxy" ] || kill "$proxy" 2>/dev/null || true
    rm -rf "$work"
}
trap finish EXIT
"$here/ceph_rgw.sh" start >"$work/store.env"
set -a
# shellcheck disable=SC1091
. "$work/store.env"
set +a
# shellcheck disable=SC2034
direct=$AWS_ENDPOINT_URL
listen=$((port + 10))
seed=$1
shift
faults=()
for fault; do
    faults+=(--fault "$fault")
done
python3 "$here/s3_fault_proxy.py" --listen $listen --upstream "127.0.0.1:$port" --seed "$seed" "${faults[@]}" \
    >"$work/proxy.log" &
proxy=$!
export AWS_ENDPOINT_URL=http://127.0.0.1:$listen
cd "$work"
