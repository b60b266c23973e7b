"""D4, the eight symmetries of a square panel, on positions and height maps.

Names, matrices and conventions are those of the lake: a matrix acts on the column (x, y), z stays; height maps are
``[y, x]``, both ascending.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["MATRICES", "NAMES", "turn_heights", "turn_positions"]

MATRICES: dict[str, NDArray[np.int64]] = {
    name: np.array(matrix)
    for name, matrix in {
        "identity": [[1, 0], [0, 1]],
        "rot90": [[0, -1], [1, 0]],
        "rot180": [[-1, 0], [0, -1]],
        "rot270": [[0, 1], [-1, 0]],
        "mirror_x": [[-1, 0], [0, 1]],
        "mirror_y": [[1, 0], [0, -1]],
        "mirror_diag": [[0, 1], [1, 0]],
        "mirror_anti": [[0, -1], [-1, 0]],
    }.items()
}
NAMES: tuple[str, ...] = tuple(MATRICES)


def turn_positions(positions: NDArray[Any], symmetry: str) -> NDArray[Any]:
    """Moves positions ``[..., 3]``; z stays."""
    turned = np.array(positions)
    turned[..., :2] = positions[..., :2] @ MATRICES[symmetry].T.astype(positions.dtype)
    return turned


def turn_heights(heights: NDArray[Any], symmetry: str) -> NDArray[Any]:
    """Moves height maps ``[..., cells, cells]`` with the panel under them."""
    cells = heights.shape[-1]
    if heights.shape[-2] != cells:
        raise ValueError(f"a height map of {heights.shape[-2]} x {cells} cells, expected a square")
    # Twice the distance to the centre, so that it is whole: cell i is at 2 i - (cells - 1).
    axis = 2 * np.arange(cells) - (cells - 1)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    # What stands at a place came from where the inverse, the transpose, takes it.
    from_x, from_y = np.tensordot(MATRICES[symmetry].T, np.stack([x, y]), axes=1)
    rows: NDArray[np.int64] = (from_y + cells - 1) // 2
    columns: NDArray[np.int64] = (from_x + cells - 1) // 2
    turned: NDArray[Any] = np.take(heights.reshape(*heights.shape[:-2], -1), rows * cells + columns, axis=-1)
    return turned
