#!/usr/bin/env bash
# Makes all packages of a commit: package.sh [COMMIT] (HEAD if none is named)
#
# dist/ has them afterwards: a source archive that builds without Node and has the manual, wheels, Debian packages, an inventory (CycloneDX)
# with licences, and SHA256SUMS. Needs git, Rust, Node with npm, Python 3.10 or newer with venv, and dpkg-deb.
# $ECHOLAKE_TARGETS names the targets, by default all below whose standard library is installed (`rustup target add`). The packages
# of a target for newer processors, TARGET/PROCESSOR, are in dist/PROCESSOR/.
# What is compiled stays in $CARGO_TARGET_DIR, so a second try goes on where the first one stopped.
set -euo pipefail
cd "$(dirname "$0")/.."
commit=$(git rev-parse --verify "${1:-HEAD}^{commit}")
version=$(git show "$commit:Cargo.toml" | sed -n '/^\[workspace.package\]/,/^$/s/^version = "\(.*\)"/\1/p')
export CARGO_TARGET_DIR="${CARGO_TARGET_DIR:-$PWD/target}"
# The commit's day: where this variable changes, cc compiles C anew, and cargo all that is above it.
SOURCE_DATE_EPOCH=$(($(git show -s --format=%ct "$commit") / 86400 * 86400))
ECHOLAKE_COMMIT=${commit:0:12}
export SOURCE_DATE_EPOCH ECHOLAKE_COMMIT
unset ECHOLAKE_LAKE
work=$CARGO_TARGET_DIR/package
source=$work/echolake-$version
out=$work/out
TARGETS=(x86_64-unknown-linux-gnu x86_64-unknown-linux-gnu/x86-64-v3 x86_64-unknown-linux-musl aarch64-unknown-linux-gnu)
WHEEL_MB=60

say() { printf '\n== %s\n' "$*" >&2; }
fail() { printf 'error: %s\n' "$*" >&2; exit 1; }

make_source() {
    say "sources and pages of echolake $version ($ECHOLAKE_COMMIT)"
    rm -rf "$source" "$work/web" "$work/programs" "$out"
    mkdir -p "$work" "$out"
    git archive --prefix="echolake-$version/" "$commit" | tar -x -C "$work"
    cp -r "$source/web" "$work/web"
    (cd "$work/web" && npm ci --no-audit --no-fund && npm run build) >"$work/npm.log" 2>&1 || { cat "$work/npm.log" >&2; exit 1; }
    cp -r "$work/web/dist" "$source/web/prebuilt"
    "$source/docs/build.sh" "$source/docs/prebuilt"
    # The time of the commit, so that cargo takes nothing for changed in a second try.
    find "$source/web/prebuilt" "$source/docs/prebuilt" -exec touch -h -d "@$SOURCE_DATE_EPOCH" {} +
    tar -c -C "$work" --sort=name --owner=0 --group=0 --numeric-owner --mtime="@$SOURCE_DATE_EPOCH" "echolake-$version" |
        gzip -9n >"$out/echolake-$version.tar.gz"
}

find_targets() {
    local installed wanted
    read -ra wanted <<<"${ECHOLAKE_TARGETS:-${TARGETS[*]}}"
    installed=$(cd "$source" && rustc --print sysroot)/lib/rustlib
    targets=()
    for target in "${wanted[@]}"; do
        if [ -d "$installed/${target%/*}/lib" ]; then
            targets+=("$target")
        else
            left_out+=("$target: no standard library; hint: rustup target add ${target%/*}")
        fi
    done
    for target in "${TARGETS[@]}"; do
        [[ " ${wanted[*]} " == *" $target "* ]] || left_out+=("$target: not in \$ECHOLAKE_TARGETS")
    done
    [ "${#targets[@]}" -gt 0 ] || fail "no target can be built: ${left_out[*]}"
}

install_tools() {
    say "tools"
    [ -x "$work/tools/bin/pip" ] || python3 -m venv "$work/tools"
    "$work/tools/bin/pip" install --quiet --disable-pip-version-check -r "$source/packaging/requirements.txt"
    # maturin finds zig by the first Python on the path.
    export PATH="$work/tools/bin:$PATH"
}

# The folder under dist/ for a target's packages.
folder_of() {
    case $1 in
        */*) echo "$out/${1#*/}" ;;
        *) echo "$out" ;;
    esac
}

program_of() {
    echo "$work/programs/${1/\//-}/echolake"
}

make_wheel() {
    local target=$1 tag=manylinux_2_28 flags=
    [[ $target == *-musl ]] && tag=musllinux_1_2
    [[ $target == */* ]] && flags="-C target-cpu=${target#*/}"
    say "wheel for $target ($tag)"
    (cd "$source/python" && RUSTFLAGS=$flags maturin build --zig --target "${target%/*}" --compatibility "$tag" --auditwheel check \
        --sbom-include pages.cdx.json --out "$(folder_of "$target")" >&2)
}

# The program as it is in the wheel: all packages ship the same bytes.
unpack_program() {
    local wheel=$1 folder=$2
    rm -rf "$folder" && mkdir -p "$folder"
    python3 -c 'import sys, zipfile; a = zipfile.ZipFile(sys.argv[1])
open(sys.argv[2], "wb").write(a.read(next(n for n in a.namelist() if n.endswith(".data/scripts/echolake"))))' \
        "$wheel" "$folder/echolake"
    chmod 755 "$folder/echolake"
}

# On a processor that is too old, the program says so. QEMU has one, if it is installed.
check_older_processor() {
    local said
    command -v qemu-x86_64 >/dev/null || { left_out+=("an older processor: not tried; hint: apt install qemu-user"); return 0; }
    if said=$(qemu-x86_64 -cpu Nehalem "$1" --version 2>&1) || [[ $said != *"built for x86-64-v3"* ]]; then
        fail "on a processor without AVX2, the program did not say what it needs: $said"
    fi
}

check_size() {
    local file=$1 most_mb=$2 bytes
    bytes=$(stat -c %s "$file")
    printf '%s: %s MB\n' "$file" "$((bytes / 1000000))" >&2
    [ "$bytes" -le "$((most_mb * 1000000))" ] || fail "$file is larger than $most_mb MB"
}

# Man pages and completions are the same for all machines; a program that runs here writes them.
make_documents() {
    local program=$1 wheel=$2
    rm -rf "$work/documents" && mkdir -p "$work/documents/completions"
    "$program" man "$work/documents/man"
    for shell in bash zsh fish; do
        "$program" completions "$shell" >"$work/documents/completions/echolake.$shell"
    done
    python3 "$source/packaging/inventory.py" merge "$wheel" "$work/documents/echolake.cdx.json"
    cp "$work/documents/echolake.cdx.json" "$out/echolake-$version.cdx.json"
    cp "$source/python/THIRD-PARTY-LICENCES.txt" "$out/echolake-$version.licences.txt"
}

left_out=()
make_source
find_targets
install_tools
python3 "$source/packaging/inventory.py" licences "$source" $(printf '%s\n' "${targets[@]%/*}" | uniq)
say "advisories"
# Only a release requires them.
ECHOLAKE_ADVISORIES=${ECHOLAKE_ADVISORIES:-unchecked} \
    "$source/packaging/advisories.sh" "$source" "$out/echolake-$version.advisories.txt"
runnable=()
for target in "${targets[@]}"; do
    rm -f "$work/fresh" && touch "$work/fresh"
    make_wheel "$target"
    wheel=$(find "$out" -name '*.whl' -newer "$work/fresh")
    program=$(program_of "$target")
    unpack_program "$wheel" "$(dirname "$program")"
    check_size "$wheel" "$WHEEL_MB"
    if [[ $target == */x86-64-v3 ]]; then
        check_older_processor "$program"
    fi
    if "$program" --version >/dev/null 2>&1; then
        [ "${#runnable[@]}" -gt 0 ] || make_documents "$program" "$wheel"
        runnable+=("$target")
    fi
done
[ "${#runnable[@]}" -gt 0 ] || fail "none of the programs runs here, so there are no man pages; hint: build for this machine, too"
for target in "${runnable[@]}"; do
    say "the end-to-end tests of the program for $target"
    (cd "$source" && ECHOLAKE_SHIPPED=$(program_of "$target") cargo test --profile quick --test main --locked -- end_to_end >&2)
done
for target in "${targets[@]}"; do
    case $target in
        x86_64-*-gnu | x86_64-*-gnu/*) architecture=amd64 ;;
        aarch64-*-gnu) architecture=arm64 ;;
        *) continue ;;
    esac
    say "Debian package for $target"
    "$source/packaging/deb.sh" "$(program_of "$target")" "$architecture" "$version" "$work/documents" "$source" \
        "$(folder_of "$target")" >&2
done
(cd "$out" && find . -type f -printf '%P\n' | sort | xargs sha256sum -- >"$work/SHA256SUMS" && mv "$work/SHA256SUMS" .)
for target in "${runnable[@]}"; do
    [[ $target == *-musl ]] || "$source/packaging/check_wheel.sh" "$(folder_of "$target")" "$version"
done
rm -rf dist && cp -r "$out" dist
say "dist/, to be published by hand"
(cd dist && ls -l)
for line in "${left_out[@]}"; do
    printf 'left out: %s\n' "$line"
done
