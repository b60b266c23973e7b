"""Checks clients of a server that encrypts and asks for tokens: `encrypted_clients.py ECHOLAKE LAKE [--write docs/clients.md]`.

It makes a certificate and tokens by the command of this name, serves the lake, and has each client verify the certificate,
log in and ask; then refuse another certificate, and be refused with a wrong token and without encryption. Nothing of the
token, the statement and the answer's column may be readable in the packets of the first (captured on loopback, which root
alone may do). Over Postgres' protocol a token's own name logs in by SCRAM-SHA-256, and the user `token` sends the token. `--write`
replaces the table in that page. Needs psql, curl, a JDK with pgjdbc in /usr/share/java, and the PyPI packages psycopg[binary], asyncpg and adbc-driver-flightsql.
"""
import argparse
import asyncio
import os
import re
import signal
import socket
import ssl
import subprocess
import sys
import tempfile
import threading
import time

from checks import write_table

HERE = os.path.dirname(os.path.abspath(__file__))
SQL = "select count(*) as number_of_grid_points from points"
NAME = "ann"
OLD = "old"
# The user who sends a token as it is.
SENDER = "token"


class EncryptedServer:
    """A server with a certificate and two tokens, one of them from a version without SCRAM; without encryption for comparison."""

    def __init__(self, program, lake, folder, port, is_encrypted=True):
        self.folder = folder
        self.http, self.flight, self.postgres = port, port + 1, port + 2
        for name in "tls", "other":
            subprocess.run([program, "certificate", "localhost", "-o", os.path.join(folder, name)], check=True, capture_output=True)
        self.certificate = os.path.join(folder, "tls", "certificate.pem")
        self.other = os.path.join(folder, "other", "certificate.pem")
        self.token, lines = self.make_token(program, NAME)
        self.old, old_lines = self.make_token(program, OLD)
        tokens = os.path.join(folder, "tokens.toml")
        with open(tokens, "w", encoding="utf-8") as file:
            file.write(lines + re.sub(r"^scram = .*\n", "", old_lines, flags=re.MULTILINE))
        addresses = zip(["--listen", "--flight-sql", "--postgres"], [self.http, self.flight, self.postgres])
        listen = [part for option, number in addresses for part in (option, f"127.0.0.1:{number}")]
        files = ["--tokens", tokens]
        if is_encrypted:
            files += ["--certificate", self.certificate, "--key", os.path.join(folder, "tls", "key.pem")]
        self.process = subprocess.Popen([program, "--lake", lake, "serve", *listen, *files], stderr=subprocess.DEVNULL)
        wait_for(self.postgres)

    @staticmethod
    def make_token(program, name):
        """The token and its lines."""
        made = subprocess.run([program, "token", name], check=True, capture_output=True, text=True)
        return made.stderr.split()[0], made.stdout + "\n"

    def stop(self):
        """Ends it."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait(20)


class PacketCapture:
    """What passes on loopback from and to these ports while it is open."""

    ALL_PROTOCOLS = 3

    def __init__(self, *ports):
        self.ports = set(ports)
        self.payloads = []

    def __enter__(self):
        self.socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(self.ALL_PROTOCOLS))
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 26)
        self.socket.bind(("lo", 0))
        self.socket.settimeout(0.2)
        self.is_open = True
        self.thread = threading.Thread(target=self.read)
        self.thread.start()
        return self

    def read(self):
        while True:
            try:
                packet = self.socket.recv(1 << 17)
            except TimeoutError:
                if not self.is_open:
                    return
                continue
            # Ethernet's header, then IPv4's, whose length is in words of 32 bits, then TCP's with both ports.
            transport = 14 + 4 * (packet[14] & 15)
            numbers = {int.from_bytes(packet[transport + at : transport + at + 2], "big") for at in (0, 2)}
            if packet[12:14] == b"\x08\x00" and packet[23] == socket.IPPROTO_TCP and numbers & self.ports:
                self.payloads.append(packet[transport + 4 * (packet[transport + 12] >> 4) :])

    def __exit__(self, *_):
        self.is_open = False
        self.thread.join()
        self.socket.close()

    def readable(self, *texts):
        """Those of the texts that can be read, and an error if nothing was captured."""
        payload = b"".join(self.payloads)
        if len(payload) < 1000:
            raise RuntimeError(f"{len(payload)} bytes were captured, expected thousands")
        return [text for text in texts if text.encode() in payload]


def wait_for(port):
    """Waits until somebody listens."""
    for _ in range(200):
        try:
            socket.create_connection(("127.0.0.1", port)).close()
            return
        except OSError:
            time.sleep(0.1)
    sys.exit(f"nothing answers on port {port} within 20 s")


def run(arguments, **environment):
    """What a program prints; an error if it fails."""
    ran = subprocess.run(arguments, capture_output=True, text=True, timeout=60, env={**os.environ, **environment})
    if ran.returncode:
        raise RuntimeError((ran.stderr or ran.stdout).strip()[-300:])
    return ran.stdout.strip()


# Each client asks with a certificate to trust, or None for no encryption, and a token; `user` where there are users.
def psql(server, certificate, token, user=NAME):
    bound = " channel_binding=require" if user == NAME else ""
    secure = f"sslmode=verify-full sslrootcert={certificate}{bound}" if certificate else "sslmode=disable"
    settings = f"host=localhost port={server.postgres} user={user} dbname=datafusion {secure}"
    return run(["psql", "-X", "-t", "-A", settings, "-c", SQL], PGPASSWORD=token or "")


def psycopg_3(server, certificate, token, user=NAME):
    import psycopg
    secure = {"sslmode": "verify-full", "sslrootcert": certificate} if certificate else {"sslmode": "disable"}
    if user == NAME:
        secure |= {"require_auth": "scram-sha-256"} | ({"channel_binding": "require"} if certificate else {})
    with psycopg.connect(host="localhost", port=server.postgres, user=user, password=token, dbname="datafusion", **secure) as lake:
        return lake.execute(SQL).fetchone()[0]


def asyncpg(server, certificate, token, user=NAME):
    import asyncpg as driver
    async def ask():
        secure = ssl.create_default_context(cafile=certificate) if certificate else False
        lake = await driver.connect(host="localhost", port=server.postgres, user=user, password=token, database="datafusion", ssl=secure)
        try:
            return await lake.fetchval(SQL)
        finally:
            await lake.close()
    return asyncio.run(ask())


def jdbc(server, certificate, token, user=NAME):
    secure = f"sslmode=verify-full&sslrootcert={certificate}" if certificate else "sslmode=disable"
    url = f"jdbc:postgresql://localhost:{server.postgres}/datafusion?user={user}&password={token}&{secure}"
    return run(["java", "-cp", "/usr/share/java/postgresql.jar", os.path.join(HERE, "postgres", "One.java"), url, SQL])


def flight_sql(server, certificate, token, user=NAME):
    import adbc_driver_flightsql.dbapi as driver
    options = {"username": user, "password": token}
    if certificate:
        with open(certificate, encoding="utf-8") as file:
            options["adbc.flight.sql.client_option.tls_root_certs"] = file.read()
    scheme = "grpc+tls" if certificate else "grpc"
    with driver.connect(f"{scheme}://localhost:{server.flight}", db_kwargs=options, autocommit=True) as lake, lake.cursor() as cursor:
        cursor.execute(SQL)
        return cursor.fetchone()[0]


def curl(server, certificate, token, user=NAME):
    scheme, secure = ("https", ["--cacert", certificate]) if certificate else ("http", [])
    url = f"{scheme}://localhost:{server.http}/api/v1/sql?format=csv"
    ask = ["-H", f"authorization: Bearer {token}", "-H", "content-type: application/sql", "-d", SQL]
    return run(["curl", "--silent", "--show-error", "--fail", *secure, *ask, url]).split()[-1]


# Name, act, what it trusts the certificate by, and how it logs in.
CLIENTS = [
    ("psql", psql, "`sslmode=verify-full sslrootcert=certificate.pem`", "SCRAM, bound to the certificate"),
    ("psycopg 3", psycopg_3, "the same", "SCRAM, bound to the certificate"),
    ("asyncpg", asyncpg, '`ssl=ssl.create_default_context(cafile="certificate.pem")`', "SCRAM"),
    ("Java: pgjdbc", jdbc, "`sslmode=verify-full&sslrootcert=certificate.pem`", "SCRAM"),
    ("ADBC Flight SQL", flight_sql, "`adbc.flight.sql.client_option.tls_root_certs`: its text", "the token"),
    ("curl", curl, "`--cacert certificate.pem`", "the token"),
]


def requested_method(server, user):
    """How the server lets a user of Postgres' protocol log in: the first bytes of its answer within TLS."""
    startup = b"\0\x03\0\0user\0" + user.encode() + b"\0\0"
    with socket.create_connection(("127.0.0.1", server.postgres), timeout=10) as plain:
        plain.sendall((8).to_bytes(4, "big") + (80877103).to_bytes(4, "big"))
        assert plain.recv(1) == b"S"
        with ssl.create_default_context(cafile=server.certificate).wrap_socket(plain, server_hostname="localhost") as stream:
            stream.sendall((len(startup) + 4).to_bytes(4, "big") + startup)
            answer = stream.recv(1000)
    return {10: "SCRAM", 3: "the token"}[int.from_bytes(answer[5:9], "big")]


def is_refused(act):
    """None if it fails."""
    try:
        return f"let in: {act()}"
    except Exception:  # whatever a driver throws is a refusal
        return None


def is_answered(act):
    """None if the answer is right."""
    try:
        value = act()
        return None if int(value) == 78 else f"returned {value!r}"
    except Exception as error:  # whatever a driver throws is a failure of this check alone
        return f"{type(error).__name__}: {error}"


def unreadable_answer(server, act):
    """Failures of an answer over an encrypted connection, and of its secrecy; None for what passed."""
    with PacketCapture(server.http, server.flight, server.postgres) as capture:
        answered = is_answered(lambda: act(server, server.certificate, server.token))
    texts = {"the token": server.token, "the statement": SQL, "the column": "number_of_grid_points"}
    found = capture.readable(*texts.values())
    names = [name for name, text in texts.items() if text in found]
    return answered, f"{' and '.join(names)} can be read" if names else None


def capture_reads():
    """None if the capture reads what is sent in plain text, so that it would show a token, too."""
    with socket.create_server(("127.0.0.1", 0)) as listener, PacketCapture(listener.getsockname()[1]) as capture:
        with socket.create_connection(listener.getsockname()) as stream:
            stream.sendall(SQL.encode() * 50)
    return None if capture.readable(SQL) else "the capture does not read plain text"


def check_client(server, name, act, login):
    """Failures by check; None for what passed."""
    answered, secrecy = unreadable_answer(server, act)
    results = {
        "verified": answered,
        "packets": secrecy,
        "another certificate": is_refused(lambda: act(server, server.other, server.token)),
        "a wrong token": is_refused(lambda: act(server, server.certificate, server.token[:-1] + "x")),
        "not encrypted": is_refused(lambda: act(server, None, server.token)),
    }
    if login.startswith("SCRAM"):
        results["an older token"] = is_answered(lambda: act(server, server.certificate, server.old, SENDER))
    for check, failure in results.items():
        if failure:
            print(f"FAIL {name}: {check}: {' '.join(failure.split())[:300]}", file=sys.stderr)
    return results


def format_table(results):
    """The table as Markdown."""
    lines = ["| client | trusts the certificate by | logs in by | passed | tried |", "| --- | --- | --- | --- | --- |"]
    for (name, _, trust, login), checks in results:
        passed = sum(failure is None for failure in checks.values())
        lines.append(f"| {name} | {trust} | {login} | {passed} | {len(checks)} |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("program")
    parser.add_argument("lake")
    parser.add_argument("--port", type=int, default=9443, help="the first of three ports")
    parser.add_argument("--write", help="the page whose table is replaced")
    given = parser.parse_args()
    if os.geteuid() != 0:
        sys.exit("packets are captured by root alone; hint: sudo, or a container")
    if failure := capture_reads():
        sys.exit(failure)
    with tempfile.TemporaryDirectory() as folder:
        server = EncryptedServer(given.program, given.lake, folder, given.port)
        try:
            methods = [requested_method(server, user) for user in (NAME, OLD, "nobody", SENDER)]
            results = [(client, check_client(server, client[0], client[1], client[3])) for client in CLIENTS]
        finally:
            server.stop()
    table = format_table(results)
    print(table)
    if given.write:
        write_table(given.write, "encrypted_clients.py", table)
    if methods != ["SCRAM"] * 3 + ["the token"]:
        sys.exit(f"the server asks for {methods}")
    return int(any(failure for _, checks in results for failure in checks.values()))


if __name__ == "__main__":
    sys.exit(main())
