#!/usr/bin/env python3
"""How queries over workers scale: check_workers.py ECHOLAKE LAKE

LAKE is a lake in a folder, which is only read. Machines are processes of this one, each held to what a small machine has:

    store      each behind a proxy of its own, 30 ms a request and 20 MiB/s: a full scan of one nce column. The store is
               simulated (s3_folder.py reads LAKE); processors have nearly nothing to do.
    processor  each in a cgroup of a quarter of a core, the lake in its folder: band energies of all responses.
    light      no limits: queries that are not spread, by a server with two workers beside one without; goal: 5 % slower.

One machine is a server without workers under the same limits. With more, the server has no limits of its own: it adds up
what workers send. Each figure is the median of --repeats, with processes and caches that are new each time. Times of
processes on one machine are no measure of many machines but for such limits, so only the ratios count; goal: 3.3 times
from one machine to four. Prints bytes and requests of each, too. Needs root for cgroups. Exits with 1 if a goal is missed.
"""
import argparse
import contextlib
import csv
import os
import pathlib
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


class ScalingCheck:
    """The machines, and what was measured."""

    def __init__(self, args, folder, upstream):
        self.args, self.folder, self.upstream = args, folder, upstream
        self.program, self.lake = pathlib.Path(args.echolake).resolve(), args.lake.resolve()
        self.ports = iter(range(FIRST_PORT, FIRST_PORT + 1000))
        self.missed = []

    def slow_store(self, stack, is_slow=True):
        """Returns the command of a machine whose network is slow."""
        latency = f"{self.args.latency}-{self.args.latency}"
        proxy = lab.Proxy(self.upstream, next(self.ports), 1, latency=latency, rate=self.args.rate if is_slow else None)
        stack.enter_context(proxy)
        settings = {
            "AWS_ENDPOINT_URL": proxy.url, "AWS_ACCESS_KEY_ID": "none", "AWS_SECRET_ACCESS_KEY": "none",
            "AWS_REGION": "us-east-1", "AWS_ALLOW_HTTP": "true",
        }
        return lab.Command(self.program, self.folder, f"s3://folder/{self.lake.name}", settings)

    def slow_core(self, stack, is_slow=True):
        """Returns the command of a machine that has little of a core."""
        program = self.program
        if is_slow:
            share = stack.enter_context(CoreShare(str(next(self.ports))))
            program = share.program(self.folder, self.program)
        return lab.Command(program, self.folder, str(self.lake))

    def measure(self, machine, query, count):
        """Returns seconds, the answer, and what the workers say of themselves."""
        with contextlib.ExitStack() as stack:
            logs = self.folder / f"log.{next(self.ports)}"
            workers = []
            for number in range(count if count > 1 else 0):
                workers.append(stack.enter_context(Worker(machine(stack), f"{logs}.{number}")))
            args = ["--workers", ",".join(worker.address for worker in workers)] if workers else []
            temp = ["--temp", str(self.folder)]
            server = stack.enter_context(lab.Server(machine(stack, not workers), logs, *args, *temp))
            connection = server.connect()
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
            workers = [stack.enter_context(Worker(command, self.folder / f"log.light.{number}")) for number in range(2)]
            with_workers = ["--workers", ",".join(worker.address for worker in workers)]
            temp, connections = ["--temp", str(self.folder)], {}
            for name, args in (("without", []), ("with", with_workers)):
                server = stack.enter_context(lab.Server(command, self.folder / f"log.{name}", *args, *temp))
                connections[name] = server.connect()
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


def main(args):
    with lab.work_folder() as folder, contextlib.ExitStack() as stack:
        server = [sys.executable, str(lab.HERE / "s3_folder.py"), str(args.lake.resolve().parent), "--listen", "0"]
        store = stack.enter_context(subprocess.Popen(server, stdout=subprocess.PIPE, text=True))
        stack.callback(store.kill)
        check = ScalingCheck(args, folder, store.stdout.readline().split()[0].removeprefix("http://"))
        some = f" and surface_id <= '{args.last_surface}'" if args.last_surface else ""
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
    parser.add_argument("--only", nargs="+", default=["store", "processor", "light"])
    parser.add_argument("--latency", type=float, default=30, help="milliseconds of each request")
    parser.add_argument("--rate", type=float, default=20, help="MiB a second of each machine")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--last-surface", help="read surfaces up to this one, for a short run")
    arguments = parser.parse_args()
    lab.run_check(lambda: main(arguments))
