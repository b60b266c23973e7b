"""Training sets of ``echolake export ml`` for torch."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from numpy.typing import NDArray
from torch.utils.data import IterableDataset, get_worker_info

from echolake.symmetry import NAMES, turn_heights, turn_positions

__all__ = ["Batch", "Measurements"]

_ALIGNMENT = 64


class Batch(dict[str, Any]):
    """Tensors by column; ``surface_ids`` and ``symmetries`` are lists that ``surface`` points into.

    The tensors of its columns are views of one piece of memory. Between processes that piece travels alone: handing over
    a tensor costs most of a millisecond, whatever its size.
    """

    def __init__(self, packed: torch.Tensor, layout: list[_Place], others: dict[str, Any]) -> None:
        super().__init__({place.name: place.view(packed) for place in layout} | others)
        self._parts = packed, layout, others

    def __reduce__(self) -> tuple[Any, ...]:
        return Batch, self._parts


@dataclass(frozen=True)
class _Place:
    """Where a column stands in a batch's memory."""

    name: str
    start: int
    shape: tuple[int, ...]
    dtype: torch.dtype

    def view(self, packed: torch.Tensor) -> torch.Tensor:
        count = int(np.prod(self.shape)) * self.dtype.itemsize
        return packed[self.start : self.start + count].view(self.dtype).view(self.shape)

_POSITIONS = ("microphone_mm", "speaker_mm")
_MEASURED = ("pair_id", "microphone", "speaker", "swapped")
"""What names points and pairs of the grid; after a turn on the fly only positions are told."""


@dataclass(frozen=True)
class _Item:
    """A surface under a symmetry: what is read at once."""

    file: Path
    row_group: int
    symmetry: str


class Measurements(IterableDataset[Batch]):
    """Batches of measurements, as tensors.

    Give it to ``DataLoader(dataset, batch_size=None, num_workers=N)``: it makes batches itself, which is what lets it
    keep up with the disk. Each batch has one tensor a column with ``batch_size`` rows, and

    - ``surface``: for each row, which of ``surface_ids`` and ``symmetries`` it is of,
    - ``heights`` (with ``heights=True``): ``[len(surface_ids), cells, cells]`` in mm, so ``batch["heights"][batch["surface"]]``
      has a map for each row.

    Files are dealt to ranks and workers; where there are fewer files than workers, surfaces are. ``mix`` surfaces, of as
    many files, are read at a time and shuffled together, while the next ones are being read.

    ``symmetries``: ``"none"``; ``"random"``, each surface under one of the eight, another one every epoch; ``"all"``, each
    under every one. Positions and height maps turn together; microphone and speaker keep their roles, so that nothing
    relies on reciprocity.
    """

    def __init__(
        self,
        path: str | Path,
        split: Literal["train", "validation", "test"] = "train",
        columns: Sequence[str] | None = None,
        *,
        batch_size: int = 512,
        heights: bool = False,
        symmetries: Literal["none", "random", "all"] = "none",
        shuffle: bool | None = None,
        mix: int = 4,
        seed: int = 0,
        rank: int | None = None,
        world_size: int | None = None,
    ) -> None:
        super().__init__()
        self.path = Path(path)
        self.files = sorted((self.path / "data").glob(f"{split}-*.parquet"))
        if not self.files:
            raise FileNotFoundError(f"no data/{split}-*.parquet in `{self.path}`; is it made by `echolake export ml`?")
        if batch_size < 1 or mix < 1:
            raise ValueError(f"batch_size {batch_size} and mix {mix} must be 1 at least")
        schema = pq.read_schema(self.files[0])
        self.columns = _numeric(schema, columns, () if symmetries == "none" else _MEASURED)
        self.split, self.batch_size, self.mix, self.seed = split, batch_size, mix, seed
        self.symmetries = symmetries
        self.shuffle = split == "train" if shuffle is None else shuffle
        self.with_heights = heights
        distributed = torch.distributed.is_available() and torch.distributed.is_initialized()
        self.rank = rank if rank is not None else (torch.distributed.get_rank() if distributed else 0)
        self.world_size = world_size if world_size is not None else (torch.distributed.get_world_size() if distributed else 1)
        if not 0 <= self.rank < self.world_size:
            raise ValueError(f"rank {self.rank} of {self.world_size}")
        self.epoch = 0
        self._groups = [(file, pq.read_metadata(file).num_row_groups) for file in self.files]
        self._heights: dict[str, NDArray[np.float32]] | None = None

    def __len__(self) -> int:
        """Rows of one epoch, of all ranks and workers."""
        rows = sum(int(pq.read_metadata(file).num_rows) for file in self.files)
        return rows * (len(NAMES) if self.symmetries == "all" else 1)

    def set_epoch(self, epoch: int) -> None:
        """Shuffles and turns anew; the same epoch and seed give the same order."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[Batch]:
        random = np.random.default_rng([self.seed, self.epoch])
        items = self._items(random)
        blocks = [items[i : i + self.mix] for i in range(0, len(items), self.mix)]
        if not blocks:
            return
        own = np.random.default_rng([self.seed, self.epoch, *self._place()])
        with ThreadPoolExecutor(max_workers=1) as ahead:
            coming = ahead.submit(self._read, blocks[0])
            for number in range(len(blocks)):
                block = coming.result()
                if number + 1 < len(blocks):
                    coming = ahead.submit(self._read, blocks[number + 1])
                yield from self._batches(block, own)

    def _place(self) -> tuple[int, int]:
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        return self.rank * workers + worker, self.world_size * workers

    # What this rank and worker reads, in its order: files side by side, so that a block is of several.
    def _items(self, random: np.random.Generator) -> list[_Item]:
        place, places = self._place()
        groups = list(self._groups)
        if self.shuffle:
            groups = [groups[i] for i in random.permutation(len(groups))]
        if len(groups) >= places:
            groups = groups[place::places]
            mine = [(file, group) for file, count in groups for group in range(count)]
        else:
            mine = [(file, group) for file, count in groups for group in range(count)][place::places]
        if self.shuffle:
            ranked = [(random.random(), random.random()) for _ in mine]
            taken: dict[Path, int] = {}
            order = []
            for i in sorted(range(len(mine)), key=lambda i: ranked[i][0]):
                turn = taken.setdefault(mine[i][0], 0)
                taken[mine[i][0]] = turn + 1
                order.append((turn, ranked[i][1], i))
            mine = [mine[i] for _, _, i in sorted(order)]
        names = {"none": ["identity"], "all": list(NAMES)}.get(self.symmetries)
        items = [
            _Item(file, group, symmetry)
            for file, group in mine
            for symmetry in (names or [NAMES[int(random.integers(len(NAMES)))]])
        ]
        if self.shuffle and self.symmetries == "all":
            items = [items[i] for i in random.permutation(len(items))]
        return items

    def _read(self, items: list[_Item]) -> dict[str, Any]:
        parts: list[dict[str, NDArray[Any]]] = []
        surface_ids: list[str] = []
        symmetries: list[str] = []
        for item in items:
            names = [*self.columns, "surface_id", "symmetry"]
            table = pq.ParquetFile(item.file, memory_map=True).read_row_group(item.row_group, columns=names)
            arrays = {name: _numpy(table.column(name)) for name in self.columns}
            arrays["surface"] = self._surfaces(table, item, surface_ids, symmetries)
            if item.symmetry != "identity":
                _turn(arrays, item.symmetry)
            parts.append(arrays)
        block: dict[str, Any] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        block["surface_ids"], block["symmetries"] = surface_ids, symmetries
        return block

    # Which entry of the block's surfaces each row is of; in a set with all symmetries a row group has several.
    def _surfaces(
        self,
        table: pa.Table,
        item: _Item,
        surface_ids: list[str],
        symmetries: list[str],
    ) -> NDArray[np.int64]:
        coded = table.column("symmetry").combine_chunks().dictionary_encode()
        names = coded.dictionary.to_pylist()
        if names != ["identity"] and self.symmetries != "none":
            raise ValueError("the training set has its symmetries already; take symmetries=\"none\"")
        start = len(surface_ids)
        surface_ids.extend([table.column("surface_id")[0].as_py()] * len(names))
        symmetries.extend([item.symmetry] if names == ["identity"] else names)
        of_row: NDArray[np.int64] = coded.indices.to_numpy().astype(np.int64) + start
        return of_row

    def _batches(self, block: dict[str, Any], random: np.random.Generator) -> Iterator[Batch]:
        rows = len(block["surface"])
        order = random.permutation(rows) if self.shuffle else None
        maps = self._maps(block["surface_ids"], block["symmetries"]) if self.with_heights else None
        for start in range(0, rows, self.batch_size):
            stop = min(start + self.batch_size, rows)
            chosen = np.arange(start, stop) if order is None else order[start:stop]
            others: dict[str, Any] = {name: block[name] for name in ("surface_ids", "symmetries")}
            if maps is not None:
                others["heights"] = maps
            yield _packed({name: values for name, values in block.items() if isinstance(values, np.ndarray)}, chosen, others)

    def _maps(self, surface_ids: list[str], symmetries: list[str]) -> torch.Tensor:
        known = self._known_heights()
        turned = [turn_heights(known[surface], symmetry) for surface, symmetry in zip(surface_ids, symmetries)]
        return torch.from_numpy(np.stack(turned))

    def _known_heights(self) -> dict[str, NDArray[np.float32]]:
        if self._heights is None:
            file = self.path / "heightmaps" / f"{self.split}.parquet"
            if not file.exists():
                raise FileNotFoundError(f"`{file}` is not there: the lake has no height maps")
            table = pq.read_table(file, columns=["surface_id", "heights_mm"], filters=[("symmetry", "=", "identity")])
            values = _numpy(table.column("heights_mm"))
            cells = int(round(values.shape[1] ** 0.5))
            maps = values.reshape(-1, cells, cells)
            self._heights = dict(zip(table.column("surface_id").to_pylist(), maps))
        return self._heights


# The chosen rows of all columns, each written straight to its place.
def _packed(columns: dict[str, NDArray[Any]], chosen: NDArray[np.int64], others: dict[str, Any]) -> Batch:
    layout, end = [], 0
    for name, values in columns.items():
        dtype = torch.from_numpy(values[:0]).dtype
        layout.append(_Place(name, end, (len(chosen), *values.shape[1:]), dtype))
        size = len(chosen) * int(np.prod(values.shape[1:])) * dtype.itemsize
        end += -(-size // _ALIGNMENT) * _ALIGNMENT
    packed = torch.empty(end, dtype=torch.uint8)
    batch = Batch(packed, layout, others)
    for name, values in columns.items():
        np.take(values, chosen, axis=0, out=batch[name].numpy(), mode="clip")
    return batch


def _numeric(schema: pa.Schema, columns: Sequence[str] | None, without: Sequence[str]) -> list[str]:
    known = [field.name for field in schema if not pa.types.is_string(field.type) and field.name not in without]
    if columns is None:
        return known
    unknown = [name for name in columns if name not in known]
    if unknown:
        raise KeyError(f"no columns {json.dumps(unknown)}; there are {json.dumps(known)}")
    return list(columns)


# Numbers of a column, without a copy where Arrow has them in one piece.
def _numpy(column: pa.ChunkedArray) -> NDArray[Any]:
    array = column.combine_chunks() if column.num_chunks != 1 else column.chunk(0)
    if pa.types.is_fixed_size_list(array.type):
        length = array.type.list_size
        values: NDArray[Any] = array.flatten().to_numpy(zero_copy_only=False).reshape(-1, length)
        return values
    plain: NDArray[Any] = array.to_numpy(zero_copy_only=False)
    return plain


def _turn(arrays: dict[str, NDArray[Any]], symmetry: str) -> None:
    for name in _POSITIONS:
        if name in arrays:
            arrays[name] = turn_positions(arrays[name], symmetry)
