#!/usr/bin/env python3
"""Kills a bucket's gateway while a command works on it: check_gateway.py ECHOLAKE

Each round takes a lake of its own through ingest, optimize, vacuum, a scan and a slice. During each of them Ceph's
gateway is killed by SIGKILL at a random moment and started again: every other round after a second or so, with the
usual retries, otherwise so late that the command gives up. It must finish, or end with an error that says what was
being done; done again it must finish, and the tables must hold what a lake in a folder holds.

Moments follow --seed; what the command does at them does not.
"""
import argparse
import collections
import hashlib
import json
import os
import pathlib
import subprocess
import time

import bucket_lab as lab

# Milliseconds before each request, so that there is something to interrupt.
LATENCY = "5-25"
# Seconds for which the gateway stays away: shorter than a command's patience, and longer.
SHORT_OUTAGE = (0.0, 2.0)
LONG_OUTAGE = (26.0, 28.0)
SCAN = "select * from measurements order by run_id, pair_id"
SLICE = ["export", "mcap", "--where", "surface_id in ('flat', 'brick')", "--output", "slice.mcap"]
STEPS = {
    "ingest": ["ingest"],
    "optimize": ["optimize"],
    "vacuum": ["vacuum", "--keep-hours", "0", "--json"],
    "scan": ["sql", "--format", "csv", SCAN],
    "slice": SLICE,
}


class GatewayRounds:
    """The rounds, and what they are compared with."""

    def __init__(self, args, folder):
        self.args, self.folder, self.echolake = args, folder, pathlib.Path(args.echolake).resolve()
        self.gateway = lab.Gateway()
        self.settings = self.gateway.start()
        self.bucket = lab.Bucket(self.settings)
        lab.record_runs(self.echolake, folder, args.runs)
        lake = lab.Command(self.echolake, folder, "lake")
        lake.ok("ingest")
        self.tables = lake.tables()
        self.scan = lake.ok(*STEPS["scan"])
        lake.ok(*SLICE)
        self.slice = self.take_slice()
        self.usual_secs = {}
        self.outcomes = collections.Counter()

    def take_slice(self):
        path = self.folder / "slice.mcap"
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        path.unlink()
        return digest

    def run(self, number, proxy):
        """One round; the first one, without kills, measures how long each step takes."""
        prefix = f"gateway-{self.args.seed}-{number}-{os.getpid()}"
        location = f"s3://{self.settings['S3_BUCKET']}/{prefix}"
        settings = self.settings | {"AWS_ENDPOINT_URL": proxy.url}
        direct = lab.Command(self.echolake, self.folder, location, self.settings)
        direct.ok("upload", "copies")
        is_long = number > 0 and number % 2 == 0
        patience = {"AWS_MAX_ATTEMPTS": "2"} if is_long else {}
        lake = lab.Command(self.echolake, self.folder, location, settings | patience)
        deleted = 0
        for step in (step for step in STEPS if step in self.args.steps):
            args = STEPS[step]
            if number == 0:
                begun = time.monotonic()
                output = lake.ok(*args)
                self.usual_secs[step] = time.monotonic() - begun
            else:
                output = self.disturbed(lake, step, args, number, LONG_OUTAGE if is_long else SHORT_OUTAGE)
            self.check(direct, step, output)
            if step == "vacuum":
                deleted = len(json.loads(output)["files"])
        lab.bucket_files(self.bucket, prefix)
        self.bucket.delete(f"{prefix}/")
        return deleted

    def disturbed(self, lake, step, args, number, outage):
        """Runs a step while the gateway is killed, and again if that failed; returns its output."""
        random = lab.random_for(self.args.seed, number, step)
        moment, away = random.uniform(0, self.usual_secs[step]), random.uniform(*outage)
        log, answer = self.folder / "step.log", self.folder / "step.out"
        with open(log, "wb") as errors, open(answer, "wb") as output:
            process = lake.start(*args, log=errors, output=output)
            try:
                time.sleep(moment)
                is_struck = process.poll() is None
                self.gateway.kill()
                time.sleep(away)
                self.gateway.start()
                code = process.wait(lab.COMMAND_LIMIT)
            except subprocess.TimeoutExpired:
                raise lab.CheckError(f"{step} did not end within {lab.COMMAND_LIMIT} s") from None
            finally:
                process.kill()
                process.wait()
        said, output = log.read_text(errors="replace"), answer.read_bytes()
        outcome = "finished" if code == 0 else "gave up"
        self.outcomes[f"{step}: {outcome}" if is_struck else f"{step}: had ended"] += 1
        print(f"round {number}: {step}, gateway away for {away:.1f} s after {moment:.1f} s: {outcome}", flush=True)
        if code == 0:
            return output
        print("    " + "\n    ".join(said.strip().splitlines()[-2:]), flush=True)
        lab.require(code in (1, 3) and "panicked" not in said, f"{step} ended with {code}: {said[-2000:]}")
        # A store that is away is no damage; who believed it would delete tables that are whole.
        is_clear = "cannot" in said and "hint: " in said and "damaged" not in said
        lab.require(is_clear, f"{step} does not say what failed: {said[-2000:]}")
        lab.require(step != "slice" or not (self.folder / "slice.mcap").exists(), "half a slice has its name")
        return lake.ok(*args)

    def check(self, lake, step, output):
        if step == "scan":
            lab.require(output == self.scan, "other rows than in a folder")
        elif step == "slice":
            lab.require(self.take_slice() == self.slice, "another slice than in a folder")
        else:
            lab.require_same(self.tables, lake.tables(), f"rows after {step}")


def main(args):
    with lab.work_folder() as folder:
        rounds = GatewayRounds(args, folder)
        port = int(rounds.settings["AWS_ENDPOINT_URL"].rsplit(":", 1)[1]) + 10
        for number in range(args.rounds + 1):
            with lab.Proxy(rounds.gateway.address, port, args.seed, latency=LATENCY) as proxy:
                try:
                    deleted = rounds.run(number, proxy)
                except lab.CheckError as error:
                    raise lab.CheckError(f"round {number}, seed {args.seed}: {error}") from None
            if number == 0 and "vacuum" in args.steps:
                lab.require(deleted > 0, "vacuum deleted nothing")
        print(f"{args.rounds} rounds, seed {args.seed}: nothing lost; {dict(sorted(rounds.outcomes.items()))}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("echolake", help="the program")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--runs", type=int, default=12)
    parser.add_argument("--steps", nargs="+", choices=STEPS, default=list(STEPS))
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    lab.run_check(lambda: main(arguments))
