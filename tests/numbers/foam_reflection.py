"""Compares levels without Foam's reflection with the truth: `foam_reflection.py --program ECHOLAKE`.

The simulated rig measures panels and their references on the paper's grid, once with Foam that reflects nothing, which
is the truth, and once with foam of each thickness; seeds are the same, so that noise and places are. Printed are the
errors of `p90_mean_db` and of `unbiased_p90_mean_db`, and the greatest of the latter over `unbiased_p90_mean_u_db`.

    --folder FOLDER  keeps the lakes there, and uses those that are there already
    --surfaces S...  the panels

Needs what `independent_chain.py` needs. Exits with 1 if an error is over 1.96 times its standard uncertainty.
"""

import argparse
import pathlib
import sys
import tempfile

from independent_chain import MeasuredLake, print_table, rig_text

SECS = 0.05
COVERAGE_FACTOR = 1.96
# Settings of the simulation by the names of the foam.
FOAMS = {
    "none": "foam_reflection = false",
    "25 mm": "foam_thickness_mm = 25.0",
    "50 mm": "foam_thickness_mm = 50.0",
    "75 mm": "foam_thickness_mm = 75.0",
}
BANDS = ("2500", "5000", "10000", "20000", "40000", "total")
COLUMNS = ("p90_mean_db", "unbiased_p90_mean_db", "unbiased_p90_mean_u_db")


def measured_lake(program: str, folder: pathlib.Path, foam: str, surfaces: list[str]) -> MeasuredLake:
    """The panels and their references."""
    text = f"{rig_text('', SECS, 'tapered')}[simulation]\n{FOAMS[foam]}\n"
    acquire = [
        ["acquire", "--rig", "RIG", "--ir-only", "--seed", str(seed + 1), "--surface", surface]
        for seed, surface in enumerate(["flat", "foam", *surfaces])
    ]
    return MeasuredLake.make(program, folder / foam.replace(" ", "-"), text, [*acquire, ["ingest"]])


def compare_levels(options: argparse.Namespace, folder: pathlib.Path) -> int:
    truth = measured_lake(options.program, folder, "none", options.surfaces)
    rows, right = [], True
    for foam in FOAMS:
        lake = measured_lake(options.program, folder, foam, options.surfaces)
        for surface in ["flat", *options.surfaces]:
            here, there = (each.surface_rows(surface, COLUMNS) for each in (lake, truth))
            true = [there[band]["p90_mean_db"] for band in BANDS]
            plain, unbiased, u = ([here[band][column] for band in BANDS] for column in COLUMNS)
            errors = [value - level for value, level in zip(unbiased, true, strict=True)]
            held = [abs(error) <= COVERAGE_FACTOR * each + 1e-6 for error, each in zip(errors, u, strict=True)]
            right &= all(held)
            for of, values in (
                ("Foam subtracted", [value - level for value, level in zip(plain, true, strict=True)]),
                ("without Foam's reflection", errors),
            ):
                rows.append([foam, surface, of, *[f"{value:+.3f}" for value in values]])
            rows.append([foam, surface, "its standard uncertainty", *[f"{value:.3f}" for value in u]])
    print_table("Errors of levels, dB", ["foam", "surface", "level", *BANDS], rows)
    return 0 if right else 1


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", required=True, type=lambda path: str(pathlib.Path(path).absolute()))
    parser.add_argument("--folder", type=pathlib.Path)
    parser.add_argument("--surfaces", nargs="+", default=["river_rock", "0015_0", "0005_1"])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        return compare_levels(options, options.folder or pathlib.Path(place))


if __name__ == "__main__":
    sys.exit(main())
