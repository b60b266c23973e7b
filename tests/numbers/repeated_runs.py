"""Counts how often uncertainties hold the truth: `repeated_runs.py --program ECHOLAKE`.

The simulated rig measures the same panels and their references again and again, each run with other noise, in air of
18 to 25 C and 30 to 60 % of humidity, and with other places of the arms, and once more in the reference air without any
of these: the truth. Printed is the share of levels that are no farther from the truth than 1.96 times their standard
uncertainty, which should be 95 %.

    --folder FOLDER  keeps the lakes there, and uses those that are there already
    --runs N         repeats, 20 by default
    --surfaces S...  the panels
    --resonance      a tweeter with a resonance at 9 kHz, of quality factor 8

Needs what `independent_chain.py` needs. Exits with 1 if less than 93 % or more than 97 % of the levels of a band are
held.
"""

import argparse
import pathlib
import sys
import tempfile
from collections.abc import Sequence

import numpy as np
from independent_chain import QUIET, SMALL_GRID, MeasuredLake, Signal, print_table, rig_text

SECS = 0.05
CELSIUS = (18.0, 25.0)
HUMIDITY_PCT = (30.0, 60.0)
REFERENCE_AIR = "temperature_c = 20.0\nhumidity_pct = 50.0\n"
COVERAGE_FACTOR = 1.96
SHARES = (0.93, 0.97)


def measured_lake(
    program: str, folder: pathlib.Path, surfaces: Sequence[str], run: int | None, tweeter: str
) -> MeasuredLake:
    """The panels and their references with seeds of their own; without a run, those without chance."""
    text = rig_text(SMALL_GRID, SECS, "tapered")
    every = ["flat", "foam", *surfaces]
    seeds = range(len(every) * (run or 0), len(every) * ((run or 0) + 1))
    name = "truth" if run is None else f"run-{run}"
    rigs = [folder / f"{name}-{surface}.toml" for surface in every]
    folder.mkdir(parents=True, exist_ok=True)
    for rig, seed in zip(rigs, seeds, strict=True):
        rig.write_text(text + (QUIET + REFERENCE_AIR if run is None else drawn_air(seed)) + tweeter)
    acquire = [
        ["acquire", "--rig", str(rig), "--seed", str(seed + 1), "--surface", surface]
        for rig, seed, surface in zip(rigs, seeds, every, strict=True)
    ]
    return MeasuredLake.make(program, folder / name, text, [*acquire, ["ingest"]])


def drawn_air(seed: int) -> str:
    """Air of a day, in a rig file."""
    chance = np.random.default_rng(seed)
    celsius, humidity_pct = (chance.uniform(*limits) for limits in (CELSIUS, HUMIDITY_PCT))
    return f"[simulation]\ntemperature_c = {celsius:.2f}\nhumidity_pct = {humidity_pct:.1f}\n"


def level_columns(lake: MeasuredLake) -> dict[str, str]:
    """The columns of levels, each with that of its uncertainty."""
    names = lake.settings.band_names()
    columns = [f"tnce_{name}" for name in names] + ["tnce_total"] + [f"tnce_band_{name}" for name in names]
    return {column: f"{column}_u_db" for column in columns}


def deviations(lake: MeasuredLake, truth: MeasuredLake, surface: str, column: str, u_column: str) -> Signal:
    """Errors of the levels over their standard uncertainties, by pair."""
    here, there = (each.rows("tnce", surface, [column, u_column]) for each in (lake, truth))
    rows = [(row[column], there[pair][column], row[u_column]) for pair, row in sorted(here.items()) if pair in there]
    energies, true, u_db = np.array(rows, float).T
    return np.array(10 * np.log10(energies / true) / u_db)


def mean_deviations(lake: MeasuredLake, truth: MeasuredLake, surface: str) -> dict[str, float]:
    """The same of the means up to P90, by band."""
    here, there = (each.surface_rows(surface, ["p90_mean_db", "p90_mean_u_db"]) for each in (lake, truth))
    return {
        band: (row["p90_mean_db"] - there[band]["p90_mean_db"]) / row["p90_mean_u_db"] for band, row in here.items()
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", required=True, type=lambda path: str(pathlib.Path(path).absolute()))
    parser.add_argument("--folder", type=pathlib.Path)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--surfaces", nargs="+", default=["river_rock", "stretcher_bond", "macrostructure"])
    parser.add_argument("--resonance", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        return count_held(options, options.folder or pathlib.Path(place))


def count_held(options: argparse.Namespace, folder: pathlib.Path) -> int:
    tweeter = "resonance_hz = 9000.0\nresonance_q = 8.0\n" if options.resonance else ""
    truth = measured_lake(options.program, folder, options.surfaces, None, tweeter)
    found: dict[tuple[str, str], list[float]] = {}
    for run in range(options.runs):
        lake = measured_lake(options.program, folder, options.surfaces, run, tweeter)
        for surface in options.surfaces:
            for column, u_column in level_columns(lake).items():
                found.setdefault(("a measurement", column), []).extend(
                    deviations(lake, truth, surface, column, u_column)
                )
            for band, deviation in mean_deviations(lake, truth, surface).items():
                found.setdefault(("mean up to P90 of a surface", band), []).append(deviation)
        print(f"run {run + 1} of {options.runs}", file=sys.stderr, flush=True)
    for of in ("a measurement", "mean up to P90 of a surface"):
        found[of, "all"] = [value for (name, _), values in found.items() if name == of for value in values]
    rows, right = [], True
    for (of, level), values in found.items():
        each = np.abs(np.array(values))
        share = (each <= COVERAGE_FACTOR).mean()
        right &= bool(SHARES[0] <= share <= SHARES[1])
        rows.append([of, level, str(len(each)), f"{100 * share:.1f}", f"{np.sqrt((each**2).mean()):.2f}"])
    header = ["of", "level", "levels", "within 1.96 u, %", "error over u, rms"]
    print_table("Levels that their uncertainty holds", header, rows)
    return 0 if right else 1


if __name__ == "__main__":
    sys.exit(main())
