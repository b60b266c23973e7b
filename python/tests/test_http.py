"""The lake over HTTP: its Parquet files read by loaders of training sets, its runs and slices by readers of MCAP."""

from __future__ import annotations

import base64
import json
import re
import subprocess
import sys
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

import pytest


def get(url: str) -> bytes:
    with urllib.request.urlopen(url) as answer:
        body: bytes = answer.read()
        return body


def files(served_http: str, table: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(get(f"{served_http}/api/v1/files?table={table}"))["files"]
    assert found
    assert all(file["table"] == table and file["superseded_rows"] == 0 for file in found)
    return found


@pytest.fixture(scope="module")
def urls(served_http: str) -> list[str]:
    """Of table tnce."""
    return [file["url"] for file in files(served_http, "tnce")]


@pytest.fixture(scope="module")
def rows(served_http: str) -> int:
    return sum(file["rows"] for file in files(served_http, "tnce"))


def test_hugging_face_streams_and_loads(urls: list[str], rows: int, tmp_path: Path) -> None:
    datasets = pytest.importorskip("datasets")
    streamed = datasets.load_dataset("parquet", data_files=urls, split="train", streaming=True)
    seen = {(row["surface_id"], row["pair_id"]) for row in streamed.select_columns(["surface_id", "pair_id"])}
    assert len(seen) == rows
    loaded = datasets.load_dataset("parquet", data_files=urls[:3], split="train", cache_dir=str(tmp_path))
    assert loaded.num_rows == 3 * 2951


def test_polars_reads_what_it_needs(urls: list[str], rows: int) -> None:
    polars = pytest.importorskip("polars")
    table = polars.scan_parquet(urls).select("surface_id", "tnce_total").collect()
    assert table.height == rows


def test_duckdb_reads_what_it_needs(urls: list[str], rows: int) -> None:
    duckdb = pytest.importorskip("duckdb")
    httpfs = pytest.importorskip("duckdb_extension_httpfs")
    lake = duckdb.connect(config={"allow_unsigned_extensions": True})
    for extension in Path(httpfs.__file__).parent.rglob("*.duckdb_extension*"):
        lake.execute(f"load '{extension}'")
    found = lake.execute("select count(*), avg(tnce_total) > 0 from read_parquet(?)", [urls]).fetchone()
    assert found == (rows, True)


def test_pyarrow_reads_what_it_needs(urls: list[str], rows: int) -> None:
    pytest.importorskip("aiohttp")
    fsspec = pytest.importorskip("fsspec")
    dataset = pytest.importorskip("pyarrow.dataset")
    found = dataset.dataset(urls, format="parquet", filesystem=fsspec.filesystem("http"))
    assert found.to_table(columns=["surface_id", "tnce_total"]).num_rows == rows


def test_a_file_that_is_not_there_is_said(served_http: str) -> None:
    with pytest.raises(urllib.error.HTTPError, match="404"):
        get(f"{served_http}/api/v1/tables/tnce/none.parquet")


def a_run(served_http: str) -> str:
    run: str = json.loads(get(f"{served_http}/api/v1/runs?limit=1"))["items"][0]["run_id"]
    return run


def slice_url(served_http: str, predicate: str, **more: str) -> str:
    return f"{served_http}/api/v1/slices.mcap?{urllib.parse.urlencode({'where': predicate} | more)}"


def test_slices_pass_the_doctor(served_http: str, tmp_path: Path) -> None:
    pytest.importorskip("pymcap_cli")
    for number, (predicate, more) in enumerate(
        [
            ("surface_id = 'flat' and pair_id < 30", {}),
            ("pair_id = 7", {"layout": "in-time"}),
            ("surface_id = 'flat'", {"topics": "/microphone/pose,/speaker/pose"}),
        ]
    ):
        path = tmp_path / f"{number}.mcap"
        path.write_bytes(get(slice_url(served_http, predicate, **more)))
        command = [str(Path(sys.executable).with_name("pymcap-cli")), "doctor", str(path)]
        checked = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
        assert checked.returncode == 0, checked.stdout + checked.stderr


def test_the_manifest_is_what_its_data_hold(served_http: str, tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader")
    manifest = json.loads(get(f"{served_http}/api/v1/foxglove/manifest?where=pair_id%3C3&run={a_run(served_http)}"))
    (source,) = manifest["sources"]
    assert set(source) == {"url", "id", "topics", "schemas", "startTime", "endTime"}
    assert all(
        re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{9}Z", source[time]) for time in ("startTime", "endTime")
    )
    schemas = {schema["id"]: schema for schema in source["schemas"]}
    told = {topic["name"]: (topic["messageEncoding"], schemas[topic["schemaId"]]) for topic in source["topics"]}
    path = tmp_path / "data.mcap"
    path.write_bytes(get(served_http + source["url"]))
    last = 0
    with path.open("rb") as file:
        # It does not seek: messages come as they stand.
        for schema, channel, message in reader.NonSeekingReader(file).iter_messages(log_time_order=False):
            assert message.log_time >= last
            last = message.log_time
            encoding, expected = told[channel.topic]
            assert (channel.message_encoding, schema.name, schema.encoding) == (
                encoding,
                expected["name"],
                expected["encoding"],
            )
            assert base64.b64decode(expected["data"], validate=True) == schema.data
    assert last > 0
