"""The baseline learns a known reflection, continues a killed run to the same weights, and refuses small sets."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
pytest.importorskip("torch")

BASELINE = Path(__file__).parents[1] / "examples" / "baseline.py"
LIMIT_SECS = 600
CELLS = 32
PAIRS = 40


def lifted_plates(folder: Path, train: int, test: int = 4) -> Path:
    """A set of plates that are lifted by 0 to 40 mm: each reflects like the plane that it lies in."""
    dice = np.random.default_rng(1)
    microphones, speakers = dice.uniform([-80, -80, 120], [80, 80, 220], (2, PAIRS, 3))
    surfaces = []
    for split, count in (("train", train), ("test", test)):
        heights = dice.uniform(0, 40, count)
        names = [f"{split}{number:04}_0" for number in range(count)]
        maps = pa.FixedSizeListArray.from_arrays(np.repeat(heights, CELLS**2).astype(np.float32), CELLS**2)
        table = {"surface_id": names, "symmetry": ["identity"] * count}
        (folder / "heightmaps").mkdir(exist_ok=True)
        size = pa.array([585.0] * count, pa.float32())
        pq.write_table(pa.table(table | {"size_mm": size, "heights_mm": maps}), folder / f"heightmaps/{split}.parquet")
        rows = [rows_of_plate(name, height, microphones, speakers) for name, height in zip(names, heights, strict=True)]
        (folder / "data").mkdir(exist_ok=True)
        with pq.ParquetWriter(folder / f"data/{split}-0.parquet", rows[0].schema) as writer:
            for row_group in rows:
                writer.write_table(row_group)
        surfaces += [(name, name[:-2], split, "primitives", "simulated") for name in names]
    with open(folder / "surfaces.csv", "w", newline="") as file:
        csv.writer(file).writerows([("surface_id", "group", "split", "typology", "origin"), *surfaces])
    (folder / "croissant.json").write_text('{"version": "1.7.0"}')
    return folder


def rows_of_plate(name: str, height: float, microphones: Any, speakers: Any) -> Any:
    def length(lift: float) -> Any:
        """Of the path by the mirror image."""
        between = microphones - speakers
        between[:, 2] = microphones[:, 2] + speakers[:, 2] - 2 * lift
        return np.linalg.norm(between, axis=1)

    energy = pa.array((length(0) / length(height)) ** 2, pa.float32())
    columns = {
        "surface_id": [name] * PAIRS,
        "symmetry": ["identity"] * PAIRS,
        "pair_id": pa.array(range(PAIRS), pa.int32()),
        "microphone_mm": pa.FixedSizeListArray.from_arrays(microphones.astype(np.float32).ravel(), 3),
        "speaker_mm": pa.FixedSizeListArray.from_arrays(speakers.astype(np.float32).ravel(), 3),
        "tnce_band_2500": energy,
        "tnce_band_5000": energy,
    }
    return pa.table(columns)


def command(folder: Path, checkpoint: Path, *more: str) -> list[str]:
    steps = ["--steps", "100", "--batch-size", "32", "--json"]
    return [sys.executable, str(BASELINE), str(folder), "--checkpoint", str(checkpoint), *steps, *more]


def learn(folder: Path, checkpoint: Path, *more: str) -> subprocess.CompletedProcess[str]:
    environment = {"PYTHONPATH": str(BASELINE.parents[1] / "src")}
    arguments = command(folder, checkpoint, *more)
    return subprocess.run(arguments, capture_output=True, text=True, timeout=LIMIT_SECS, env=environment)


def test_it_learns_a_known_reflection_and_continues_after_a_kill(tmp_path: Path) -> None:
    folder = lifted_plates(tmp_path, 20)
    predictions = tmp_path / "predictions.parquet"
    done = learn(folder, tmp_path / "whole.pt", "--predict", str(predictions))
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    errors = {name: max(of_band) for name, of_band in report["rms_error_db"].items()}
    assert errors["network"] < 0.5 < errors["pair mean"] <= errors["mean"] * 1.1
    assert errors["network"] < errors["integral"]
    assert report["origins"] == ["simulated"]
    assert report["trained_on"]["lake_version"] == 7
    measured = pq.read_table(folder / "data/test-0.parquet", columns=["surface_id", "pair_id", "tnce_band_5000"])
    predicted = pq.read_table(predictions)
    for column in ("surface_id", "pair_id"):
        assert predicted.column(column).to_pylist() == measured.column(column).to_pylist()
    ratios = predicted.column("tnce_band_5000").to_numpy() / measured.column("tnce_band_5000").to_numpy()
    assert np.sqrt(np.mean((10 * np.log10(ratios)) ** 2)) == pytest.approx(
        report["rms_error_db"]["network"][1], rel=1e-3
    )

    checkpoint = tmp_path / "killed.pt"
    environment = {"PYTHONPATH": str(BASELINE.parents[1] / "src")}
    with subprocess.Popen(command(folder, checkpoint), stdout=subprocess.DEVNULL, env=environment) as process:
        while not checkpoint.exists() and process.poll() is None:
            time.sleep(0.01)
        process.kill()
    assert process.returncode == -9
    again = learn(folder, checkpoint)
    assert "continues" in again.stderr
    assert json.loads(again.stdout) == report
    other = learn(lifted_plates(tmp_path, 21), checkpoint)
    assert other.returncode == 1
    assert "expected" in other.stderr


def test_few_reliefs_are_refused_in_words(tmp_path: Path) -> None:
    done = learn(lifted_plates(tmp_path, 19), tmp_path / "baseline.pt")
    assert done.returncode == 2
    assert "split train has 19 reliefs, expected at least 20" in done.stderr
    assert not done.stdout
