"""The table of designs and performances that the manual shows."""

import csv
import io
import json
import re
import subprocess
from pathlib import Path

LIMIT_SECS = 600
MANUAL = Path(__file__).parents[2] / "docs" / "training.md"


def query(echolake: str, lake: Path, sql: str) -> list[dict[str, str]]:
    command = [echolake, "--lake", str(lake), "sql", "--format", "csv"]
    done = subprocess.run(command, input=sql, check=True, capture_output=True, text=True, timeout=LIMIT_SECS)
    return list(csv.DictReader(io.StringIO(done.stdout)))


def test_designs_have_their_parameters_and_levels(echolake: str, lake: Path) -> None:
    found = re.search(r"<<'SQL'\n(.*?)\n    SQL\n", MANUAL.read_text(), re.DOTALL)
    assert found
    designs = query(echolake, lake, found[1])
    surfaces = query(echolake, lake, "select * from catalogue where typology = 'flemish_bond_bricks'")
    assert len(designs) == len(surfaces) > 0
    by_name = {surface["surface_id"]: surface for surface in surfaces}
    for design in designs:
        surface = by_name[design["surface_id"]]
        parameters = json.loads(surface["parameters"])
        for name in ("brick_height_mm", "joint_width_mm"):
            assert float(design[name]) == parameters[name]
        assert design["macrostructure"] == surface["macrostructure"]
        assert design["against_flat_10000_db"] == surface["against_flat_10000_db"]
