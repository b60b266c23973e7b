"""DuckDB as the peer of `bench queries` and of `sql-differences`: one JSON object a line in, one a line out.

First {"tables": {name: [files]}, "threads": n, "copy": flag, "settings": {name: value}}, then {"sql": text} for each
query, which is answered by its time up to the last row in Arrow. With {"sql": text, "rows": file} the rows are written
into the file, too, as Arrow IPC. With "copy" the tables are in memory, else views over the files.

Needs the PyPI packages duckdb and pyarrow.
"""
import json
import sys
import threading
import time

import duckdb
import pyarrow

# A query that takes longer is interrupted, which is an error.
LIMIT_SECONDS = 60


def start(order):
    connection = duckdb.connect()
    connection.execute(f"SET threads = {int(order['threads'])}")
    # Warm, as the other side is: footers are kept.
    connection.execute("SET parquet_metadata_cache = true")
    for name, value in order.get("settings", {}).items():
        connection.execute(f"SET {name} = '{value}'")
    kind = "TABLE" if order.get("copy") else "VIEW"
    for name, files in order["tables"].items():
        listed = ", ".join("'" + file.replace("'", "''") + "'" for file in files)
        connection.execute(f'CREATE {kind} "{name}" AS SELECT * FROM read_parquet([{listed}])')
    return connection


def answer(connection, sql, file):
    timer = threading.Timer(LIMIT_SECONDS, connection.interrupt)
    timer.start()
    try:
        begin = time.perf_counter()
        table = connection.execute(sql).to_arrow_table()
        seconds = time.perf_counter() - begin
    finally:
        timer.cancel()
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
