#!/usr/bin/env python3
"""Times two builds of echolake beside each other: `compare_programs.py NEW OLD [--surfaces N] [--rounds N]`.

Both make a lake by `demo`, ingest the same run files (those of OLD's lake), and answer the twelve queries of
`bench queries` from a server over HTTP, each on its own lake. They take turns, and each round begins with the other
one. Prints, for each work, the medians in seconds and the ratio NEW / OLD, as the median of the rounds with its range.
Where the answers differ in their number of rows, it says so: the ratio then compares different work. Needs nothing but
Python.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

QUERIES = Path(__file__).resolve().parent.parent / "stress/src/bench/queries/twelve.sql"
# A query is asked this often in a round; its time is the least, because a busy machine only ever adds to it.
ASKED = 5
LONGEST_SECONDS = 1800
STARTED_WITHIN_SECONDS = 60


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("new", type=Path)
    parser.add_argument("old", type=Path)
    parser.add_argument("--surfaces", type=int, default=6, help="surfaces of the demo (6)")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of each work (5)")
    options = parser.parse_args()
    programs = [options.new.resolve(), options.old.resolve()]
    with tempfile.TemporaryDirectory() as folder:
        lakes = [Path(folder) / "new", Path(folder) / "old"]
        compare("demo", options.rounds, lambda side: demo(programs[side], lakes[side], options.surfaces))
        compare("ingest", options.rounds, lambda side: ingest(programs[side], lakes[1], Path(folder) / "ingested"))
        servers = [Server(program, lake) for program, lake in zip(programs, lakes, strict=True)]
        try:
            compare_queries(servers, options.rounds)
        finally:
            for server in servers:
                server.stop()


def compare(name: str, rounds: int, work: Callable[[int], float]) -> None:
    """Prints times and ratio of a work; `work(0)` takes seconds with the new program, `work(1)` with the old one."""
    times: list[list[float]] = [[], []]
    for number in range(rounds):
        for side in (0, 1) if number % 2 == 0 else (1, 0):
            times[side].append(work(side))
    ratios = [new / old for new, old in zip(*times, strict=True)]
    new, old = (statistics.median(side) for side in times)
    spread = f"{min(ratios):.2f} to {max(ratios):.2f}"
    print(f"{name:20} {new:9.4f} s {old:9.4f} s {statistics.median(ratios):6.2f} ({spread})", flush=True)


def demo(program: Path, lake: Path, surfaces: int) -> float:
    shutil.rmtree(lake, ignore_errors=True)
    return seconds([program, "--lake", lake, "demo", "--no-serve", "--surfaces", str(surfaces)])


def ingest(program: Path, source: Path, lake: Path) -> float:
    """Ingests the run files of another lake."""
    shutil.rmtree(lake, ignore_errors=True)
    shutil.copytree(source, lake, ignore=shutil.ignore_patterns("tables", "runs"))
    for file in (source / "runs").rglob("*.mcap"):
        shutil.copy(file, lake / "inbox" / file.name)
    return seconds([program, "--lake", lake, "ingest"])


def seconds(command: list[object]) -> float:
    begun = time.monotonic()
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, timeout=LONGEST_SECONDS)
    if done.returncode != 0:
        sys.exit(f"error: {' '.join(map(str, command))}: exit code {done.returncode}\n{done.stderr}")
    return time.monotonic() - begun


class Server:
    """A server on a port of its own; only HTTP is used."""

    def __init__(self, program: Path, lake: Path) -> None:
        ports = ["--listen", "127.0.0.1:0", "--flight-sql", "127.0.0.1:0", "--postgres", "127.0.0.1:0"]
        command = [str(program), "--lake", str(lake), "serve", *ports]
        self.log = lake.with_name(f"{lake.name}.log")
        with self.log.open("w") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log)
        begun = time.monotonic()
        while not (address := re.search(r"http://127\.0\.0\.1:\d+", self.log.read_text())):
            if self.process.poll() is not None or time.monotonic() - begun > STARTED_WITHIN_SECONDS:
                sys.exit(f"error: {program} has not started to serve: {self.log.read_text()}")
            time.sleep(0.1)
        self.address = address.group()

    def query(self, sql: str, accept: str = "application/vnd.apache.arrow.stream") -> bytes:
        headers = {"content-type": "application/json", "accept": accept}
        body = json.dumps({"query": sql}).encode()
        request = urllib.request.Request(f"{self.address}/api/v1/sql", body, headers)
        with urllib.request.urlopen(request, timeout=LONGEST_SECONDS) as answer:
            return bytes(answer.read())

    def value(self, sql: str) -> object:
        """Returns the column `value` of the first row."""
        return json.loads(self.query(sql, "application/json"))[0]["value"]

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait(LONGEST_SECONDS)


def compare_queries(servers: list[Server], rounds: int) -> None:
    surfaces = [str(server.value("select min(surface_id) as value from surfaces")) for server in servers]
    for part in QUERIES.read_text().split("\n\n-- ")[1:]:
        name, _, text = part.partition("\n")
        if "@peer" in name:
            continue
        text = text.strip().rstrip(";").replace("$PAIR", "160")
        queries = [text.replace("$SURFACE", surface) for surface in surfaces]
        count = "select count(*) as value from ({}) answer"
        rows = [server.value(count.format(sql)) for server, sql in zip(servers, queries, strict=True)]
        if rows[0] != rows[1]:
            print(f"{name}: {rows[0]} rows and {rows[1]}, so the ratio compares different work")

        def least(side: int, queries: list[str] = queries) -> float:
            times = []
            for _ in range(ASKED):
                begun = time.monotonic()
                servers[side].query(queries[side])
                times.append(time.monotonic() - begun)
            return min(times)

        compare(name, rounds, least)


if __name__ == "__main__":
    main()
