"""How fast ``echolake.torch`` is, beside pyarrow's bare read of the same columns of the same files.

    python bench/loader.py TRAINING_SET [--workers 1] [--rounds 5] [--memory 1024]

Takes turns, so that whatever else the machine does slows all of them, and compares medians.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from torch.utils.data import DataLoader

from echolake.torch import Measurements


def tables(files: list[Path], columns: list[str]) -> Iterator[int]:
    """Row counts of whole files, read at pyarrow's defaults."""
    for file in files:
        yield pq.read_table(file, columns=columns).num_rows


def row_groups(files: list[Path], columns: list[str]) -> Iterator[int]:
    """Row counts of row groups, as much at a time as the loader reads."""
    for file in files:
        opened = pq.ParquetFile(file, memory_map=True)
        for group in range(opened.num_row_groups):
            yield opened.read_row_group(group, columns=columns).num_rows


def streamed(files: list[Path], columns: list[str]) -> Iterator[int]:
    """Row counts of pieces, none of them kept: pyarrow at its fastest."""
    for file in files:
        for rows in pq.ParquetFile(file, memory_map=True).iter_batches(1024, columns=columns):
            yield rows.num_rows


def loaded(path: Path, workers: int, **settings: Any) -> Iterator[int]:
    """Row counts of the loader's batches."""
    for batch in DataLoader(Measurements(path, **settings), batch_size=None, num_workers=workers):
        yield len(batch["surface"])


def rate(run: Callable[[], Iterator[int]]) -> float:
    """Samples per second of an epoch, the start of workers included."""
    start = time.perf_counter()
    rows = sum(run())
    return rows / (time.perf_counter() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path", type=Path, metavar="TRAINING_SET")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--memory", type=int, default=1024, help="MiB of decoded surfaces that a process keeps for small clumps"
    )
    given = parser.parse_args()
    dataset = Measurements(given.path)
    columns = [*dataset.columns, "surface_id", "symmetry"]
    files = [given.path / name for name in dataset.source.files]
    bare = {
        "pyarrow, whole files": partial(tables, files, columns),
        "pyarrow, row groups": partial(row_groups, files, columns),
        "pyarrow, 1024 rows at a time": partial(streamed, files, columns),
    }
    load = partial(loaded, given.path, given.workers)
    mixed = partial(load, memory=given.memory << 20)
    loaders = {
        "echolake.torch": load,
        "echolake.torch, turned, heights": partial(load, symmetries="random", heights=True),
        "echolake.torch, clump 256": partial(mixed, clump=256),
        "echolake.torch, clump 1": partial(mixed, clump=1),
    }
    rates: dict[str, list[float]] = {name: [] for name in [*bare, *loaders]}
    for run in bare.values():
        rate(run)
    for _ in range(given.rounds):
        for name, run in (bare | loaders).items():
            rates[name].append(rate(run))
    middle = {name: statistics.median(values) for name, values in rates.items()}
    samples = dataset.rows()
    print(f"{samples} samples, workers: {given.workers}, rounds: {given.rounds}, load: {os.getloadavg()[0]:.1f}")
    for name, values in rates.items():
        shares = "".join(f"  {middle[name] / middle[other]:5.0%}" for other in bare) if name in loaders else ""
        print(f"{name:32} {middle[name]:9.0f} samples/s ({min(values):.0f} to {max(values):.0f}){shares}")


if __name__ == "__main__":
    main()
