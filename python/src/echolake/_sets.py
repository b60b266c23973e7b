"""The files of an exported training set, in a folder, at an address or in a bucket."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import pyarrow as pa
import pyarrow.fs as pa_fs
import pyarrow.parquet as pq

_Result = TypeVar("_Result")
RETRY_SECS = (0.1, 0.2, 0.4, 0.8, 1.6)
_ROWS_AT_ONCE = 1024
"""Rows to decode at once: few enough to be copied before they leave the processor's cache."""


@dataclass(frozen=True)
class RowGroup:
    """The rows of a surface: a row group of a file, or of a query."""

    file: str
    number: int
    rows: int
    metadata: Any = field(default=None, repr=False)


@dataclass(frozen=True)
class SplitContents:
    """What a split has: its surfaces' rows, the columns there are, and those taken unless others are named."""

    groups: list[RowGroup]
    schema: pa.Schema
    defaults: list[str]
    digest: str
    is_turned: bool


class SetFiles:
    """A folder of ``echolake export ml``."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.is_local = "://" not in path
        self.root = path.rstrip("/")
        self.filesystem: pa_fs.FileSystem | None = None
        if path.startswith(("http://", "https://")):
            import fsspec

            # pyarrow asks for the ranges of a row group in few pieces itself.
            self.open: Callable[[str], Any] = fsspec.filesystem("http", cache_type="none").open
        else:
            if self.is_local:
                self.filesystem, self.root = pa_fs.LocalFileSystem(use_mmap=True), str(Path(path).absolute())
            else:
                self.filesystem, self.root = pa_fs.FileSystem.from_uri(self.root)
            self.open = self.filesystem.open_input_file

    def describe_split(self, split: str) -> SplitContents:
        """Reads the checksums and the footers of a split's files."""
        try:
            sums = self._read_file("SHA256SUMS", lambda file: file.read().decode())
        except FileNotFoundError:
            sums = ""
        names = [line.split(maxsplit=1)[1].lstrip("*") for line in sums.splitlines()] or self._list_folder("data")
        files = sorted(name for name in names if name.startswith(f"data/{split}-") and name.endswith(".parquet"))
        if not files:
            raise FileNotFoundError(f"no data/{split}-*.parquet in `{self.path}`; is it made by `echolake export ml`?")
        with ThreadPoolExecutor() as threads:
            read = list(threads.map(lambda name: self._read_file(name, pq.read_metadata), files))
        footers = dict(zip(files, read, strict=True))
        counts = {name: [f.row_group(i).num_rows for i in range(f.num_row_groups)] for name, f in footers.items()}
        digest = hashlib.sha256((sums or json.dumps(counts)).encode()).hexdigest()[:16]
        groups = [RowGroup(file, i, n, footers[file]) for file in files for i, n in enumerate(counts[file]) if n > 0]
        schema = footers[files[0]].schema.to_arrow_schema()
        first = self.read_group(groups[0], ["symmetry"], pa.Table.from_batches)
        is_turned = set(first.column(0).to_pylist()) != {"identity"}
        return SplitContents(groups, schema, schema.names, digest, is_turned)

    def read_group(
        self, group: RowGroup, names: Sequence[str], read: Callable[[Iterator[pa.RecordBatch]], _Result]
    ) -> _Result:
        """What ``read`` makes of the batches of a row group."""

        def read_batches(file: Any) -> _Result:
            opened = pq.ParquetFile(file, metadata=group.metadata, pre_buffer=not self.is_local)
            return read(opened.iter_batches(_ROWS_AT_ONCE, [group.number], list(names), use_threads=False))

        return self._read_file(group.file, read_batches)

    def read_height_maps(self, split: str) -> pa.Table:
        """``surface_id``, ``size_mm`` and ``heights_mm`` of a split's surfaces."""
        name, columns = f"heightmaps/{split}.parquet", ["surface_id", "size_mm", "heights_mm"]

        def read_maps(file: Any) -> pa.Table:
            return pq.read_table(file, columns=columns, filters=[("symmetry", "=", "identity")])

        try:
            return self._read_file(name, read_maps)
        except FileNotFoundError as missing:
            raise FileNotFoundError(f"`{self.path}/{name}` is not there: the lake has no height maps") from missing

    def read_statistics(self) -> dict[str, Any]:
        """Mean and standard deviation of columns over split train."""
        try:
            columns: dict[str, Any] = self._read_file("statistics.json", json.load)["columns"]
        except FileNotFoundError as missing:
            raise FileNotFoundError(f"no statistics.json in `{self.path}`; hint: export the set again") from missing
        return columns

    def _read_file(self, name: str, read: Callable[[Any], _Result]) -> _Result:
        def read_once() -> _Result:
            with self.open(f"{self.root}/{name}") as file:
                return read(file)

        return retry_read(read_once, () if self.is_local else RETRY_SECS)

    def _list_folder(self, name: str) -> list[str]:
        if self.filesystem is None:
            return []
        found = self.filesystem.get_file_info(pa_fs.FileSelector(f"{self.root}/{name}", allow_not_found=True))
        return [f"{name}/{file.base_name}" for file in found]


def retry_read(read: Callable[[], _Result], waits: Sequence[float]) -> _Result:
    """What ``read`` returns; it is tried again after each of ``waits``, in seconds."""
    try:
        return read()
    except (FileNotFoundError, LookupError):
        raise
    except Exception:
        if not waits:
            raise
    time.sleep(waits[0])
    return retry_read(read, waits[1:])
