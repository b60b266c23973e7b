"""Runs Postgres' clients against a served lake and prints a table of what passed: client, passed of tried.

    postgres_clients.py postgresql://me@127.0.0.1:5433/datafusion --lake LAKE --flight grpc://127.0.0.1:8081
    postgres_clients.py ... --control postgresql://postgres@127.0.0.1:5432/lake

Each driver also reads all rows of all tables and views, streamed if it can: names, types and values must be those that
pyarrow reads from the lake's folder, and for views from Arrow Flight SQL (`lake_tables.py`). The lake should therefore be a
small one: `echolake --lake LAKE demo --rig tests/fixtures/small_rig.toml --surfaces 4 --no-serve`.

With `--control`, the lake's tables and views are first loaded into that database of a real PostgreSQL, and the same checks
are run against it: its figures say which failures are the checks' own. `--client NAME` runs one client alone,
`--json` prints the results with the texts of failures, and `--write docs/clients.md` replaces the table in that page, with
`--client` the client's row.

A client that is not installed is left out with a line on stderr. Needed for all: psql, perl with DBD::Pg, a JDK with
pgjdbc in /usr/share/java, Go with lib/pq and pgx 4 in /usr/share/gocode, pyodbc with Debian's odbc-postgresql, in this
folder's `postgres/` the npm packages pg, pg-cursor, postgres and knex, and the PyPI packages psycopg[binary], psycopg2-binary,
pg8000, asyncpg, sqlalchemy[asyncio], pandas, polars, connectorx, sqlacodegen, ibis-framework[postgres], pgcli and
adbc-driver-postgresql.
"""
import argparse
import asyncio
import collections
import datetime
import decimal
import importlib
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import urllib.parse

import psycopg

from checks import read_table, write_table
from lake_tables import NUMBERS, load_tables, type_of_arrow

HERE = os.path.dirname(os.path.abspath(__file__))
PROGRAMS = os.path.join(HERE, "postgres")
GO_PACKAGES = "/usr/share/gocode"
# Generous, because a machine may be busy: of a program, of a check, and of the check of a whole table.
TIMEOUT_SECS = 1200
CHECK_SECS = 60
TABLE_SECS = 300
# Rows that drivers fetch at a time if they stream.
FETCHED_ROWS = 100

COMMANDS = r"""\d;\d pairs;\d runs;\dS pg_class;\da;\dA;\dAc;\dAf;\dAo;\dAp;\db;\dc;\dC;\dd;\dD;\ddp;\dE;\des;\det;\deu;\dew;\df
\dF;\dFd;\dFp;\dFt;\dg;\di;\dl;\dL;\dm;\dn;\do;\dO;\dp;\dP;\drds;\dRp;\dRs;\ds;\dt;\dT;\du;\dv;\dx;\dX;\dy;\l;\z;\sf upper
\conninfo;\encoding;\d+;\d+ pairs;\da;\dA+;\db+;\dc+;\dC+;\dd;\dD+;\des+;\df+ upper;\dF+;\dg+;\di+;\dL+;\dm+;\dn+;\do+;\dO+
\dP+;\dRp+;\ds+;\dt+;\dT+;\du+;\dv+;\dx+;\dy+;\l+;\dt public.*;\d public.*;\df upper;\dT int*;\do =;\dt *pair*;\dn public
\dfa;\dfn;\dfw;\dft""".replace("\n", ";").split(";")


class ClientRun:
    """The checks of one client against one server."""

    def __init__(self, url, tables, flight):
        self.url = url
        self.tables = tables
        self.flight = flight
        self.results = {}

    def check(self, name, act, expected=None, limit_secs=CHECK_SECS):
        """Passes if `act` returns what is expected, or anything true, without an exception; 0 seconds are no limit."""
        try:
            signal.alarm(limit_secs)
            value = act()
            signal.alarm(0)
            wrong = value != expected if expected is not None else value is False or value is None
            self.results[name] = f"returned {value!r}"[:300] if wrong else None
        except Exception as error:  # whatever a driver throws is a failure of this check alone
            signal.alarm(0)
            self.results[name] = f"{type(error).__name__}: {error}"[:600]

    def run_program(self, arguments, **options):
        """Takes the results of a program that prints JSON objects, a line each, and is given a file of queries.

        An object has `check` and may have `error`; or it has `table` and `columns`, and then follow the table's rows, an object
        with `row` each, and one with `end`; or it has `end` and `error`. A program of several drivers names the `driver`.
        """
        with tempfile.NamedTemporaryFile("w", suffix=".tsv", encoding="utf-8") as queries, tempfile.TemporaryFile("w+") as said:
            queries.writelines(f"{table.table}\t{table.sql}\n" for table in self.tables)
            queries.flush()
            pipes = {"stdout": subprocess.PIPE, "stderr": said, "text": True}
            with subprocess.Popen([*arguments, queries.name], **pipes, **options) as program:
                limit = threading.Timer(TIMEOUT_SECS, program.kill)
                limit.start()
                lines = (json.loads(line) for line in program.stdout if line.startswith("{"))
                self.take_results(lines)
                program.wait()
                limit.cancel()
            said.seek(0)
            if program.returncode:
                self.results["the program"] = said.read()[-600:] or f"ended with {program.returncode}"

    def take_results(self, lines):
        """Takes the results of these objects; a table's rows are compared as they come."""
        known = {table.table: table for table in self.tables}
        for line in lines:
            if "check" in line:
                self.results[line["check"]] = line.get("error")
            elif "end" in line:
                self.results[value_check(line["end"], line)] = line.get("error", "no columns")
            elif "table" in line:
                rows = take_rows(lines)
                columns = [(column, type_name(kind)) for column, kind in line["columns"]]
                # The program has a limit as a whole.
                self.check(value_check(line["table"], line), lambda: known[line["table"]].compare(columns, rows) is None, limit_secs=0)
                collections.deque(rows, maxlen=0)
        for name in map(value_check, known):
            if not any(result.endswith(name) for result in self.results):
                self.results[name] = "no rows"


def value_check(table, line=None):
    """The name of the check of a table's values; a program with several drivers names the one."""
    driver = (line or {}).get("driver")
    return f"{driver}: values of {table}" if driver else f"values of {table}"


def take_rows(lines):
    """The rows up to the object that ends them; a RuntimeError if that has an error."""
    for line in lines:
        if "row" not in line:
            if "error" in line:
                raise RuntimeError(line["error"])
            return
        yield line["row"]


def stop_check(*_):
    """Ends a check that takes too long."""
    raise TimeoutError("no answer in time")


def split_url(url):
    """Host, port, user and database, as the drivers take them that know no URL."""
    parts = urllib.parse.urlsplit(url)
    return {"host": parts.hostname, "port": parts.port, "user": parts.username, "database": parts.path.strip("/")}


# Postgres' names of types by SQL's.
SQL_TYPES = {
    "TEXT": "text", "BOOLEAN": "bool", "SMALLINT": "int2", "INTEGER": "int4", "BIGINT": "int8", "REAL": "float4", "DOUBLE PRECISION": "float8",
    "TIMESTAMP WITH TIME ZONE": "timestamptz", "REAL[]": "_float4", "DOUBLE PRECISION[]": "_float8", "INTEGER[]": "_int4", "TEXT[]": "_text", "BYTEA": "bytea",
}


def type_name(kind):
    """Postgres' name of a type in lower case, of its name in a driver or in SQL, or of its number."""
    if written := SQL_TYPES.get(str(kind).upper()):
        return written
    name = NUMBERS.get(int(kind), str(kind)) if str(kind).isdigit() else str(kind).lower()
    return f"_{name[:-2]}" if name.endswith("[]") else name


def list_tables(url):
    """Names of the tables and views."""
    with psycopg.connect(url, autocommit=True) as lake:
        rows = lake.execute("select table_name from information_schema.tables where table_schema = 'public' order by 1")
        return [name for name, in rows]


# What every driver is asked in its own way: SQL, values, and the one row that is expected.
VALUES = [
    ("select 1, 1", (), (1, 1)),
    ("select $1::int", (7,), (7,)),
    ("select $1::bigint + 1", (7,), (8,)),
    ("select $1::text", ("é",), ("é",)),
    ("select $1::float8", (0.25,), (0.25,)),
    ("select $1::boolean", (True,), (True,)),
    ("select count(*) from pairs where pair_id = any($1::int[])", ([1, 2, 5],), (3,)),
    ("select count(*) from pairs where pair_id < $1", (3,), (3,)),
    ("select count(*) from runs where run_id = $1", ("none",), (0,)),
    ("select pair_id from pairs order by pair_id limit $1 offset $2", (1, 2), (2,)),
    ("select array[1, 2, 3]", (), ([1, 2, 3],)),
    ("select array[0.5, 1.5]::real[]", (), ([0.5, 1.5],)),
    ("select null::int", (), (None,)),
    ("select count(*) from information_schema.tables where table_name like $1 escape '/'", ("nce/%",), (0,)),
    ("select pg_typeof(1)::text", (), ("integer",)),
    ("select format('%s-%I', 'a', 'b c')", (), ('a-"b c"',)),
    ("select pg_size_pretty(20480::bigint)", (), ("20 kB",)),
    ("select pg_backend_pid() > 0", (), (True,)),
]


def check_values(run, query, style, skip=()):
    """Asks `VALUES`; `query` returns a row, `style` makes the driver's placeholder of a number."""
    for sql, values, expected in VALUES:
        if sql in skip:
            continue
        asked = re.sub(r"\$(\d)", lambda m: style(m[1]), sql)
        run.check(sql, lambda: tuple(query(asked, values)), expected)


def check_tables(run, fetch):
    """Reads each table and view; `fetch` returns columns with their types, None for a type of the driver's own, and rows."""
    for table in run.tables:
        def compare():
            columns, rows = fetch(table.sql)
            table.compare([(name, kind and type_name(kind)) for name, kind in columns], rows)
            return True
        run.check(f"values of {table.table}", compare, limit_secs=TABLE_SECS)


def describe_rows(cursor, rows):
    """Columns with their types, and rows, of a cursor that knows its columns once it has given a row."""
    first = list(itertools.islice(rows, 1))
    return [(column[0], column[1]) for column in cursor.description], itertools.chain(first, rows)


def run_psql(run, command, *options):
    """What psql prints for a line of input; a RuntimeError if it failed."""
    ran = subprocess.run(["psql", "-X", "-v", "ON_ERROR_STOP=1", *options, run.url], input=command, capture_output=True, text=True, timeout=TIMEOUT_SECS)
    said = ran.stdout + ran.stderr
    if ran.returncode or "ERROR" in said:
        raise RuntimeError(said.strip())
    return ran.stdout


def psql(run):
    for command in COMMANDS:
        run.check(command, lambda: run_psql(run, command) is not None)
    # Separators and a text for null that no value has.
    raw = ["-qAt", "-F", "\x1f", "-R", "\x1e", "-P", "null=\x1d", "-v", f"FETCH_COUNT={FETCHED_ROWS}"]
    def fetch(sql):
        types = run_psql(run, f"{sql} \\gdesc", *raw[:5])
        columns = [line.split("\x1f") for line in types.rstrip("\n").split("\x1e")]
        rows = (row.split("\x1f") for row in run_psql(run, sql, *raw).rstrip("\n").split("\x1e"))
        return columns, ([None if value == "\x1d" else value for value in row] for row in rows)
    check_tables(run, fetch)


def psycopg_3(run):
    with psycopg.connect(run.url, autocommit=True) as lake:
        one = lambda sql, values: lake.execute(sql, values or None).fetchone()
        check_values(run, one, lambda n: "%s")
        def fetch(sql):
            cursor = lake.cursor(binary=True)
            return describe_rows(cursor, cursor.stream(sql))
        check_tables(run, fetch)
        run.check("text", lambda: len(lake.execute("select * from measurements limit 3").fetchall()), 3)
        run.check("stream", lambda: sum(1 for _ in lake.cursor().stream("select * from pairs limit 9")), 9)
        def copied():
            with lake.cursor().copy("copy (select pair_id from pairs limit 4) to stdout") as copy:
                return sum(1 for _ in copy)
        run.check("copy", copied, 4)
        when = datetime.datetime(2020, 1, 1, tzinfo=datetime.timezone.utc)
        run.check("a time", lambda: lake.execute("select %s::timestamptz", (when,)).fetchone()[0], when)
        run.check("a date", lambda: lake.execute("select %s::date", (when.date(),)).fetchone()[0], when.date())
        run.check("an interval", lambda: lake.execute("select interval '90 minutes'").fetchone()[0], datetime.timedelta(minutes=90))
        run.check("a numeric", lambda: lake.execute("select 1.25::numeric(8,2)").fetchone()[0], decimal.Decimal("1.25"))
        types = lambda: psycopg.types.TypeInfo.fetch(lake, "int4")
        run.check("TypeInfo", lambda: (types().oid, types().array_oid), (23, 1007))
    def transaction():
        with psycopg.connect(run.url) as own, own.cursor(name="named") as named:
            named.execute("select pair_id from pairs order by 1 limit 20")
            return len(named.fetchmany(5)) + len(named.fetchall())
    run.check("a cursor of the server", transaction, 20)


def psycopg_2(run):
    import psycopg2
    import psycopg2.extras
    lake = psycopg2.connect(run.url)
    lake.autocommit = True
    def ask(sql, values=None):
        with lake.cursor() as cursor:
            cursor.execute(sql, values)
            return cursor.fetchall()
    check_values(run, lambda sql, values: ask(sql, values or None)[0], lambda n: "%s")
    def fetch(sql):
        cursor = psycopg2.connect(run.url).cursor("all_rows")
        cursor.itersize = FETCHED_ROWS
        cursor.execute(sql)
        return describe_rows(cursor, iter(cursor))
    check_tables(run, fetch)
    def named():
        own = psycopg2.connect(run.url)
        cursor = own.cursor("named")
        cursor.execute("select pair_id from pairs limit 30")
        return len(cursor.fetchall())
    run.check("a cursor of the server", named, 30)
    run.check("readonly session", lambda: lake.set_session(readonly=True) is None)
    run.check("register_composite", lambda: psycopg2.extras.register_default_json(lake) is not None)


def pg8000(run):
    import pg8000.dbapi
    import pg8000.native
    where = split_url(run.url)
    lake = pg8000.native.Connection(where["user"], host=where["host"], port=where["port"], database=where["database"])
    def one(sql, values):
        named = {f"v{i + 1}": value for i, value in enumerate(values)}
        return lake.run(sql, **named)[0]
    # pg8000 takes a colon for a placeholder of its own; casts are written out.
    check_values(run, lambda sql, values: one(sql, values), lambda n: f":v{n}")
    def fetch(sql):
        rows = lake.run(sql)
        return [(column["name"], column["type_oid"]) for column in lake.columns], rows
    check_tables(run, fetch)
    prepared = lambda: lake.prepare("select pair_id from pairs where pair_id < :n").run(n=4)
    run.check("prepared", lambda: len(prepared()), 4)
    lake.close()


def asyncpg(run):
    import asyncpg as driver

    async def connected(act):
        lake = await driver.connect(run.url)
        try:
            return await act(lake)
        finally:
            lake.terminate()
    ask = lambda act: asyncio.run(connected(act))
    check_values(run, lambda sql, values: ask(lambda lake: lake.fetchrow(sql, *values)), lambda n: f"${n}")
    async def fetch(lake, sql):
        statement = await lake.prepare(sql)
        async with lake.transaction(readonly=True):
            rows = [tuple(row) async for row in statement.cursor(prefetch=FETCHED_ROWS)]
        return [(a.name, a.type.name) for a in statement.get_attributes()], rows
    check_tables(run, lambda sql: ask(lambda lake: fetch(lake, sql)))
    when = datetime.datetime(2020, 1, 1, tzinfo=datetime.timezone.utc)
    run.check("a time", lambda: ask(lambda lake: lake.fetchval("select $1::timestamptz", when)), when)
    run.check("any without a type", lambda: ask(lambda lake: lake.fetchval("select count(*) from pairs where pair_id = any($1)", [1, 2])), 2)
    run.check("any of texts", lambda: ask(lambda lake: lake.fetchval("select count(*) from runs where run_id = any($1)", ["x"])), 0)
    run.check("numeric[]", lambda: ask(lambda lake: lake.fetchval("select array[1.5::numeric(8,2)]")), [decimal.Decimal("1.50")])
    run.check("reset", lambda: ask(lambda lake: lake.reset()) is None)
    async def pooled():
        async with driver.create_pool(run.url, min_size=1, max_size=2) as pool:
            async with pool.acquire() as lake:
                first = await lake.fetchval("select 1")
            async with pool.acquire() as lake:
                return first + await lake.fetchval("select 2")
    run.check("pool", lambda: asyncio.run(pooled()), 3)
    async def cursor(lake):
        async with lake.transaction(readonly=True):
            return len([row async for row in lake.cursor("select pair_id from pairs limit 40", prefetch=7)])
    run.check("cursor", lambda: ask(cursor), 40)
    run.check("introspection", lambda: ask(lambda lake: lake.fetchval("select 'x'::name")), "x")
    async def prepared(lake):
        statement = await lake.prepare("select pair_id, direct_mm from pairs where pair_id = $1")
        return [p.name for p in statement.get_parameters()], [a.type.name for a in statement.get_attributes()]
    run.check("prepared types", lambda: ask(prepared), (["int4"], ["int4", "float8"]))


def sql_type(kind, engine):
    """Postgres' name of a type of SQLAlchemy's."""
    written = kind.compile(dialect=engine.dialect)
    return SQL_TYPES.get(written, written)


def sqlalchemy(run):
    import pandas
    import sqlalchemy as sa
    for driver in "psycopg", "psycopg2", "pg8000", "asyncpg":
        if driver == "asyncpg":
            from sqlalchemy.ext.asyncio import create_async_engine
            async def select():
                engine = create_async_engine(run.url.replace("postgresql://", "postgresql+asyncpg://"))
                async with engine.connect() as lake:
                    return (await lake.execute(sa.text("select count(*) from pairs where pair_id < :n"), {"n": 4})).scalar()
            run.check("asyncpg: select", lambda: asyncio.run(select()), 4)
            continue
        engine = sa.create_engine(run.url.replace("postgresql://", f"postgresql+{driver}://"))
        inspector = lambda: sa.inspect(engine)
        name = lambda what: f"{driver}: {what}"
        run.check(name("schemas"), lambda: "public" in inspector().get_schema_names())
        run.check(name("tables"), lambda: "measurements" in inspector().get_table_names())
        run.check(name("views"), lambda: len(inspector().get_view_names()) > 0)
        run.check(name("views are no tables"), lambda: not set(inspector().get_view_names()) & set(inspector().get_table_names()))
        run.check(name("columns"), lambda: inspector().get_columns("pairs")[0]["name"] == "pair_id")
        for about in "get_pk_constraint", "get_foreign_keys", "get_indexes", "get_unique_constraints", "get_check_constraints", "get_table_comment":
            run.check(name(about), lambda: getattr(inspector(), about)("pairs") is not None)
        run.check(name("comment"), lambda: bool(inspector().get_table_comment("pairs")["text"]))
        run.check(name("column's comment"), lambda: bool(inspector().get_columns("pairs")[0]["comment"]))
        run.check(name("has_table"), lambda: inspector().has_table("pairs"))
        run.check(name("enums"), lambda: inspector().get_enums() == [])
        def reflected(sql):
            table = sa.Table(re.search('from "(.*?)"', sql)[1], sa.MetaData(), autoload_with=engine)
            own = engine.connect().execution_options(stream_results=True, max_row_buffer=FETCHED_ROWS)
            rows = own.execute(sa.text(sql).columns(*table.columns))
            return [(c.name, sql_type(c.type, engine)) for c in table.columns], (tuple(row) for row in rows)
        if driver == "psycopg":
            check_tables(run, reflected)
        def types():
            table = sa.Table("measurements", sa.MetaData(), autoload_with=engine)
            return sql_type(table.c.ir.type, engine)
        run.check(name("list's type"), types, "_float4")
        def reflect():
            known = sa.MetaData()
            known.reflect(engine, views=True)
            return len(known.tables) == len(list_tables(run.url))
        run.check(name("reflect all"), reflect)
        def limited():
            table = sa.Table("pairs", sa.MetaData(), autoload_with=engine)
            with engine.connect() as lake:
                return len(lake.execute(sa.select(table).where(table.c.pair_id.in_([1, 2, 3])).limit(2).offset(1)).all())
        run.check(name("limit and in"), limited, 2)
        run.check(name("pandas.read_sql"), lambda: pandas.read_sql("select * from pairs limit 3", engine).shape[0], 3)
        run.check(name("pandas.read_sql_table"), lambda: len(pandas.read_sql_table("runs", engine)) > 0)


def sqlacodegen(run):
    program = os.path.join(os.path.dirname(sys.executable), "sqlacodegen")
    for form in "declarative", "tables", "dataclasses":
        for more in [], ["--noviews"]:
            ask = lambda: subprocess.run([program, "--generator", form, *more, run.url.replace("postgresql://", "postgresql+psycopg://")], capture_output=True, text=True, timeout=TIMEOUT_SECS)
            def made():
                ran = ask()
                if ran.returncode or "measurements" not in ran.stdout:
                    raise RuntimeError(ran.stderr[-500:])
                return True
            run.check(" ".join([form, *more]), made)


def ibis(run):
    import ibis
    where = split_url(run.url)
    lake = ibis.postgres.connect(**where)
    run.check("list_tables", lambda: "pairs" in lake.list_tables())
    run.check("list_databases", lambda: "public" in lake.list_databases())
    run.check("version", lambda: bool(lake.version))
    for table in list_tables(run.url):
        run.check(f"schema of {table}", lambda: len(lake.table(table).schema()) > 0)
        run.check(f"{table}", lambda: lake.table(table).limit(3).execute() is not None)
    run.check("filter", lambda: len(lake.table("pairs").filter(lambda t: t.pair_id < 5).execute()), 5)
    run.check("group", lambda: len(lake.table("pairs").group_by("microphone").agg(n=lambda t: t.count()).execute()) > 0)
    run.check("mutate", lambda: lake.table("pairs").mutate(m=lambda t: t.direct_mm / 1000).limit(2).execute().shape[0], 2)
    run.check("type of a list", lambda: str(lake.table("measurements").schema()["ir"]).strip("!"), "array<float32>")
    run.check("sql", lambda: len(lake.sql("select 1 as a").execute()), 1)
    run.check("to_pyarrow", lambda: lake.table("pairs").limit(2).to_pyarrow().num_rows, 2)
    def fetch(sql):
        table, *keys = re.findall('"(.*?)"', sql)
        return fetch_arrow(lake.table(table).order_by(keys).to_pyarrow_batches(chunk_size=FETCHED_ROWS))
    check_tables(run, fetch)


def pgcli(run):
    from pgcli.pgexecute import PGExecute
    from pgspecial.main import PGSpecial
    special = PGSpecial()
    where = split_url(run.url)
    lake = PGExecute(where["database"], where["user"], None, where["host"], where["port"])
    for name in "tables", "views", "table_columns", "view_columns", "databases", "foreignkeys", "functions", "datatypes", "casing":
        run.check(name, lambda: list(getattr(lake, name)()) is not None)
    run.check("schemata", lambda: "public" in lake.schemata())
    run.check("search_path", lambda: "public" in lake.search_path())
    run.check("views are found", lambda: len(list(lake.views())) > 0)
    run.check("functions are found", lambda: len(list(lake.functions())) > 0)
    run.check("view_definition", lambda: bool(lake.view_definition("tnce_db")))
    for command in r"\d", r"\dt", r"\dv", r"\df upper", r"\dn", r"\du", r"\l", r"\d pairs", r"\dT", r"\dx", r"\dD", r"\dp", r"\ddp", r"\dm", r"\ds", r"\di", r"\db":
        def ask():
            for title, rows, headers, status, *_ in lake.run(command, special):
                if rows is not None:
                    list(rows)
                if isinstance(status, str) and "ERROR" in status.upper():
                    raise RuntimeError(status)
            return True
        run.check(command, ask)


def fetch_arrow(batches):
    """Columns with their types, and rows, of a reader of record batches."""
    return [(field.name, type_of_arrow(field.type)) for field in batches.schema], take_batches(batches)


def take_batches(batches):
    """The rows of record batches, as they come."""
    return (row for batch in batches for row in zip(*(column.to_pylist() for column in batch.columns)))


def flight_sql(run):
    import adbc_driver_flightsql.dbapi as driver
    with driver.connect(run.flight, autocommit=True) as lake, lake.cursor() as cursor:
        def fetch(sql):
            cursor.execute(sql)
            return fetch_arrow(cursor.fetch_record_batch())
        check_tables(run, fetch)


def adbc(run):
    import adbc_driver_postgresql.dbapi as driver
    with driver.connect(run.url, autocommit=True) as lake:
        def ask(sql, values=None):
            with lake.cursor() as cursor:
                cursor.execute(sql, values or None)
                return cursor.fetch_arrow_table()
        row = lambda sql, values: tuple(ask(sql, values).to_pylist()[0].values())
        check_values(run, row, lambda n: f"${n}", skip={"select 1, 1", "select count(*) from pairs where pair_id = any($1::int[])"})
        with lake.cursor() as cursor:
            def fetch(sql):
                cursor.execute(sql)
                return fetch_arrow(cursor.fetch_record_batch())
            check_tables(run, fetch)
        for depth in "catalogs", "db_schemas", "tables", "columns", "all":
            run.check(f"get_objects {depth}", lambda: lake.adbc_get_objects(depth=depth).read_all().num_rows > 0)
        run.check("get_objects of a table", lambda: "pairs" in str(lake.adbc_get_objects(depth="columns", table_name_filter="pairs").read_all().to_pylist()))
        run.check("get_table_types", lambda: "table" in lake.adbc_get_table_types())
        run.check("get_info", lambda: bool(lake.adbc_get_info()))
        for table in list_tables(run.url):
            run.check(f"get_table_schema {table}", lambda: len(lake.adbc_get_table_schema(table).names) > 0)


def odbc(run):
    import pyodbc
    where = split_url(run.url)
    settings = f"Driver={{PostgreSQL Unicode}};Server={where['host']};Port={where['port']};Uid={where['user']};Database={where['database']};UseDeclareFetch=1;Fetch={FETCHED_ROWS}"
    lake = pyodbc.connect(settings, autocommit=True)
    arrays = [sql for sql, values, expected in VALUES if "array" in sql or "any(" in sql]
    check_values(run, lambda sql, values: lake.execute(sql, *values).fetchone(), lambda n: "?", skip=arrays)
    cursor = lake.cursor()
    def fetch(sql):
        table = re.search('from "(.*?)"', sql)[1]
        types = [(row.column_name, row.type_name) for row in lake.cursor().columns(table=table, schema="public").fetchall()]
        return types, lake.execute(sql)
    check_tables(run, fetch)
    for name, arguments in [
        ("tables", {}), ("columns", {"table": "pairs"}), ("statistics", {"table": "pairs"}), ("primaryKeys", {"table": "pairs"}),
        ("foreignKeys", {"table": "pairs"}), ("getTypeInfo", {}), ("procedures", {}), ("rowIdColumns", {"table": "pairs"}),
    ]:
        run.check(name, lambda: getattr(cursor, name)(**arguments).fetchall() is not None)
    run.check("tables are found", lambda: any(row.table_name == "pairs" for row in cursor.tables(tableType="TABLE").fetchall()))
    run.check("views are found", lambda: len(cursor.tables(tableType="VIEW").fetchall()) > 0)


def polars(run):
    import connectorx
    import polars as pl
    sql = "select surface_id, pair_id, snr_db from measurements limit 7"
    for protocol in "binary", "csv", "cursor", "simple":
        run.check(f"connectorx {protocol}", lambda: connectorx.read_sql(run.url, sql, protocol=protocol).shape, (7, 3))
    run.check("read_database_uri", lambda: pl.read_database_uri(sql, run.url).shape, (7, 3))
    run.check("read_database_uri adbc", lambda: pl.read_database_uri(sql, run.url, engine="adbc").shape, (7, 3))
    for table in list_tables(run.url):
        run.check(f"adbc {table}", lambda: pl.read_database_uri(f"select * from {table} limit 3", run.url, engine="adbc") is not None)
    def fetch(sql):
        batches = connectorx.read_sql(run.url, sql, return_type="arrow_stream", batch_size=FETCHED_ROWS)
        # It makes all numbers 64 bits wide.
        return [(name, None) for name in batches.schema.names], take_batches(batches)
    check_tables(run, fetch)


def node(run):
    run.run_program(["node", "clients.mjs", run.url], cwd=PROGRAMS)


def perl(run):
    run.run_program(["perl", os.path.join(PROGRAMS, "clients.pl"), *map(str, split_url(run.url).values())])


def jdbc(run):
    where = split_url(run.url)
    url = f"jdbc:postgresql://{where['host']}:{where['port']}/{where['database']}?user={where['user']}"
    run.run_program(["java", "-cp", "/usr/share/java/postgresql.jar", os.path.join(PROGRAMS, "Clients.java"), url])


def go(run, driver):
    with tempfile.TemporaryDirectory() as folder:
        program = os.path.join(folder, "clients")
        cache = os.path.join(tempfile.gettempdir(), "go-build")
        outside = {**os.environ, "GOPATH": GO_PACKAGES, "GO111MODULE": "off", "GOCACHE": cache}
        files = [os.path.join(PROGRAMS, name) for name in ("clients.go", f"{driver}.go")]
        built = subprocess.run(["go", "build", "-o", program, *files], env=outside, capture_output=True, text=True)
        if built.returncode:
            raise RuntimeError(built.stderr)
        run.run_program([program, run.url + "?sslmode=disable"])


def lib_pq(run):
    go(run, "lib_pq")


def pgx(run):
    go(run, "pgx")


def tools(run):
    """The catalogue queries of programs that are not run themselves, one per heading in `catalogue.sql`."""
    with open(os.path.join(PROGRAMS, "catalogue.sql"), encoding="utf-8") as file:
        parts = re.split(r"^-- (.+)\n", file.read(), flags=re.MULTILINE)[1:]
    with psycopg.connect(run.url, autocommit=True) as lake:
        names = {"{schema}": "select oid::text from pg_namespace where nspname = 'public'", "{table}": "select oid::text from pg_class where relname = 'pairs'"}
        known = {name: lake.execute(sql).fetchone()[0] for name, sql in names.items()}
        for title, sql in zip(parts[::2], parts[1::2]):
            for name, value in known.items():
                sql = sql.replace(name, str(value))
            def ask():
                answer = lake.execute(sql.strip().rstrip(";"))
                rows = answer.fetchall() if answer.description else []
                # A title that ends in a plus sign says that there are rows.
                return len(rows) > 0 or not title.endswith("+")
            run.check(title, ask)


# The name of each client in the table, what runs it, and what it needs: modules of Python, programs, or folders.
CLIENTS = [
    ("psql", psql, ["psql"]),
    ("psycopg 3", psycopg_3, []),
    ("psycopg2", psycopg_2, ["psycopg2"]),
    ("pg8000", pg8000, ["pg8000"]),
    ("asyncpg", asyncpg, ["asyncpg"]),
    ("SQLAlchemy, pandas", sqlalchemy, ["sqlalchemy", "pandas"]),
    ("sqlacodegen", sqlacodegen, ["sqlacodegen"]),
    ("ibis", ibis, ["ibis"]),
    ("pgcli", pgcli, ["pgcli"]),
    ("ADBC Flight SQL", flight_sql, []),
    ("ADBC", adbc, ["adbc_driver_postgresql"]),
    ("polars, connectorx", polars, ["polars", "connectorx"]),
    ("ODBC", odbc, ["pyodbc"]),
    ("Node: pg, postgres.js, knex", node, ["node"]),
    ("Perl: DBD::Pg", perl, ["perl"]),
    ("Java: pgjdbc", jdbc, ["java"]),
    ("Go: lib/pq", lib_pq, ["go", f"{GO_PACKAGES}/src/github.com/lib/pq"]),
    ("Go: pgx", pgx, ["go", f"{GO_PACKAGES}/src/github.com/jackc/pgx/v4"]),
    ("catalogue queries of DBeaver, Grafana, Metabase, Superset, Tableau, Power BI, DataGrip", tools, []),
]


def find_missing(needs):
    """What is needed and not installed."""
    for need in needs:
        if need.startswith("/"):
            if not os.path.isdir(need):
                return need
            continue
        if need in ("psql", "node", "perl", "java", "go"):
            if not shutil.which(need):
                return need
            continue
        try:
            importlib.import_module(need)
        except ImportError:
            return need
    return None


def run_clients(url, names, tables, flight):
    """The results by client: check and text of its failure, None if it passed; without `flight` not over Flight SQL."""
    results = {}
    for name, act, needs in CLIENTS:
        if names and not any(asked.lower() in name.lower() for asked in names):
            continue
        if missing := find_missing(needs):
            print(f"left out: {name} ({missing} is not installed)", file=sys.stderr)
            continue
        if act is flight_sql and not flight:
            continue
        run = ClientRun(url, tables, flight)
        try:
            act(run)
        except Exception as error:  # a client that cannot even connect
            run.results["the client"] = f"{type(error).__name__}: {error}"[:600]
        results[name] = run.results
        print(f"{name}: {count_passed(run.results)} of {len(run.results)}", file=sys.stderr, flush=True)
    return results


def count_passed(results):
    """How many checks did not fail."""
    return sum(error is None for error in results.values())


def load_control(url, control, tables):
    """Loads all tables, and the rows of views as tables with views of them under the views' names."""
    with psycopg.connect(url, autocommit=True) as lake, psycopg.connect(control, autocommit=True) as own:
        kinds = dict(lake.execute("select table_name, table_type from information_schema.tables where table_schema = 'public'").fetchall())
        own.execute("drop schema if exists public, stored cascade; create schema public; create schema stored")
        queries = {table.table: table.sql for table in tables}
        for name, kind in kinds.items():
            is_view = kind == "VIEW" or name not in BASE_TABLES
            stored = f"{name}_rows" if is_view else name
            answer = lake.execute(f'select * from "{name}" limit 0')
            types = [own.execute("select format_type(%s, -1)", (c.type_code,)).fetchone()[0] for c in answer.description]
            columns = ", ".join(f'"{c.name}" {kind}' for c, kind in zip(answer.description, types))
            own.execute(f'create table "{stored}" ({columns})')
            with lake.cursor().copy(f"copy ({queries[name]}) to stdout") as source, own.cursor().copy(f'copy "{stored}" from stdin') as target:
                for part in source:
                    target.write(part)
            if is_view:
                own.execute(f'alter table "{stored}" set schema stored; create view "{name}" as select * from stored."{stored}"')
            else:
                own.execute(f"comment on table \"{name}\" is 'a table'")
                for column in answer.description:
                    own.execute(f"comment on column \"{name}\".\"{column.name}\" is 'a column'")


BASE_TABLES = {"surfaces", "runs", "points", "pairs", "measurements", "nce", "tnce", "tnce_d4", "heightmaps", "environment", "events", "surface_stats"}


def format_table(results, control, before=()):
    """The table as Markdown; the lines `before` are those of clients that did not run."""
    rows = {line.split(" | ")[0].removeprefix("| "): line for line in before}
    for name, checks in results.items():
        beside = count_passed(control[name]) if name in control else ""
        rows[name] = f"| {name} | {count_passed(checks)} | {len(checks)} | {beside} |"
    lines = [rows[name] for name, *_ in CLIENTS if name in rows]
    return "\n".join(["| client | passed | tried | PostgreSQL |", "| --- | --- | --- | --- |", *lines])


def main():
    signal.signal(signal.SIGALRM, stop_check)
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("url")
    parser.add_argument("--lake", required=True, help="the folder of the lake that is served")
    parser.add_argument("--flight", required=True, help="where it is served over Arrow Flight SQL")
    parser.add_argument("--control", help="an empty database of a real PostgreSQL; its schema public is replaced")
    parser.add_argument("--client", action="append", default=[], help="a part of a client's name")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--write", help="the page whose table is replaced")
    given = parser.parse_args()
    tables = load_tables(given.lake, given.flight)
    control = {}
    if given.control:
        load_control(given.url, given.control, tables)
        print("PostgreSQL:", file=sys.stderr)
        control = run_clients(given.control, given.client, tables, None)
        print("echolake:", file=sys.stderr)
    results = run_clients(given.url, given.client, tables, given.flight)
    if given.json:
        print(json.dumps({"results": results, "control": control}, indent=1))
        return 0
    print(format_table(results, control))
    for name, checks in results.items():
        for check, failure in checks.items():
            if failure is not None:
                beside = " (PostgreSQL, too)" if control.get(name, {}).get(check) else ""
                print(f"FAIL {name}: {check}{beside}: {' '.join(failure.split())[:300]}")
    if given.write:
        before = read_table(given.write, "postgres_clients.py") if given.client else ()
        write_table(given.write, "postgres_clients.py", format_table(results, control, before))
    return int(any(failure for checks in results.values() for failure in checks.values()))


if __name__ == "__main__":
    sys.exit(main())
