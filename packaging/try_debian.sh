#!/usr/bin/env bash
# Tries dist/ on a fresh Debian 12, by the commands of the README: try_debian.sh [FOLDER]
#
# Needs root and debootstrap. The system is made in FOLDER, a temporary one if none is named, and removed again. First
# the wheel is installed and the demo runs; then the Debian package is installed, used, and purged.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=${1:-$(mktemp -d)}
trap 'rm -rf --one-file-system "$folder"' EXIT
version=$(basename dist/echolake-*.tar.gz .tar.gz)
version=${version#echolake-}
# It is the root of other users, too.
chmod 755 "$folder"
debootstrap --variant=minbase --include=python3-venv bookworm "$folder" >/dev/null
cp -r dist "$folder/root/dist"
# The indented lines below the first heading that installs something.
sed -n '/^## Install without a build/,/^## /s/^    //p' README.md >"$folder/root/readme.sh"
cat >"$folder/root/try.sh" <<'TRY'
set -euo pipefail
cd /root
version=$1
for tool in cc gcc cargo rustc node npm; do
    ! command -v "$tool" || { echo "error: $tool is here"; exit 1; }
done
fetch() { python3 -c 'import sys, urllib.request; print(urllib.request.urlopen(sys.argv[1]).read().decode())' "$1"; }
# The server is the oldest of its processes.
server() { pidof echolake | tr ' ' '\n' | sort -n | head -1; }
LIMIT=90

echo "== the README's commands"
cat readme.sh
began=$SECONDS
bash -e readme.sh >demo.out 2>demo.log &
until grep -q 'http://' demo.log; do
    kill -0 $! 2>/dev/null || { cat demo.out demo.log; echo "error: the commands ended"; exit 1; }
    sleep 0.2
done
echo "the catalogue is served after $((SECONDS - began)) s"
[ "$((SECONDS - began))" -le "$LIMIT" ] || { echo "error: more than $LIMIT s"; exit 1; }
tail -3 demo.log
fetch "$(grep -o 'http://[^ ]*' demo.log | tail -1)" | grep -q '/assets/index-' || { echo "error: no pages"; exit 1; }
kill -INT "$(server)"
wait
ls -l env/bin/echolake
env/bin/echolake doctor --self

echo "== the Debian package"
apt-get update -qq
apt-get install -y -qq ./dist/echolake_*_"$(dpkg --print-architecture)".deb >/dev/null 2>&1
[ "$(echolake --version)" = "echolake $version" ]
runuser -u echolake -- echolake --lake /var/lib/echolake demo --no-serve >/dev/null 2>demo.log || { cat demo.log; exit 1; }
runuser -u echolake -- echolake --lake /var/lib/echolake doctor | head -2
(. /etc/default/echolake && cd / && ECHOLAKE_LAKE=$ECHOLAKE_LAKE exec runuser -u echolake -- echolake serve $ECHOLAKE_SERVE_OPTIONS) 2>serve.log &
until grep -q 'postgresql://' serve.log; do sleep 0.2; done
fetch http://127.0.0.1:8080/health
kill -TERM "$(server)"
wait
runuser -u nobody -- echolake --lake /var/lib/echolake doctor --self | grep "lake's files"
before=$(cd /var/lib/echolake && find . -type f -print0 | sort -z | xargs -0 sha256sum | sha256sum)
apt-get purge -y -qq echolake >/dev/null 2>&1
! command -v echolake
[ "$(cd /var/lib/echolake && find . -type f -print0 | sort -z | xargs -0 sha256sum | sha256sum)" = "$before" ]
env/bin/echolake --lake /var/lib/echolake doctor | head -2
echo "the package is purged, the lake is whole"
TRY
# Mounts and processes of its own, which end with it.
# shellcheck disable=SC2016
unshare --mount --pid --fork --kill-child bash -euc '
    mount -t proc proc "$1/proc"
    for device in null zero random urandom full tty; do touch "$1/dev/$device" && mount --bind "/dev/$device" "$1/dev/$device"; done
    mount -t tmpfs tmpfs "$1/dev/shm" 2>/dev/null || true
    cp /etc/resolv.conf "$1/etc/resolv.conf"
    exec chroot "$1" env -i HOME=/root LANG=C.UTF-8 PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin \
        bash /root/try.sh "$2"' try "$folder" "$version"
