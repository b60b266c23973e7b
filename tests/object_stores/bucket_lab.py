"""What the checks of lakes in buckets share: Ceph's S3 gateway, the proxy before it, the command, and comparisons.

Needs Python's standard library alone. `ceph_rgw.sh` beside it installs and starts the gateway.
"""
import base64
import collections
import contextlib
import datetime
import hashlib
import hmac
import http.client
import json
import os
import pathlib
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.parse
import xml.etree.ElementTree as ET

HERE = pathlib.Path(__file__).resolve().parent
SMALL_RIG = HERE.parent / "fixtures" / "small_rig.toml"
TABLES = (
    "runs surfaces measurements nce tnce tnce_d4 surface_stats environment events heightmaps points pairs"
).split()
# Seconds for one command; a busy machine may be slow.
COMMAND_LIMIT = 600
UNSIGNED = "UNSIGNED-PAYLOAD"


class CheckError(Exception):
    """What was checked does not hold."""


def require(condition, message):
    """Ends the check with a message if the condition does not hold."""
    if not condition:
        raise CheckError(message)


def run_check(check):
    """Runs a check to its end; its failure is one line and exit code 1."""
    try:
        check()
    except CheckError as error:
        sys.exit(f"FAILED: {error}")


class Gateway:
    """Ceph's S3 gateway of `ceph_rgw.sh`."""

    def __init__(self, bytes_limit=8 << 30):
        self.environment = os.environ | {"CEPH_RGW_BYTES": os.environ.get("CEPH_RGW_BYTES", str(bytes_limit))}
        self.folder = pathlib.Path(os.environ.get("CEPH_RGW_DIR", "/tmp/ceph_rgw"))

    def start(self):
        """Starts what is not running, and returns its settings: endpoint, credentials, bucket."""
        # The daemons it starts would keep a pipe open for ever.
        with tempfile.TemporaryFile("w+") as output:
            script = ["bash", str(HERE / "ceph_rgw.sh"), "start"]
            code = subprocess.run(script, env=self.environment, stdout=output, timeout=COMMAND_LIMIT).returncode
            require(code == 0, "Ceph's gateway does not start")
            output.seek(0)
            self.settings = dict(line.strip().split("=", 1) for line in output)
        self.address = self.settings["AWS_ENDPOINT_URL"].removeprefix("http://")
        return self.settings

    def kill(self):
        """Kills the gateway by SIGKILL; objects stay, since others hold them."""
        pid = int((self.folder / "client.rgw0.pid").read_text())
        os.kill(pid, signal.SIGKILL)
        while is_alive(pid):
            time.sleep(0.01)


def is_alive(pid):
    """Returns whether a process runs; one that ended and was not waited for does not."""
    try:
        state = pathlib.Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


class Bucket:
    """A bucket, with requests that go past the proxy."""

    def __init__(self, settings):
        self.address = settings["AWS_ENDPOINT_URL"].removeprefix("http://")
        self.key, self.secret = settings["AWS_ACCESS_KEY_ID"], settings["AWS_SECRET_ACCESS_KEY"]
        self.region, self.name = settings["AWS_REGION"], settings["S3_BUCKET"]
        self.connections = threading.local()

    def request(self, method, key="", query=None, body=b"", headers=None):
        """Sends one signed request; returns headers and body of the answer, or raises CheckError."""
        path = urllib.parse.quote(f"/{self.name}/{key}" if key else f"/{self.name}")
        pairs = sorted((query or {}).items())
        query = "&".join(f"{urllib.parse.quote(k, safe='')}={urllib.parse.quote(v, safe='')}" for k, v in pairs)
        target = f"{path}?{query}" if query else path
        headers = self._sign(method, path, query) | (headers or {})
        for attempt in range(5):
            try:
                connection = self._connection()
                connection.request(method, target, body, headers)
                answer = connection.getresponse()
                content = answer.read()
                break
            except (OSError, http.client.HTTPException):
                self.connections.connection = None
                if attempt == 4:
                    raise
                time.sleep(0.2 * 2**attempt)
        require(answer.status < 300, f"{method} {target}: {answer.status} {content[:300]!r}")
        return answer.headers, content

    def _connection(self):
        if getattr(self.connections, "connection", None) is None:
            self.connections.connection = http.client.HTTPConnection(self.address, timeout=60)
        return self.connections.connection

    def _sign(self, method, path, query):
        # AWS Signature Version 4, without a digest of the body.
        now = datetime.datetime.now(datetime.timezone.utc).strftime("%Y%m%dT%H%M%SZ")
        scope = f"{now[:8]}/{self.region}/s3/aws4_request"
        named = "host;x-amz-content-sha256;x-amz-date"
        lines = f"host:{self.address}\nx-amz-content-sha256:{UNSIGNED}\nx-amz-date:{now}\n"
        canonical = "\n".join([method, path, query, lines, named, UNSIGNED])
        digest = hashlib.sha256(canonical.encode()).hexdigest()
        signed = f"AWS4-HMAC-SHA256\n{now}\n{scope}\n{digest}".encode()
        key = f"AWS4{self.secret}".encode()
        for part in scope.split("/"):
            key = hmac.digest(key, part.encode(), "sha256")
        signature = hmac.new(key, signed, "sha256").hexdigest()
        authorization = f"AWS4-HMAC-SHA256 Credential={self.key}/{scope}, SignedHeaders={named}, Signature={signature}"
        return {"x-amz-date": now, "x-amz-content-sha256": UNSIGNED, "authorization": authorization}

    def get(self, key):
        return self.request("GET", key)[1]

    def put(self, key, body):
        self.request("PUT", key, body=body)

    def list(self, prefix):
        """Returns the ETags of all objects below a prefix, by key."""
        query, tags = {"list-type": "2", "prefix": prefix}, {}
        while True:
            page = ET.fromstring(self.request("GET", query=query)[1])
            name = lambda tag: "{http://s3.amazonaws.com/doc/2006-03-01/}" + tag
            for entry in page.findall(name("Contents")):
                tags[entry.findtext(name("Key"))] = entry.findtext(name("ETag")).strip('"')
            token = page.findtext(name("NextContinuationToken"))
            if not token:
                return tags
            query["continuation-token"] = token

    def delete(self, prefix):
        """Deletes all objects below a prefix."""
        keys = list(self.list(prefix))
        for start in range(0, len(keys), 1000):
            objects = "".join(f"<Object><Key>{key}</Key></Object>" for key in keys[start : start + 1000])
            body = f"<Delete><Quiet>true</Quiet>{objects}</Delete>".encode()
            digest = base64.b64encode(hashlib.md5(body).digest()).decode()
            self.request("POST", query={"delete": ""}, body=body, headers={"content-md5": digest})


class Proxy:
    """The proxy that harms requests, as a process."""

    def __init__(self, upstream, port, seed, faults=(), latency=None):
        self.port, self.url = port, f"http://127.0.0.1:{port}"
        command = [sys.executable, str(HERE / "s3_fault_proxy.py"), "--listen", str(port), "--upstream", upstream]
        command += ["--seed", str(seed)] + [part for fault in faults for part in ("--fault", fault)]
        command += ["--latency", latency] if latency else []
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE)
        require(self.process.stdout.readline(), f"the proxy does not listen on port {port}")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()

    def counts(self, path="/__proxy/stats"):
        """Returns what was asked and what was done to it."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        connection.request("GET", path)
        return json.loads(connection.getresponse().read())

    def forget(self):
        """Begins to count anew."""
        self.counts("/__proxy/reset")


class Command:
    """The program under test, on one lake, from one folder."""

    def __init__(self, program, folder, lake, environment=None):
        self.program, self.folder, self.lake = str(program), pathlib.Path(folder), lake
        inherited = {name: value for name, value in os.environ.items() if name != "ECHOLAKE_LAKE"}
        self.environment = inherited | (environment or {})

    def start(self, *args, log=None, output=subprocess.DEVNULL):
        """Starts it; what it says goes to an open file, or nowhere."""
        command = [self.program, "--lake", self.lake, *args]
        error = log or subprocess.DEVNULL
        return subprocess.Popen(command, cwd=self.folder, env=self.environment, stdout=output, stderr=error)

    def run(self, *args, input=None):
        """Runs it to its end."""
        command = [self.program, "--lake", self.lake, *args]
        return subprocess.run(
            command, cwd=self.folder, env=self.environment, input=input, capture_output=True, timeout=COMMAND_LIMIT
        )

    def ok(self, *args):
        """Runs it and returns its output; it must end with 0."""
        done = self.run(*args)
        said = done.stderr.decode(errors="replace")
        require(done.returncode == 0, f"`{' '.join(args)}` ended with {done.returncode}: {said[-2000:]}")
        return done.stdout

    def rows(self, table):
        """Returns all rows of a table as lines of CSV, in an order that files do not matter for."""
        return sorted(self.ok("sql", "--format", "csv", f"select * from {table}").splitlines())

    def tables(self):
        """Returns digests of all rows of all tables, as queries see them, with their counts."""
        return {table: digest_of(self.rows(table)) for table in TABLES}


def digest_of(lines):
    return len(lines), hashlib.sha256(b"\n".join(lines)).hexdigest()


def current_files(commits):
    """Returns the files that a table's commits, in their order, leave in it: the runs' parts by the names of files."""
    there = {}
    for commit in commits:
        for line in commit.splitlines():
            action = json.loads(line)
            if "add" in action:
                name = urllib.parse.unquote(action["add"]["path"])
                parts = action["add"].get("tags", {}).get("echolake.parts")
                # A file of one run has the name of its part.
                there[name] = [part[0] for part in json.loads(parts)] if parts else [name]
            if "remove" in action:
                there.pop(urllib.parse.unquote(action["remove"]["path"]), None)
    return there


def list_rows(files):
    """Returns how often a table has the rows of each run and derivation: which runs share a file is left to chance."""
    return collections.Counter(part for parts in files.values() for part in parts)


def folder_files(lake):
    """Returns the parts of a lake's tables, with their number, and the MD5 digests of its run files."""
    lake, found = pathlib.Path(lake), {}
    for table in TABLES:
        commits = [path.read_text() for path in sorted((lake / f"tables/{table}/_delta_log").glob("*.json"))]
        found |= {f"tables/{table}/{part}": count for part, count in list_rows(current_files(commits)).items()}
    runs = {str(path.relative_to(lake)): path for path in (lake / "runs").rglob("*.mcap")}
    return found | {name: hashlib.md5(path.read_bytes()).hexdigest() for name, path in runs.items()}


def bucket_files(bucket, prefix):
    """Returns the same of a lake in a bucket, whose logs must name files that are there."""
    there = {key.removeprefix(f"{prefix}/"): tag for key, tag in bucket.list(f"{prefix}/").items()}
    found, absent = {}, []
    for table in TABLES:
        log = f"tables/{table}/_delta_log/"
        commits = sorted(name for name in there if name.startswith(log) and name.endswith(".json"))
        files = current_files([bucket.get(f"{prefix}/{name}").decode() for name in commits])
        absent += [f"tables/{table}/{name}" for name in files if f"tables/{table}/{name}" not in there]
        found |= {f"tables/{table}/{part}": count for part, count in list_rows(files).items()}
    require(not absent, f"the log names files that are not there: {absent[:5]}")

    def digest(name):
        # The ETag of an object that came in parts is no digest of its bytes.
        return hashlib.md5(bucket.get(f"{prefix}/{name}")).hexdigest() if "-" in there[name] else there[name]

    return found | {name: digest(name) for name in there if name.startswith("runs/") and name.endswith(".mcap")}


def require_same(expected, seen, what):
    """Both must have the same keys and values; names the first differences."""
    if expected == seen:
        return
    missing = sorted(expected.keys() - seen.keys())
    added = sorted(seen.keys() - expected.keys())
    other = sorted(key for key in expected.keys() & seen.keys() if expected[key] != seen[key])
    raise CheckError(f"{what}: {len(missing)} missing, {len(added)} more, {len(other)} others:"
                     f" {[*missing[:3], *added[:3], *((key, expected[key], seen[key]) for key in other[:3])]}")


def record_runs(program, folder, count):
    """Records so many small runs, six surfaces and variants of them, into `copies`; returns the files."""
    shutil.copy(SMALL_RIG, folder / "rig.toml")
    copies = folder / "copies"
    copies.mkdir()
    command = Command(program, folder, "lake")
    surfaces = ["flat", "foam", "wood", "prd", "brick", "wavy"]
    for number in range(count):
        surface = surfaces[number % 6] + (f"_{number}" if number >= 6 else "")
        args = ["acquire", "--surface", surface, "--rig", "rig.toml", "--ir-only", "--seed", str(number)]
        run = folder / command.ok(*args).decode().strip()
        shutil.copy(run, copies / run.name)
    return sorted(copies.iterdir())


@contextlib.contextmanager
def work_folder():
    """Makes a folder that is deleted at the end."""
    folder = pathlib.Path(tempfile.mkdtemp(prefix="echolake-bucket-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def random_for(*parts):
    """Returns a source of random numbers for this seed and these names of a part of the work."""
    return random.Random(" ".join(str(part) for part in parts))


class Server:
    """`serve` on free ports, as a process."""

    def __init__(self, command, log, *args):
        self.log = open(log, "w+b")
        addresses = [part for name in ("listen", "flight-sql", "postgres") for part in (f"--{name}", "127.0.0.1:0")]
        self.process = command.start("serve", *addresses, *args, log=self.log)
        end = time.monotonic() + COMMAND_LIMIT
        while not (found := [line for line in self.said().splitlines() if "  http://" in line]):
            require(self.process.poll() is None and time.monotonic() < end, f"no server: {self.said()[-2000:]}")
            time.sleep(0.05)
        self.address = found[0].split("http://")[1].split("/")[0].split()[0]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.kill()
        self.log.close()

    def said(self):
        """Returns what it wrote to stderr."""
        return pathlib.Path(self.log.name).read_text(errors="replace")

    def kill(self):
        """Kills it by SIGKILL; its engines end by themselves."""
        self.process.kill()
        self.process.wait()

    def connect(self):
        return ServerConnection(self.address)


class ServerConnection:
    """One client's connection to a server."""

    def __init__(self, address):
        self.http = http.client.HTTPConnection(address, timeout=COMMAND_LIMIT)

    def get(self, path):
        """Returns the body of an answer; another status than 200 is an error."""
        self.http.request("GET", path)
        return self._body(path)

    def sql(self, query):
        """Returns a query's answer as CSV."""
        return self._ask(query, "csv")

    def schema(self, query):
        """Returns the schema of a query's answer, as the bytes of its message in Arrow's stream."""
        stream = self._ask(query, "arrow")
        # After a mark of four bytes, the length of the message.
        return stream[8 : 8 + int.from_bytes(stream[4:8], "little")]

    def _ask(self, query, form):
        self.http.request("POST", f"/api/v1/sql?format={form}", query.encode(), {"content-type": "application/sql"})
        return self._body(query)

    def _body(self, asked):
        answer = self.http.getresponse()
        body = answer.read()
        require(answer.status == 200, f"{asked}: {answer.status} {body[:500]!r}")
        return body
