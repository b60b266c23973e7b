"""DuckDB as the peer of `bench queries`: one JSON object a line in, one a line out.

First {"tables": {name: [files]}, "threads": n}, then {"sql": text} for each query, which is answered by its time up to
the last row in Arrow. With {"sql": text, "rows": file} the rows are written into the file, too, as Arrow IPC.

Needs the PyPI packages duckdb and pyarrow.
"""
import json
import sys
import time

import duckdb
import pyarrow


def start(order):
    connection = duckdb.connect()
    connection.execute(f"SET threads = {int(order['threads'])}")
    # Warm, as the other side is: footers are kept.
    connection.execute("SET parquet_metadata_cache = true")
    for name, files in order["tables"].items():
        listed = ", ".join("'" + file.replace("'", "''") + "'" for file in files)
        connection.execute(f'CREATE VIEW "{name}" AS SELECT * FROM read_parquet([{listed}])')
    return connection


def answer(connection, sql, file):
    begin = time.perf_counter()
    table = connection.execute(sql).to_arrow_table()
    seconds = time.perf_counter() - begin
    if file is not None:
        with pyarrow.ipc.new_file(file, table.schema) as writer:
            writer.write_table(table)
    return {"seconds": seconds}


def main():
    connection = None
    for line in sys.stdin:
        order = json.loads(line)
        try:
            if connection is None:
                connection = start(order)
                reply = {"version": duckdb.__version__}
            else:
                reply = answer(connection, order["sql"], order.get("rows"))
        except Exception as error:  # The other side says what to do about it.
            reply = {"error": str(error)}
        print(json.dumps(reply), flush=True)


main()
