#!/usr/bin/env bash
# Releases a version: release.sh VERSION
#
# Cuts CHANGELOG.md, sets the version everywhere, commits that, makes all packages in dist/ and tags the commit. Nothing
# is pushed or published. Branch and work tree change only after the packages are made and tried: a release that failed
# or was interrupted leaves them as they were, and the next try reuses what is compiled.
set -euo pipefail
[ "$#" -eq 1 ] || { sed -n '2,6s/^# //p' "$0"; exit 2; }
cd "$(dirname "$0")/.."
version=$1
fail() { printf 'error: %s\n' "$*" >&2; exit 1; }
[ -z "$(git status --porcelain)" ] || fail "the work tree has changes; hint: commit or stash them"
git symbolic-ref --quiet HEAD >/dev/null || fail "no branch is checked out"
git rev-parse --quiet --verify "refs/tags/v$version" >/dev/null && fail "the tag v$version exists"

# The commit of an earlier try from the same place is taken again: it is part of the compiled program.
reference=refs/echolake/release-$version
if [ "$(git rev-parse --quiet --verify "$reference^" || true)" != "$(git rev-parse HEAD)" ]; then
    folder=$(mktemp -d)
    trap 'git worktree remove --force "$folder"' EXIT
    git worktree add --quiet --detach "$folder"
    python3 packaging/set_version.py "$version" "$folder"
    (cd "$folder" && cargo metadata --locked --format-version 1 >/dev/null)
    git -C "$folder" commit --quiet --all --message "Release $version"
    git update-ref "$reference" "$(git -C "$folder" rev-parse HEAD)"
    git worktree remove --force "$folder"
    trap - EXIT
fi
ECHOLAKE_ADVISORIES=${ECHOLAKE_ADVISORIES:-required} packaging/package.sh "$reference"
git merge --quiet --ff-only "$reference" || fail "the branch has changed meanwhile; hint: run this again"
git tag --annotate "v$version" --message "echolake $version"
git update-ref -d "$reference"
printf '\necholake %s is committed and tagged as v%s; nothing is pushed.\n' "$version" "$version"
