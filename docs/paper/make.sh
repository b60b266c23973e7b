#!/bin/bash
# Makes the paper's panels on the simulated rig, and the figures and tables of docs/paper.md of them.
#
#     docs/paper/make.sh [LAKE]
#
# Surfaces that are in the lake are not measured again. $ECHOLAKE is the program, by default this checkout's.
set -euo pipefail
lake=$(realpath -m "${1:-$(dirname "$0")/paper-lake}")
cd "$(dirname "$0")"
program=${ECHOLAKE:-cargo run --release --locked --quiet --manifest-path ../../Cargo.toml --}

echolake() { $program --lake "$lake" "$@"; }

# measure SURFACE PANEL [KEY=VALUE ...]
measure() {
    local surface=$1 panel=$2 settings=()
    shift 2
    if compgen -G "$lake/runs/$surface/*.mcap" > /dev/null || compgen -G "$lake/inbox/*-$surface-*.mcap" > /dev/null; then
        return
    fi
    for setting in "$@"; do settings+=(--set "$setting"); done
    echolake acquire --surface "$surface" --panel "$panel" "${settings[@]}" --rig rig.toml --ir-only
}

# The large shape of panels whose names end in _1.
waves=(macrostructure=wavy_xy macro_depth_mm=120 macro_wavelength_mm=2500)
# Brick walls with level faces and raked joints.
bricks=("${waves[@]}" projection_mm=0 lean_mm=0 joint_shape=raked joint_depth_mm=10 brick_length_mm=215 brick_height_mm=65)

measure flat flat
measure foam foam
measure wood wood
measure prd prd
measure river_rock river_rock
measure 0015_0 macrostructure macrostructure=convex macro_depth_mm=150
measure 0031_0 macrostructure macrostructure=concave macro_depth_mm=150
measure 0015_1 macrostructure "${waves[@]}"
measure 0012_1 flemish_bond "${bricks[@]}" joint_width_mm=6
measure 0011_1 flemish_bond "${bricks[@]}" joint_width_mm=12
measure 0013_1 stretcher_bond "${bricks[@]}" joint_width_mm=15
measure 0005_1 polygonal_rubble "${waves[@]}" stone_size_mm=333 joint_width_mm=25 joint_depth_mm=40 roughness_mm=10
echolake ingest

# Runs each line of paper.md that is a command. Figures are written here; a table is put between its marks, the first
# after the command.
commands=$(grep '^    echolake figure ' ../paper.md)
while read -r _ words; do
    if [[ $words == figure\ table\ * ]]; then
        name=$(sed 's/.*-o \(.*\)\.md$/\1/' <<< "$words")
    fi
    # shellcheck disable=SC2086 # words of a command
    echolake $words < /dev/null
    [[ $words == figure\ table\ * ]] || continue
    awk -v name="$name" '
        $0 == "<!-- end " name " -->" { hidden = 0 }
        !hidden { print }
        $0 == "<!-- " name " -->" { hidden = 1; print ""; while ((getline line < (name ".md")) > 0) print line; print "" }
    ' ../paper.md > paper.md.new
    mv paper.md.new ../paper.md
    rm "$name.md"
done <<< "$commands"
