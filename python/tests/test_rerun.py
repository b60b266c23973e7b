"""A slice in rerun."""

from pathlib import Path

import pytest

pytest.importorskip("rerun")
pytest.importorskip("mcap_protobuf")

import echolake.rerun


def test_a_slice_becomes_a_recording(a_slice: Path, tmp_path: Path) -> None:
    saved = tmp_path / "five.rrd"
    echolake.rerun.view(a_slice, save=saved)
    assert saved.stat().st_size > 100_000, "the panel's mesh is in it"
    content = saved.read_bytes()
    for entity in (b"/panel", b"/microphone", b"/speaker", b"/ir", b"/environment/temperature_c", b"/sound/ir"):
        assert entity in content, entity
