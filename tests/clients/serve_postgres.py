"""Checks a served lake over Postgres' protocol: `serve_postgres.py postgresql://me@127.0.0.1:5433/datafusion`.

Needs the PyPI packages psycopg[binary], sqlalchemy, pandas, polars, connectorx, adbc-driver-postgresql, asyncpg, duckdb and
duckdb-extension-postgres-scanner of duckdb's version. psql and the catalogue queries of tools are checked by
`postgres_clients.py`. Prints a line a check, exits with 1 where one fails.
"""
import asyncio
import datetime
import glob
import os
import sys
import threading
import time

import adbc_driver_postgresql.dbapi
import asyncpg
import connectorx
import duckdb
import duckdb_extension_postgres_scanner
import pandas
import polars
import psycopg
import sqlalchemy

from checks import Checks

ENDLESS = """select count(*) from generate_series(1, 1000000) a cross join generate_series(1, 1000000) b
             where a.value + b.value = 7"""


def main(url):
    checks = Checks()
    connect = lambda **more: psycopg.connect(url, autocommit=True, **more)
    connection = connect()
    one = lambda query, *values: connection.execute(query, *values).fetchone()[0]
    state = lambda query: refused(connection, query)

    kinds = lambda table: dict(connection.execute("select column_name, data_type from information_schema.columns where table_name = %s", (table,)).fetchall())
    some = {"surface_id": "text", "log_time": "timestamp with time zone", "pair_id": "integer", "snr_db": "real", "ir": "ARRAY"}
    checks.same("information_schema: types", some, lambda: {name: kind for name, kind in kinds("measurements").items() if name in some})
    checks.same("information_schema: numbers", "double precision", lambda: kinds("pairs")["direct_mm"])
    checks.same("user", ["postgres"] * 3, lambda: [one(f"select {name}") for name in ("user", "session_user", "current_user")])
    checks.same("time zones", [("UTC", datetime.timedelta(0), False)], lambda: connection.execute("select name, utc_offset, is_dst from pg_timezone_names").fetchall())

    count = one("select count(*) from measurements")
    checks.same("psycopg: parameters", 7, lambda: one("select count(*) from pairs where pair_id < %s and direct_mm > %s", (7, 0.5)))
    checks.same("psycopg: NULL", 0, lambda: one("select count(*) from runs where run_id = %s", (None,)))
    checks.same("psycopg: a list", 2, lambda: one("select count(*) from pairs where pair_id = any(%s)", ([1, 2],)))
    checks.same("psycopg: prepared", list(range(8)), lambda: [one("select count(*) from pairs where pair_id < %s", (i,)) for i in range(8)])
    checks.holds("psycopg: lists as arrays", lambda: len(one("select ir from measurements limit 1")), lambda n: n > 1)
    checks.holds("psycopg: binary", lambda: len(connection.cursor(binary=True).execute("select ir, log_time from measurements limit 1").fetchone()[0]), lambda n: n > 1)
    checks.same("psycopg: stream", count, lambda: sum(1 for _ in connection.cursor().stream("select pair_id from measurements")))

    def cursor():
        with psycopg.connect(url) as own, own.cursor(name="named") as named:
            named.execute("select pair_id from measurements where pair_id >= %s", (0,))
            return len(named.fetchmany(10)) + len(named.fetchall())

    checks.same("psycopg: a cursor on the server", count, cursor)

    def copied(form):
        with connection.cursor().copy(f"copy (select pair_id, ir from measurements) to stdout ({form})") as copy:
            return sum(1 for _ in copy)

    for form in ("format text", "format csv", "format binary"):
        checks.holds(f"psycopg: copy, {form}", lambda: copied(form), lambda n: n in (count, count + 1))
    for query, expected in [
        ("drop table runs", "25006"), ("copy pairs to '/tmp/x'", "25006"), ("set work_mem = '1GB'", "42704"),
        ("select nope from runs", "42703"), ("select * from nope", "42P01"), ("selec", "42601"),
    ]:
        checks.same(f"psycopg: {query}", expected, lambda: state(query))

    def transaction():
        with psycopg.connect(url) as own:
            failed = refused(own, "select nope from runs"), refused(own, "select 1")
            own.rollback()
            return failed + (own.execute("select 1").fetchone()[0],)

    checks.same("psycopg: a failed transaction", ("42703", "25P02", 1), transaction)
    checks.same("psycopg: options", "5s", lambda: connect(options="-c statement_timeout=5s").execute("show statement_timeout").fetchone()[0])

    def timed_out():
        own = connect(options="-c statement_timeout=300ms")
        begun = time.monotonic()
        return refused(own, ENDLESS), time.monotonic() - begun < 2

    checks.same("psycopg: statement_timeout", ("57014", True), timed_out)

    def cancelled():
        own = connect()
        threading.Timer(0.3, own.cancel).start()
        begun = time.monotonic()
        return refused(own, ENDLESS), time.monotonic() - begun < 2, own.execute("select 1").fetchone()[0]

    checks.same("psycopg: cancel", ("57014", True, 1), cancelled)

    engine = sqlalchemy.create_engine(url.replace("postgresql://", "postgresql+psycopg://"))
    inspected = lambda: sqlalchemy.inspect(engine)
    checks.holds("SQLAlchemy: tables", lambda: inspected().get_table_names(), lambda names: "measurements" in names)
    checks.holds("SQLAlchemy: columns", lambda: inspected().get_columns("pairs"), lambda columns: columns[0]["name"] == "pair_id")

    def reflected():
        table = sqlalchemy.Table("measurements", sqlalchemy.MetaData(), autoload_with=engine)
        with engine.connect() as own:
            rows = own.execute(sqlalchemy.select(table.c.pair_id, table.c.ir).limit(3)).all()
        kinds = [type(table.c[name].type).__name__ for name in ("pair_id", "snr_db", "log_time")]
        return len(rows), kinds, len(table.primary_key), len(table.indexes), len(table.foreign_keys)

    checks.same("SQLAlchemy: reflection", (3, ["INTEGER", "REAL", "TIMESTAMP"], 0, 0, 0), reflected)

    def all_reflected():
        known = sqlalchemy.MetaData()
        known.reflect(engine)
        return sorted(known.tables)

    checks.holds("SQLAlchemy: reflection of all", all_reflected, lambda names: names == sorted(inspected().get_table_names()))
    constraints = lambda own: own.get_unique_constraints("pairs") + own.get_check_constraints("pairs") + own.get_foreign_keys("pairs")
    checks.same("SQLAlchemy: constraints", [], lambda: constraints(inspected()))
    checks.same("pandas", (3, 2), lambda: pandas.read_sql("select pair_id, direct_mm from pairs limit 3", engine).shape)

    rows = "select surface_id, pair_id, snr_db, ir from measurements"
    checks.same("polars read_database_uri", (count, 4), lambda: polars.read_database_uri(rows, url).shape)
    checks.same("polars read_database_uri, adbc", (count, 4), lambda: polars.read_database_uri(rows, url, engine="adbc").shape)
    for protocol in ("binary", "csv", "cursor", "simple"):
        checks.same(f"connectorx {protocol}", (count, 3), lambda: connectorx.read_sql(url, "select surface_id, pair_id, snr_db from measurements", protocol=protocol).shape)

    def adbc(act):
        with adbc_driver_postgresql.dbapi.connect(url, autocommit=True) as own:
            return act(own)

    def fetched(own, query, values=None):
        with own.cursor() as cursor:
            cursor.execute(query, values)
            return cursor.fetch_arrow_table()

    checks.same("ADBC: select", count, lambda: adbc(lambda own: fetched(own, rows).num_rows))
    checks.same("ADBC: no rows", 0, lambda: adbc(lambda own: fetched(own, "select * from pairs where false").num_rows))
    checks.same("ADBC: parameters", 5, lambda: adbc(lambda own: fetched(own, "select count(*) n from pairs where pair_id < $1", (5,)).to_pylist()[0]["n"]))
    checks.holds("ADBC: get_objects", lambda: adbc(lambda own: str(own.adbc_get_objects(depth="tables").read_all().to_pylist())), lambda text: "measurements" in text)
    checks.same("ADBC: get_table_schema", "pair_id", lambda: adbc(lambda own: own.adbc_get_table_schema("pairs").names[0]))

    async def asynchronous():
        own = await asyncpg.connect(url)
        try:
            async with own.transaction(readonly=True):
                cursor = await own.cursor("select pair_id from measurements order by 1")
                part = len(await cursor.fetch(10))
            return part, len(await own.fetch("select * from pairs where pair_id < $1", 5))
        finally:
            await own.close()

    checks.same("asyncpg", (10, 5), lambda: asyncio.run(asynchronous()))

    duck = duckdb.connect(config={"allow_unsigned_extensions": "true"})
    folder = os.path.dirname(duckdb_extension_postgres_scanner.__file__)
    duck.execute(f"LOAD '{glob.glob(folder + '/**/*.duckdb_extension', recursive=True)[0]}'")
    duck.execute(f"ATTACH '{url}' AS lake (TYPE postgres, READ_ONLY)")
    ducks = lambda query: duck.execute(query).fetchone()[0]
    checks.same("DuckDB ATTACH", count, lambda: ducks("select count(*) from lake.measurements"))
    checks.holds("DuckDB: a list", lambda: ducks("select len(ir) from lake.measurements limit 1"))
    checks.same("DuckDB: a filter", 5, lambda: ducks("select count(*) from lake.pairs where pair_id < 5"))
    checks.same("DuckDB postgres_query", count, lambda: ducks("select n from postgres_query('lake', 'select count(*) n from measurements')"))
    return checks.done()


def refused(connection, query):
    """The state that a query fails with."""
    try:
        connection.execute(query)
    except psycopg.Error as error:
        return error.sqlstate


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
