#!/usr/bin/env python3
"""A lake in Azure's blobs, by Azurite, Microsoft's emulator: check_azure.py ECHOLAKE

Installs Azurite from npm into a folder of its own. Two ingests share an inbox that `upload` filled; then `optimize`, `vacuum`
and `doctor`. All tables must have the rows that an ingest of the same runs into a folder has, and a server must answer.
"""
import argparse
import base64
import datetime
import hashlib
import hmac
import pathlib
import subprocess
import time
import urllib.error
import urllib.request

import bucket_lab as lab

# Azurite's own, which its documentation names.
ACCOUNT = "devstoreaccount1"
KEY = "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw=="
CONTAINER = "lakes"
PORT = 17_100
AZURITE = "azurite@3"


class Azurite:
    """The emulator, as a process."""

    def __init__(self, folder):
        folder.mkdir()
        subprocess.run(["npm", "install", "--silent", "--prefix", folder, AZURITE], check=True, timeout=600)
        program = folder / "node_modules/.bin/azurite-blob"
        options = ["--blobPort", str(PORT), "--location", folder / "blobs", "--silent", "--skipApiVersionCheck", "--disableTelemetry"]
        self.process = subprocess.Popen([program, *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self.url = f"http://127.0.0.1:{PORT}/{ACCOUNT}"

    def __enter__(self):
        end = time.monotonic() + 60
        while not self.has_container():
            lab.require(self.process.poll() is None and time.monotonic() < end, "Azurite does not start")
            time.sleep(0.2)
        return self

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait()

    def has_container(self):
        """Makes the container; returns False while Azurite does not listen yet."""
        date = datetime.datetime.now(datetime.timezone.utc).strftime("%a, %d %b %Y %H:%M:%S GMT")
        headers = {"x-ms-date": date, "x-ms-version": "2021-08-06", "Content-Length": "0"}
        lines = ["PUT", *[""] * 11, f"x-ms-date:{date}", "x-ms-version:2021-08-06"]
        text = "\n".join([*lines, f"/{ACCOUNT}/{ACCOUNT}/{CONTAINER}", "restype:container"])
        digest = hmac.new(base64.b64decode(KEY), text.encode(), hashlib.sha256).digest()
        headers["Authorization"] = f"SharedKey {ACCOUNT}:{base64.b64encode(digest).decode()}"
        request = urllib.request.Request(f"{self.url}/{CONTAINER}?restype=container", method="PUT", headers=headers)
        try:
            return urllib.request.urlopen(request, timeout=10).status == 201
        except urllib.error.HTTPError as refused:
            raise lab.CheckError(f"Azurite makes no container: {refused.read()[:500]!r}") from refused
        except urllib.error.URLError:
            return False

    def settings(self):
        return {
            "AZURE_STORAGE_ACCOUNT_NAME": ACCOUNT,
            "AZURE_STORAGE_ACCOUNT_KEY": KEY,
            "AZURE_STORAGE_ENDPOINT": self.url,
            "AZURE_ALLOW_HTTP": "true",
        }


def main(args):
    with lab.work_folder() as folder, Azurite(folder / "azurite") as azurite:
        program = pathlib.Path(args.echolake).resolve()
        runs = lab.record_runs(program, folder, args.runs)
        local = lab.Command(program, folder, "lake")
        local.ok("ingest")
        remote = lab.Command(program, folder, f"az://{CONTAINER}/one", azurite.settings())
        remote.ok("upload", *(str(run) for run in runs))
        both = [remote.start("ingest"), remote.start("ingest")]
        lab.require([ingest.wait(600) for ingest in both] == [0, 0], "an ingest failed")
        # Each completes the runs that it saw.
        remote.ok("ingest")
        expected = local.tables()
        lab.require_same(expected, remote.tables(), "after two ingests")
        remote.ok("optimize")
        remote.ok("vacuum", "--keep-hours", "0")
        remote.ok("doctor")
        lab.require_same(expected, remote.tables(), "once its files are merged")
        with lab.Server(remote, folder / "serve.log") as server:
            answer = server.connect().sql("select count(*) as n from runs").split()
        lab.require(answer == [b"n", str(args.runs).encode()], f"the server answers {answer}")
        rows = {table: count - 1 for table, (count, _) in expected.items()}
        print(f"{args.runs} runs by two ingests, merged, served: all rows as in a folder, {rows}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("echolake", help="the program")
    parser.add_argument("--runs", type=int, default=8)
    arguments = parser.parse_args()
    lab.run_check(lambda: main(arguments))
