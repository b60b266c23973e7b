"""Checks agents: `agent_clients.py ECHOLAKE LAKE [--write docs/clients.md]`.

It serves the lake with tokens and asks it with the official Python client of the Model Context Protocol, in the protocol's
revision of 2026-07-28, in those with a handshake, and over `echolake mcp`. `--write` replaces the table in that page. Needs
the PyPI package mcp.
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
    ]
    with tempfile.TemporaryDirectory() as folder:
        server = TokenServer(program, lake, folder, given.port)
        try:
            steps = [
                lambda checks: asyncio.run(agent_over_http(checks, server, "auto")),
                lambda checks: asyncio.run(agent_over_http(checks, server, "legacy")),
                lambda checks: asyncio.run(agent_over_pipes(checks, server, program, lake)),
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
