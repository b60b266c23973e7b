#!/usr/bin/env bash
# Tries the wheel of this machine as a user would: check_wheel.sh FOLDER VERSION
#
# It is installed in a fresh environment, with no index and no other program on the path, and measures, ingests and asks.
set -euo pipefail
[ "$#" -eq 2 ] || { sed -n '2,4s/^# //p' "$0"; exit 2; }
folder=$(realpath "$1") version=$2
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
began=$SECONDS
python3 -m venv env
alone() { env -i PATH="$place/env/bin" HOME="$place" TMPDIR="${TMPDIR:-/tmp}" "$@"; }
alone pip install --quiet --disable-pip-version-check --no-index --find-links "$folder" echolake
installed=$((SECONDS - began))
printed=$(alone echolake --version)
[ "$printed" = "echolake $version" ] || { echo "error: \`echolake --version\` printed $printed" >&2; exit 1; }
alone python -c "import echolake; assert echolake.__version__ == '$version', echolake.__version__"
alone echolake doctor --self
alone echolake demo --no-serve
rows=$(alone echolake sql --format csv 'select count(*) from measurements' | tail -1)
[ "$rows" = 17706 ] || { echo "error: the demo's lake has $rows measurements, expected 6 surfaces of 2951" >&2; exit 1; }
echo "installed in $installed s, with the demo $((SECONDS - began)) s"
