#!/bin/bash
# Makes the paper's panels on the simulated rig, and the figures and tables of docs/paper.md of them.
#
#     docs/paper/make.sh [LAKE]
#
# Surfaces that are in the lake are not measured again. $ECHOLAKE is the program, by default this checkout's.
set -euo pipefail
lake=$(realpath -m "${1:-$(dirname "$0")/paper-lake}")
cd "$(dirname "$0")"
program=${ECHOLAKE:-cargo run --profile quick --locked --quiet --manifest-path ../../Cargo.toml --}

echolake() { $program --lake "$lake" "$@"; }

# Surfaces whose names say what they are: references, a wall, and the paper's panels as `echolake panel --list` has them.
for surface in flat foam wood prd river_rock 0015_0 0031_0 0015_1 0012_1 0011_1 0013_1 0005_1; do
    compgen -G "$lake/runs/$surface/*.mcap" > /dev/null || compgen -G "$lake/inbox/*-$surface-*.mcap" > /dev/null ||
        # 3: pairs were given up, as a few of 0031_0, whose focus is louder than the direct sound.
        echolake acquire --surface "$surface" --rig rig.toml --ir-only || [ $? = 3 ]
done
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
