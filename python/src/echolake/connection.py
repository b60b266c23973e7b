"""Queries over Arrow Flight SQL."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["Lake", "connect"]

_BEARER = "adbc.flight.sql.authorization_header"


class Lake:
    """A served lake. Made by :func:`connect`; a context manager."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection

    def sql(self, query: str, parameters: Sequence[Any] | None = None) -> pa.Table:
        """The answer to a query, all of it; ``$1``, ``$2`` stand for parameters."""
        with self._connection.cursor() as cursor:
            cursor.execute(query, parameters)
            return cursor.fetch_arrow_table()

    @contextmanager
    def stream(self, query: str, parameters: Sequence[Any] | None = None) -> Iterator[pa.RecordBatchReader]:
        """The answer to a query as batches that come one after the other; the query ends with the block."""
        with self._connection.cursor() as cursor:
            cursor.execute(query, parameters)
            reader = cursor.fetch_record_batch()
            try:
                yield reader
            finally:
                reader.close()

    def tables(self) -> dict[str, pa.Schema]:
        """The tables and views with their columns."""
        names = self.sql("select table_name from information_schema.tables where table_schema = 'public' order by 1")
        return {name: self.sql(f'select * from "{name}" limit 0').schema for name in names.column(0).to_pylist()}

    def close(self) -> None:
        """Ends the connection."""
        self._connection.close()

    def __enter__(self) -> Lake:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def connect(url: str = "grpc://127.0.0.1:8081", token: str | None = None) -> Lake:
    """Opens a lake that ``echolake serve`` serves.

    ``url`` is the Flight SQL address that it prints; ``grpc+tls://`` behind a proxy with TLS. ``token`` is one of
    ``echolake token``, where the server asks for them.
    """
    if not url.startswith(("grpc://", "grpc+tls://", "grpc+tcp://", "grpc+unix://")):
        raise ValueError(f"`{url}` is no Flight SQL address; expected grpc://host:port")
    try:
        import adbc_driver_flightsql.dbapi as flight_sql
        import pyarrow  # noqa: F401
    except ImportError as missing:
        raise ImportError(f"{missing}; hint: pip install 'echolake[client]'") from missing
    options = {_BEARER: f"Bearer {token}"} if token is not None else {}
    return Lake(flight_sql.connect(url, db_kwargs=options, autocommit=True))
