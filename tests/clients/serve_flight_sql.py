"""Checks a served lake over Flight SQL with ADBC and polars: `serve_flight_sql.py grpc://127.0.0.1:8081 [TOKEN]`.

Needs the PyPI packages adbc-driver-flightsql, pyarrow and polars. Prints a line a check, exits with 1 where one fails.
"""
import sys
import threading
import time

import adbc_driver_flightsql.dbapi
import polars

from checks import Checks

ENDLESS = """select count(*) from generate_series(1, 1000000) a cross join generate_series(1, 1000000) b
             where a.value + b.value = 7"""


def main(address, token=None):
    checks = Checks()
    options = {"username": "me", "password": token} if token else {}
    connection = adbc_driver_flightsql.dbapi.connect(address, db_kwargs=options, autocommit=True)

    def ask(query, values=None):
        with connection.cursor() as cursor:
            cursor.execute(query, values)
            return cursor.fetch_arrow_table()

    def refused(query):
        try:
            ask(query)
        except Exception as error:
            return str(error)

    def one(query, values=None):
        return ask(query, values).to_pylist()[0]

    count = one("select count(*) n from measurements")["n"]
    checks.same("select", count, lambda: ask("select * from measurements").num_rows)
    checks.same("no rows", 0, lambda: ask("select * from runs where false").num_rows)
    checks.holds("large rows", lambda: ask("select * from heightmaps").num_rows)
    checks.same("numbers as parameters", 7, lambda: one("select count(*) n from pairs where pair_id < $1", (7,))["n"])
    checks.same("text as parameter", "a", lambda: one("select $1 as x", ("a",))["x"])
    checks.same("NULL as parameter", None, lambda: one("select $1 as x", (None,))["x"])
    checks.holds("error with its place", lambda: refused("select nonsense from runs"), lambda e: "^" in e and "hint" in e)
    for query in ("drop table runs", "insert into runs values (1)", "copy (select 1) to '/tmp/x'", "set a.b = 1"):
        checks.holds(f"refusal of {query}", lambda: refused(query), lambda e: e and "only reading" in e)
    objects = lambda depth: connection.adbc_get_objects(depth=depth).read_all().to_pylist()[0]
    tables = lambda: objects("all")["catalog_db_schemas"][0]["db_schema_tables"]
    checks.same("get_objects", True, lambda: "measurements" in [t["table_name"] for t in tables()])
    checks.holds("get_objects' columns", lambda: tables()[0]["table_columns"])
    checks.same("get_table_schema", "pair_id", lambda: connection.adbc_get_table_schema("pairs").names[0])
    checks.same("get_table_types", ["TABLE"], connection.adbc_get_table_types)
    checks.same("get_info", "echolake", lambda: connection.adbc_get_info()["vendor_name"])
    checks.same("polars", (3, 2), lambda: polars.read_database("select pair_id, direct_mm from pairs limit 3", connection).shape)

    def cancelled():
        with connection.cursor() as cursor:
            threading.Timer(0.5, cursor.adbc_cancel).start()
            begun = time.monotonic()
            try:
                cursor.execute(ENDLESS)
                cursor.fetchall()
            except Exception:
                return time.monotonic() - begun

    checks.holds("cancel", cancelled, lambda seconds: seconds < 2)
    return checks.done()


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
