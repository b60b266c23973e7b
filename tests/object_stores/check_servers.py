#!/usr/bin/env python3
"""Two servers on one bucket, one of them killed under a hundred readers: check_servers.py ECHOLAKE

Half of the readers ask the first server, half the second. After a while the first is killed by SIGKILL, and its readers
go on with the second. Each answer is compared with what a lake in a folder answers. No reader of the second server may
have an error, and no answer of either may be wrong or cut short without one.
"""
import argparse
import collections
import http.client
import os
import pathlib
import threading
import time

import bucket_lab as lab

QUERIES = [
    "select surface_id, count(*) as n from measurements group by surface_id order by surface_id",
    "select pair_id, tnce_total from tnce where surface_id = 'brick' order by pair_id",
    "select ir from measurements where surface_id = 'flat' and pair_id = 17",
    "select surface_id, band, p50_db from surface_stats order by surface_id, band",
    "select run_id, file_sha256 from runs order by run_id",
    "select m.pair_id, n.nce_2500 from measurements m join nce n using (run_id, pair_id)"
    " where m.surface_id = 'wavy' order by m.pair_id limit 10",
]
PAGES = ["/api/v1/surfaces?limit=60", "/api/v1/surfaces/prd", "/api/v1/surfaces/brick/pairs/3"]


class Readers:
    """A hundred readers, and what they saw."""

    def __init__(self, args, servers, answers):
        self.args, self.servers, self.answers = args, servers, answers
        self.lock, self.end, self.killed_at = threading.Lock(), False, None
        self.times = collections.defaultdict(list)
        self.counts, self.failures = collections.Counter(), []

    def read(self, number):
        """One reader: asks until the end; a reader of the killed server goes on with the other one."""
        random = lab.random_for(self.args.seed, number)
        server = number % 2
        connection = self.servers[server].connect()
        while not self.end:
            asked = random.choice(list(self.answers))
            begun = time.monotonic()
            try:
                answer = connection.get(asked) if asked.startswith("/") else connection.sql(asked)
            except (OSError, http.client.HTTPException) as error:
                if server == 0 and self.killed_at is not None:
                    self.count("moved readers")
                    server = 1
                    connection = self.servers[server].connect()
                else:
                    self.fail(f"reader {number} of server {server}: {type(error).__name__} {error}")
                    return
            except lab.CheckError as error:
                self.fail(f"reader {number} of server {server}: {error}")
                return
            else:
                if answer != self.answers[asked]:
                    self.fail(f"reader {number} of server {server}: wrong answer to {asked}: {answer[:200]!r}")
                self.note(number, begun)

    def note(self, number, begun):
        phase = "before" if self.killed_at is None or begun < self.killed_at else "after"
        with self.lock:
            self.times[phase, number % 2].append(time.monotonic() - begun)

    def count(self, what):
        with self.lock:
            self.counts[what] += 1

    def fail(self, why):
        with self.lock:
            self.failures.append(why)

    def run(self):
        threads = [threading.Thread(target=self.read, args=(n,), daemon=True) for n in range(self.args.readers)]
        for thread in threads:
            thread.start()
        time.sleep(self.args.seconds / 2)
        engines = children_of(self.servers[0].process.pid)
        self.killed_at = time.monotonic()
        self.servers[0].kill()
        time.sleep(self.args.seconds / 2)
        self.end = True
        for thread in threads:
            thread.join(lab.COMMAND_LIMIT)
        lab.require(not any(thread.is_alive() for thread in threads), "a reader still waits")
        left = [pid for pid in engines if lab.is_alive(pid)]
        lab.require(not left, f"engines of the killed server still run: {left}")


def children_of(parent):
    """Returns all processes below one."""
    parents = {}
    for path in pathlib.Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(path.parent.name)] = int(path.read_text().rsplit(")", 1)[1].split()[1])
        except (FileNotFoundError, ProcessLookupError):
            pass
    found, added = set(), {parent}
    while added:
        added = {pid for pid, above in parents.items() if above in added} - found
        found |= added
    return found


def percentiles(times):
    times = sorted(times)
    return " ".join(f"p{p} {1000 * times[min(len(times) - 1, len(times) * p // 100)]:.0f} ms" for p in (50, 99, 100))


def main(args):
    with lab.work_folder() as folder:
        program = pathlib.Path(args.echolake).resolve()
        settings = lab.Gateway().start()
        bucket, prefix = lab.Bucket(settings), f"servers-{args.seed}-{os.getpid()}"
        lab.record_runs(program, folder, args.runs)
        local = lab.Command(program, folder, "lake")
        local.ok("ingest")
        answers = {query: local.ok("sql", "--format", "csv", query) for query in QUERIES}
        with lab.Server(local, folder / "serve.local") as server:
            connection = server.connect()
            answers |= {page: connection.get(page) for page in PAGES}
        remote = lab.Command(program, folder, f"s3://{settings['S3_BUCKET']}/{prefix}", settings)
        remote.ok("ingest", *sorted(str(path) for path in (folder / "copies").iterdir()))
        with lab.Server(remote, folder / "serve.0") as first, lab.Server(remote, folder / "serve.1") as second:
            readers = Readers(args, [first, second], answers)
            readers.run()
        bucket.delete(f"{prefix}/")
        for phase in ("before", "after"):
            for number, name in ((1, "of the other server"), (0, "of the killed server")):
                times = readers.times[phase, number]
                lab.require(times, f"no answers {phase} the kill to readers {name}")
                print(f"{phase} the kill, readers {name}: {len(times)} answers, {percentiles(times)}")
        lab.require(not readers.failures, f"{len(readers.failures)} failures: {readers.failures[:3]}; seed {args.seed}")
        moved = readers.counts["moved readers"]
        lab.require(moved == args.readers // 2, f"{moved} readers had their server killed, expected {args.readers // 2}")
        print(f"{args.readers} readers, {moved} of them moved: no wrong answer, and no error of the other server")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("echolake", help="the program")
    parser.add_argument("--readers", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--runs", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    lab.run_check(lambda: main(arguments))
