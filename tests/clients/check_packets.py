"""Reads the packets of a session over each protocol: `check_packets.py ECHOLAKE LAKE [--write docs/clients.md]`.

It serves the lake with tokens, first in plain text and then with a certificate, has a client of each protocol log in by its
token and ask, and captures loopback with tcpdump meanwhile. Of the encrypted sessions neither token nor statement nor a row may
be readable; of those in plain text all three must be, or the capture proves nothing. The row's text is put together by the
query, so that it stands in no statement. `--write` replaces the table in that page. Needs root, tcpdump, and pyarrow from PyPI.
"""
import argparse
import http.client
import os
import socket
import ssl
import struct
import subprocess
import sys
import tempfile
import time

from checks import write_table
from encrypted_clients import EncryptedServer

SQL = "select concat('text_of', '_row_', point_id) as label from points order by point_id"
ROW = "text_of_row_7"
SETTLE_SECONDS = 0.5
ETHERNET_HEADER, PCAP_HEADER, RECORD_HEADER = 14, 24, 16


class TcpdumpCapture:
    """What passes on loopback from and to these ports while it is open."""

    def __init__(self, folder, *ports):
        self.path = os.path.join(folder, "loopback.pcap")
        self.filter = " or ".join(f"tcp port {port}" for port in ports)

    def __enter__(self):
        command = ["tcpdump", "-i", "lo", "-s", "0", "-B", "65536", "-U", "--immediate-mode", "-Z", "root", "-w", self.path, self.filter]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        said = next((line for line in self.process.stderr if "listening on" in line), None)
        if said is None:
            sys.exit("tcpdump does not listen; hint: it needs root")
        return self

    def __exit__(self, *_):
        time.sleep(SETTLE_SECONDS)
        self.process.terminate()
        said = self.process.communicate(timeout=20)[1]
        if "0 packets dropped by kernel" not in said:
            sys.exit(f"packets were lost: {said}")

    def streams(self):
        """What was sent in one direction of each connection, by the ports of both ends."""
        with open(self.path, "rb") as file:
            content = file.read()
        if content[:4] != b"\xd4\xc3\xb2\xa1":
            sys.exit(f"`{self.path}` begins with {content[:4].hex()}, expected d4c3b2a1")
        streams, at = {}, PCAP_HEADER
        while at < len(content):
            length = struct.unpack_from("<I", content, at + 8)[0]
            add_payload(streams, content[at + RECORD_HEADER : at + RECORD_HEADER + length])
            at += RECORD_HEADER + length
        return streams


def add_payload(streams, packet):
    """Adds what a packet of IPv4 carries; loopback keeps the order."""
    transport = ETHERNET_HEADER + 4 * (packet[ETHERNET_HEADER] & 15)
    end = ETHERNET_HEADER + int.from_bytes(packet[ETHERNET_HEADER + 2 : ETHERNET_HEADER + 4], "big")
    ports = struct.unpack_from(">HH", packet, transport)
    payload = packet[transport + 4 * (packet[transport + 12] >> 4) : end]
    streams[ports] = streams.get(ports, b"") + payload


def context(server):
    """Trust in its certificate alone."""
    return ssl.create_default_context(cafile=server.certificate)


# A session each: log in by the token, ask, read all rows; how many these were.
def http_session(server, is_encrypted):
    where = ("localhost", server.http)
    connection = http.client.HTTPSConnection(*where, context=context(server)) if is_encrypted else http.client.HTTPConnection(*where)
    headers = {"authorization": f"Bearer {server.token}", "content-type": "application/sql", "accept": "text/csv"}
    connection.request("POST", "/api/v1/sql", SQL, headers)
    return len(connection.getresponse().read().decode().split()) - 1


def flight_session(server, is_encrypted):
    from pyarrow import flight
    secure = {}
    if is_encrypted:
        with open(server.certificate, "rb") as file:
            secure["tls_root_certs"] = file.read()
    client = flight.FlightClient(f"{'grpc+tls' if is_encrypted else 'grpc+tcp'}://localhost:{server.flight}", **secure)
    options = flight.FlightCallOptions(headers=[(b"authorization", b"Bearer " + server.token.encode())])
    # Flight SQL's CommandStatementQuery within Any: field 1 of both is a text, field 2 of the outer one its content.
    kind = b"type.googleapis.com/arrow.flight.protocol.sql.CommandStatementQuery"
    query = b"\x0a" + bytes([len(SQL)]) + SQL.encode()
    command = b"\x0a" + bytes([len(kind)]) + kind + b"\x12" + bytes([len(query)]) + query
    info = client.get_flight_info(flight.FlightDescriptor.for_command(command), options)
    return sum(client.do_get(endpoint.ticket, options).read_all().num_rows for endpoint in info.endpoints)


def postgres_session(server, is_encrypted):
    """As the user who sends the token itself."""
    stream = socket.create_connection(("localhost", server.postgres), timeout=20)
    if is_encrypted:
        stream.sendall(struct.pack(">II", 8, 80877103))
        assert stream.recv(1) == b"S"
        stream = context(server).wrap_socket(stream, server_hostname="localhost")
    with stream, stream.makefile("rb") as answers:
        startup = b"\0\x03\0\0user\0token\0database\0datafusion\0\0"
        stream.sendall(struct.pack(">I", len(startup) + 4) + startup)
        send_postgres(stream, b"p", server.token)
        kinds_until_ready(answers)
        send_postgres(stream, b"Q", SQL)
        return kinds_until_ready(answers).count(b"D")


def send_postgres(stream, kind, text):
    stream.sendall(kind + struct.pack(">I", len(text) + 5) + text.encode() + b"\0")


def kinds_until_ready(answers):
    kinds = []
    while kinds[-1:] != [b"Z"]:
        kinds.append(answers.read(1))
        answers.read(struct.unpack(">I", answers.read(4))[0] - 4)
    return kinds


SESSIONS = {"HTTP": ("http", http_session), "Flight SQL": ("flight", flight_session), "Postgres": ("postgres", postgres_session)}


def readable_texts(program, lake, port, is_encrypted):
    """By protocol: bytes that were captured, and which of the texts can be read."""
    with tempfile.TemporaryDirectory() as folder:
        server = EncryptedServer(program, lake, folder, port, is_encrypted)
        try:
            with TcpdumpCapture(folder, server.http, server.flight, server.postgres) as capture:
                for name, (_, session) in SESSIONS.items():
                    if (rows := session(server, is_encrypted)) < 1:
                        sys.exit(f"{name} has {rows} rows, expected some")
            streams = capture.streams()
        finally:
            server.stop()
    texts = {"token": server.token, "statement": SQL, "row": ROW}
    results = {}
    for name, (attribute, _) in SESSIONS.items():
        ours = [content for ports, content in streams.items() if getattr(server, attribute) in ports]
        results[name] = sum(map(len, ours)), {what: any(text.encode() in content for content in ours) for what, text in texts.items()}
    return results


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("program")
    parser.add_argument("lake")
    parser.add_argument("--port", type=int, default=9473, help="the first of three ports")
    parser.add_argument("--write", help="the page whose table is replaced")
    given = parser.parse_args()
    results = {is_encrypted: readable_texts(given.program, given.lake, given.port, is_encrypted) for is_encrypted in (False, True)}
    lines = ["| session | bytes captured | token | statement | row |", "| --- | --- | --- | --- | --- |"]
    wrong = []
    for is_encrypted, found in results.items():
        for name, (captured, texts) in found.items():
            words = " | ".join("readable" if is_readable else "not readable" for is_readable in texts.values())
            lines.append(f"| {name}, {'TLS' if is_encrypted else 'plain text'} | {captured} | {words} |")
            wrong += [f"{name}, {what}: {'readable' if is_encrypted else 'not readable'} {'with' if is_encrypted else 'without'} TLS"
                      for what, is_readable in texts.items() if is_readable == is_encrypted]
    print("\n".join(lines))
    if given.write:
        write_table(given.write, "check_packets.py", "\n".join(lines))
    for failure in wrong:
        print(f"FAIL {failure}", file=sys.stderr)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
