#!/usr/bin/env bash
# Builds the manual, a site with a search box, from docs/: build.sh FOLDER
#
# FOLDER is emptied first. The generator, zensical, is installed from PyPI. A program that is built with
# $ECHOLAKE_MANUAL=FOLDER (a full path) shows the site under /docs. A link to a page that is missing is an error.
set -euo pipefail
[ "$#" -eq 1 ] || { sed -n '2,5s/^# //p' "$0"; exit 2; }
folder=$(realpath -m "$1")
cd "$(dirname "$0")/.."
tools="$HOME/.cache/echolake/zensical-0.0.73"
[ -x "$tools/bin/zensical" ] || {
    python3 -m venv --clear "$tools"
    "$tools/bin/pip" install --quiet --disable-pip-version-check zensical==0.0.73
}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cp -r docs "$work/docs"
rm -rf "$work/docs/prebuilt" "$work"/docs/*.sh "$work/docs/paper/make.sh"
cp docs/zensical.toml "$work/zensical.toml"
(cd "$work" && NO_COLOR=1 "$tools/bin/zensical" build --clean --strict >&2)
rm -rf "$folder"
mkdir -p "$(dirname "$folder")"
mv "$work/site" "$folder"
