#!/usr/bin/env python3
"""What a store's latency costs: check_latency.py ECHOLAKE

Each request to Ceph's gateway waits 30 ms in the proxy. Measured and compared with their goals:

    one response of a served lake, with its tables' metadata in memory           100 ms
    the catalogue's first view after a server's start, of a lake of 350 runs     1.5 s
    ingest of one run of the paper's rig, beside the same in a folder            1.5 times

Prints medians and the number of requests of each. Exits with 1 if a goal is missed.
"""
import argparse
import concurrent.futures
import os
import pathlib
import shutil
import statistics
import time

import bucket_lab as lab

IR_GOAL_SECS, VIEW_GOAL_SECS, INGEST_GOAL = 0.1, 1.5, 1.5
SMALL_TABLES = ["runs", "surfaces", "surface_stats", "points", "pairs"]
FIRST_VIEW = ["/api/v1/lake", "/api/v1/surfaces?limit=60"]


class LatencyCheck:
    """The store, its proxy, and what was measured."""

    def __init__(self, args, folder):
        self.args, self.folder, self.program = args, folder, pathlib.Path(args.echolake).resolve()
        self.gateway = lab.Gateway()
        self.settings = self.gateway.start()
        self.bucket = lab.Bucket(self.settings)
        self.prefix = f"latency-{args.seed}-{os.getpid()}"
        port = int(self.settings["AWS_ENDPOINT_URL"].rsplit(":", 1)[1]) + 10
        self.proxy = lab.Proxy(self.gateway.address, port, args.seed, latency=f"{args.latency}-{args.latency}")
        self.missed = []

    def command(self, lake, is_slow=True):
        """The command on a lake in the bucket, through the proxy or past it."""
        settings = self.settings | ({"AWS_ENDPOINT_URL": self.proxy.url} if is_slow else {})
        return lab.Command(self.program, self.folder, f"s3://{self.settings['S3_BUCKET']}/{self.prefix}/{lake}", settings)

    def report(self, what, value, goal, unit):
        requests = sum(self.proxy.counts()["asked"].values())
        verdict = "" if value <= goal else "  MISSED"
        print(f"{what}: {value:.2f} {unit}, goal {goal} {unit}; {requests} requests{verdict}", flush=True)
        if value > goal:
            self.missed.append(what)

    def paper_runs(self):
        """Returns runs of Flat, Foam and further surfaces by the paper's rig, without sweeps: recorded, or of a lake."""
        surfaces = ["flat", "foam", *(f"brick_{n}" for n in range(self.args.repeats))]
        if self.args.runs_of:
            others = sorted({run.parent.name for run in self.args.runs_of.glob("runs/*/*.mcap")} - {"flat", "foam"})
            surfaces[2:] = others[: self.args.repeats]
            return [(surface, min((self.args.runs_of / "runs" / surface).glob("*.mcap"))) for surface in surfaces]
        local = lab.Command(self.program, self.folder, "paper")
        runs = []
        for number, surface in enumerate(surfaces):
            run = local.ok("acquire", "--surface", surface, "--ir-only", "--seed", str(number)).decode().strip()
            runs.append((surface, self.folder / run))
        return runs

    def check_ingest(self, runs):
        """Takes in one run after the other, in a folder and in the bucket."""
        lakes = {"folder": lab.Command(self.program, self.folder, "beside"), "bucket": self.command("paper")}
        (self.folder / "beside").mkdir()
        shutil.copy(runs[0][1].parents[2] / "lake.toml" if self.args.runs_of else self.folder / "paper/lake.toml",
                    self.folder / "beside")
        times = {name: [] for name in lakes}
        for name, lake in lakes.items():
            lake.ok("ingest", *(str(run) for _, run in runs[:2]))
        for _, run in runs[2:]:
            for name, lake in lakes.items():
                self.proxy.forget()
                begun = time.monotonic()
                lake.ok("ingest", str(run))
                times[name].append(time.monotonic() - begun)
        beside, remote = (statistics.median(times[name]) for name in ("folder", "bucket"))
        print(f"ingest of a run: {beside:.2f} s in a folder, {remote:.2f} s in the bucket")
        self.report("ingest of a run, beside a folder's", remote / beside, INGEST_GOAL, "times")

    def check_response(self, surface):
        """Asks for responses of random pairs; the first one reads the files' metadata, and is not measured."""
        random = lab.random_for(self.args.seed)
        fetched, cached = [], []
        with lab.Server(self.command("paper"), self.folder / "serve.paper", *self.cache("paper")) as server:
            connection = server.connect()
            for number in range(40):
                pair = random.randrange(2951)
                query = f"select ir from measurements where surface_id = '{surface}' and pair_id = {pair}"
                self.proxy.forget()
                begun = time.monotonic()
                connection.sql(query)
                took = time.monotonic() - begun
                if number > 0:
                    (fetched if self.proxy.counts()["bytes"].get("down", 0) > 100_000 else cached).append(took)
        lab.require(fetched and cached, "the cache had all blocks from the beginning, or never")
        print(f"one response from the cache: {statistics.median(cached):.3f} s, median of {len(cached)}")
        print(f"one response from the store: {max(fetched):.3f} s at most, of {len(fetched)}")
        self.report("one response, its block not in the cache", statistics.median(fetched), IR_GOAL_SECS, "s")

    def check_first_view(self):
        """Starts a server twice: with an empty cache, and with what the first one left in it."""
        if self.args.runs_of:
            self.copy_logs(self.args.runs_of)
        else:
            lab.record_runs(self.program, self.folder, self.args.surfaces)
            copies = sorted(str(path) for path in (self.folder / "copies").iterdir())
            self.command("many", is_slow=False).ok("ingest", *copies)
        if self.args.optimize:
            self.command("many", is_slow=False).ok("optimize")
        for cache in ("empty cache", "filled cache"):
            with lab.Server(self.command("many"), self.folder / "serve.many", *self.cache("many")) as server:
                self.proxy.forget()
                begun = time.monotonic()
                # The page asks for both at once.
                with concurrent.futures.ThreadPoolExecutor() as pool:
                    list(pool.map(lambda path: server.connect().get(path), FIRST_VIEW))
                took = time.monotonic() - begun
                self.report(f"the catalogue's first view, {cache}", took, VIEW_GOAL_SECS, "s")

    def copy_logs(self, lake):
        """Copies what the first view needs of a lake in a folder: all logs, and the files of small tables."""
        paths = [lake / "lake.toml", *lake.glob("tables/*/_delta_log/*")]
        paths += [path for name in SMALL_TABLES for path in lake.glob(f"tables/{name}/*.parquet")]
        with concurrent.futures.ThreadPoolExecutor(8) as pool:
            keys = [f"{self.prefix}/many/{path.relative_to(lake)}" for path in paths]
            list(pool.map(lambda key, path: self.bucket.put(key, path.read_bytes()), keys, paths))

    def cache(self, name):
        return ["--cache", str(self.folder / f"cache.{name}")]


def main(args):
    with lab.work_folder() as folder:
        check = LatencyCheck(args, folder)
        with check.proxy:
            try:
                if "view" in args.only:
                    check.check_first_view()
                if {"ingest", "response"} & set(args.only):
                    runs = check.paper_runs()
                    check.check_ingest(runs)
                    if "response" in args.only:
                        check.check_response(runs[-1][0])
            finally:
                check.bucket.delete(f"{check.prefix}/")
        lab.require(not check.missed, f"goals missed: {', '.join(check.missed)}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("echolake", help="the program")
    parser.add_argument("--latency", type=float, default=30, help="milliseconds of each request")
    parser.add_argument("--surfaces", type=int, default=350)
    parser.add_argument("--repeats", type=int, default=3, help="runs that are ingested")
    parser.add_argument("--runs-of", type=pathlib.Path, metavar="LAKE", help="take runs and tables of this lake in a folder instead of recording some")
    parser.add_argument("--optimize", action="store_true", help="merge the lake's files before the first view")
    parser.add_argument("--only", nargs="+", default=["view", "ingest", "response"])
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    lab.run_check(lambda: main(arguments))
