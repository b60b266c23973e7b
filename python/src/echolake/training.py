"""Training sets of ``echolake export ml`` without torch: rows by number, and batches of NumPy arrays in one order.

The order of an epoch follows from seed and epoch alone: batch ``k`` has the same rows with any number of ranks and
workers, and a run that stopped continues at batch ``k`` without reading what came before it.
"""

from __future__ import annotations

import json
import os
import warnings
import weakref
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from threading import Lock
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from echolake._sets import SetFiles
from echolake.lake_query import LakeQuery, QueriedSet
from echolake.symmetry import NAMES, turn_heights, turn_positions

__all__ = ["BatchDict", "EpochOrder", "LakeQuery", "MeasurementBatches", "MeasurementRows", "OrderSettings"]

BatchDict = dict[str, Any]
Kind = tuple[np.dtype[Any], tuple[int, ...]]
Numbers = NDArray[np.int64]
Allocate = Callable[[Mapping[str, Kind]], tuple[BatchDict, dict[str, NDArray[Any]]]]
"""Makes a batch of the given types and shapes, and the arrays to fill."""
_READERS = 2
_BATCHES_AHEAD = 32
_MOST_WORKERS = 1024
"""Workers that can be told apart when an iteration begins where a state was made."""
_POSITIONS = ("microphone_mm", "speaker_mm")
_MEASURED = ("pair_id", "microphone", "speaker", "swapped")
"""Columns that name points and pairs of the grid: a row turned while loading has positions only."""


@dataclass(frozen=True)
class OrderSettings:
    """Settings that decide which rows a batch has.

    An epoch is a sequence of all rows. Clumps of consecutive rows of a surface are permuted: ``clump`` rows each, or
    whole surfaces. Then the rows of each ``mix`` consecutive clumps are permuted among each other. Batches are cut from
    the sequence and dealt in turn from ``lanes`` stretches of it: if ranks times workers divides ``lanes``, each
    process reads stretches of its own, so hardly any surface is read by two of them.
    """

    batch_size: int = 512
    clump: int | Literal["surface"] = "surface"
    mix: int = 4
    lanes: int = 4
    shuffle: bool = True
    drop_last: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("batch_size", "clump", "mix", "lanes"):
            value = getattr(self, name)
            if not (value == "surface" and name == "clump") and (isinstance(value, str) or value < 1):
                raise ValueError(f"{name} {value!r}, expected 1 at least" + ' or "surface"' * (name == "clump"))


class EpochOrder:
    """The rows of each batch of an epoch, computed from the surfaces' row counts."""

    def __init__(self, sizes: Numbers, settings: OrderSettings, epoch: int) -> None:
        rows = int(sizes.sum())
        self.settings = settings
        self.batches = rows // settings.batch_size if settings.drop_last else -(-rows // settings.batch_size)
        self.rows = min(rows, self.batches * settings.batch_size)
        self._epoch = epoch
        self._windows: dict[int, Numbers] = {}
        if settings.shuffle and settings.clump == 1:
            self._firsts = self._make_generator(0).permutation(rows)
        elif settings.shuffle:
            firsts, counts = _cut_clumps(sizes, settings.clump)
            order = self._make_generator(0).permutation(len(firsts))
            self._firsts, self._counts = firsts[order], counts[order]
            self._ends = np.cumsum(self._counts)
            self._window_ends = np.append(self._ends[settings.mix - 1 : -1 : settings.mix], self._ends[-1:])

    def compute_rows(self, batch: int) -> Numbers:
        """Numbers of the rows of a batch, ``[batch_size]``; the sequence's last batch may be short."""
        start = self._locate_batch(batch) * self.settings.batch_size
        places = np.arange(start, min(start + self.settings.batch_size, self.rows))
        if not self.settings.shuffle:
            return places
        if self.settings.clump == 1:
            return self._firsts[places]
        if self.settings.mix > 1:
            places = self._mix_places(places)
        clumps = np.searchsorted(self._ends, places, side="right")
        return self._firsts[clumps] + places - (self._ends[clumps] - self._counts[clumps])

    def draw_symmetries(self, surfaces: int) -> Numbers:
        """A symmetry for each surface, as its place in ``NAMES``."""
        return self._make_generator(1).randint(len(NAMES), size=surfaces)

    # The stretch of lane i begins at its share of the batches; the first lanes have one more where shares are unequal.
    def _locate_batch(self, batch: int) -> int:
        lanes = self.settings.lanes if self.settings.shuffle else 1
        share, more = divmod(self.batches, lanes)
        lane = batch % lanes
        return lane * share + min(lane, more) + batch // lanes

    def _mix_places(self, places: Numbers) -> Numbers:
        windows = np.searchsorted(self._window_ends, places, side="right")
        mixed = np.empty_like(places)
        for window in np.unique(windows):
            start = self._window_ends[window - 1] if window > 0 else 0
            here = windows == window
            mixed[here] = start + self._permute_window(int(window), int(start))[places[here] - start]
        return mixed

    def _permute_window(self, window: int, start: int) -> Numbers:
        if window not in self._windows:
            if len(self._windows) > 2 * self.settings.lanes:
                self._windows.clear()
            self._windows[window] = self._make_generator(2, window).permutation(int(self._window_ends[window]) - start)
        return self._windows[window]

    # NumPy promises for this class alone that its numbers stay the same in later versions.
    def _make_generator(self, *purpose: int) -> np.random.RandomState:
        return np.random.RandomState(
            np.random.MT19937(np.random.SeedSequence([self.settings.seed, self._epoch, *purpose]))
        )


# First row and number of rows of each clump.
def _cut_clumps(sizes: Numbers, clump: int | str) -> tuple[Numbers, Numbers]:
    starts = np.cumsum(sizes) - sizes
    if isinstance(clump, str):
        return starts, sizes
    pieces = -(-sizes // clump)
    within = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    return np.repeat(starts, pieces) + within * clump, np.minimum(clump, np.repeat(sizes, pieces) - within * clump)


@dataclass
class _SurfaceRows:
    """Decoded rows of a row group; ``of_row`` points into ``NAMES``."""

    columns: dict[str, NDArray[Any]]
    surface_id: str
    of_row: Numbers


def _allocate_arrays(kinds: Mapping[str, Kind]) -> tuple[BatchDict, dict[str, NDArray[Any]]]:
    arrays = {name: np.empty(shape, dtype) for name, (dtype, shape) in kinds.items()}
    return dict(arrays), arrays


class _ProcessState:
    """Threads and decoded rows of one process; a forked one makes its own."""

    def __init__(self, path: str | LakeQuery) -> None:
        self.process = os.getpid()
        self.set: SetFiles | QueriedSet = QueriedSet(path) if isinstance(path, LakeQuery) else SetFiles(path)
        self.threads = ThreadPoolExecutor(_READERS)
        self.lock = Lock()
        self.surfaces: OrderedDict[int, Future[_SurfaceRows]] = OrderedDict()
        # Arrays of surfaces that nothing uses any more: new memory would take as long as decoding into it.
        self.spare: deque[dict[str, NDArray[Any]]] = deque()


class MeasurementRows:
    """Rows of a split by number, in the order of its files: a source for samplers of torch and for grain.

    ``path`` is a folder, an address ``http://`` of one (needs fsspec and aiohttp), a bucket's URI that pyarrow
    reads, as ``s3://bucket/prefix?endpoint_override=...``, or a :class:`LakeQuery` of a served lake. A process keeps
    decoded surfaces up to ``memory`` bytes. With ``symmetries="all"`` each surface comes under all eight, one after the
    other. Rows are dicts of NumPy values, of the ``columns`` and of the positions, which every set has.

    ``heights=64`` gives maps of 64 x 64 cells, each the mean of those beneath it. ``normalise`` subtracts the mean of
    split train from columns of floats and from heights, and divides by its standard deviation. ``spectra=["ir"]`` adds
    ``ir_spectrum``, ``[samples / 2 + 1]`` complex: the sum of x[n] exp(-2 pi i k n / samples) at ``frequencies_hz``, in
    the response's unit, never normalised.
    """

    def __init__(
        self,
        path: str | Path | LakeQuery,
        split: Literal["train", "validation", "test"] = "train",
        columns: Sequence[str] | None = None,
        *,
        heights: bool | int = False,
        symmetries: Literal["none", "random", "all"] = "none",
        spectra: Sequence[str] = (),
        normalise: bool = False,
        memory: int = 256 << 20,
    ) -> None:
        self.path: str | LakeQuery = path.pin_version() if isinstance(path, LakeQuery) else str(path)
        self.split, self.symmetries, self.heights = split, symmetries, heights
        self._state: _ProcessState | None = None
        source = self._process_state().set
        contents = source.describe_split(split)
        self._groups, self._is_turned = contents.groups, contents.is_turned
        #: Digest of the set: of its checksums, else of its files' names and rows.
        self.digest = contents.digest
        #: Names of the files, in a set that has files.
        self.files = list(dict.fromkeys(group.file for group in self._groups))
        self._copies = len(NAMES) if symmetries == "all" else 1
        #: Rows of each surface, ``[surfaces]``, each of its symmetries for itself.
        self.sizes = np.repeat(np.array([group.rows for group in self._groups], np.int64), self._copies)
        self._ends = np.cumsum(self.sizes)
        if self._is_turned and symmetries != "none":
            raise ValueError('the training set has its symmetries already; take symmetries="none"')
        schema = contents.schema
        without = () if symmetries == "none" else _MEASURED
        self.columns = _numeric_columns(schema, contents.defaults, columns, without)
        self._kinds = {name: _column_kind(schema.field(name)) for name in self.columns}
        self.spectra = {f"{name}_spectrum": name for name in spectra}
        if missing := [name for name in spectra if not self._kinds.get(name, (None, ()))[1]]:
            raise KeyError(f"no spectra of {json.dumps(missing)}, which are no columns of responses")
        self._rates_hz = {name: (schema.field(name).metadata or {}).get(b"rate_hz") for name in spectra}
        #: Mean and standard deviation of the columns that are normalised.
        self.statistics = self._read_statistics(source.read_statistics()) if normalise else {}
        row_bytes = sum(dtype.itemsize * int(np.prod(shape)) for dtype, shape in self._kinds.values()) + 8
        surface_bytes = row_bytes * int(self.sizes.max())
        #: Decoded surfaces that a process keeps, and the bytes of all.
        self.capacity, self.all_bytes = max(1, memory // surface_bytes), surface_bytes * len(self._groups)
        self._heights: dict[str, tuple[NDArray[np.float32], float]] | None = None

    def __len__(self) -> int:
        return int(self.sizes.sum())

    def __getitem__(self, number: int) -> BatchDict:
        return self.__getitems__([number])[0]

    def __getitems__(self, numbers: Sequence[int]) -> list[BatchDict]:
        if self.symmetries == "random":
            raise ValueError('rows by number are under no or all symmetries; take symmetries="all" and draw rows')
        if not all(-len(self) <= number < len(self) for number in numbers):
            raise IndexError(f"no row {list(numbers)}; there are {len(self)}")
        wanted = np.array(numbers, np.int64) % len(self)
        batch = self.read_rows(wanted)
        found = []
        for row in np.searchsorted(np.sort(wanted), wanted).tolist():
            place = batch["surface"][row]
            values = {name: batch[name][row] for name in (*self.columns, *self.spectra)}
            values |= {"surface_id": batch["surface_ids"][place], "symmetry": batch["symmetries"][place]}
            found.append(values | {name: batch[name][place] for name in ("heights", "size_mm") if self.heights})
        return found

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_state": None}

    def frequencies_hz(self, response: str) -> NDArray[Any]:
        """Frequencies of the bins of a response's spectrum."""
        if not (rate_hz := self._rates_hz.get(response)):
            raise KeyError(f"no rate of `{response}`; hint: name it in spectra; a set that is older, export again")
        return np.fft.rfftfreq(self._kinds[response][1][0], 1 / float(rate_hz))

    def find_surfaces(self, numbers: Numbers) -> set[int]:
        """The surfaces that rows are of."""
        return set((np.unique(np.searchsorted(self._ends, numbers, side="right")) // self._copies).tolist())

    def start_reading(self, surfaces: set[int]) -> list[Future[_SurfaceRows]]:
        """Reads surfaces in threads; those used least recently make room."""
        state = self._process_state()
        with state.lock:
            for surface in sorted(surfaces):
                if surface not in state.surfaces:
                    state.surfaces[surface] = state.threads.submit(self._read_surface, state, surface)
                state.surfaces.move_to_end(surface)
            coming = [state.surfaces[surface] for surface in sorted(surfaces)]
            while len(state.surfaces) > max(self.capacity, len(surfaces)):
                state.surfaces.popitem(last=False)
        return coming

    def read_rows(
        self, numbers: Numbers, drawn: Numbers | None = None, allocate: Allocate = _allocate_arrays
    ) -> BatchDict:
        """Rows by number, under the symmetries ``drawn`` for surfaces; those of a surface stand together.

        Columns have shape ``[rows, ...]``; ``surface`` points into ``surface_ids`` and ``symmetries``; ``heights`` on
        request are ``[len(surface_ids), cells, cells]`` in mm, of panels whose edges are ``size_mm``.
        """
        numbers = np.sort(numbers)
        items, firsts = np.unique(np.searchsorted(self._ends, numbers, side="right"), return_index=True)
        # A set that was exported under all symmetries has each of them in a row group.
        named = [NAMES if self._is_turned else (self._select_symmetry(item, drawn),) for item in items.tolist()]
        kinds = {name: (dtype, (len(numbers), *shape)) for name, (dtype, shape) in self._kinds.items()}
        for name, of in self.spectra.items():
            kinds[name] = np.dtype(np.complex64), (len(numbers), self._kinds[of][1][0] // 2 + 1)
        kinds["surface"] = np.dtype(np.int64), (len(numbers),)
        if self.heights:
            maps = sum(len(names) for names in named)
            cells = next(iter(self._known_heights().values()))[0].shape
            kinds["heights"], kinds["size_mm"] = (np.dtype(np.float32), (maps, *cells)), (np.dtype(np.float32), (maps,))
        batch, arrays = allocate(kinds)
        surface_ids: list[str] = []
        stops = [*firsts[1:].tolist(), len(numbers)]
        for item, names, first, stop in zip(items.tolist(), named, firsts.tolist(), stops, strict=True):
            read = self._surface_rows(item // self._copies)
            rows = numbers[first:stop] - (self._ends[item] - self.sizes[item])
            for name in self.columns:
                # Any mode but the default lets NumPy write to the place itself.
                read.columns[name].take(rows, axis=0, out=arrays[name][first:stop], mode="clip")
                if name in _POSITIONS and not self._is_turned and names != ("identity",):
                    arrays[name][first:stop] = turn_positions(arrays[name][first:stop], names[0])
            arrays["surface"][first:stop] = len(surface_ids) + read.of_row[rows] * self._is_turned
            for name in names if self.heights else ():
                place = len(surface_ids) + names.index(name)
                height, arrays["size_mm"][place] = self._known_heights()[read.surface_id]
                arrays["heights"][place] = turn_heights(height, name)
            surface_ids += [read.surface_id] * len(names)
        for name, of in self.spectra.items():
            arrays[name][...] = np.fft.rfft(arrays[of])
        for name in arrays.keys() & self.statistics.keys():
            mean, deviation = self.statistics[name]
            arrays[name] -= mean
            arrays[name] /= deviation
        batch["surface_ids"], batch["symmetries"] = surface_ids, [name for names in named for name in names]
        return batch

    def _select_symmetry(self, item: int, drawn: Numbers | None) -> str:
        return NAMES[item % self._copies if drawn is None else int(drawn[item])]

    def _read_statistics(self, columns: dict[str, Any]) -> dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]]:
        found = {}
        for name, stored in [*((name, name) for name in self.columns), ("heights", "heights_mm")]:
            if column := columns.get(stored):
                mean, deviation = (np.array(column[key], np.float32) for key in ("mean", "standard_deviation"))
                # A column of one value is 0.
                found[name] = mean, np.where(deviation > 0, deviation, np.float32(1))
        return found

    def _process_state(self) -> _ProcessState:
        if self._state is None or self._state.process != os.getpid():
            self._state = _ProcessState(self.path)
        return self._state

    def _surface_rows(self, surface: int) -> _SurfaceRows:
        coming = self.start_reading({surface})[0]
        try:
            return coming.result()
        except BaseException:
            self._process_state().surfaces.pop(surface, None)
            raise

    # Nearly all of a row group is one column; readers side by side do more than threads within one.
    def _read_surface(self, state: _ProcessState, surface: int) -> _SurfaceRows:
        group = self._groups[surface]
        names = [*self.columns, "surface_id", "symmetry"]
        try:
            columns = state.spare.pop()
        except IndexError:
            rows = int(self.sizes.max())
            columns = {name: np.empty((rows, *shape), dtype) for name, (dtype, shape) in self._kinds.items()}

        def copy_batches(batches: Iterator[pa.RecordBatch]) -> pa.Table:
            told = []
            start = 0
            for rows in batches:
                for name in self.columns:
                    columns[name][start : start + rows.num_rows] = _column_values(rows.column(name))
                told.append(rows.select(["surface_id", "symmetry"]))
                start += rows.num_rows
            return pa.Table.from_batches(told)

        table = state.set.read_group(group, names, copy_batches)
        coded = table.column("symmetry").combine_chunks().dictionary_encode()
        places = np.array([NAMES.index(name) for name in coded.dictionary.to_pylist()])
        read = _SurfaceRows(columns, table.column("surface_id")[0].as_py(), places[coded.indices.to_numpy()])
        weakref.finalize(read, state.spare.append, columns)
        return read

    def _known_heights(self) -> dict[str, tuple[NDArray[np.float32], float]]:
        if self._heights is None:
            table = self._process_state().set.read_height_maps(self.split)
            values = _column_values(table.column("heights_mm").combine_chunks())
            cells = round(values.shape[1] ** 0.5)
            wanted = cells if self.heights is True else self.heights
            if wanted < 1 or cells % wanted > 0:
                raise ValueError(f"heights={wanted}, expected a divisor of the {cells} cells of the set's maps")
            maps = values.reshape(-1, wanted, cells // wanted, wanted, cells // wanted).mean((2, 4))
            sizes = table.column("size_mm").to_pylist()
            maps_of_sizes = zip(maps, sizes, strict=True)
            self._heights = dict(zip(table.column("surface_id").to_pylist(), maps_of_sizes, strict=True))
        return self._heights


class MeasurementBatches:
    """Batches of a split as dicts of NumPy arrays, in the order of ``OrderSettings``.

    Batch ``k`` goes to rank ``k % world_size``, whose batches go to its workers in turn. All ranks have as many
    batches: the last ones begin with the epoch's first again (``drop_last=True`` leaves out instead what does not fill
    a batch for every rank). So with one rank each row comes once in an epoch; to evaluate, read with one.

    ``len`` is the number of batches of this rank, ``rows()`` that of rows of all ranks. A batch has the columns of
    ``MeasurementRows.read_rows`` and its number ``batch`` in the epoch.

    ``symmetries``: ``"none"``; ``"random"``, each surface under one of the eight, another one every epoch; ``"all"``,
    each under every one. Positions and height maps turn together; microphone and speaker keep their roles, so that
    nothing relies on reciprocity. Responses and levels stay as they were measured, although the rig's aim and
    directivity do not turn with a panel: energies are off by 0.5 dB rms at 20 kHz and 1 dB at 40 kHz, levels over
    Flat's total by 0.1 to 0.6 dB, levels over Flat's same band (``tnce_band_*``) by 0.2 dB or less.
    """

    def __init__(
        self,
        path: str | Path | LakeQuery,
        split: Literal["train", "validation", "test"] = "train",
        columns: Sequence[str] | None = None,
        *,
        heights: bool | int = False,
        symmetries: Literal["none", "random", "all"] = "none",
        spectra: Sequence[str] = (),
        normalise: bool = False,
        memory: int = 256 << 20,
        rank: int = 0,
        world_size: int = 1,
        **order: Any,
    ) -> None:
        super().__init__()
        known = [field.name for field in fields(OrderSettings)]
        if unknown := [name for name in order if name not in known]:
            raise TypeError(f"no settings {json.dumps(unknown)}; an order has {json.dumps(known)}")
        if not 0 <= rank < world_size:
            raise ValueError(f"rank {rank} of {world_size}")
        if order.get("shuffle") is None:
            order["shuffle"] = split == "train"
        self.settings = OrderSettings(**order)
        inputs: dict[str, Any] = {"heights": heights, "symmetries": symmetries, "spectra": spectra}
        self.source = MeasurementRows(path, split, columns, **inputs, normalise=normalise, memory=memory)
        if self.settings.shuffle and self.settings.clump != "surface" and self.source.all_bytes > memory:
            warnings.warn(
                f"clump={self.settings.clump} decodes surfaces again and again: all of them take "
                f"{-(-self.source.all_bytes >> 20)} MiB, memory has {memory >> 20} MiB a process; hint: give more "
                'memory, or clump="surface" with a larger mix',
                stacklevel=2,
            )
        self.columns, self.rank, self.world_size = self.source.columns, rank, world_size
        # Epoch, and the batch that a loaded state continues with.
        self._place: Any = np.zeros(2, np.int64)
        # 1 for each worker whose next iteration begins there: only the first one after a state was loaded does.
        self._pending: Any = np.zeros(_MOST_WORKERS, np.int8)
        self._order: tuple[int, EpochOrder] | None = None
        # Where the iteration began, batches given since then, and among how many workers.
        self._start, self._given, self._workers = 0, 0, 1
        self._resumed: tuple[int, int, int] | None = None

    @property
    def epoch(self) -> int:
        """The epoch that the next iteration is of."""
        return int(self._place[0])

    def set_epoch(self, epoch: int) -> None:
        """Shuffles and turns anew; an epoch that a state was loaded for continues where it was."""
        if epoch != self.epoch:
            self._place[0], self._place[1] = epoch, 0
            self._start, self._given = 0, 0

    def __len__(self) -> int:
        return self._shared_batches(0)

    def rows(self) -> int:
        """Rows of an epoch, over all ranks, none twice."""
        return self.current_order().rows

    def current_order(self) -> EpochOrder:
        """The order of the current epoch."""
        if self._order is None or self._order[0] != self.epoch:
            self._order = self.epoch, EpochOrder(self.source.sizes, self.settings, self.epoch)
        return self._order[1]

    def __iter__(self) -> Iterator[BatchDict]:
        return self.iterate_share(0, 1)

    def iterate_share(self, worker: int, workers: int) -> Iterator[BatchDict]:
        """The batches of one of a rank's workers; surfaces of the next ones are being read meanwhile.

        The first iteration after a state was loaded has the rest of its epoch, later ones have whole epochs.
        """
        if workers > _MOST_WORKERS:
            raise ValueError(f"{workers} workers, expected {_MOST_WORKERS} at most")
        order, start = self.current_order(), int(self._place[1]) * int(self._pending[worker])
        # Nor does a later iteration with more workers, or one whose first was left before all of them began.
        self._pending[worker if start else slice(None)] = 0
        self._pending[workers:] = 0
        drawn = order.draw_symmetries(len(self.source.sizes)) if self.source.symmetries == "random" else None
        self._start, self._given, self._workers = start, 0, workers
        resumed, self._resumed = self._resumed, None
        if resumed and resumed[0] == self.epoch:
            if resumed[2] != workers:
                raise ValueError(
                    f"the state is of a worker among {resumed[2]}, there are {workers}; hint: "
                    "state_dict(after=batch) in the training process is good for any number"
                )
            self._given = resumed[1]
        planned: deque[tuple[int, Numbers, set[int]]] = deque()
        for share in range(worker + self._given * workers, self._shared_batches(start), workers):
            number = start + share * self.world_size + self.rank
            rows = order.compute_rows(number % order.batches)
            surfaces = self.source.find_surfaces(rows)
            while planned and (
                len(planned) == _BATCHES_AHEAD
                or len(surfaces.union(*(others for _, _, others in planned))) > self.source.capacity
            ):
                yield self._read_batch(*planned.popleft()[:2], drawn)
            if len(surfaces) <= self.source.capacity:
                self.source.start_reading(surfaces)
            planned.append((number, rows, surfaces))
        while planned:
            yield self._read_batch(*planned.popleft()[:2], drawn)

    def state_dict(self, after: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """What continues an epoch: settings, epoch and the next batch, for any number of ranks and workers.

        ``after`` is the batch that this rank took last. Without it the state is that of this process; torch's
        ``StatefulDataLoader`` asks each of several workers for one, which is good for as many workers only.
        """
        epoch, start = self.epoch, self._start
        if after is None and self._workers > 1:
            share = {"given": self._given, "workers": self._workers}
            return self._describe_set() | {"epoch": epoch, "batch": start} | share
        if after is not None:
            start = after["batch"] - self.rank + self.world_size
        else:
            start += self._given * self.world_size
        if self._shared_batches(start) == 0:
            epoch, start = epoch + 1, 0
        return self._describe_set() | {"epoch": epoch, "batch": start}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues where a state was made, with other ranks and workers, too.

        The next iteration has the rest of the state's epoch. If that is less than a batch for each rank, and
        ``drop_last`` leaves it out, it is the epoch after that.
        """
        for name, value in self._describe_set().items():
            if state.get(name) != value:
                raise ValueError(f"the state is of a set with {name} {state.get(name)!r}, this one has {value!r}")
        self._place[0], self._place[1] = state["epoch"], state["batch"]
        self._resumed = (state["epoch"], state["given"], state["workers"]) if "workers" in state else None
        if self._resumed is None and self._shared_batches(state["batch"]) == 0:
            self._place[0], self._place[1] = state["epoch"] + 1, 0
        self._start = int(self._place[1])
        self._given, self._workers = self._resumed[1:] if self._resumed else (0, 1)
        self._pending[self._own_workers()] = 1

    # The workers that a state which is loaded in this process is for.
    def _own_workers(self) -> int | slice:
        return slice(None)

    def _describe_set(self) -> dict[str, Any]:
        named = {"set": self.source.digest, "split": self.source.split, "symmetries": self.source.symmetries}
        return named | asdict(self.settings)

    # Batches of each rank from batch `start` of the epoch on.
    def _shared_batches(self, start: int) -> int:
        left = self.current_order().batches - start
        return max(0, left // self.world_size if self.settings.drop_last else -(-left // self.world_size))

    def _read_batch(self, number: int, rows: Numbers, drawn: Numbers | None) -> BatchDict:
        batch = self.source.read_rows(rows, drawn, self._allocate)
        batch["batch"] = number
        self._given += 1
        return batch

    def _allocate(self, kinds: Mapping[str, Kind]) -> tuple[BatchDict, dict[str, NDArray[Any]]]:
        return _allocate_arrays(kinds)


# Type and shape of a row; where a number may be missing, it has to be one that can be NaN.
def _column_kind(field: pa.Field) -> Kind:
    if pa.types.is_fixed_size_list(field.type):
        return np.dtype(field.type.value_type.to_pandas_dtype()), (field.type.list_size,)
    dtype = np.dtype(field.type.to_pandas_dtype())
    return (np.dtype(np.float64) if field.nullable and dtype.kind != "f" else dtype), ()


def _numeric_columns(
    schema: pa.Schema, defaults: Sequence[str], columns: Sequence[str] | None, without: Sequence[str]
) -> list[str]:
    known = [field.name for field in schema if not pa.types.is_string(field.type) and field.name not in without]
    if columns is None:
        return [name for name in known if name in defaults]
    unknown = [name for name in columns if name not in known]
    if unknown:
        raise KeyError(f"no columns {json.dumps(unknown)}; there are {json.dumps(known)}")
    # A response means nothing without the places that it was measured at.
    return [*columns, *(name for name in _POSITIONS if name in known and name not in columns)]


# Numbers of a column, without a copy where Arrow has them in one piece; a missing list is NaN.
def _column_values(array: pa.Array) -> NDArray[Any]:
    if not pa.types.is_fixed_size_list(array.type):
        plain: NDArray[Any] = array.to_numpy(zero_copy_only=False)
        return plain
    given: NDArray[Any] = array.flatten().to_numpy(zero_copy_only=False).reshape(-1, array.type.list_size)
    if array.null_count == 0:
        return given
    values = np.full((len(array), array.type.list_size), np.nan, given.dtype)
    values[array.is_valid().to_numpy(zero_copy_only=False)] = given
    return values
