"""How fast ``echolake.torch`` is beside other loaders of the same rows, and over HTTP on loopback beside local files.

    pip install lancedb datasets fsspec aiohttp rangehttpserver
    python bench/peers.py TRAINING_SET [--rounds 3] [--http http://localhost:8080/set]

Every loader gives all rows of split train once, as tensors of the same columns, in batches of the same size, in one
process without workers. They take turns, so that whatever else the machine does slows all of them, and medians are
compared. "first" is the time from nothing to the first batch; "resume" that from a state of the epoch's middle to the
batch after it ("!" where its rows are not those of the epoch that went on). A copy for LanceDB is made beside the set.
"mixed" rows come from all surfaces, others in pieces as long as a surface; datasets mixes those in its buffer, and
otherwise reads files in their order. pyarrow's bare read makes no tensors.
"""

from __future__ import annotations

import argparse
import os
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from echolake.torch import Measurements

COLUMNS = ["microphone_mm", "speaker_mm", "ir", "tnce_total"]
BATCH_ROWS, BUFFER_ROWS = 1024, 10_000
# Batches, and what tells the state after the batch that was taken last; how to start them, at a state or without one.
Started = tuple[Iterator[Any], Callable[[], Any] | None]
Start = Callable[[Any], Started]


def start_echolake(path: Path | str, clump: int | Literal["surface"], state: Any) -> Started:
    dataset = Measurements(path, columns=COLUMNS, batch_size=BATCH_ROWS, clump=clump, memory=4 << 30)
    if state is not None:
        dataset.load_state_dict(state)
    return iter(dataset), dataset.state_dict


def read_batches(files: list[Path]) -> Iterator[pa.RecordBatch]:
    for file in files:
        yield from pq.ParquetFile(file, memory_map=True).iter_batches(BATCH_ROWS, columns=COLUMNS)


def start_pyarrow(files: list[Path], whole: bool, state: Any) -> Started:
    return (pq.read_table(file, columns=COLUMNS) for file in files) if whole else read_batches(files), None


def start_datasets(files: list[Path], buffer: int, state: Any) -> Started:
    from datasets import load_dataset  # type: ignore[import,unused-ignore]

    names = [str(file) for file in files]
    rows = load_dataset("parquet", data_files=names, split="train", streaming=True, columns=COLUMNS)
    rows = (rows.shuffle(seed=0, buffer_size=buffer) if buffer else rows).with_format("torch")
    if state is not None:
        rows.load_state_dict(state)
    return rows.iter(BATCH_ROWS), rows.state_dict


def copy_lancedb(folder: Path, files: list[Path]) -> None:
    import lancedb  # type: ignore[import,unused-ignore]

    schema = pa.schema([pq.read_schema(files[0]).field(name) for name in COLUMNS])
    lancedb.connect(folder).create_table("rows", pa.RecordBatchReader.from_batches(schema, read_batches(files)))


# As few steps for each row as its loader allows: a row is a place in the arrays of what was read at once.
def point_rows(read: pa.RecordBatch) -> list[tuple[dict[str, Any], int]]:
    arrays = {}
    for name, column in zip(COLUMNS, read.columns, strict=True):
        is_list = pa.types.is_fixed_size_list(column.type)
        values = (column.flatten() if is_list else column).to_numpy(zero_copy_only=False)
        arrays[name] = values.reshape(len(column), -1) if is_list else values
    return [(arrays, place) for place in range(read.num_rows)]


def collate_rows(rows: Iterable[tuple[dict[str, Any], int]]) -> dict[str, torch.Tensor]:
    found: dict[int, tuple[dict[str, Any], list[int]]] = {}
    for arrays, place in rows:
        found.setdefault(id(arrays), (arrays, []))[1].append(place)
    pieces = {name: [arrays[name][places] for arrays, places in found.values()] for name in COLUMNS}
    return {name: torch.from_numpy(np.concatenate(values)) for name, values in pieces.items()}


# As many splits as echolake's order has lanes; the default of 64 rows to read at once is several times slower.
def start_lancedb(folder: Path, clump: int, state: Any) -> Started:
    import lancedb
    from lancedb import streaming

    table, read = lancedb.connect(folder).open_table("rows"), 4096 if clump > 1 else 1024
    dataset = streaming.StreamingDataset(
        table, num_splits=4, shuffle_clump_size=clump, read_batch_size=read, columns=COLUMNS, transform=point_rows
    )
    if state is not None:
        dataset.load_state_dict(state)
    loader = streaming.StreamingDataLoader(dataset, batch_size=BATCH_ROWS, collate_fn=collate_rows)
    return iter(loader), dataset.state_dict


@contextmanager
def serve_folder(path: Path) -> Iterator[str]:
    """Address of a folder that a process of its own serves; the loader's repeated reads wait for its start."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "RangeHTTPServer", "--bind", "127.0.0.1", str(port)]
    server = subprocess.Popen(command, cwd=path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        server.kill()
        server.wait()


def measure_epoch(start: Start, samples: int) -> tuple[float, float]:
    """Samples per second of an epoch, and seconds to its first batch."""
    began = time.perf_counter()
    batches, _ = start(None)
    rows = len(next(batches)["tnce_total"])
    first = time.perf_counter() - began
    rows += sum(len(batch["tnce_total"]) for batch in batches)
    # LanceDB leaves out what does not fill all splits.
    if not samples - 4 < rows <= samples:
        raise ValueError(f"{rows} rows of {samples}")
    return rows / (time.perf_counter() - began), first


def stop_midway(start: Start, samples: int) -> tuple[Any, list[float]] | None:
    """State of the epoch's middle, and the energies of the next batch, sorted."""
    batches, tell_state = start(None)
    if tell_state is None:
        return None
    for _ in range(samples // BATCH_ROWS // 2):
        next(batches)
    return tell_state(), sorted(next(batches)["tnce_total"].tolist())


def measure_resume(start: Start, state: Any, expected: list[float]) -> tuple[float, bool]:
    """Seconds from a state to its first batch, and whether it is the expected one."""
    began = time.perf_counter()
    batch = next(start(state)[0])
    return time.perf_counter() - began, sorted(batch["tnce_total"].tolist()) == expected


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path", type=Path, metavar="TRAINING_SET")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--http", help="address of the same set on another server, as nginx")
    given = parser.parse_args()
    os.environ["HF_HUB_OFFLINE"] = "1"
    source = Measurements(given.path).source
    samples, files = len(source), [given.path / name for name in source.files]
    if not (copy := given.path.absolute().with_name(f"{given.path.name}-lancedb")).exists():
        copy_lancedb(copy, files)
    with serve_folder(given.path) as served:
        compared: dict[str, Start] = {
            "echolake": partial(start_echolake, given.path, "surface"),
            "echolake, HTTP": partial(start_echolake, served, "surface"),
            "lancedb": partial(start_lancedb, copy, int(source.sizes.max())),
            "datasets": partial(start_datasets, files, 0),
            "pyarrow, whole files": partial(start_pyarrow, files, True),
            "pyarrow, 1024 rows at a time": partial(start_pyarrow, files, False),
            "echolake, mixed": partial(start_echolake, given.path, 1),
            "lancedb, mixed": partial(start_lancedb, copy, 1),
            "datasets, mixed": partial(start_datasets, files, BUFFER_ROWS),
        }
        if given.http:
            compared["echolake, HTTP, other server"] = partial(start_echolake, given.http, "surface")
        states = {name: stop_midway(start, samples) for name, start in compared.items()}
        epochs: dict[str, list[tuple[float, float]]] = {name: [] for name in compared}
        resumes: dict[str, list[tuple[float, bool]]] = {name: [] for name in compared}
        for _ in range(given.rounds):
            for name, start in compared.items():
                epochs[name].append(measure_epoch(start, samples))
                if state := states[name]:
                    resumes[name].append(measure_resume(start, *state))
    rates = {name: statistics.median(rate for rate, _ in measured) for name, measured in epochs.items()}
    print(f"{samples} samples, rounds: {given.rounds}, load: {os.getloadavg()[0]:.1f}")
    print(f"{'':30} {'samples/s':>9} {'(min to max)':>18} {'of echolake':>11} {'first':>8} {'resume':>8}")
    for name, measured in epochs.items():
        share = rates[name] / rates["echolake, mixed" if name.endswith("mixed") else "echolake"]
        mark = " " if all(same for _, same in resumes[name]) else "!"
        resume = f"{statistics.median(secs for secs, _ in resumes[name]):6.2f} s{mark}" if resumes[name] else "- "
        first, spread = statistics.median(x[1] for x in measured), f"({min(measured)[0]:.0f} to {max(measured)[0]:.0f})"
        print(f"{name:30} {rates[name]:9.0f} {spread:>18} {share:11.2f} {first:6.2f} s {resume:>9}")


if __name__ == "__main__":
    main()
