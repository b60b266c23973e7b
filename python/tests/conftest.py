"""A lake that the command makes and serves, and what it exports. ``ECHOLAKE`` names the command's binary; where it is
missing, what needs it is skipped."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

#: How long a command may take; a busy machine may need some of it.
LIMIT_SECS = 1800


@pytest.fixture(scope="session")
def echolake() -> str:
    found = os.environ.get("ECHOLAKE") or shutil.which("echolake")
    if not found:
        pytest.skip("no echolake binary; hint: ECHOLAKE=target/quick/echolake")
    return found


@pytest.fixture(scope="session")
def lake(echolake: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve surfaces; ``ECHOLAKE_TEST_LAKE`` names one that is there already."""
    if there := os.environ.get("ECHOLAKE_TEST_LAKE"):
        return Path(there)
    path = tmp_path_factory.mktemp("lake") / "lake"
    subprocess.run(
        [echolake, "--lake", str(path), "demo", "--no-serve", "--surfaces", "12", "--ir-only"],
        check=True,
        capture_output=True,
        timeout=LIMIT_SECS,
    )
    return path


@contextmanager
def serve_lake(echolake: str, lake: Path) -> Iterator[dict[str, str]]:
    """Where a lake is served, by scheme."""
    anywhere = "127.0.0.1:0"
    command = [
        echolake,
        "--lake",
        str(lake),
        "serve",
        "--listen",
        anywhere,
        "--flight-sql",
        anywhere,
        "--postgres",
        "off",
    ]
    server = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    # Reading its lines has no limit of its own: a server that says nothing is killed, and they end.
    silence = threading.Timer(LIMIT_SECS, server.kill)
    silence.start()
    try:
        assert server.stderr is not None
        found: dict[str, str] = {}
        for line in server.stderr:
            found |= {scheme: f"{scheme}://{host}" for scheme, host in re.findall(r"(http|grpc)://(\S+:\d+)", line)}
            if len(found) == 2:
                break
        else:
            pytest.fail("the server ended before it listened")
        silence.cancel()
        # What it says later must not fill the pipe.
        threading.Thread(target=server.stderr.read, daemon=True).start()
        yield found
    finally:
        silence.cancel()
        server.terminate()
        try:
            server.wait(timeout=60)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait(timeout=60)
            raise


@pytest.fixture(scope="session")
def addresses(echolake: str, lake: Path) -> Iterator[dict[str, str]]:
    """Where it is served, by scheme."""
    with serve_lake(echolake, lake) as found:
        yield found


@pytest.fixture(scope="session")
def served(addresses: dict[str, str]) -> str:
    """Its Flight SQL address."""
    return addresses["grpc"]


@pytest.fixture(scope="session")
def served_http(addresses: dict[str, str]) -> str:
    """Its HTTP address."""
    return addresses["http"]


def export(echolake: str, lake: Path, *arguments: str) -> None:
    command = [echolake, "--lake", str(lake), "export", *arguments]
    subprocess.run(command, check=True, capture_output=True, timeout=LIMIT_SECS)


@pytest.fixture(scope="session")
def training_set(echolake: str, lake: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Rows as measured."""
    path = tmp_path_factory.mktemp("ml") / "plain"
    export(echolake, lake, "ml", "-o", str(path))
    return path


@pytest.fixture(scope="session")
def turned_set(echolake: str, lake: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Rows under all symmetries, few columns."""
    path = tmp_path_factory.mktemp("ml") / "turned"
    export(echolake, lake, "ml", "-o", str(path), "--symmetries", "all", "--columns", "tnce_total")
    return path


@pytest.fixture(scope="session")
def a_slice(echolake: str, lake: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five measurements of one run."""
    path = tmp_path_factory.mktemp("slices") / "five.mcap"
    export(echolake, lake, "mcap", "--where", "surface_id = 'flat' and pair_id < 5", "-o", str(path))
    return path


@pytest.fixture(scope="session")
def small_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training set whose numbers tell the row: 13 surfaces of 40 to 52 pairs in four files, made without a lake."""
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = tmp_path_factory.mktemp("small") / "set"
    (path / "data").mkdir(parents=True)
    (path / "heightmaps").mkdir()
    for file in range(4):
        tables = [rows_of_surface(surface) for surface in range(file, 13, 4)]
        with pq.ParquetWriter(path / "data" / f"train-{file}.parquet", tables[0].schema) as writer:
            for table in tables:
                writer.write_table(table)
    names = [f"{surface:04}_0" for surface in range(13)]
    heights = pa.array([[surface, 1.0, 2.0, 3.0] for surface in range(13)], pa.list_(pa.float32(), 4))
    sizes = pa.array([100.0] * 13, pa.float32())
    maps = pa.table({"surface_id": names, "symmetry": ["identity"] * 13, "size_mm": sizes, "heights_mm": heights})
    pq.write_table(maps, path / "heightmaps" / "train.parquet")
    return path


def rows_of_surface(surface: int) -> Any:
    """Pair p of surface s: response [s, p, 0, 0], missing for pair 3, and samples 1000 s + p, missing for pair 5."""
    import pyarrow as pa

    count = 40 + surface
    pairs = range(count)
    position = pa.list_(pa.field("element", pa.float32(), nullable=False), 3)
    response = pa.list_(pa.field("element", pa.float32(), nullable=False), 4)
    columns = {
        "surface_id": pa.array([f"{surface:04}_0"] * count),
        "symmetry": pa.array(["identity"] * count),
        "pair_id": pa.array(pairs, pa.int32()),
        "microphone_mm": pa.array([[surface, p, 7.0] for p in pairs], position),
        "ir": pa.array([None if p == 3 else [surface, p, 0, 0] for p in pairs], response),
        "samples": pa.array([None if p == 5 else 1000 * surface + p for p in pairs], pa.int64()),
    }
    fields = [pa.field(name, values.type, nullable=name in ("ir", "samples")) for name, values in columns.items()]
    return pa.table(columns, schema=pa.schema(fields))
