"""The baseline learns from many reliefs only."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

BASELINE = Path(__file__).parents[1] / "examples" / "baseline.py"
CELLS = 16


def training_set(folder: Path, reliefs: int) -> Path:
    """A set of random reliefs beside a reference."""
    rng = np.random.default_rng(1)
    names = ["flat", *(f"{i:04}_0" for i in range(reliefs))]
    (folder / "data").mkdir()
    (folder / "heightmaps").mkdir()
    for split in ("train", "test"):
        heights = {
            "surface_id": names,
            "symmetry": ["identity"] * len(names),
            "size_mm": [585.0] * len(names),
            "heights_mm": [rng.random(CELLS**2, np.float32) for _ in names],
        }
        pq.write_table(pa.table(heights), folder / "heightmaps" / f"{split}.parquet")
        with pq.ParquetWriter(folder / "data" / f"{split}-0.parquet", rows("x", rng).schema) as writer:
            for name in names:
                writer.write_table(rows(name, rng))
    return folder


def rows(surface: str, rng: np.random.Generator) -> pa.Table:
    count = 30
    columns = {
        "surface_id": [surface] * count,
        "typology": ["reference" if surface == "flat" else "river_rock"] * count,
        "symmetry": ["identity"] * count,
        "pair_id": pa.array(range(count), pa.int32()),
        "microphone_mm": list((rng.random((count, 3)) * 100 + [0, 0, 100]).astype(np.float32)),
        "speaker_mm": list((rng.random((count, 3)) * 100 + [0, 0, 100]).astype(np.float32)),
        "tnce_2500": pa.array(rng.random(count), pa.float32()),
    }
    return pa.table(columns)


def learn(folder: Path, *more: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, str(BASELINE), str(folder), "--epochs", "0", *more]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


@pytest.mark.parametrize("reliefs", [0, 1, 19])
def test_few_reliefs_are_refused_in_words(tmp_path: Path, reliefs: int) -> None:
    done = learn(training_set(tmp_path, reliefs))
    assert done.returncode == 2
    assert f"split train has {reliefs} reliefs besides references, expected at least 20" in done.stderr
    assert "Traceback" not in done.stderr
    assert not done.stdout


def test_few_reliefs_are_learned_from_on_request_and_columns_are_aligned(tmp_path: Path) -> None:
    done = learn(training_set(tmp_path, 3), "--few")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert {line.split()[0] for line in lines[1:]} >= {"pair", "ridge"}
    assert len({len(line) for line in lines if "e+" not in line}) == 1, done.stdout
