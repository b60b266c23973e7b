"""A training set that queries of a served lake give, without an export."""

from __future__ import annotations

import hashlib
import json
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import pyarrow as pa

from echolake._sets import RETRY_SECS, RowGroup, SplitContents, retry_read
from echolake.contributions import read_refusal

__all__ = ["LakeQuery"]

_Result = TypeVar("_Result")
_TIMEOUT_SECS = 120
_KEYS = ("surface_id", "run_id", "pair_id", "microphone", "speaker")
_NOT_CHOSEN = (*_KEYS, "log_time_ns", "chunk_offset")


@dataclass(frozen=True)
class LakeQuery:
    """Surfaces of the lake that ``echolake serve`` serves at ``url``, split as ``echolake export ml`` splits them.

    ``where`` selects surfaces, a predicate over view ``catalogue``. ``as_of`` is a version of the lake, a tag or a
    time; without it, the newest version when the set is opened. References and rejected measurements are left out.
    ``seed`` draws the panels that are held out. ``token`` needs the scope ``sql``.
    """

    url: str
    where: str = "true"
    as_of: str | int | None = None
    seed: int = 1
    token: str | None = field(default=None, repr=False)

    def pin_version(self) -> LakeQuery:
        """The same query of one version of the lake."""
        if self.as_of is not None:
            return self
        newest = _ask_server(self, "select max(version) as newest from system.versions where \"table\" = 'runs'")
        if (version := newest.column("newest")[0].as_py()) is None:
            raise LookupError(f"{self.url} tells no versions to this token; hint: as_of=")
        return replace(self, as_of=version)


class QueriedSet:
    """Reads a set by queries, one for the rows of a surface. ``query`` names its version."""

    is_local = False

    def __init__(self, query: LakeQuery) -> None:
        self.query = query

    def describe_split(self, split: str) -> SplitContents:
        """Asks for the surfaces, their splits and numbers of rows."""
        listed = (
            "select listed.surface_id, panel, typology = 'reference' or named.surface_id is not null as is_reference "
            f"from {self._relation('surfaces')} listed "
            f"join (select distinct surface_id from {self._relation('tnce')}) derived "
            "on derived.surface_id = listed.surface_id "
            f"join (select surface_id from {self._relation('catalogue')} where (\n{self.query.where}\n)) selected "
            "on selected.surface_id = listed.surface_id "
            f"left join (select flat_reference as surface_id from {self._relation('surfaces')} "
            f"union select foam_reference from {self._relation('surfaces')}) named "
            "on named.surface_id = listed.surface_id"
        )
        surfaces = self._ask(
            f"select listed.*, rows from ({listed}) listed "
            f"left join (select surface_id, count(*) as rows from {self._relation('tnce_db')} group by surface_id) "
            "counted on counted.surface_id = listed.surface_id order by listed.surface_id"
        ).to_pylist()
        # SQL has signed numbers; a seed of export ml has as many bits.
        seed = int.from_bytes(self.query.seed.to_bytes(8, "little"), "little", signed=True)
        drawn = self._ask(f"select panel_splits(surface_id, is_reference, {seed}) as splits from ({listed}) listed")
        splits = dict(drawn.column("splits")[0].as_py() or ())
        reliefs = [surface for surface in surfaces if not surface["is_reference"]]
        groups = [
            RowGroup(surface["surface_id"], 0, surface["rows"])
            for surface in reliefs
            if splits[surface["surface_id"]] == split and surface["rows"]
        ]
        if not groups:
            counts = f"{len(reliefs)} surfaces of {len({surface['panel'] for surface in reliefs})} panels"
            raise LookupError(f"{counts} in {self.query!r}, none in split {split}")
        named = [self.query.as_of, self.query.seed, [(group.file, group.rows) for group in groups]]
        digest = hashlib.sha256(json.dumps(named).encode()).hexdigest()[:16]
        tables, schema = self._columns
        bands = [f"tnce_{band['key']}" for band in self._lake["bands"]]
        defaults = [name for name in schema.names if name not in tables]
        return SplitContents(groups, schema, [*defaults, "temperature_c", "snr_db", "ir", *bands], digest, False)

    def read_group(
        self, group: RowGroup, names: Sequence[str], read: Callable[[Iterator[pa.RecordBatch]], _Result]
    ) -> _Result:
        """What ``read`` makes of the rows of a surface."""
        tables, schema = self._columns
        chosen = [name for name in names if name in tables]
        joined = "".join(
            f" join {self._relation(table)} {table} on {table}.surface_id = known.surface_id "
            f"and {table}.run_id = known.run_id and {table}.pair_id = known.pair_id"
            for table in sorted({tables[name] for name in chosen})
        )
        columns = "".join(f', {tables[name]}."{name}"' for name in chosen)
        rows = self._ask(
            f"select known.run_id, known.pair_id, known.microphone, known.speaker{columns} "
            f"from {self._relation('tnce_db')} known{joined} where known.surface_id = '{group.file}'"
        ).sort_by([("run_id", "ascending"), ("pair_id", "ascending")])
        if rows.num_rows != group.rows:
            raise LookupError(f"{rows.num_rows} rows of {group.file} in {self.query!r}, expected {group.rows}")
        same = {"surface_id": group.file, "symmetry": "identity"}
        for name, value in same.items():
            rows = rows.append_column(name, pa.array([value] * rows.num_rows))
        for point in ("microphone", "speaker"):
            rows = rows.append_column(f"{point}_mm", self._positions.take(rows.column(point)))
        wanted = pa.schema([pa.field(name, pa.string()) if name in same else schema.field(name) for name in names])
        return read(iter(rows.select(names).cast(wanted).to_batches()))

    def read_height_maps(self, split: str) -> pa.Table:
        """``surface_id``, ``size_mm`` and ``heights_mm`` of all surfaces, those of newer runs last."""
        maps = self._ask(
            f"select surface_id, size_mm, heights_mm from {self._relation('heightmaps')} "
            "where symmetry = 'identity' order by surface_id, run_id"
        )
        if maps.num_rows == 0:
            raise FileNotFoundError(f"{self.query!r}: the lake has no height maps")
        cells = len(maps.column("heights_mm")[0])
        return maps.set_column(2, "heights_mm", maps.column("heights_mm").cast(pa.list_(pa.float32(), cells)))

    def read_statistics(self) -> dict[str, Any]:
        """Refuses: statistics take a pass over all rows, which an export makes."""
        raise ValueError("a query has no statistics to normalise by; hint: echolake export ml")

    @cached_property
    def _lake(self) -> dict[str, Any]:
        return dict(json.loads(_request_answer(self.query, "/api/v1/lake", None, lambda answer: answer.read())))

    @cached_property
    def _positions(self) -> pa.Array:
        points = [[point[axis] for axis in ("x_mm", "y_mm", "z_mm")] for point in self._lake["points"]]
        return pa.array(points, pa.list_(pa.float32(), 3))

    @cached_property
    def _columns(self) -> tuple[dict[str, str], pa.Schema]:
        """The table that each column comes from, and the types of a training set: single precision, fixed lists."""
        numbers = [pa.field(name, pa.int32(), False) for name in ("pair_id", "microphone", "speaker")]
        position = pa.list_(pa.float32(), 3)
        positions = [pa.field(f"{of}_mm", position, False, {"unit": "mm"}) for of in ("microphone", "speaker")]
        fields = [*numbers, *positions]
        tables: dict[str, str] = {}
        for table in ("measurements", "nce", "tnce"):
            for column in self._ask(f"select * from {self._relation(table)} limit 0").schema:
                if column.name in tables or column.name in _NOT_CHOSEN:
                    continue
                if pa.types.is_list(column.type):
                    samples = pa.list_(pa.float32(), self._lake["ir_length"])
                    rate = {b"rate_hz": str(self._lake["rate_hz"]).encode()}
                    column = column.with_type(samples).with_metadata((column.metadata or {}) | rate)
                elif pa.types.is_float64(column.type):
                    column = column.with_type(pa.float32())
                elif not (pa.types.is_float32(column.type) or pa.types.is_integer(column.type)):
                    continue
                tables[column.name] = table
                fields.append(column)
        return tables, pa.schema(fields)

    def _relation(self, name: str) -> str:
        return '"{}@{}"'.format(name, str(self.query.as_of).replace('"', '""'))

    def _ask(self, sql: str) -> pa.Table:
        return _ask_server(self.query, sql)


def _ask_server(query: LakeQuery, sql: str) -> pa.Table:
    def read_table(answer: Any) -> pa.Table:
        return pa.ipc.open_stream(answer).read_all()

    return _request_answer(query, "/api/v1/sql", sql, read_table)


def _request_answer(query: LakeQuery, path: str, sql: str | None, read: Callable[[Any], _Result]) -> _Result:
    headers = {"Content-Type": "application/sql", "Accept": "application/vnd.apache.arrow.stream, */*;q=0.1"}
    if query.token is not None:
        headers["Authorization"] = f"Bearer {query.token}"
    body = sql.encode() if sql is not None else None
    request = urllib.request.Request(query.url.rstrip("/") + path, body, headers)

    def read_once() -> _Result:
        try:
            with urllib.request.urlopen(request, timeout=_TIMEOUT_SECS) as answer:
                return read(answer)
        except urllib.error.HTTPError as refusal:
            told = f"{query.url} answered {refusal.code}: {read_refusal(refusal)}"
            if refusal.code == 429 or refusal.code >= 500:
                raise ConnectionError(told) from refusal
            raise LookupError(told) from refusal
        except urllib.error.URLError as failed:
            raise ConnectionError(f"{query.url} does not answer: {failed.reason}") from failed

    return retry_read(read_once, RETRY_SECS)
