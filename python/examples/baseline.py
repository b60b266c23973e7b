"""A first number to beat: TNCE of each band at each pair, learned from the height map alone.

    python examples/baseline.py TRAINING_SET [--epochs 3]

Three predictors, each in dB, each with its error on every split: the mean of each pair over the training set; ridge
regression on local features of the relief around the point where sound is reflected; a small convolutional network over
a window there, where torch is. TRAINING_SET is a folder of ``echolake export ml``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

Floats = NDArray[np.float32]

SPLITS = ("train", "validation", "test")
FLOOR_DB = -40.0
"""What is weaker counts as this: a level of nothing is minus infinity."""
RADII_MM = (25.0, 60.0, 140.0)
"""Of the discs whose roughness is measured: about the first Fresnel zones from 40 down to 2.5 kHz."""
SHIFTS = 4
LEAST_RELIEFS = 20
"""Of the training set: from fewer nothing can be learned that holds for another relief."""
PAIRS_A_SURFACE = 150
"""Of the 2951; a surface's pairs are alike. References are left out: what is to be learned is relief."""


@dataclass
class Rows:
    """Rows of a split: surface, pair, positions in mm, and what is to be learned, in dB."""

    surface: NDArray[np.int64]
    pair: NDArray[np.int64]
    microphone: Floats
    speaker: Floats
    target: Floats
    maps: Floats
    size_mm: float


def read(folder: Path, split: str, bands: list[str], rng: np.random.Generator) -> Rows | None:
    """Some pairs of every surface of a split that has a height map."""
    heights = folder / "heightmaps" / f"{split}.parquet"
    if not heights.exists():
        return None
    table = pq.read_table(heights, filters=[("symmetry", "=", "identity")])
    places = {surface: i for i, surface in enumerate(table.column("surface_id").to_pylist())}
    maps = fixed(table.column("heights_mm"))
    cells = round(maps.shape[1] ** 0.5)
    columns = ["surface_id", "typology", "symmetry", "pair_id", "microphone_mm", "speaker_mm", *bands]
    parts: list[list[NDArray[np.generic]]] = []
    for file in sorted((folder / "data").glob(f"{split}-*.parquet")):
        rows = pq.ParquetFile(file)
        for group in range(rows.num_row_groups):
            some = rows.read_row_group(group, columns=columns)
            surface = some.column("surface_id")[0].as_py()
            if surface not in places or some.column("typology")[0].as_py() == "reference":
                continue
            plain = np.flatnonzero(np.asarray(some.column("symmetry").to_pylist()) == "identity")
            keep = np.sort(rng.permutation(plain)[:PAIRS_A_SURFACE])
            levels = np.stack([10 * np.log10(np.maximum(some.column(b).to_numpy(), 1e-12)) for b in bands], axis=1)
            parts.append(
                [
                    np.full(len(keep), places[surface]),
                    some.column("pair_id").to_numpy()[keep],
                    fixed(some.column("microphone_mm"))[keep],
                    fixed(some.column("speaker_mm"))[keep],
                    np.maximum(levels[keep], FLOOR_DB).astype(np.float32),
                ]
            )
    if not parts:
        return None
    surface, pair, microphone, speaker, target = (np.concatenate(column) for column in zip(*parts, strict=True))
    size = float(table.column("size_mm")[0].as_py())
    return Rows(surface, pair, microphone, speaker, target, maps.reshape(-1, cells, cells), size)


def fixed(column) -> Floats:  # type: ignore[no-untyped-def]
    """A column of lists of one length as a matrix."""
    array = column.combine_chunks()
    matrix: Floats = array.flatten().to_numpy().reshape(len(array), -1)
    return matrix


def specular(rows: Rows) -> Floats:
    """Where the flat panel would reflect, x and y in mm."""
    m, s = rows.microphone, rows.speaker
    share = (m[:, 2] / (m[:, 2] + s[:, 2]))[:, None]
    point: Floats = m[:, :2] + share * (s[:, :2] - m[:, :2])
    return point


def features(rows: Rows) -> Floats:
    """Local features of the relief at each row's point of reflection, and the geometry."""
    cells = rows.maps.shape[-1]
    pitch = rows.size_mm / cells
    point = specular(rows)
    centre = np.clip(np.round(point / pitch + (cells - 1) / 2).astype(int), 0, cells - 1)
    along_y: Floats = np.gradient(rows.maps, pitch, axis=1)
    along_x: Floats = np.gradient(rows.maps, pitch, axis=2)
    columns = [np.linalg.norm(rows.microphone - rows.speaker, axis=1) / 300, point[:, 0] / 300, point[:, 1] / 300]
    columns += [rows.microphone[:, 2] / 300, rows.speaker[:, 2] / 300, (np.abs(point) / 300).max(axis=1)]
    for radius in RADII_MM:
        reach = int(np.ceil(radius / pitch))
        offsets = [
            (dy, dx)
            for dy in range(-reach, reach + 1, max(1, reach // SHIFTS))
            for dx in range(-reach, reach + 1, max(1, reach // SHIFTS))
            if np.hypot(dy, dx) * pitch <= radius
        ]
        y = np.clip(centre[:, 1, None] + [dy for dy, _ in offsets], 0, cells - 1)
        x = np.clip(centre[:, 0, None] + [dx for _, dx in offsets], 0, cells - 1)
        heights = rows.maps[rows.surface[:, None], y, x]
        slopes = along_x[rows.surface[:, None], y, x], along_y[rows.surface[:, None], y, x]
        columns += [heights.mean(1) / 10, np.log1p(heights.std(1)), heights.std(1) / 10]
        columns += [slopes[0].mean(1), slopes[1].mean(1), np.log1p(10 * np.sqrt(slopes[0].var(1) + slopes[1].var(1)))]
    base = np.stack(columns, axis=1).astype(np.float32)
    # Products let a line bend; the constant is the mean.
    upper = np.triu_indices(base.shape[1])
    return np.concatenate([np.ones((len(base), 1), np.float32), base, base[:, upper[0]] * base[:, upper[1]]], axis=1)


def ridge(x: Floats, y: Floats, weight: float) -> tuple[Floats, Floats, Floats]:
    """Weights for standardised features, with their means and scales."""
    mean: Floats = x.mean(0)
    scale: Floats = x.std(0) + 1e-6
    mean[0], scale[0] = 0, 1
    z = ((x - mean) / scale).astype(np.float64)
    weights = np.linalg.solve(z.T @ z + weight * len(z) * np.eye(z.shape[1]), z.T @ y)
    return weights.astype(np.float32), mean, scale


def report(name: str, bands: list[str], errors: Mapping[str, NDArray[np.floating[Any]]]) -> None:
    """Root mean square errors in dB, a line a split."""
    for split, error in errors.items():
        each = "  ".join(f"{e:6.2f}" for e in np.sqrt((error**2).mean(0)))
        print(f"{name:<13} {split:<11} {each}  {np.sqrt((error**2).mean()):6.2f}", flush=True)


def pair_means(splits: dict[str, Rows]) -> dict[str, Floats]:
    """Errors of the mean of each pair in the training set."""
    train = splits["train"]
    mean = train.target.mean(0)
    pairs = int(max(rows.pair.max() for rows in splits.values())) + 1
    # A pair that is rare in the sample leans on the mean of all.
    sums, counts = np.tile(mean * 2, (pairs, 1)), np.full((pairs, 1), 2.0)
    np.add.at(sums, train.pair, train.target)
    np.add.at(counts, train.pair, 1.0)
    means = sums / counts
    return {split: rows.target - means[rows.pair] for split, rows in splits.items()}


def network(splits: dict[str, Rows], bands: list[str], epochs: int) -> dict[str, Floats] | None:
    """Errors of a small convolutional network; None without torch."""
    try:
        import torch
        from torch import nn
    except ImportError:
        return None
    torch.manual_seed(1)
    window, side = 300.0, 32
    axis = (torch.arange(side) + 0.5) / side * 2 - 1

    def inputs(rows: Rows, chosen: NDArray[np.int64]) -> tuple[torch.Tensor, torch.Tensor]:
        point = torch.from_numpy(specular(rows)[chosen])
        maps = torch.from_numpy(rows.maps[rows.surface[chosen]])[:, None] / 10
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        grid = torch.stack([x, y], -1)[None] * (window / rows.size_mm) + (point * 2 / rows.size_mm)[:, None, None, :]
        # Beyond the panel there is nothing: the second channel says where it is.
        there = (grid.abs() <= 1).all(-1, keepdim=True).permute(0, 3, 1, 2).float()
        seen = nn.functional.grid_sample(maps, grid.float(), padding_mode="border", align_corners=False)
        both = np.concatenate([rows.microphone[chosen], rows.speaker[chosen]], axis=1) / 300
        return torch.cat([seen * there, there], 1), torch.from_numpy(both.astype(np.float32))

    class Net(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            layers: list[nn.Module] = []
            for before, after in ((2, 16), (16, 24), (24, 32)):
                layers += [nn.Conv2d(before, after, 3, padding=1), nn.ReLU(), nn.MaxPool2d(2)]
            self.see = nn.Sequential(*layers, nn.Flatten())
            self.say = nn.Sequential(nn.Linear(32 * (side // 8) ** 2 + 6, 96), nn.ReLU(), nn.Linear(96, len(bands)))

        def forward(self, maps: torch.Tensor, geometry: torch.Tensor) -> torch.Tensor:
            said: torch.Tensor = self.say(torch.cat([self.see(maps), geometry], 1))
            return said

    net, train = Net(), splits["train"]
    mean, scale = train.target.mean(0), train.target.std(0)
    steps = epochs * (len(train.pair) // 256)
    optimiser = torch.optim.AdamW(net.parameters(), 2e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, total_steps=max(2, steps))
    rng = np.random.default_rng(1)
    for _ in range(epochs):
        order = rng.permutation(len(train.pair))
        for start in range(0, len(order) - 255, 256):
            chosen = order[start : start + 256]
            wanted = torch.from_numpy((train.target[chosen] - mean) / scale)
            loss = nn.functional.mse_loss(net(*inputs(train, chosen)), wanted)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    errors = {}
    net.eval()
    with torch.no_grad():
        for split, rows in splits.items():
            blocks = np.array_split(np.arange(len(rows.pair)), max(1, len(rows.pair) // 1024))
            said = np.concatenate([net(*inputs(rows, block)).numpy() for block in blocks])
            errors[split] = rows.target - (said * scale + mean)
    return errors


def main() -> None:
    """Reads, learns and reports."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--epochs", type=int, default=3)
    parser.add_argument("--few", action="store_true", help=f"learn even from fewer than {LEAST_RELIEFS} reliefs")
    arguments = parser.parse_args()
    first = sorted((arguments.folder / "data").glob("train-*.parquet"))
    if not first:
        parser.error(f"no data/train-*.parquet in `{arguments.folder}`; is it made by `echolake export ml`?")
    names = pq.read_schema(first[0]).names
    bands = [
        name for name in names if name.startswith("tnce_") and name.split("_")[-1].isdigit() and "band" not in name
    ]
    rng = np.random.default_rng(1)
    found = {split: read(arguments.folder, split, bands, rng) for split in SPLITS}
    splits = {split: rows for split, rows in found.items() if rows is not None}
    reliefs = len(np.unique(splits["train"].surface)) if "train" in splits else 0
    if reliefs == 0 or (reliefs < LEAST_RELIEFS and not arguments.few):
        parser.error(
            f"`{arguments.folder}`: split train has {reliefs} reliefs besides references, expected at least "
            f"{LEAST_RELIEFS}, because errors on other reliefs would mean nothing; hint: a lake of "
            "`echolake demo --surfaces 50 --ir-only`, or --few"
        )
    print("RMS error in dB           " + "  ".join(f"{b.removeprefix('tnce_'):>6}" for b in bands) + "     all")
    report("pair mean", bands, pair_means(splits))
    x = {split: features(rows) for split, rows in splits.items()}
    weights, mean, scale = ridge(x["train"], splits["train"].target, 1e-4)
    report("ridge", bands, {s: rows.target - ((x[s] - mean) / scale) @ weights for s, rows in splits.items()})
    if (errors := network(splits, bands, arguments.epochs)) is not None:
        report("small network", bands, errors)


if __name__ == "__main__":
    main()
