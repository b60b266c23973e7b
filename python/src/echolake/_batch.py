"""How a batch stands in memory, and how it gets from a worker process to the one that trains."""

from __future__ import annotations

import math
import mmap
import multiprocessing
import os
import sys
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.reduction import ForkingPickler
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from echolake.training import Kind

__all__ = ["Batch", "Memory"]

_ALIGNMENT = 64
_MOST_SLABS = 32
"""More than a DataLoader has under way of a worker; who keeps more batches gets further ones in memory of their own."""


class Batch(dict[str, Any]):
    """Tensors by column; ``surface_ids`` and ``symmetries`` are lists that ``surface`` points into.

    The tensors are views of one piece of memory, and between processes that piece travels alone: handing over a tensor
    costs most of a millisecond, whatever its size.
    """

    _packed: _Packed | None = None

    def __copy__(self) -> Batch:
        clone = Batch(self)
        clone._packed = self._packed
        return clone

    def __reduce__(self) -> tuple[Any, ...]:
        return Batch, (dict(self),)


class _Place(NamedTuple):
    """Where a column stands in a batch's memory; ``start`` in bytes, ``strides`` in elements."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    start: int


@dataclass
class _Packed:
    """The memory of a batch that is not sent yet."""

    memory: torch.Tensor
    slab: _Slab | None
    layout: _Layout
    views: dict[str, torch.Tensor]


_Layout = tuple[_Place, ...]


class _Slab:
    """Memory that a worker fills again once the batch in it is gone.

    New shared memory for each batch would take as long as reading it. The first byte says whether another process uses
    it; the batch stands behind, aligned.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.file = os.memfd_create("echolake")
        os.ftruncate(self.file, _ALIGNMENT + size)
        self._map = mmap.mmap(self.file, _ALIGNMENT + size)
        self._view: weakref.ref[NDArray[np.uint8]] | None = None

    def free(self) -> bool:
        return self._map[0] == 0 and (self._view is None or self._view() is None)

    def take(self, size: int) -> torch.Tensor:
        view = np.frombuffer(self._map, np.uint8, size, _ALIGNMENT)
        self._view = weakref.ref(view)
        return torch.from_numpy(view)

    def send(self) -> tuple[int, int]:
        self._map[0] = 1
        return os.getpid(), self.file


class _Received(mmap.mmap):
    """A slab in the process that trains, given back when the last tensor in it is gone."""

    owner: int

    def __del__(self) -> None:
        # A process forked meanwhile has it, too, but may not give it back.
        if self.owner == os.getpid():
            self[0] = 0


class Memory:
    """Gives memory to a dataset's batches: slabs in a worker on Linux, elsewhere whatever torch has."""

    def __init__(self) -> None:
        self._slabs: list[_Slab] = []
        self._reuses = _parent_can_open()
        self._layouts: dict[Any, tuple[_Layout, int]] = {}

    def allocate_batch(self, kinds: Mapping[str, Kind]) -> Batch:
        """A batch of uninitialised tensors, by type and shape."""
        layout, size = self._layout(kinds)
        slab = self._slab(size) if self._reuses else None
        memory = slab.take(size) if slab else torch.empty(size, dtype=torch.uint8)
        views = _views(memory, layout)
        batch = Batch(views)
        batch._packed = _Packed(memory, slab, layout, views)
        return batch

    # The same for almost all batches of a dataset.
    def _layout(self, kinds: Mapping[str, Kind]) -> tuple[_Layout, int]:
        key = tuple(kinds.items())
        if key not in self._layouts:
            self._layouts[key] = _laid_out(kinds)
        return self._layouts[key]

    def _slab(self, size: int) -> _Slab | None:
        found = next((slab for slab in self._slabs if slab.size >= size and slab.free()), None)
        if found is None and len(self._slabs) < _MOST_SLABS:
            # Memory that nothing was written to costs nothing, and the next batch may be larger.
            found = _Slab(2 * size)
            self._slabs.append(found)
        return found


def _laid_out(kinds: Mapping[str, Kind]) -> tuple[_Layout, int]:
    layout, end = [], 0
    for name, (dtype, shape) in kinds.items():
        strides = tuple(math.prod(shape[axis + 1 :]) for axis in range(len(shape)))
        layout.append(_Place(name, dtype.name, shape, strides, end))
        end += -(-math.prod(shape) * dtype.itemsize // _ALIGNMENT) * _ALIGNMENT
    return tuple(layout), end


def _views(memory: torch.Tensor, layout: _Layout) -> dict[str, torch.Tensor]:
    typed: dict[str, torch.Tensor] = {}
    views = {}
    for name, dtype, shape, strides, start in layout:
        if (whole := typed.get(dtype)) is None:
            whole = typed[dtype] = memory.view(getattr(torch, dtype))
        views[name] = whole.as_strided(shape, strides, start // whole.itemsize)
    return views


# By way of /proc: it needs no connection between the processes, unlike torch's way to send a file.
def _parent_can_open() -> bool:
    parent = multiprocessing.parent_process()
    if parent is None or parent.pid is None or sys.platform != "linux":
        return False
    try:
        # Who may look into it may be looked into by it: same user, same numbers of processes.
        return bool(os.listdir(f"/proc/{parent.pid}/fd"))
    except OSError:
        return False


# Only for multiprocessing: what pickles otherwise may be read twice or much later.
def _reduce(batch: Batch) -> tuple[Any, ...]:
    packed, batch._packed = batch._packed, None
    if packed is None:
        return batch.__reduce__()
    sent = tuple(place for place in packed.layout if batch.get(place.name) is packed.views[place.name])
    names = {place.name for place in sent}
    others = {name: value for name, value in batch.items() if name not in names}
    if packed.slab is None:
        return _unpacked, (packed.memory, sent, list(batch), others)
    return _received, (*packed.slab.send(), len(packed.memory), sent, list(batch), others)


def _received(process: int, file: int, size: int, *parts: Any) -> Batch:
    opened = os.open(f"/proc/{process}/fd/{file}", os.O_RDWR | os.O_CLOEXEC)
    try:
        received = _Received(opened, _ALIGNMENT + size)
    finally:
        os.close(opened)
    received.owner = os.getpid()
    return _unpacked(torch.from_numpy(np.frombuffer(received, np.uint8, size, _ALIGNMENT)), *parts)


def _unpacked(memory: torch.Tensor, layout: _Layout, names: list[str], others: dict[str, Any]) -> Batch:
    values = _views(memory, layout) | others
    return Batch({name: values[name] for name in names})


ForkingPickler.register(Batch, _reduce)
