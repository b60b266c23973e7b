"""D4 in Python is D4 in the lake."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from echolake.symmetry import MATRICES, NAMES, turn_heights, turn_positions


def test_the_eight_are_a_group() -> None:
    products = {tuple((MATRICES[a] @ MATRICES[b]).ravel()) for a in NAMES for b in NAMES}
    assert products == {tuple(MATRICES[a].ravel()) for a in NAMES}
    assert len(products) == 8


def test_heights_move_with_positions() -> None:
    heights = np.zeros((6, 6))
    heights[1, 4] = 1.0  # y = -1.5, x = 1.5 cells from the centre
    for name in NAMES:
        [[y, x]] = np.argwhere(turn_heights(heights, name) == 1.0) - 2.5
        expected = turn_positions(np.array([[1.5, -1.5, 7.0]]), name)
        assert np.array_equal(expected, [[x, y, 7.0]]), name


def test_height_maps_are_those_that_the_lake_has(turned_set: Path) -> None:
    table = pq.read_table(turned_set / "heightmaps" / "train.parquet")
    surface = table.column("surface_id")[0].as_py()
    maps = {
        row["symmetry"]: np.reshape(row["heights_mm"], (128, 128))
        for row in table.to_pylist()
        if row["surface_id"] == surface
    }
    assert set(maps) == set(NAMES)
    for name in NAMES:
        assert np.array_equal(turn_heights(maps["identity"], name), maps[name]), name


def test_positions_are_those_that_the_lake_has(turned_set: Path) -> None:
    table = pq.read_table(next((turned_set / "data").glob("test-*.parquet")))
    columns = ("symmetry", "pair_id", "swapped", "microphone_mm", "speaker_mm")
    rows = zip(*(table.column(name).to_pylist() for name in columns), strict=True)
    placed = {(symmetry, pair): (swapped, np.array(m), np.array(s)) for symmetry, pair, swapped, m, s in rows}
    for (symmetry, pair), (swapped, microphone, speaker) in placed.items():
        _, m, s = placed["identity", pair]
        wanted = [turn_positions(m, symmetry), turn_positions(s, symmetry)]
        assert np.allclose([speaker, microphone] if swapped else [microphone, speaker], wanted, atol=1e-3)
