"""A query of a served lake gives the rows that an export of the same surfaces has."""

from __future__ import annotations

import pickle
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

pytest.importorskip("pyarrow.parquet")

from conftest import serve_lake

from echolake.contributions import ContributionClient
from echolake.lake_query import QueriedSet
from echolake.training import LakeQuery, MeasurementBatches, MeasurementRows

COLUMNS = ["pair_id", "microphone_mm", "speaker_mm", "temperature_c", "ir", "tnce_total", "nce_10000"]
PREDICATE = "typology <> 'river_rock' -- and a comment"


@pytest.fixture(scope="module")
def exported(echolake: str, lake: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("queried") / "set"
    columns = ["--columns", "temperature_c,ir,tnce_total,nce_10000"]
    command = [echolake, "--lake", str(lake), "export", "ml", "-o", str(path), "--where", PREDICATE, *columns]
    subprocess.run(command, check=True, capture_output=True)
    return path


@pytest.fixture(scope="module")
def own_http(echolake: str, lake: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A copy of the lake: what is annotated here is seen by no other test."""
    copy = tmp_path_factory.mktemp("own") / "lake"
    shutil.copytree(lake, copy)
    with serve_lake(echolake, copy) as addresses:
        yield addresses["http"]


def read_surfaces(source: MeasurementRows) -> dict[str, dict[str, Any]]:
    ends = np.cumsum(source.sizes)
    found = {}
    for end, size in zip(ends, source.sizes, strict=True):
        batch = source.read_rows(np.arange(end - size, end))
        found[batch["surface_ids"][0]] = batch
    return found


@pytest.mark.parametrize("split", ["train", "validation", "test"])
def test_a_query_has_the_rows_of_an_export(
    served_http: str, exported: Path, split: Literal["train", "validation", "test"]
) -> None:
    queried = MeasurementRows(LakeQuery(served_http, where=PREDICATE), split, COLUMNS, heights=32, spectra=["ir"])
    stored = MeasurementRows(exported, split, COLUMNS, heights=32, spectra=["ir"])
    assert np.array_equal(queried.frequencies_hz("ir"), stored.frequencies_hz("ir"))
    queried_rows = read_surfaces(queried)
    stored_rows = read_surfaces(stored)
    assert queried_rows.keys() == stored_rows.keys() != set()
    for surface, rows in stored_rows.items():
        for name in (*COLUMNS, "heights", "size_mm", "ir_spectrum"):
            assert queried_rows[surface][name].dtype == rows[name].dtype
            assert np.array_equal(queried_rows[surface][name], rows[name]), (surface, name)


# B6
def test_queries_have_positions_whatever_columns_are_named(served_http: str) -> None:
    row = MeasurementRows(LakeQuery(served_http), "train", ["tnce_total"])[0]
    assert row["microphone_mm"].shape == row["speaker_mm"].shape == (3,)


def test_a_query_stays_at_its_version_and_resumes(own_http: str) -> None:
    before = MeasurementBatches(LakeQuery(own_http), columns=["pair_id", "tnce_total"])
    surface = before.source.files[0]
    query = LakeQuery(own_http)
    asked = QueriedSet(query.pin_version())._ask(f"select run_id from runs where surface_id = '{surface}'")
    ContributionClient(own_http, author="pytest").annotate(
        asked.column("run_id")[0].as_py(), "verdict", "rejected", pair_ids=[7], comment="test"
    )
    try:
        after = MeasurementBatches(query, columns=["pair_id", "tnce_total"])
        assert (before.rows() - after.rows(), before.source.path == after.source.path) == (1, False)
        digests = [batch["tnce_total"].tobytes() for batch in before]
        assert len(digests) == len(before)
        states = iter(before)
        for _ in range(3):
            next(states)
        resumed = pickle.loads(pickle.dumps(MeasurementBatches(before.source.path, columns=["pair_id", "tnce_total"])))
        resumed.load_state_dict(before.state_dict())
        assert [batch["tnce_total"].tobytes() for batch in resumed] == digests[3:]
        with pytest.raises(ValueError, match="the state is of a set with set"):
            after.load_state_dict(before.state_dict())
    finally:
        ContributionClient(own_http, author="pytest").annotate(
            asked.column("run_id")[0].as_py(), "verdict", "accepted", pair_ids=[7], comment="test"
        )


@pytest.mark.parametrize(
    ("query", "settings", "told"),
    [
        ({"where": "nope = 1"}, {}, "no column `nope`"),
        ({"where": "true)) or ((true"}, {}, "answered 400"),
        ({"as_of": 'x" y'}, {}, "answered 400"),
        ({"as_of": 4000}, {}, "4000"),
        ({"where": "false"}, {}, "0 surfaces of 0 panels"),
        ({}, {"columns": ["nope"]}, "no columns .*nope.*tnce_total"),
        ({}, {"normalise": True}, "hint: echolake export ml"),
    ],
)
def test_what_is_wrong_is_told(served_http: str, query: dict[str, Any], settings: dict[str, Any], told: str) -> None:
    with pytest.raises((LookupError, ValueError), match=told):
        MeasurementRows(LakeQuery(served_http, **query), **settings)


def test_a_server_that_is_not_there_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        url = f"http://127.0.0.1:{free.getsockname()[1]}"
    with pytest.raises(ConnectionError, match=f"{url} does not answer: .*refused"):
        MeasurementRows(LakeQuery(url))
