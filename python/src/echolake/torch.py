"""Training sets of ``echolake export ml`` for torch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, cast

import torch
from numpy.typing import NDArray
from torch.utils.data import IterableDataset, get_worker_info

from echolake._batch import Batch, Memory
from echolake.training import BatchDict, Kind, LakeQuery, MeasurementBatches, MeasurementRows

__all__ = ["Batch", "LakeQuery", "MeasurementRows", "Measurements"]


class Measurements(MeasurementBatches, IterableDataset[Batch]):
    """Batches of measurements, as tensors, in an order that ranks and workers do not change.

    Give it to ``DataLoader(dataset, batch_size=None, num_workers=N)`` or torchdata's ``StatefulDataLoader``: it makes
    batches itself. Ranks are those of ``torch.distributed`` unless they are given. ``MeasurementBatches`` tells the
    order, what a rank gets, and the state; ``MeasurementRows`` gives single rows to a sampler.

    ``batch["heights"][batch["surface"]]`` (with ``heights=True``) has a map for each row.
    """

    def __init__(
        self,
        path: str | Path | LakeQuery,
        split: Literal["train", "validation", "test"] = "train",
        columns: Sequence[str] | None = None,
        *,
        rank: int | None = None,
        world_size: int | None = None,
        **settings: Any,
    ) -> None:
        distributed = torch.distributed.is_available() and torch.distributed.is_initialized()
        if rank is None:
            rank = torch.distributed.get_rank() if distributed else 0
        if world_size is None:
            world_size = torch.distributed.get_world_size() if distributed else 1
        super().__init__(path, split, columns, rank=rank, world_size=world_size, **settings)
        # Workers that outlive an epoch see where the next one begins; this process sees how many there are.
        self._place = torch.zeros(3, dtype=torch.int64).share_memory_()
        self._pending = torch.zeros(len(self._pending), dtype=torch.int8).share_memory_()
        self._memory: Memory | None = None

    def __iter__(self) -> Iterator[Batch]:
        info = get_worker_info()
        # What a worker gave away is in use until the training process drops it; a forked copy knows nothing of that.
        if info is None or self._memory is None:
            self._memory = Memory()
        self._place[2] = info.num_workers if info else 0
        share = self.iterate_share(info.id, info.num_workers) if info else self.iterate_share(0, 1)
        return cast(Iterator[Batch], share)

    def state_dict(self, after: Mapping[str, Any] | None = None) -> dict[str, Any]:
        if after is None and get_worker_info() is None and self._place[2] > 0:
            raise ValueError("workers make the batches, and are ahead of training; hint: state_dict(after=batch)")
        return super().state_dict(after)

    # A worker's state is its own: the others may have begun already.
    def _own_workers(self) -> int | slice:
        info = get_worker_info()
        return slice(None) if info is None else info.id

    def _allocate(self, kinds: Mapping[str, Kind]) -> tuple[BatchDict, dict[str, NDArray[Any]]]:
        assert self._memory is not None
        batch = self._memory.allocate_batch(kinds)
        return batch, {name: values.numpy() for name, values in batch.items()}
