"""Training sets of ``echolake export ml`` for torch."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import cycle, islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from numpy.typing import NDArray
from torch.utils.data import IterableDataset, get_worker_info

from echolake._batch import Batch, Memory
from echolake.symmetry import NAMES, turn_heights, turn_positions

__all__ = ["Batch", "Measurements"]

_READERS = 2
_AT_ONCE = 1024
"""Rows to decode at once: few enough to be copied before they leave the processor's cache."""
_POSITIONS = ("microphone_mm", "speaker_mm")
_MEASURED = ("pair_id", "microphone", "speaker", "swapped")
"""What names points and pairs of the grid; after a turn on the fly only positions are told."""


@dataclass(frozen=True)
class _Item:
    """A surface under a symmetry: what is read at once."""

    file: Path
    row_group: int
    rows: int
    symmetry: str


@dataclass(frozen=True)
class _PlannedBlock:
    """Surfaces that a rank reads and shuffles together, and how many batches it makes of them."""

    number: int
    items: list[_Item]
    batches: int


@dataclass
class _Block:
    """Surfaces that are shuffled together: rows by column, and what column ``surface`` points into."""

    columns: dict[str, NDArray[Any]]
    surface_ids: list[str]
    symmetries: list[str]


@dataclass
class _Surfaces:
    """What was read at once is of these; ``of_row`` says which."""

    surface_ids: list[str]
    symmetries: list[str]
    of_row: NDArray[np.int64]


_Room = dict[str, NDArray[Any]]
"""Memory of a block's columns, kept for the next block."""


class Measurements(IterableDataset[Batch]):
    """Batches of measurements, as tensors.

    Give it to ``DataLoader(dataset, batch_size=None, num_workers=N)``: it makes batches itself, which is what lets it
    keep up with the disk. Each batch has one tensor a column with ``batch_size`` rows, and

    - ``surface``: for each row, which of ``surface_ids`` and ``symmetries`` it is of,
    - ``heights`` (with ``heights=True``): ``[len(surface_ids), cells, cells]`` in mm, so
      ``batch["heights"][batch["surface"]]`` has a map for each row.

    Surfaces are dealt to ranks. ``mix`` of a rank's surfaces, of as many files, are read at a time and shuffled
    together, while the next ones are being read; these blocks are dealt to its workers. A block's last batch may be
    short.

    ``len`` is the number of batches of an epoch of this rank. It is the same at every rank and with any number of
    workers: a rank that has fewer than another repeats its first ones, with its rows in another order. So each row
    comes once if there is one rank, and at least once if there are several; to evaluate, read with ``world_size=1``.

    ``symmetries``: ``"none"``; ``"random"``, each surface under one of the eight, another one every epoch; ``"all"``,
    each under every one. Positions and height maps turn together; microphone and speaker keep their roles, so that
    nothing relies on reciprocity. Responses and levels stay as they were measured, although the rig's aim and
    directivity do not turn with a panel: energies are off by 0.5 dB rms at 20 kHz and 1 dB at 40 kHz, levels over
    Flat's total by 0.1 to 0.6 dB, levels over Flat's same band (``tnce_band_*``) by 0.2 dB or less.
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
        self.world_size = (
            world_size if world_size is not None else (torch.distributed.get_world_size() if distributed else 1)
        )
        if not 0 <= self.rank < self.world_size:
            raise ValueError(f"rank {self.rank} of {self.world_size}")
        self.epoch = 0
        self._groups = [(file, _rows(pq.read_metadata(file))) for file in self.files]
        self._kinds = {name: _kind(schema.field(name)) for name in self.columns} | {"surface": (np.dtype(np.int64), ())}
        self._heights: dict[str, NDArray[np.float32]] | None = None
        self._metadata: dict[Path, pq.FileMetaData] = {}
        self._memory: Memory | None = None

    def __len__(self) -> int:
        """Batches of one epoch of this rank, over all of its workers; every rank has as many."""
        return sum(planned.batches for planned in self._plan())

    def set_epoch(self, epoch: int) -> None:
        """Shuffles and turns anew; the same epoch and seed give the same order."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[Batch]:
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        plan = self._plan()[worker::workers]
        if not plan:
            return
        if self._memory is None or info is None:
            self._memory = Memory()
        # One block is dealt out while the next one is read; both places are filled again and again.
        rooms: tuple[_Room, _Room] = {}, {}
        with ThreadPoolExecutor(max_workers=_READERS) as readers:
            coming = self._submit(readers, plan[0].items, rooms[0])
            for number, planned in enumerate(plan):
                block = coming.result()
                if number + 1 < len(plan):
                    coming = self._submit(readers, plan[number + 1].items, rooms[(number + 1) % 2])
                random = np.random.default_rng([self.seed, self.epoch, self.rank, planned.number])
                yield from islice(self._batches(block, random, self._memory), planned.batches)

    # The blocks of this rank. A rank with fewer batches than another repeats its first ones: no rank waits for another
    # at the end of an epoch, and no row is left out.
    def _plan(self) -> list[_PlannedBlock]:
        order = self._order()
        ranks = [self._blocks(order, rank) for rank in range(self.world_size)]
        counts = [sum(block.batches for block in blocks) for blocks in ranks]
        own = ranks[self.rank]
        missing = max(counts) - counts[self.rank]
        for block in cycle(list(own)):
            if missing == 0:
                break
            own.append(_PlannedBlock(len(own), block.items, min(missing, block.batches)))
            missing -= own[-1].batches
        return own

    def _blocks(self, order: list[_Item], rank: int) -> list[_PlannedBlock]:
        # With fewer surfaces than ranks, some ranks read what another one reads, too.
        mine = order[rank :: self.world_size] or order[rank % max(1, len(order)) :][:1]
        blocks = [mine[i : i + self.mix] for i in range(0, len(mine), self.mix)]
        counts = [-(-sum(item.rows for item in block) // self.batch_size) for block in blocks]
        return [_PlannedBlock(number, *planned) for number, planned in enumerate(zip(blocks, counts, strict=True))]

    # All that is read in an epoch, in its order, the same at every rank: files side by side, so a block is of several.
    def _order(self) -> list[_Item]:
        random = np.random.default_rng([self.seed, self.epoch])
        groups = [(file, group, rows) for file, counts in self._groups for group, rows in enumerate(counts) if rows > 0]
        if self.shuffle:
            ranked = [(random.random(), random.random()) for _ in groups]
            taken: dict[Path, int] = {}
            order = []
            for i in sorted(range(len(groups)), key=lambda i: ranked[i][0]):
                turn = taken.setdefault(groups[i][0], 0)
                taken[groups[i][0]] = turn + 1
                order.append((turn, ranked[i][1], i))
            groups = [groups[i] for _, _, i in sorted(order)]
        names = {"none": ["identity"], "all": list(NAMES)}.get(self.symmetries)
        items = [
            _Item(file, group, rows, symmetry)
            for file, group, rows in groups
            for symmetry in (names or [NAMES[int(random.integers(len(NAMES)))]])
        ]
        if self.shuffle and self.symmetries == "all":
            items = [items[i] for i in random.permutation(len(items))]
        return items

    # Tasks begin in this order: when what waits for the parts begins, all of them are under way.
    def _submit(self, readers: ThreadPoolExecutor, items: list[_Item], room: _Room) -> Future[_Block]:
        starts = np.cumsum([0, *(item.rows for item in items)])
        columns = self._columns(int(starts[-1]), room)
        parts = []
        for item, start, stop in zip(items, starts[:-1], starts[1:], strict=True):
            part = {name: values[start:stop] for name, values in columns.items()}
            parts.append(readers.submit(self._read, item, part))
        return readers.submit(lambda: _Block(columns, *_numbered([part.result() for part in parts])))

    # Where a block goes: over the one before last, as far as there is room.
    def _columns(self, rows: int, room: _Room) -> dict[str, NDArray[Any]]:
        for name, (dtype, shape) in self._kinds.items():
            if name not in room or len(room[name]) < rows:
                room[name] = np.empty((rows, *shape), dtype)
        return {name: values[:rows] for name, values in room.items()}

    def _read(self, item: _Item, columns: dict[str, NDArray[Any]]) -> _Surfaces:
        names = [*self.columns, "surface_id", "symmetry"]
        told: list[pa.RecordBatch] = []
        start = 0
        # Nearly all of a row group is one column; readers side by side do more than threads within one.
        for rows in self._open(item.file).iter_batches(_AT_ONCE, [item.row_group], names, use_threads=False):
            for name in self.columns:
                columns[name][start : start + rows.num_rows] = _numpy(rows.column(name))
            told.append(rows.select(["surface_id", "symmetry"]))
            start += rows.num_rows
        if item.symmetry != "identity":
            _turn(columns, item.symmetry)
        return self._surfaces(pa.Table.from_batches(told), item, columns["surface"])

    def _open(self, file: Path) -> pq.ParquetFile:
        opened = pq.ParquetFile(file, memory_map=True, metadata=self._metadata.get(file))
        self._metadata[file] = opened.metadata
        return opened

    # Which of the surfaces read each row is of; in a set with all symmetries a row group has several.
    def _surfaces(self, table: pa.Table, item: _Item, of_row: NDArray[np.int64]) -> _Surfaces:
        coded = table.column("symmetry").combine_chunks().dictionary_encode()
        names = coded.dictionary.to_pylist()
        if names != ["identity"] and self.symmetries != "none":
            raise ValueError('the training set has its symmetries already; take symmetries="none"')
        of_row[:] = coded.indices.to_numpy()
        surface_ids = [table.column("surface_id")[0].as_py()] * len(names)
        return _Surfaces(surface_ids, [item.symmetry] if names == ["identity"] else names, of_row)

    def _batches(self, block: _Block, random: np.random.Generator, memory: Memory) -> Iterator[Batch]:
        rows = len(block.columns["surface"])
        order = random.permutation(rows) if self.shuffle else np.arange(rows)
        whole = {"heights": self._maps(block)} if self.with_heights else {}
        for start in range(0, rows, self.batch_size):
            batch = memory.batch(block.columns, order[start : start + self.batch_size], whole)
            batch["surface_ids"], batch["symmetries"] = block.surface_ids, block.symmetries
            yield batch

    def _maps(self, block: _Block) -> NDArray[np.float32]:
        known = self._known_heights()
        pairs = zip(block.surface_ids, block.symmetries, strict=True)
        return np.stack([turn_heights(known[surface], symmetry) for surface, symmetry in pairs])

    def _known_heights(self) -> dict[str, NDArray[np.float32]]:
        if self._heights is None:
            file = self.path / "heightmaps" / f"{self.split}.parquet"
            if not file.exists():
                raise FileNotFoundError(f"`{file}` is not there: the lake has no height maps")
            table = pq.read_table(file, columns=["surface_id", "heights_mm"], filters=[("symmetry", "=", "identity")])
            values = _numpy(table.column("heights_mm"))
            cells = round(values.shape[1] ** 0.5)
            maps = values.reshape(-1, cells, cells)
            self._heights = dict(zip(table.column("surface_id").to_pylist(), maps, strict=True))
        return self._heights


# All surfaces of a block in one row.
def _numbered(parts: list[_Surfaces]) -> tuple[list[str], list[str]]:
    surface_ids: list[str] = []
    symmetries: list[str] = []
    for part in parts:
        part.of_row += len(surface_ids)
        surface_ids += part.surface_ids
        symmetries += part.symmetries
    return surface_ids, symmetries


# Type and shape of a row; where a number may be missing, it has to be one that can be NaN.
def _kind(field: pa.Field) -> tuple[np.dtype[Any], tuple[int, ...]]:
    if pa.types.is_fixed_size_list(field.type):
        return np.dtype(field.type.value_type.to_pandas_dtype()), (field.type.list_size,)
    dtype = np.dtype(field.type.to_pandas_dtype())
    return (np.dtype(np.float64) if field.nullable and dtype.kind != "f" else dtype), ()


def _rows(metadata: pq.FileMetaData) -> list[int]:
    return [metadata.row_group(group).num_rows for group in range(metadata.num_row_groups)]


def _numeric(schema: pa.Schema, columns: Sequence[str] | None, without: Sequence[str]) -> list[str]:
    known = [field.name for field in schema if not pa.types.is_string(field.type) and field.name not in without]
    if columns is None:
        return known
    unknown = [name for name in columns if name not in known]
    if unknown:
        raise KeyError(f"no columns {json.dumps(unknown)}; there are {json.dumps(known)}")
    return list(columns)


# Numbers of a column, without a copy where Arrow has them in one piece.
def _numpy(column: pa.Array | pa.ChunkedArray) -> NDArray[Any]:
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if pa.types.is_fixed_size_list(array.type):
        values: NDArray[Any] = array.flatten().to_numpy(zero_copy_only=False).reshape(-1, array.type.list_size)
        return values
    plain: NDArray[Any] = array.to_numpy(zero_copy_only=False)
    return plain


def _turn(arrays: dict[str, NDArray[Any]], symmetry: str) -> None:
    for name in _POSITIONS:
        if name in arrays:
            arrays[name][:] = turn_positions(arrays[name], symmetry)
