"""Scans a server's TLS on its three protocols: `check_tls.py ECHOLAKE LAKE [--write docs/clients.md]`.

It makes a certificate and tokens by the command of this name and serves the lake. Which versions and cipher suites the
server takes is asked by first messages of a client that offer all of them (`tls_hello.py`); renegotiation by
`openssl s_client`. The same is asked of `openssl s_server` with everything on, which must show weaknesses, so that a scan that
finds none has looked. Then the certificate is renewed while a hundred clients keep and make connections: none may be lost,
and the new one must be served. `--write` replaces the table in that page. Needs openssl, and Python 3.11 alone.
"""
import argparse
import asyncio
import hashlib
import os
import re
import shutil
import ssl
import subprocess
import sys
import tempfile
import time

import tls_hello
from checks import write_table
from encrypted_clients import EncryptedServer, wait_for
from tls_hello import VERSIONS, WEAK_SUITES

CLIENTS = 100
SECONDS_BEFORE, SECONDS_AFTER = 3, 5
# Half of the clients keep their connection to the end; the others make a new one after so many requests.
REQUESTS_A_CONNECTION = 3
TAKEN, REFUSED = "taken", "refused"
EXPECTED_VERSIONS = {name: TAKEN if name in ("TLS 1.2", "TLS 1.3") else REFUSED for name in VERSIONS}
STRONG = re.compile(r"^(TLS_ECDHE_\w+_|TLS_)(AES_(128|256)_GCM|CHACHA20_POLY1305)_SHA(256|384)$")


def run(*arguments, **more):
    """A program that must not fail."""
    return subprocess.run(arguments, check=True, capture_output=True, text=True, timeout=60, **more)


def suite_names():
    """Names of suites by their numbers, as far as openssl knows them."""
    lines = run("openssl", "ciphers", "-V", "-stdname", "ALL:COMPLEMENTOFALL:@SECLEVEL=0").stdout.splitlines()
    found = (re.match(r"\s*0x(\w\w),0x(\w\w) - (\S+)", line) for line in lines)
    return {int(match[1] + match[2], 16): match[3] for match in found if match}


class WeakServer:
    """openssl's server with all that it has: the scan must find it."""

    def __init__(self, folder, port):
        certificate, key = os.path.join(folder, "weak.pem"), os.path.join(folder, "weak-key.pem")
        run("openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=localhost", "-keyout", key, "-out", certificate)
        options = ["-www", "-min_protocol", "None", "-cipher", "ALL:COMPLEMENTOFALL:@SECLEVEL=0", "-client_renegotiation"]
        self.process = subprocess.Popen(
            ["openssl", "s_server", "-accept", f"127.0.0.1:{port}", "-cert", certificate, "-key", key, *options],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait_for(port)

    def stop(self):
        """Ends it."""
        self.process.terminate()
        self.process.wait(20)


def renegotiation(port, *options):
    """Whether the server lets a client of TLS 1.2 negotiate anew: openssl's client does so on a line `R`, looks at the certificate
    once more if it may, and waits if its wish is not heard."""
    client = subprocess.Popen(
        ["openssl", "s_client", "-connect", f"127.0.0.1:{port}", "-tls1_2", *options],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        for line in "R\n", "Q\n":
            time.sleep(1)
            client.stdin.write(line)
            client.stdin.flush()
    except BrokenPipeError:
        pass  # it ended at the refusal
    try:
        said, _ = client.communicate(timeout=5)
    except subprocess.TimeoutExpired:
        client.kill()
        said, _ = client.communicate()
    if "RENEGOTIATING" not in said:
        raise RuntimeError(f"openssl s_client did not try: {said[-300:]}")
    return TAKEN if "verify return" in said.split("RENEGOTIATING", 1)[1] else REFUSED


def scan(connect, port, *options):
    """What a protocol takes, by what was asked."""
    taken = lambda version, suites: TAKEN if (hello := tls_hello.ask(connect, version, suites)) and hello.version == version else REFUSED
    tls_12, tls_13 = VERSIONS["TLS 1.2"], VERSIONS["TLS 1.3"]
    found = {
        name: taken(version, tls_hello.SUITES_13 if version == tls_13 else tls_hello.SUITES_12) for name, version in VERSIONS.items()
    }
    found |= {f"suites: {name}": taken(tls_12, suites) for name, suites in WEAK_SUITES.items()}
    hello = tls_hello.ask(connect, tls_12, tls_hello.SUITES_12)
    found["compression"] = TAKEN if hello and hello.compression else REFUSED
    found["TLS 1.2 says that 1.3 is there"] = "yes" if hello and hello.says_downgrade() else "no"
    found["renegotiation"] = renegotiation(port, *options)
    names = suite_names()
    for name, version, suites in ("TLS 1.2", tls_12, tls_hello.SUITES_12), ("TLS 1.3", tls_13, tls_hello.SUITES_13):
        found[f"suites of {name}"] = sorted(names.get(number, f"0x{number:04X}") for number in tls_hello.accepted_suites(connect, version, suites))
    return found


def weaknesses(found):
    """What is not as it must be, in words."""
    expected = EXPECTED_VERSIONS | {f"suites: {name}": REFUSED for name in WEAK_SUITES}
    expected |= {"compression": REFUSED, "renegotiation": REFUSED, "TLS 1.2 says that 1.3 is there": "yes"}
    wrong = [f"{what}: {found[what]}, expected {value}" for what, value in expected.items() if found[what] != value]
    for name in "TLS 1.2", "TLS 1.3":
        suites = found[f"suites of {name}"]
        wrong += [f"{name} takes {suite}" for suite in suites if not STRONG.match(suite)] + ([] if suites else [f"no suite of {name}"])
    return wrong


# A client of each protocol: how it begins on a fresh stream, and a request with its answer on an open one.
async def ask_http(reader, writer):
    writer.write(b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\n")
    head = await reader.readuntil(b"\r\n\r\n")
    if not head.startswith(b"HTTP/1.1 200"):
        raise ValueError(f"{head[:50]!r} came, expected HTTP/1.1 200")
    await reader.readexactly(int(re.search(rb"content-length: (\d+)", head.lower())[1]))


async def begin_http_2(_, writer, __):
    writer.write(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + http_2_frame(4, b""))


def http_2_frame(kind, content, flags=0):
    return len(content).to_bytes(3, "big") + bytes([kind, flags]) + (0).to_bytes(4, "big") + content


async def ask_http_2(reader, writer):
    """A PING, whose answer comes among settings and windows."""
    content = os.urandom(8)
    writer.write(http_2_frame(6, content))
    while True:
        head = await reader.readexactly(9)
        answer = await reader.readexactly(int.from_bytes(head[:3], "big"))
        if head[3] == 7:
            raise ConnectionError("GOAWAY came")
        if head[3] == 6 and head[4] == 1 and answer == content:
            return


async def postgres_message(reader):
    head = await reader.readexactly(5)
    content = await reader.readexactly(int.from_bytes(head[1:], "big") - 4)
    if head[:1] == b"E":
        raise ValueError(f"{content!r} came")
    return head[:1], content


async def begin_postgres(reader, writer, token):
    startup = b"\0\x03\0\0user\0token\0database\0datafusion\0\0"
    writer.write((len(startup) + 4).to_bytes(4, "big") + startup)
    await postgres_message(reader)
    password = token.encode() + b"\0"
    writer.write(b"p" + (len(password) + 4).to_bytes(4, "big") + password)
    await until_ready(reader)


async def until_ready(reader):
    while (await postgres_message(reader))[0] != b"Z":
        pass


async def ask_postgres(reader, writer):
    """A Sync, which is no query: of these a token may run a few at once."""
    writer.write(b"S" + (4).to_bytes(4, "big"))
    await until_ready(reader)


async def nothing(*_):
    pass


class RenewalLoad:
    """Clients that keep and make connections while the certificate changes."""

    def __init__(self, server, trusted):
        """`trusted` are the digests of the certificates that may be shown."""
        self.server, self.trusted = server, trusted
        self.contexts = {protocol: self.context(protocol) for protocol in ("http/1.1", "h2", "postgresql")}
        self.is_open = True
        self.answers, self.lost, self.kept = 0, [], 0
        self.connections = {}

    @staticmethod
    def context(protocol):
        """Certificates are compared by their digests: of two self-signed ones of one name, OpenSSL tries only one."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        context.set_alpn_protocols([protocol])
        return context

    async def open_stream(self, port, context, is_postgres):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        if is_postgres:
            writer.write((8).to_bytes(4, "big") + (80877103).to_bytes(4, "big"))
            await reader.readexactly(1)
        await writer.start_tls(context, server_hostname="localhost")
        certificate = writer.get_extra_info("ssl_object").getpeercert(True)
        shown = hashlib.sha256(certificate).hexdigest()
        if shown not in self.trusted:
            raise ValueError(f"a certificate of SHA-256 {shown} was shown")
        self.connections[shown] = self.connections.get(shown, 0) + 1
        return reader, writer

    async def client(self, port, protocol, begin, ask, is_kept):
        context = self.contexts[protocol]
        while self.is_open:
            try:
                reader, writer = await self.open_stream(port, context, protocol == "postgresql")
                await begin(reader, writer, self.server.token)
                requests = 0
                while self.is_open and (is_kept or requests < REQUESTS_A_CONNECTION):
                    await asyncio.wait_for(ask(reader, writer), tls_hello.TIME_LIMIT)
                    self.answers += 1
                    requests += 1
                    await asyncio.sleep(0.2)
                self.kept += is_kept
                writer.close()
            except Exception as error:  # whatever it is, a connection was lost
                self.lost.append(f"{protocol}: {type(error).__name__}: {error}")
                await asyncio.sleep(0.1)

    def clients(self):
        """A task each, of the three protocols in turn; two of four keep their connection."""
        kinds = [
            (self.server.http, "http/1.1", nothing, ask_http),
            (self.server.flight, "h2", begin_http_2, ask_http_2),
            (self.server.postgres, "postgresql", begin_postgres, ask_postgres),
        ]
        return [self.client(*kinds[number % 3], number % 4 < 2) for number in range(CLIENTS)]


def certificate_digest(path):
    with open(path, encoding="utf-8") as file:
        return hashlib.sha256(ssl.PEM_cert_to_DER_cert(file.read())).hexdigest()


async def renewal(program, server, folder):
    """Renews the certificate under load: what the clients saw."""
    run(program, "certificate", "localhost", "-o", os.path.join(folder, "renewed"))
    renewed = os.path.join(folder, "renewed", "certificate.pem")
    old, new = (certificate_digest(path) for path in (server.certificate, renewed))
    load = RenewalLoad(server, {old, new})
    tasks = [asyncio.create_task(client) for client in load.clients()]
    await asyncio.sleep(SECONDS_BEFORE)
    # The key first: for a moment the two files do not fit.
    shutil.copy(os.path.join(folder, "renewed", "key.pem"), os.path.join(folder, "tls", "key.pem"))
    await asyncio.sleep(1.5)
    shutil.copy(renewed, server.certificate)
    await asyncio.sleep(SECONDS_AFTER)
    load.is_open = False
    await asyncio.wait_for(asyncio.gather(*tasks), 60)
    return load, load.connections.get(new, 0)


def format_table(columns, sentences):
    """The table as Markdown; `columns` are the scans by their names."""
    first = next(iter(columns.values()))
    lines = ["| | " + " | ".join(columns) + " |", "| --- |" + " --- |" * len(columns)]
    for what in first:
        cells = (found[what] for found in columns.values())
        shown = [cell if isinstance(cell, str) else str(len(cell)) for cell in cells]
        lines.append(f"| {what} | " + " | ".join(shown) + " |")
    return "\n".join([*lines, "", *sentences])


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("program")
    parser.add_argument("lake")
    parser.add_argument("--port", type=int, default=9463, help="the first of four ports")
    parser.add_argument("--write", help="the page whose table is replaced")
    given = parser.parse_args()
    failures = []
    with tempfile.TemporaryDirectory() as folder:
        server, weak = EncryptedServer(given.program, given.lake, folder, given.port), WeakServer(folder, given.port + 3)
        try:
            columns = {
                "HTTP": scan(lambda: tls_hello.plain_connection(server.http), server.http),
                "Flight SQL": scan(lambda: tls_hello.plain_connection(server.flight), server.flight, "-alpn", "h2"),
                "Postgres": scan(lambda: tls_hello.postgres_connection(server.postgres), server.postgres, "-starttls", "postgres"),
                "openssl s_server, all on": scan(lambda: tls_hello.plain_connection(given.port + 3), given.port + 3),
            }
            load, renewed = asyncio.run(renewal(given.program, server, folder))
        finally:
            server.stop()
            weak.stop()
    *ours, control = columns.items()
    failures += [f"{name}: {wrong}" for name, found in ours for wrong in weaknesses(found)]
    missed = {"TLS 1.0", "suites: RSA without forward secrecy", "suites: CBC", "renegotiation"}
    failures += [f"the scan does not see {what} of a server that takes it" for what in missed if control[1][what] != TAKEN]
    failures += [] if load.kept == CLIENTS // 2 else [f"{load.kept} connections were kept, expected {CLIENTS // 2}"]
    failures += sorted(set(load.lost)) + ([] if renewed else ["the renewed certificate was never served"])
    suites = sorted({suite for _, found in ours for version in ("TLS 1.2", "TLS 1.3") for suite in found[f"suites of {version}"]})
    table = format_table(columns, [
        "Taken: " + ", ".join(f"`{suite}`" for suite in suites) + ".",
        f"A certificate renewed under {CLIENTS} clients of all protocols: {sum(load.connections.values())} connections, {renewed} of them "
        f"with the new one, {load.answers} answers, {load.kept} connections kept from before to after, {len(load.lost)} lost.",
    ])
    print(table)
    if given.write:
        write_table(given.write, "check_tls.py", table)
    for failure in failures:
        print(f"FAIL {failure}", file=sys.stderr)
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
