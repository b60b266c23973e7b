"""DuckDB as the peer of benchmark `query-bench`: one JSON object a line in, one a line out.

First {"tables": {name: [files]}, "threads": n}, then {"sql": text} for each query, which is answered by its time up to
the last row in Arrow, its number of rows, and of each column the sum of its numbers or of its texts' lengths.

Needs the PyPI packages duckdb and pyarrow.
"""
import json
import sys
import time

import duckdb
import pyarrow
import pyarrow.compute


def start(order):
    connection = duckdb.connect()
    connection.execute(f"SET threads = {int(order['threads'])}")
    # Warm, as the other side is: footers are kept.
    connection.execute("SET parquet_metadata_cache = true")
    for name, files in order["tables"].items():
        listed = ", ".join("'" + file.replace("'", "''") + "'" for file in files)
        connection.execute(f'CREATE VIEW "{name}" AS SELECT * FROM read_parquet([{listed}])')
    return connection


def column_sum(column):
    kind = column.type
    if pyarrow.types.is_list(kind) or pyarrow.types.is_large_list(kind):
        return column_sum(pyarrow.compute.list_flatten(column))
    if pyarrow.types.is_string(kind) or pyarrow.types.is_large_string(kind):
        column = pyarrow.compute.binary_length(column)
    elif pyarrow.types.is_integer(kind):
        column = column.cast(pyarrow.int64())
    else:
        column = column.cast(pyarrow.float64())
    return float(pyarrow.compute.sum(column).as_py() or 0)


def answer(connection, sql):
    begin = time.perf_counter()
    table = connection.execute(sql).to_arrow_table()
    seconds = time.perf_counter() - begin
    return {"seconds": seconds, "rows": table.num_rows, "sums": [column_sum(c) for c in table.columns]}


def main():
    connection = None
    for line in sys.stdin:
        order = json.loads(line)
        try:
            if connection is None:
                connection = start(order)
                reply = {"version": duckdb.__version__}
            else:
                reply = answer(connection, order["sql"])
        except Exception as error:  # The other side says what to do about it.
            reply = {"error": str(error)}
        print(json.dumps(reply), flush=True)


main()
