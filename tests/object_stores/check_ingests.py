#!/usr/bin/env python3
"""Four ingests share one inbox of a bucket while requests fail and processes are killed: check_ingests.py ECHOLAKE

Each round: 40 small runs are uploaded to a lake of their own in Ceph's gateway, through a proxy with one of six mixes
of faults; four ingests take them in, and are killed by SIGKILL at random moments and started again. Afterwards the
tables must hold what a lake in a folder holds: the same run files byte for byte, the rows of the same runs once, in
whatever files, and as many rows by SQL, in some rounds the same rows. Several rounds run at once.

Kills and faults follow --seed; the moments at which processes meet do not.
"""
import argparse
import collections
import concurrent.futures
import os
import pathlib
import shutil
import signal
import subprocess
import time

import bucket_lab as lab

MIXES = {
    "none": [],
    "answers lost": ["put,_delta_log,0.25,reply-lost", "put,_claims,0.1,reply-lost"],
    "done, then 500": ["put,_delta_log,0.25,done-500", "put,_claims,0.1,done-500"],
    "409": ["put,_delta_log,0.2,409", "put,_claims,0.1,409"],
    "overloaded": [
        "put,_delta_log,0.1,reply-lost", "put,_delta_log,0.1,done-503", "put,,0.1,503", "get,,0.05,503",
        "*,,0.03,reset", "get,prefix=,0.04,half-answer", "get,parquet,0.03,half-answer",
    ],
    "bad line": ["put,_delta_log,0.15,reply-lost", "put,,0.05,half-request", "get,,0.05,503", "*,,0.02,reset"],
}
INGESTS = 4
# Rounds between two that compare all rows of all tables by SQL.
ROWS_EVERY = 5


def counts(lake):
    """Returns the number of rows of each table by one query."""
    queries = (f"select '{table}' as name, count(*) as rows from {table}" for table in lab.TABLES)
    lines = lake.ok("sql", "--format", "csv", " union all ".join(queries)).decode().splitlines()[1:]
    return {name: int(rows) for name, rows in (line.split(",") for line in lines)}


class IngestRounds:
    """The rounds, and what they are compared with."""

    def __init__(self, args, folder):
        self.args, self.folder, self.echolake = args, folder, pathlib.Path(args.echolake).resolve()
        self.gateway = lab.Gateway()
        self.settings = self.gateway.start()
        self.bucket = lab.Bucket(self.settings)
        runs = lab.record_runs(self.echolake, folder, args.runs)
        lake = lab.Command(self.echolake, folder, "lake")
        begun = time.monotonic()
        lake.ok("ingest")
        # A round with four ingests and faults takes a few times as long; most kills shall strike.
        self.usual_secs = 2 * (time.monotonic() - begun) + 2
        lake.ok("ingest")
        self.expected_rows, self.expected_files = lake.tables(), lab.folder_files(folder / "lake")
        self.expected_counts = counts(lake)
        lab.require(self.expected_counts["runs"] == len(runs), "the folder has not all runs")

    def run(self, number, lane):
        """One round; returns its mix and how many ingests were killed."""
        name = list(MIXES)[number % len(MIXES)]
        port = int(self.settings["AWS_ENDPOINT_URL"].rsplit(":", 1)[1]) + 10 + lane
        prefix = f"ingests-{self.args.seed}-{number}-{os.getpid()}"
        with lab.Proxy(self.gateway.address, port, self.args.seed * 1000 + number, MIXES[name]) as proxy:
            location = f"s3://{self.settings['S3_BUCKET']}/{prefix}"
            settings = self.settings | {"AWS_ENDPOINT_URL": proxy.url}
            lake = lab.Command(self.echolake, self.folder, location, settings)
            lake.ok("upload", self.own_copies(lane))
            killed = self.ingest(lake, number)
            # Takes nothing in; its clean-up leaves the files that a lake has where nobody was killed.
            lake.ok("ingest")
            direct = lab.Command(self.echolake, self.folder, location, self.settings)
            lab.require_same(self.expected_counts, counts(direct), "counts of rows")
            # It takes long to look at them all.
            if number % ROWS_EVERY == 0:
                lab.require_same(self.expected_rows, direct.tables(), "rows")
            lab.require_same(self.expected_files, lab.bucket_files(self.bucket, prefix), "runs and their rows")
            left = [key for key in self.bucket.list(f"{prefix}/inbox/") if key.endswith(".mcap")]
            lab.require(not left, f"left in the inbox: {left}")
            faults = {kind: n for kind, n in proxy.counts()["done"].items() if not kind.startswith("status")}
        self.bucket.delete(f"{prefix}/")
        return name, killed, sum(faults.values())

    def own_copies(self, lane):
        # An upload keeps a journal beside each file.
        folder = self.folder / f"copies.{lane}"
        if not folder.exists():
            shutil.copytree(self.folder / "copies", folder, copy_function=os.link)
        return folder.name

    def ingest(self, lake, number):
        random = lab.random_for(self.args.seed, number)
        count = random.randint(1, 4) if self.args.kills is None else self.args.kills
        kills = sorted((random.uniform(0, self.usual_secs), random.randrange(INGESTS)) for _ in range(count))
        logs = [open(self.folder / f"ingest.{number}.{n}", "w+b") for n in range(INGESTS)]
        ingests = [lake.start("ingest", log=log) for log in logs]
        begun, killed = time.monotonic(), 0
        try:
            for moment, victim in kills:
                time.sleep(max(0, begun + moment - time.monotonic()))
                if ingests[victim].poll() is None:
                    ingests[victim].send_signal(signal.SIGKILL)
                    ingests[victim].wait()
                    ingests[victim] = lake.start("ingest", log=logs[victim])
                    killed += 1
            for ingest, log in zip(ingests, logs):
                code = ingest.wait(lab.COMMAND_LIMIT)
                log.seek(0)
                lab.require(code == 0, f"an ingest ended with {code}: {log.read()[-2000:].decode(errors='replace')}")
        except subprocess.TimeoutExpired:
            raise lab.CheckError(f"an ingest did not end within {lab.COMMAND_LIMIT} s") from None
        finally:
            for ingest, log in zip(ingests, logs):
                ingest.kill()
                ingest.wait()
                log.close()
                os.unlink(log.name)
        return killed


def main(args):
    with lab.work_folder() as folder:
        rounds = IngestRounds(args, folder)
        done, killed, faults = collections.Counter(), 0, 0
        begun = time.monotonic()
        with concurrent.futures.ThreadPoolExecutor(args.lanes) as pool:
            lanes = list(range(args.lanes))

            def run(number):
                lane = lanes.pop()
                try:
                    return rounds.run(number, lane)
                finally:
                    lanes.append(lane)

            futures = {pool.submit(run, number): number for number in range(args.first, args.first + args.rounds)}
            for future in concurrent.futures.as_completed(futures):
                try:
                    mix, kills, struck = future.result()
                except lab.CheckError as error:
                    pool.shutdown(cancel_futures=True)
                    raise lab.CheckError(f"round {futures[future]}, seed {args.seed}: {error}") from None
                done[mix] += 1
                killed += kills
                faults += struck
                print(f"round {futures[future]} ({mix}): as in a folder; {kills} ingests killed, {struck} faults;"
                      f" {sum(done.values())} rounds in {time.monotonic() - begun:.0f} s", flush=True)
        print(f"{sum(done.values())} rounds of {args.runs} runs, seed {args.seed}: 0 lost, 0 doubled, all files equal;"
              f" {killed} ingests killed, {faults} faults; {dict(done)}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("echolake", help="the program")
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="number of the first round")
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--kills", type=int, help="kills in each round, by default one to four")
    parser.add_argument("--lanes", type=int, default=3, help="rounds at once")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    lab.run_check(lambda: main(arguments))
