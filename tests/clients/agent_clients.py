"""Checks agents and spreadsheets: `agent_clients.py ECHOLAKE LAKE [--write docs/clients.md]`.

It serves the lake with tokens and asks it with the official Python client of the Model Context Protocol, in the protocol's
revision of 2026-07-28, in those with a handshake, and over `echolake mcp`; then with delta-sharing and pandas, whose values
must be those that SQL answers. `--write` replaces the table in that page. Needs the PyPI packages mcp, delta-sharing, pandas
and pyarrow.
"""
import argparse
import asyncio
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request

from checks import write_table

WORDS = ["list_tables", "describe_table", "query", "list_functions", "surface_summary", "run_summary", "slice_url"]
# Calls that are not right, and a part of what is said about each.
HOSTILE = [
    ("query", {}, "missing field `sql`"),
    ("query", {"sql": 7}, "expected a string"),
    ("query", {"sql": "select 1", "max_rows": 10**9}, "hint: 1 to 1000"),
    ("query", {"sql": "select 1", "format": "csv"}, "hint: max_rows, sql"),
    ("query", {"sql": "drop table runs"}, "read_only"),
    ("query", {"sql": "copy runs to '/tmp/x.csv'"}, "read_only"),
    ("query", {"sql": "set datafusion.execution.batch_size = 1"}, "read_only"),
    ("query", {"sql": "select * from '/etc/passwd'"}, "query_invalid"),
    ("query", {"sql": "select tnce_totl from tnce"}, "hint"),
    ("query", {"sql": "select " + "(" * 5000 + "1" + ")" * 5000}, "query_invalid"),
    ("describe_table", {"table": "pg_shadow"}, "hint"),
    ("describe_table", {"table": ["runs"]}, "expected a string"),
    ("surface_summary", {"surface_id": "../../etc/passwd"}, "not_found"),
    ("surface_summary", {"surface_id": "x' or 1=1 --"}, "not_found"),
    ("run_summary", {"run_id": "%2e%2e"}, "not_found"),
    ("slice_url", {}, "hint"),
    ("slice_url", {"where": "true) or (true"}, "one expression"),
    ("slice_url", {"runs": ["no such run"]}, "not_found"),
    ("list_functions", {"search": {"$gt": ""}}, "expected a string"),
]


class TokenServer:
    """A server with a token."""

    def __init__(self, program, lake, folder, port):
        made = subprocess.run([program, "token", "agent"], check=True, capture_output=True, text=True)
        self.token = made.stderr.split()[0]
        tokens = os.path.join(folder, "tokens.toml")
        with open(tokens, "w", encoding="utf-8") as file:
            file.write(made.stdout)
        listen = ["--listen", f"127.0.0.1:{port}", "--flight-sql", "off", "--postgres", "off", "--tokens", tokens]
        self.origin = f"http://127.0.0.1:{port}"
        self.process = subprocess.Popen([program, "--lake", lake, "serve", *listen], stderr=subprocess.DEVNULL)
        self.wait()

    def wait(self):
        """Until it takes requests."""
        for _ in range(300):
            try:
                return self.read("/ready")
            except OSError:
                time.sleep(0.1)
        sys.exit("the server is not ready within 30 s")

    def read(self, path, token=None, **more):
        """The answer to a request."""
        headers = {"authorization": f"Bearer {token}"} if token else {}
        url = path if path.startswith("http") else self.origin + path
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers, **more), timeout=120) as answer:
            return answer.read()

    def rows(self, sql):
        """The rows of a query."""
        request = urllib.request.Request(self.origin + "/api/v1/sql", data=sql.encode(), headers={
            "authorization": f"Bearer {self.token}", "content-type": "application/sql"})
        with urllib.request.urlopen(request, timeout=120) as answer:
            return json.load(answer)

    def status(self, path, token=None, **more):
        """The status of the answer."""
        try:
            self.read(path, token, **more)
            return 200
        except urllib.error.HTTPError as refused:
            return refused.code

    def stop(self):
        """Ends it."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait(60)


class ClientChecks:
    """The checks of a client."""

    def __init__(self, name):
        self.name, self.passed, self.tried = name, 0, 0

    def holds(self, what, is_right, found=""):
        """Counts one."""
        self.tried += 1
        self.passed += bool(is_right)
        if not is_right:
            print(f"FAIL {self.name}: {what}: {str(found)[:600]}", file=sys.stderr)

    def run(self, what, act):
        """Counts one, whatever it throws."""
        try:
            found = act()
            self.holds(what, found is None or found is True, found)
        except Exception as error:  # whatever a client throws is a failure of this check alone
            self.holds(what, False, f"{type(error).__name__}: {error}")


async def ask_as_agent(checks, client, server):
    """Every tool, and what is not right."""
    checks.holds("tools", [tool.name for tool in (await client.list_tools()).tools] == WORDS)

    async def value(tool, **arguments):
        result = await client.call_tool(tool, arguments)
        checks.holds(f"{tool} {arguments}"[:80], not result.is_error, result.content)
        text = json.loads(result.content[0].text) if not result.is_error else None
        checks.holds(f"{tool}: text and value are the same", text == result.structured_content)
        return result.structured_content

    tables = await value("list_tables")
    names = {table["name"] for table in tables["tables"]}
    checks.holds("tables", {"surfaces", "tnce", "tnce_db", "ir"} <= names and all(t["meaning"] for t in tables["tables"]), tables)
    described = await value("describe_table", table="tnce_db")
    units = {column["name"]: column["unit"] for column in described["columns"]}
    checks.holds("units", units.get("incidence_deg") and "select" in described["definition"].lower(), units)
    asked = "select count(*) as n, min(direct_mm) as shortest from pairs"
    answer = await value("query", sql=asked)
    expected = server.rows(asked)[0]
    checks.holds("rows", answer["rows"] == [[expected["n"], expected["shortest"]]] and not answer["truncated"], answer)
    answer = await value("query", sql="select pair_id from pairs order by pair_id")
    is_cut = answer["row_count"] == 100 and answer["truncated"] and "max_rows" in answer["note"]
    checks.holds("rows end at 100 and it is said", is_cut == (expected["n"] > 100), answer["note"] if is_cut else answer)
    answer = await value("query", sql="select ir from measurements", max_rows=1000)
    checks.holds("bytes end and it is said", answer["truncated"] and len(json.dumps(answer)) < 150_000, len(json.dumps(answer)))
    functions = await value("list_functions")
    checks.holds("functions", any("p90" in f["syntax"] and f.get("example") for f in functions["functions"]), functions)
    found = await value("list_functions", search="fresnel")
    checks.holds("a function is found", 0 < len(found["functions"]) < 20, found)
    surface = await value("surface_summary", surface_id="flat")
    run = surface["runs"][-1]
    summary = await value("run_summary", run_id=run)
    checks.holds("the run", summary["run"]["surface_id"] == "flat" and summary["topics"], summary)
    one = await value("slice_url", runs=[run], where="pair_id < 3", topics=["/ir"])
    return run, surface, summary, one


async def ask_hostile(checks, client):
    """What is not right is an error that says so, and the next call is answered."""
    for tool, arguments, part in HOSTILE:
        result = await client.call_tool(tool, arguments)
        text = result.content[0].text
        checks.holds(f"{tool} {arguments}"[:80], result.is_error and part in text, text)
    result = await client.call_tool("query", {"sql": "select 1 as one"})
    checks.holds("afterwards", not result.is_error and result.structured_content["rows"] == [[1]], result)


async def agent_over_http(checks, server, mode):
    """The client over HTTP."""
    import httpx2
    from mcp import Client
    from mcp.client.streamable_http import streamable_http_client

    def client(token):
        http = httpx2.AsyncClient(headers={"authorization": f"Bearer {token}"}, timeout=120)
        return Client(streamable_http_client(server.origin + "/mcp", http_client=http), mode=mode)

    async with client(server.token) as agent:
        _, surface, summary, one = await ask_as_agent(checks, agent, server)
        await ask_hostile(checks, agent)
    for link in [*surface["links"].values(), *summary["links"].values(), one["url"], one["foxglove_manifest"]]:
        if not link.endswith(".glb"):
            checks.holds(f"link {link}", server.status(link, server.token) == 200)
    magic = server.read(one["url"], server.token)[:5]
    checks.holds("the slice is an MCAP file", magic == b"\x89MCAP", magic)
    try:
        async with client(server.token[:-1] + "x"):
            checks.holds("a wrong token", False, "let in")
    except Exception:  # whatever the client throws is a refusal
        checks.holds("a wrong token", True)


async def agent_over_pipes(checks, server, program, lake):
    """The client with a server of its own on standard input and output."""
    from mcp import Client
    from mcp.client.stdio import StdioServerParameters

    own = StdioServerParameters(command=program, args=["--lake", lake, "mcp", "--pages", server.origin])
    async with Client(own) as agent:
        _, surface, _, _ = await ask_as_agent(checks, agent, server)
        await ask_hostile(checks, agent)
        checks.holds("links", surface["links"]["page"].startswith(server.origin), surface["links"])


def foreign_pages(checks, server):
    """What a browser's page of elsewhere gets."""
    message = json.dumps({"jsonrpc": "2.0", "id": 1, "method": "tools/list"}).encode()
    checks.holds("no token", server.status("/mcp", data=message) == 401)


def shared_tables(checks, server, folder):
    """Every shared table as pandas reads it, against SQL."""
    import delta_sharing
    import pandas

    profile = os.path.join(folder, "lake.share")
    with open(profile, "wb") as file:
        file.write(server.read("/delta-sharing/profile.share", server.token))
    client = delta_sharing.SharingClient(profile)
    tables = client.list_all_tables()
    names = {table.name for table in tables}
    checks.holds("tables", {"surfaces", "tnce", "tnce_db", "catalogue", "measurements"} <= names, names)
    checks.holds("views with lists are not shared", not {"ir", "augmented"} & names, names)
    for table in tables:
        url = f"{profile}#{table.share}.{table.schema}.{table.name}"
        columns = [row["column_name"] for row in server.rows(
            f"select column_name from information_schema.columns where table_name = '{table.name}' order by ordinal_position")]
        count = server.rows(f"select count(*) as n from {table.name}")[0]["n"]

        def is_same(url=url, count=count, columns=columns, table=table):
            found = delta_sharing.load_as_pandas(url)
            if (len(found), list(found.columns)) != (count, columns):
                return f"{len(found)} rows, expected {count}; {set(columns) ^ set(found.columns)}"
            numbers = [c for c in columns if found[c].dtype.kind in "if"][:8]
            sums = ", ".join(f'sum(cast("{c}" as double)) as "{c}"' for c in numbers)
            expected = server.rows(f"select {sums} from {table.name}")[0] if numbers else {}
            for name, value in expected.items():
                total = found[name].astype("float64").sum()
                if value is not None and abs(total - value) > 1e-6 * max(1.0, abs(value)):
                    return f"sum of {name} is {total}, expected {value}"
            return None

        if count > 200_000:
            checks.run(f"{table.name}, 10 rows", lambda url=url: len(delta_sharing.load_as_pandas(url, limit=10)) == 10)
        else:
            checks.run(table.name, is_same)
    url = f"{profile}#echolake.lake."
    checks.run("version", lambda: delta_sharing.get_table_version(url + "tnce") >= 0)
    checks.run("limit", lambda: len(delta_sharing.load_as_pandas(url + "pairs", limit=7)) == 7)
    checks.run("lists", lambda: len(delta_sharing.load_as_pandas(url + "measurements", limit=2)["ir"][1]) > 100)
    metadata = delta_sharing.get_table_metadata(url + "tnce_db")
    checks.holds("metadata", "incidence_deg" in metadata.schema_string, metadata)
    checks.holds("empty", isinstance(delta_sharing.load_as_pandas(url + "runs", limit=0), pandas.DataFrame))
    addresses(checks, server, folder, profile)


def addresses(checks, server, folder, profile):
    """Files are read by their addresses, which are for these files alone."""
    import delta_sharing

    base = "/delta-sharing/shares/echolake/schemas/lake/tables/"
    lines = server.read(base + "runs/query", server.token, data=b"{}").decode().splitlines()
    file = json.loads(lines[2])["file"]
    whole = server.read(file["url"])
    checks.holds("an address needs no token", len(whole) == file["size"] and whole[:4] == b"PAR1", len(whole))
    part = urllib.request.Request(file["url"], headers={"range": "bytes=0-3"})
    with urllib.request.urlopen(part, timeout=60) as answer:
        checks.holds("by ranges", (answer.status, answer.read()) == (206, b"PAR1"))
    head = urllib.request.Request(file["url"], method="HEAD")
    with urllib.request.urlopen(head, timeout=60) as answer:
        checks.holds("its length", int(answer.headers["content-length"]) == file["size"])
    parts = file["url"].split("/")
    for at, changed in [(-1, "x.parquet"), (-2, "surfaces"), (-3, "00" * 32), (-4, "99999999999"), (-5, "61")]:
        other = "/".join([*parts[:at], changed, *parts[at + 1 or len(parts):]])
        checks.holds(f"another address: {changed}", server.status(other) in (401, 404), other)
    for path, method in [("no_table/query", b"{}"), ("ir/query", b"{}"), ("runs/query", b"[")]:
        checks.holds(path, server.status(base + path, server.token, data=method) in (400, 404))
    checks.holds("the past", server.status(base + "runs/query", server.token, data=b'{"version": 0}') == 400)
    checks.holds("changes", server.status(base + "runs/changes?startingVersion=0", server.token) == 400)
    checks.holds("without a token", server.status(base + "runs/query", data=b"{}") == 401)
    wrong = os.path.join(folder, "wrong.share")
    with open(profile, encoding="utf-8") as file, open(wrong, "w", encoding="utf-8") as other:
        json.dump(json.load(file) | {"bearerToken": "echolake_" + "0" * 64}, other)
    try:
        delta_sharing.load_as_pandas(wrong + "#echolake.lake.runs")
        checks.holds("a wrong token", False, "let in")
    except Exception:  # whatever the client throws is a refusal
        checks.holds("a wrong token", True)


def version_of(package):
    """A package's version."""
    from importlib.metadata import version

    return f"{package} {version(package)}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("program")
    parser.add_argument("lake")
    parser.add_argument("--port", type=int, default=9543)
    parser.add_argument("--write", help="the page whose table is replaced")
    given = parser.parse_args()
    program, lake = os.path.abspath(given.program), os.path.abspath(given.lake)
    agents = version_of("mcp")
    all_checks = [
        ClientChecks(f"{agents}, `POST /mcp`, revision 2026-07-28"),
        ClientChecks(f"{agents}, `POST /mcp`, with a handshake"),
        ClientChecks(f"{agents}, `echolake mcp`"),
        ClientChecks(f"{version_of('delta-sharing')}, {version_of('pandas')}"),
    ]
    with tempfile.TemporaryDirectory() as folder:
        server = TokenServer(program, lake, folder, given.port)
        try:
            steps = [
                lambda checks: asyncio.run(agent_over_http(checks, server, "auto")),
                lambda checks: asyncio.run(agent_over_http(checks, server, "legacy")),
                lambda checks: asyncio.run(agent_over_pipes(checks, server, program, lake)),
                lambda checks: shared_tables(checks, server, folder),
            ]
            for checks, step in zip(all_checks, steps):
                try:
                    step(checks)
                except Exception as error:  # it is a failure of this client, and the others are tried
                    checks.holds("to the end", False, f"{type(error).__name__}: {error}")
            foreign_pages(all_checks[0], server)
        finally:
            server.stop()
    lines = ["| client | passed | tried |", "| --- | --- | --- |"]
    lines += [f"| {checks.name} | {checks.passed} | {checks.tried} |" for checks in all_checks]
    table = "\n".join(lines)
    print(table)
    if given.write:
        write_table(given.write, "agent_clients.py", table)
    return int(any(checks.passed < checks.tried for checks in all_checks))


if __name__ == "__main__":
    sys.exit(main())
