"""A slice in rerun."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rerun")
pytest.importorskip("mcap_protobuf")

import rerun as rr

import echolake.rerun

LIMIT_SECS = 120


def contents(saved: Path) -> dict[str, tuple[int, set[str]]]:
    """Rows and components of each entity, as rerun's own command prints them."""
    command = [sys.executable, "-m", "rerun", "rrd", "print", str(saved)]
    printed = subprocess.run(command, check=True, capture_output=True, text=True, timeout=LIMIT_SECS).stdout
    found: dict[str, tuple[int, set[str]]] = {}
    for rows, entity, components in re.findall(r"with (\d+) rows .* - (/\S*) - data columns: \[(.*)\]", printed):
        before = found.get(entity, (0, set()))
        found[entity] = (before[0] + int(rows), before[1] | set(components.split()))
    return found


def test_a_slice_becomes_a_recording(a_slice: Path, tmp_path: Path) -> None:
    saved = tmp_path / "five.rrd"
    echolake.rerun.view(a_slice, save=saved)
    found = contents(saved)
    assert "Asset3D:blob" in found["/world/panel/mesh"][1]
    once_a_measurement = {
        "/world/panel/microphone": "Points3D:positions",
        "/world/panel/speaker": "Points3D:positions",
        "/environment/temperature_c": "Scalars:scalars",
        "/environment/pressure_hpa": "Scalars:scalars",
        "/measurement/snr_db": "Scalars:scalars",
        "/ir": "BarChart:abscissa",
    }
    if hasattr(rr, "AssetAudio"):
        once_a_measurement["/sound/ir"] = "AssetAudio:blob"
    for entity, component in once_a_measurement.items():
        rows, components = found[entity]
        assert rows == 5, entity
        assert component in components, entity


def test_both_arms_stand_in_the_world_and_move(a_slice: Path, tmp_path: Path) -> None:
    saved = tmp_path / "five.rrd"
    echolake.rerun.view(a_slice, save=saved, pairs=[0, 3])
    found = contents(saved)
    for name in ("microphone", "speaker"):
        links = [f"{name}_foot", *(f"{name}_link_{number}" for number in range(1, 6)), f"{name}_flange", name]
        for depth in range(1, len(links) + 1):
            entity = "/".join(["/world", *links[:depth]])
            assert found[entity] == (2, {"Transform3D:quaternion", "Transform3D:translation"}), entity
            kinds = {component.split(":")[0] for component in found[f"{entity}/shape_0"][1]}
            assert kinds in ({"Cylinders3D"}, {"Ellipsoids3D"}), entity


def test_the_blueprint_has_an_axis_for_each_quantity(a_slice: Path, tmp_path: Path) -> None:
    saved = tmp_path / "five.rrd"
    echolake.rerun.view(a_slice, save=saved, pairs=[0])
    views = [components for entity, (_, components) in contents(saved).items() if entity.startswith("/view/")]
    assert sum("PlotLegend:visible" in components for components in views) == 6
    assert sum("EyeControls3D:position" in components for components in views) == 1
    playing = contents(saved)["/time_panel"][1]
    assert {"TimePanelBlueprint:timeline", "TimePanelBlueprint:play_state"} <= playing
