#!/usr/bin/env python3
"""Queries over workers, their answers and how they scale: check_workers.py ECHOLAKE LAKE

LAKE is a lake in a folder, which is only read. First of all, answers:

    answers    every query of query-bench, of docs/functions.md and of docs/clients.md, by servers with one, two, four
               and eight workers, which spread all that can be spread: schema and rows of a server without workers.

Then scaling. Machines are processes of this one, each held to what a small machine has:

    store      each behind a proxy of its own, 30 ms a request and 20 MiB/s: a full scan of one nce column. Processors
               have nearly nothing to do.
    processor  each in a cgroup of a quarter of a core, the lake in its folder: band energies of all responses.
    light      no limits: queries that are not spread, by a server with two workers beside one without; goal: 5 % slower.

The store of `answers` and `store` is simulated (s3_folder.py reads LAKE); with --ceph it is Ceph's gateway, into which the
tables of LAKE are copied first (CEPH_RGW_STORE=bluestore and CEPH_RGW_BYTES for a large one).

One machine is a server without workers under the same limits. With more, the server has no limits of its own: it adds up
what workers send. Each figure is the median of --repeats, with processes and caches that are new each time. Times of
processes on one machine are no measure of many machines but for such limits, so only the ratios count; goal: 3.3 times
from one machine to four. Prints bytes and requests of each, too. Needs root for cgroups. Exits with 1 if a goal is missed.
"""
import argparse
import concurrent.futures
import contextlib
import csv
import math
import os
import pathlib
import re
import statistics
import subprocess
import sys
import time

import bucket_lab as lab

GOAL, GOAL_MACHINES = 3.3, 4
LIGHT_GOAL, LIGHT_QUERIES = 1.05, 300
LIGHT_QUERY = "select pair_id, snr_db, ir from measurements where surface_id = 'flat' and pair_id = {}"
STORE_QUERY = "select count(*) as n, max(nce_5000[100]) as most from nce where nce_5000[7] > -1"
PROCESSOR_QUERY = "select count(*) as n, max(band_energy(ir)['energy_2500']) as most from measurements where pair_id >= 0"
ANSWER_WORKERS = (1, 2, 4, 8)
# Sums of floats depend on the order of their parts, in their last digits.
TOLERANCE = 1e-9
CHECKOUT = lab.HERE.parent.parent
CGROUPS = pathlib.Path("/sys/fs/cgroup")
# Of each period, the part of one core, in microseconds.
PERIOD, QUARTER = 100_000, 25_000
FIRST_PORT = 7500


class CoreShare:
    """A cgroup of a quarter of a core."""

    def __init__(self, name):
        is_first_version = (CGROUPS / "cpu").is_dir()
        self.folder = (CGROUPS / "cpu" if is_first_version else CGROUPS) / f"echolake-{os.getpid()}-{name}"
        self.folder.mkdir()
        if is_first_version:
            (self.folder / "cpu.cfs_period_us").write_text(str(PERIOD))
            (self.folder / "cpu.cfs_quota_us").write_text(str(QUARTER))
        else:
            (self.folder / "cpu.max").write_text(f"{QUARTER} {PERIOD}")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for _ in range(100):
            with contextlib.suppress(OSError):
                self.folder.rmdir()
                return
            time.sleep(0.1)

    def program(self, folder, program):
        """Returns a program that runs another one in here."""
        path = folder / self.folder.name
        path.write_text(f'#!/bin/sh\necho $$ > {self.folder}/cgroup.procs\nexec {program} "$@"\n')
        path.chmod(0o755)
        return path


class Worker:
    """`serve --worker`, as a process."""

    def __init__(self, command, log):
        self.log = open(log, "w+b")
        self.process = command.start("serve", "--worker", "127.0.0.1:0", log=self.log)
        end = time.monotonic() + lab.COMMAND_LIMIT
        while not (found := [line for line in self.said().splitlines() if "  worker " in line]):
            lab.require(self.process.poll() is None and time.monotonic() < end, f"no worker: {self.said()[-2000:]}")
            time.sleep(0.05)
        self.address = found[0].split()[1]

    def said(self):
        return pathlib.Path(self.log.name).read_text(errors="replace")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        self.log.close()


class LakeStore:
    """A lake in a store: a folder's, which a simulated server reads, or a copy in Ceph."""

    def __init__(self, settings, bucket, prefix):
        self.settings, self.lake = settings, f"s3://{bucket}/{prefix}"
        self.address = settings["AWS_ENDPOINT_URL"].removeprefix("http://")

    @classmethod
    def from_folder(cls, lake, stack):
        """Starts the simulated server."""
        command = [sys.executable, str(lab.HERE / "s3_folder.py"), str(lake.parent), "--listen", "0"]
        server = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        stack.callback(server.kill)
        settings = {
            "AWS_ENDPOINT_URL": server.stdout.readline().split()[0], "AWS_ACCESS_KEY_ID": "none",
            "AWS_SECRET_ACCESS_KEY": "none", "AWS_REGION": "us-east-1", "AWS_ALLOW_HTTP": "true",
        }
        return cls(settings, "folder", lake.name)

    @classmethod
    def copied_to_ceph(cls, lake):
        """Starts Ceph's gateway, and copies what queries read."""
        settings = lab.Gateway().start()
        bucket, prefix = lab.Bucket(settings), f"workers-{os.getpid()}"
        paths = [path for path in (lake / "tables").rglob("*") if path.is_file()]
        paths = [lake / "lake.toml", *(path for path in paths if not path.name.startswith("."))]
        with concurrent.futures.ThreadPoolExecutor(4) as pool:
            keys = [f"{prefix}/{path.relative_to(lake)}" for path in paths]
            list(pool.map(lambda key, path: bucket.put(key, path.read_bytes()), keys, paths))
        print(f"{len(paths)} files, {sum(path.stat().st_size for path in paths) >> 20} MiB, are in Ceph", flush=True)
        return cls(settings, settings["S3_BUCKET"], prefix)

    def command(self, program, folder, url=None):
        """Returns the program on the lake, through a proxy or not."""
        return lab.Command(program, folder, self.lake, self.settings | ({"AWS_ENDPOINT_URL": url} if url else {}))


class WorkersCheck:
    """The machines, and what was measured."""

    def __init__(self, args, folder, store):
        self.args, self.folder, self.store = args, folder, store
        self.program, self.lake = pathlib.Path(args.echolake).resolve(), args.lake.resolve()
        self.ports = iter(range(FIRST_PORT, FIRST_PORT + 1000))
        self.missed = []

    def slow_store(self, stack, is_slow=True):
        """Returns the command of a machine whose network is slow."""
        latency = f"{self.args.latency}-{self.args.latency}"
        rate = self.args.rate if is_slow else None
        proxy = lab.Proxy(self.store.address, next(self.ports), 1, latency=latency, rate=rate)
        return self.store.command(self.program, self.folder, stack.enter_context(proxy).url)

    def slow_core(self, stack, is_slow=True):
        """Returns the command of a machine that has little of a core."""
        program = self.program
        if is_slow:
            share = stack.enter_context(CoreShare(str(next(self.ports))))
            program = share.program(self.folder, self.program)
        return lab.Command(program, self.folder, str(self.lake))

    def serve(self, stack, command, workers, logs, *args):
        """Starts a server, and before it a worker of each of these commands; returns a connection to it."""
        started = [stack.enter_context(Worker(worker, f"{logs}.{number}")) for number, worker in enumerate(workers)]
        spread = ["--workers", ",".join(worker.address for worker in started)] if started else []
        return stack.enter_context(lab.Server(command, logs, *spread, "--temp", str(self.folder), *args)).connect()

    def check_answers(self):
        """Compares answers over workers with those of a server without."""
        command = self.store.command(self.program, self.folder)
        with contextlib.ExitStack() as stack:
            local = self.serve(stack, command, [], self.folder / "log.answers")
            surface = local.sql("select min(surface_id) from surfaces where surface_id not in ('flat', 'foam')")
            queries = documented_queries(surface.decode().split()[1])
            right = {sql: (local.schema(sql), local.sql(sql)) for sql in queries}
        for count in ANSWER_WORKERS:
            with contextlib.ExitStack() as stack:
                workers = [command] * count
                logs = self.folder / f"log.answers.{count}"
                connection = self.serve(stack, command, workers, logs, "--spread-from", "0")
                spread, exact = 0, 0
                for sql, (schema, rows) in right.items():
                    plan = connection.sql(f"explain {sql}").decode()
                    spread += f"spread over {count} of {count} workers" in plan
                    lab.require(connection.schema(sql) == schema, f"{count} workers, another schema: {sql}")
                    given = connection.sql(sql)
                    exact += given == rows
                    lab.require(have_same_rows(given, rows), f"{count} workers, other rows: {sql}")
                print(f"answers: {len(right)} queries with {count} workers, {spread} of them spread: the same schemas and rows,"
                      f" {exact} byte for byte, the others but for order and last digits", flush=True)

    def measure(self, machine, query, count):
        """Returns seconds, the answer, and what the workers say of themselves."""
        with contextlib.ExitStack() as stack:
            logs = self.folder / f"log.{next(self.ports)}"
            workers = [machine(stack) for _ in range(count if count > 1 else 0)]
            connection = self.serve(stack, machine(stack, not workers), workers, logs)
            # It reads the logs, and finds the workers.
            plan = connection.sql(f"explain {query}").decode()
            lab.require(f"spread over {count} of {count} workers" in plan or not workers, f"it is not spread: {plan}")
            begun = time.monotonic()
            answer = connection.sql(query)
            took = time.monotonic() - begun
            # The server asks workers that it has not asked for five seconds.
            time.sleep(6 if workers else 0)
            told = connection.sql("select read_bytes, store_requests, reading_tasks from system.workers").decode()
            return took, answer, [[int(cell) for cell in row] for row in list(csv.reader(told.splitlines()))[1:] if row]

    def report(self, what, machine, query):
        """Measures with each number of machines; four must be so much faster than one."""
        times, right = {}, None
        for count in self.args.machines:
            measured = [self.measure(machine, query, count) for _ in range(self.args.repeats)]
            for _, answer, _ in measured:
                right = right or answer
                lab.require(answer == right, f"{count} machines answer {answer!r}, one {right!r}")
            times[count] = statistics.median(took for took, _, _ in measured)
            line = f"{what}: {count} machines {times[count]:.2f} s, {times[min(times)] / times[count]:.2f} times"
            figures = measured[-1][2]
            if figures:
                read = [row[0] for row in figures]
                line += (f"; {sum(read) / (1 << 20):.0f} MiB read, largest {max(read) * len(read) / max(1, sum(read)):.2f} of"
                         f" the mean, {sum(row[1] for row in figures)} requests, {sum(row[2] for row in figures)} tasks with work")
            print(line, flush=True)
        if min(times) == 1 and GOAL_MACHINES in times and times[1] / times[GOAL_MACHINES] < GOAL:
            self.missed.append(what)

    def check_light(self):
        """Asks two servers by turns for single responses."""
        with contextlib.ExitStack() as stack:
            command = self.slow_core(stack, is_slow=False)
            connections = {
                name: self.serve(stack, command, workers, self.folder / f"log.{name}")
                for name, workers in (("without", []), ("with", [command] * 2))
            }
            times = {name: [] for name in connections}
            for number in range(LIGHT_QUERIES):
                for name, connection in connections.items():
                    begun = time.perf_counter()
                    connection.sql(LIGHT_QUERY.format(number % 2000))
                    times[name].append(time.perf_counter() - begun)
        medians = {name: statistics.median(taken[20:]) for name, taken in times.items()}
        ratio = medians["with"] / medians["without"]
        print(f"one response: {medians['without'] * 1e3:.2f} ms without workers, {medians['with'] * 1e3:.2f} ms with,"
              f" {ratio:.3f} times; medians of {LIGHT_QUERIES - 20}", flush=True)
        if ratio > LIGHT_GOAL:
            self.missed.append("a query that is not spread")


def documented_queries(surface):
    """Returns the queries of query-bench, about a surface and one of its pairs, and those of the manual."""
    bench = (CHECKOUT / "campaigns/src/query_bench/queries.sql").read_text().split("\n\n-- ")[1:]
    queries = [part.split("\n", 1)[1].strip() for part in bench if "@peer" not in part.split("\n", 1)[0]]
    queries += re.findall(r"^> (.*)$", (CHECKOUT / "docs/functions.md").read_text(), re.MULTILINE)
    queries += re.findall(r"""['"](select [^'"]*)['"]""", (CHECKOUT / "docs/clients.md").read_text())
    known = {"$SURFACE": surface, "$PAIR": "160", "$1": "'flat'"}
    return [re.sub(r"\$\w+", lambda found: known[found.group()], sql.rstrip(";")) for sql in queries]


def have_same_rows(given, expected):
    """Compares two answers in CSV; the order of rows and the last digits of numbers do not count."""
    pair = [sorted(answer.splitlines()) for answer in (given, expected)]
    if pair[0] == pair[1]:
        return True
    rounded = lambda row: [f"{float(cell):.6g}" if is_number(cell) else cell for cell in row]
    pair = [sorted(csv.reader(answer.decode().splitlines()), key=rounded) for answer in (given, expected)]
    return len(pair[0]) == len(pair[1]) and all(map(are_same_rows, *pair))


def are_same_rows(given, expected):
    same = lambda a, b: a == b or (is_number(a) and is_number(b) and math.isclose(float(a), float(b), rel_tol=TOLERANCE))
    return len(given) == len(expected) and all(map(same, given, expected))


def is_number(text):
    with contextlib.suppress(ValueError):
        return math.isfinite(float(text))
    return False


def main(args):
    with lab.work_folder() as folder, contextlib.ExitStack() as stack:
        lake = args.lake.resolve()
        store = LakeStore.copied_to_ceph(lake) if args.ceph else LakeStore.from_folder(lake, stack)
        check = WorkersCheck(args, folder, store)
        some = f" and surface_id <= '{args.last_surface}'" if args.last_surface else ""
        if "answers" in args.only:
            check.check_answers()
        if "store" in args.only:
            check.report("scan through slow networks", check.slow_store, STORE_QUERY + some)
        if "processor" in args.only:
            check.report("band energies on quarters of a core", check.slow_core, PROCESSOR_QUERY + some)
        if "light" in args.only:
            check.check_light()
        lab.require(not check.missed, f"goals missed: {', '.join(check.missed)}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("echolake", help="the program")
    parser.add_argument("lake", type=pathlib.Path, help="a lake in a folder")
    parser.add_argument("--machines", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--only", nargs="+", default=["answers", "store", "processor", "light"])
    parser.add_argument("--ceph", action="store_true", help="copy the lake's tables into Ceph, and read them there")
    parser.add_argument("--latency", type=float, default=30, help="milliseconds of each request")
    parser.add_argument("--rate", type=float, default=20, help="MiB a second of each machine")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--last-surface", help="read surfaces up to this one, for a short run")
    arguments = parser.parse_args()
    lab.run_check(lambda: main(arguments))
