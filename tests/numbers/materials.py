"""Compares view `materials` with what is known of simulated panels: `materials.py --program ECHOLAKE`.

Absorption: the simulated rig measures Flat, Foam and a board (`wood`) again and again, each run with other noise and
other air. Flat's print has a reflection factor R(f) that is known (`acquisition/panel/src/material.rs`); the truth is
1 - |R|^2 with the weights of the board's spectrum in the octave of IEC 61260-1, by SciPy's Butterworth filter. Printed
are the greatest error and the share of values that are no farther from the truth than 1.96 times their standard
uncertainty.

Scattering: panels on the paper's grid, without noise. Printed are both methods with their uncertainties, and what is
computed of the relief's far field. `tests/simulation/compare_bem.py --far-field` compares them with boundary elements.

    --folder FOLDER  keeps the lakes there, and uses those that are there already
    --runs N         repeats, 20 by default
    --surfaces S...  the panels

Needs what `independent_chain.py` needs. Exits with 1 if less than 93 % of the absorptions are held.
"""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile
from typing import Any

import numpy as np
from independent_chain import QUIET, SMALL_GRID, MeasuredLake, print_table, rig_text
from repeated_runs import COVERAGE_FACTOR, SHARES, drawn_air
from scipy import signal

SECS = 0.05
BANDS = np.array([2500.0, 5000.0, 10000.0, 20000.0, 40000.0])
# Octaves that a sweep from 2 to 40 kHz has all of, by their exact midband frequencies at 1:10.
OCTAVES = 10 * 1000 * 10 ** (0.3 * np.array([-1, 0, 1]))
RATE_HZ = 96e3


def rows(program: str, lake: MeasuredLake, query: str) -> list[dict[str, Any]]:
    run = [program, "--lake", str(lake.folder), "sql", query, "--format", "json"]
    found: list[dict[str, Any]] = json.loads(subprocess.run(run, check=True, capture_output=True, text=True).stdout)
    return found


def repeated_lake(program: str, folder: pathlib.Path, run: int) -> MeasuredLake:
    """Flat, Foam and a board in air of their own."""
    folder.mkdir(parents=True, exist_ok=True)
    acquire = []
    for number, surface in enumerate(("flat", "foam", "wood")):
        rig = folder / f"run-{run}-{surface}.toml"
        rig.write_text(rig_text(SMALL_GRID, SECS, "tapered") + drawn_air(3 * run + number))
        acquire.append(
            ["acquire", "--rig", str(rig), "--ir-only", "--seed", str(3 * run + number + 1), "--surface", surface]
        )
    return MeasuredLake.make(
        program, folder / f"run-{run}", rig_text(SMALL_GRID, SECS, "tapered"), [*acquire, ["ingest"]]
    )


def true_absorption(program: str, lake: MeasuredLake) -> np.ndarray:
    """1 - |R|^2 of the print, by the board's energy in each bin and the octaves' filters."""
    found = rows(program, lake, "select reflected_ir from nce where surface_id = 'wood'")
    spectra = np.abs(np.fft.rfft([row["reflected_ir"] for row in found])) ** 2
    hz = np.fft.rfftfreq(len(found[0]["reflected_ir"]), 1 / RATE_HZ)
    reflected = (1 - 0.048) * (1 + (hz / 31_200) ** 2) / (1 + (hz / 20_000) ** 2)
    half = 10**0.15
    filters = [signal.butter(6, [hz_0 / half, hz_0 * half], "bandpass", fs=RATE_HZ, output="sos") for hz_0 in OCTAVES]
    shares = np.array([np.abs(signal.sosfreqz(sos, hz, fs=RATE_HZ)[1]) ** 2 for sos in filters])
    weights = shares * spectra.sum(0)
    absorption: np.ndarray = 1 - (weights * reflected).sum(1) / weights.sum(1)
    return absorption


def check_absorption(options: argparse.Namespace, folder: pathlib.Path) -> bool:
    errors, deviations = [], []
    for run in range(options.runs):
        lake = repeated_lake(options.program, folder, run)
        truth = true_absorption(options.program, lake)
        of_flat = "surface_id = 'flat' and absorption is not null"
        query = f"select absorption, absorption_u from materials where {of_flat} order by band_hz"
        found = rows(options.program, lake, query)
        value, u = (np.array([row[name] for row in found]) for name in ("absorption", "absorption_u"))
        errors.append(value - truth)
        deviations.append((value - truth) / u)
        print(f"run {run + 1} of {options.runs}", file=sys.stderr, flush=True)
    held = np.abs(deviations) <= COVERAGE_FACTOR
    cells = [
        [f"{hz:.0f}", f"{t:.3f}", f"{m:+.4f}", f"{s:.4f}", f"{100 * h:.0f}"]
        for hz, t, m, s, h in zip(OCTAVES, truth, np.mean(errors, 0), np.abs(errors).max(0), held.mean(0), strict=True)
    ]
    cells.append(["all", "", "", "", f"{100 * held.mean():.1f}"])
    print_table("Absorption of Flat", ["octave", "true", "mean error", "greatest", "within 1.96 u, %"], cells)
    return bool(held.mean() >= SHARES[0])


def print_scattering(options: argparse.Namespace, folder: pathlib.Path) -> None:
    text = rig_text("", SECS, "tapered") + QUIET
    acquire = [
        ["acquire", "--rig", "RIG", "--ir-only", "--seed", str(seed + 1), "--surface", surface]
        for seed, surface in enumerate(["flat", "foam", "wood", *options.surfaces])
    ]
    lake = MeasuredLake.make(options.program, folder / "paper", text, [*acquire, ["ingest"]])
    cells = []
    for surface in ["wood", *options.surfaces]:
        query = f"select * from materials where surface_id = '{surface}' order by band_hz"
        found = rows(options.program, lake, query)
        for label, name in (
            ("absorption", "absorption"),
            ("scattering", "scattering"),
            ("specular loss", "specular_loss"),
            ("far field, computed", "far_scattering"),
            ("normalised diffusion, computed", "diffusion_normalised"),
        ):
            values = [
                "null" if row[name] is None
                else f"{row[name]:.2f}" + (f" ± {row[name + '_u']:.2f}" if row.get(name + "_u") is not None else "")
                for row in found
            ]  # fmt: skip
            cells.append([surface, label, *values])
        cells.extend(
            [surface, kind, *[row[kind] or "" for row in found]] for kind in ("absorption_reason", "scattering_reason")
        )
    print_table("Materials", ["surface", "", *[f"{hz:.0f} Hz" for hz in BANDS]], cells)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", required=True, type=lambda path: str(pathlib.Path(path).absolute()))
    parser.add_argument("--folder", type=pathlib.Path)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--surfaces", nargs="+", default=["river_rock", "macrostructure", "prd"])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = options.folder or pathlib.Path(place)
        right = check_absorption(options, folder)
        print_scattering(options, folder)
    return 0 if right else 1


if __name__ == "__main__":
    sys.exit(main())
