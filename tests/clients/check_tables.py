"""Checks a lake's tables with other readers: `check_tables.py LAKE`. Each Parquet file by itself in pyarrow, polars
and DuckDB, and each table as a Delta table in deltalake; row counts must agree.

Needs the PyPI packages pyarrow, polars, duckdb and deltalake. Exits with 1 and says what differs.
"""
import pathlib
import sys

import deltalake
import duckdb
import polars
import pyarrow.parquet


def main(lake):
    for folder in sorted((pathlib.Path(lake) / "tables").iterdir()):
        table = deltalake.DeltaTable(str(folder))
        adds = table.get_add_actions(flatten=True)
        rows = sum(adds.column("num_records").to_pylist())
        files = [str(folder / path) for path in adds.column("path").to_pylist()]
        if not files:
            print(f"{folder.name}: empty")
            continue
        counts = {
            "pyarrow": sum(pyarrow.parquet.read_table(f, partitioning=None).num_rows for f in files),
            "polars": sum(polars.read_parquet(f).height for f in files),
            "duckdb": sum(duckdb.sql(f"select * from read_parquet('{f}')").to_arrow_table().num_rows for f in files),
            "deltalake": table.to_pyarrow_table().num_rows,
            "polars delta": polars.scan_delta(str(folder)).collect().height,
        }
        wrong = {reader: count for reader, count in counts.items() if count != rows}
        assert not wrong, f"{folder.name}: the log says {rows} rows, {wrong}"
        print(f"{folder.name}: {rows} rows in {len(files)} files, {', '.join(counts)} agree")


if __name__ == "__main__":
    try:
        main(sys.argv[1])
    except AssertionError as error:
        sys.exit(str(error))
