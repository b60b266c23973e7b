#!/bin/bash
# Makes the conformance inputs of the MCAP project, by its own generator: `make_mcap_inputs.sh FOLDER [REPOSITORY]`.
#
# REPOSITORY is whatever git clones, by default GitHub's; the generator runs in a temporary folder with packages of npm.
# Needs git, node and npm. `compare_mcap.py FOLDER` compares what is made.
set -euo pipefail
folder=$(realpath -m "${1:?usage: make_mcap_inputs.sh FOLDER [REPOSITORY]}")
repository=${2:-https://github.com/foxglove/mcap}

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
# The files that the repository stores by git-lfs are the inputs themselves, which are made here.
GIT_LFS_SKIP_SMUDGE=1 git clone --quiet --bare --depth 1 "$repository" "$work/git"
git -C "$work/git" archive HEAD tests/conformance/scripts/generate-inputs.ts tests/conformance/util \
    tests/conformance/variants | tar -x -C "$work"
cd "$work/tests/conformance"
echo '{"type": "module"}' > package.json
npm install --silent --no-save --no-package-lock @mcap/core @foxglove/crc commander@11 tsx@4
npx --no-install tsx scripts/generate-inputs.ts --data-dir "$folder"
