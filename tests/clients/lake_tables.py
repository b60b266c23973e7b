"""All rows of every table and view of a lake, as pyarrow reads them, to compare with what a client is sent.

A table's rows are those of its Parquet files and its types those of its Delta schema; a view has neither, so its rows and
types are what Arrow Flight SQL answers. They are held in memory: the lake should be small.
Needs the PyPI packages adbc-driver-flightsql, deltalake, numpy and pyarrow.
"""
import dataclasses
import datetime
import os
import re

import adbc_driver_flightsql.dbapi
import deltalake
import numpy
import pyarrow

DELTA_TYPES = {
    "string": "text", "boolean": "bool", "byte": "int2", "short": "int2", "integer": "int4", "long": "int8",
    "float": "float4", "double": "float8", "timestamp": "timestamptz", "timestamp_ntz": "timestamp", "binary": "bytea", "date": "date",
}
ARROW_TYPES = {
    "string": "text", "string_view": "text", "large_string": "text", "bool": "bool", "int8": "int2", "int16": "int2", "int32": "int4",
    "int64": "int8", "uint64": "numeric", "float": "float4", "double": "float8", "timestamp[us, tz=UTC]": "timestamptz",
    "timestamp[us]": "timestamp", "binary": "bytea", "date32[day]": "date",
}
# Numbers of Postgres' types, which some drivers give instead of names.
NUMBERS = {
    16: "bool", 17: "bytea", 20: "int8", 21: "int2", 23: "int4", 25: "text", 700: "float4", 701: "float8", 1082: "date",
    1114: "timestamp", 1184: "timestamptz", 1700: "numeric", 1000: "_bool", 1005: "_int2", 1007: "_int4", 1009: "_text",
    1016: "_int8", 1021: "_float4", 1022: "_float8",
}
PYTHON_TYPES = {
    "bool": bool, "text": str, "int2": int, "int4": int, "int8": int, "float4": float, "float8": float,
    "timestamptz": datetime.datetime, "timestamp": datetime.datetime, "date": datetime.date, "bytea": (bytes, memoryview, bytearray),
}
FLOATS = {"float4": numpy.float32, "float8": numpy.float64}
TIME = re.compile(r"(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d)(:\d\d)?(\.\d+)?(?:Z|[+]00(?::?00)?)?$")


@dataclasses.dataclass
class LakeTable:
    """The rows of a table or view, the query for them, and Postgres' names of the columns' types."""

    table: str
    sql: str
    names: list
    types: list
    rows: list

    def compare(self, columns, rows):
        """Raises AssertionError unless a client got these names, types and values; texts are read as the type's.

        The type of a column may be None, which is any. `rows` may be any iterator: rows are compared as they come.
        """
        expected = list(zip(self.names, self.types))
        told = [(name, kind or known) for (name, kind), known in zip(columns, self.types)] if len(columns) == len(expected) else columns
        assert told == expected, f"columns {[c for c in told if c not in expected]}, expected {[c for c in expected if c not in told]}"
        count = 0
        for row in rows:
            assert count < len(self.rows), f"more than {len(self.rows)} rows"
            for name, kind, value, right in zip(self.names, self.types, row, self.rows[count], strict=True):
                assert is_same(value, right, kind), f"row {count}, {name} {kind}: {str(value)[:80]!r}, expected {str(right)[:80]!r}"
            count += 1
        assert count == len(self.rows), f"{count} rows, expected {len(self.rows)}"


def is_same(value, right, kind):
    """True if a client's value is pyarrow's."""
    if value is None or right is None:
        return value is right
    if kind.startswith("_"):
        return is_same_list(value, right, kind[1:])
    if isinstance(value, str) and kind != "text":
        value = parse_text(value, kind)
    if not isinstance(value, PYTHON_TYPES[kind]) or isinstance(value, bool) != (kind == "bool"):
        return False
    if kind in FLOATS:
        return bool(numpy.array_equal(FLOATS[kind](value), FLOATS[kind](right), equal_nan=True))
    if kind == "timestamptz" and value.tzinfo is None:
        value = value.replace(tzinfo=datetime.timezone.utc)
    return bytes(value) == right if kind == "bytea" else value == right


def is_same_list(value, right, kind):
    """True if a client's list is pyarrow's; it may be written as Postgres writes it."""
    if isinstance(value, str):
        value = [None if item == "NULL" else item.strip('"') for item in value.strip("{}").split(",") if item]
    if kind in FLOATS and None not in right and None not in value and len(value) == len(right):
        numbers = [numpy.asarray(numbers, dtype=FLOATS[kind]) for numbers in (value, right)]
        return bool(numpy.array_equal(*numbers, equal_nan=True))
    return len(value) == len(right) and all(is_same(a, b, kind) for a, b in zip(value, right))


def parse_text(text, kind):
    """The value of a text that a program printed."""
    if kind == "bool":
        return {"t": True, "true": True, "1": True, "f": False, "false": False, "0": False}.get(text)
    if kind in FLOATS:
        return float(text)
    if kind.startswith("int"):
        return int(text)
    if kind.startswith("timestamp") and (parts := TIME.match(text)):
        date, minutes, seconds, fraction = parts.groups()
        micros = (fraction or ".0")[:7]
        time = datetime.datetime.strptime(f"{date} {minutes}{seconds or ':00'}{micros}", "%Y-%m-%d %H:%M:%S.%f")
        return time.replace(tzinfo=datetime.timezone.utc) if kind == "timestamptz" else time
    if kind == "bytea":
        return bytes.fromhex(text.removeprefix("\\x"))
    return text


def type_of_delta(kind):
    """Postgres' name of a type of Delta's."""
    return "_" + type_of_delta(kind.element_type) if isinstance(kind, deltalake.schema.ArrayType) else DELTA_TYPES[kind.type]


def type_of_arrow(kind):
    """Postgres' name of a type of Arrow's."""
    is_list = pyarrow.types.is_list(kind) or pyarrow.types.is_fixed_size_list(kind) or pyarrow.types.is_large_list(kind)
    return "_" + type_of_arrow(kind.value_type) if is_list else ARROW_TYPES[str(kind)]


def load_tables(lake, flight):
    """All tables and views of the lake in this folder, which is served at this URL."""
    with adbc_driver_flightsql.dbapi.connect(flight, autocommit=True) as connection, connection.cursor() as cursor:
        def ask(sql):
            cursor.execute(sql)
            return cursor.fetch_arrow_table()
        names = ask("select table_name from information_schema.tables where table_schema = 'public' order by 1")
        return [load_table(ask, lake, table) for table in names.column(0).to_pylist()]


def load_table(ask, lake, table):
    """One table or view."""
    schema = ask(f'select * from "{table}" limit 0').schema
    types = [type_of_arrow(field.type) for field in schema]
    keys = [name for name, kind in zip(schema.names, types) if not kind.startswith("_")]
    order = ", ".join(f'"{key}"' for key in keys)
    sql = f'select * from "{table}" order by {order}'
    folder = os.path.join(lake, "tables", table)
    if not os.path.isdir(folder):
        return LakeTable(table, sql, schema.names, types, to_rows(ask(sql)))
    stored = deltalake.DeltaTable(folder)
    rows = stored.to_pyarrow_table().sort_by([(key, "ascending") for key in keys])
    fields = stored.schema().fields
    return LakeTable(table, sql, [f.name for f in fields], [type_of_delta(f.type) for f in fields], to_rows(rows))


def to_rows(table):
    """Rows of values."""
    return list(zip(*(column.to_pylist() for column in table.columns)))
