"""Annotations and predictions from Python, as queries and pages of the server have them."""

from __future__ import annotations

import json
import subprocess
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from echolake.contributions import ContributionClient, ContributionError


@pytest.fixture(scope="module")
def run(served_http: str) -> dict[str, Any]:
    with urllib.request.urlopen(f"{served_http}/api/v1/runs?limit=1") as answer:
        found: dict[str, Any] = json.load(answer)["items"][0]
    return found


def rows(echolake: str, lake: Path, query: str) -> list[dict[str, Any]]:
    command = [echolake, "--lake", str(lake), "sql", "--json", query]
    found: list[dict[str, Any]] = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    return found


def test_many_annotations_are_stored_once(echolake: str, lake: Path, served_http: str, run: dict[str, Any]) -> None:
    client = ContributionClient(served_http, author="ann")
    many = [
        {"annotation_id": f"many-{i}", "run_id": run["run_id"], "kind": "label", "value": "odd", "pair_ids": [i]}
        for i in range(1200)
    ]
    assert client.annotate_all(many) == [one["annotation_id"] for one in many]
    assert client.annotate_all(many) == [one["annotation_id"] for one in many]
    name = client.annotate(run["run_id"], "note", comment="seen", microphones=[0])
    query = "select author, count(*) as n, count(distinct annotation_id) as ids from annotations group by author"
    assert rows(echolake, lake, query) == [{"author": "ann", "n": 1201, "ids": 1201}]
    region = rows(echolake, lake, f"select pair_ids from annotations where annotation_id = '{name}'")[0]["pair_ids"]
    expected = rows(echolake, lake, "select pair_id from pairs where microphone = 0 order by pair_id")
    assert region == [row["pair_id"] for row in expected]
    with pytest.raises(ContributionError, match="expected `accepted` or `rejected`") as refused:
        client.annotate(run["run_id"], "verdict", "bad")
    assert (refused.value.status, refused.value.code) == (400, "request_invalid")


def test_predictions_have_their_errors(echolake: str, lake: Path, served_http: str, run: dict[str, Any]) -> None:
    pa = pytest.importorskip("pyarrow")
    surface = run["surface_id"]
    query = f"select pair_id, tnce_band_5000 as e from tnce where surface_id = '{surface}' order by pair_id"
    measured = rows(echolake, lake, query)
    table = pa.table(
        {
            "surface_id": [surface] * len(measured),
            "pair_id": [row["pair_id"] for row in measured],
            "tnce_band_5000": [row["e"] * 10 ** (0.2 if i % 2 else -0.2) for i, row in enumerate(measured)],
        }
    )
    client = ContributionClient(served_http)
    version = client.predict("offset", "1", table)
    assert version == client.predict("offset", "1", table)
    with urllib.request.urlopen(f"{served_http}/api/v1/surfaces/{surface}/predictions") as answer:
        shown = json.load(answer)
    assert [one["model"] for one in shown] == ["offset"]
    assert shown[0]["rms_band_db"][1] == pytest.approx(2.0, abs=1e-6)
    with pytest.raises(ContributionError, match="is there already"):
        client.predict("offset", "1", table.slice(0, 5))
