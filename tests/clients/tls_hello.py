"""A client's first message of TLS, written byte by byte, and the server's answer to it.

A library offers what it was built with: OpenSSL of today has neither SSL 3.0 nor RC4. This offers anything, and reads no
further than the answer, which says what the server would speak. TLS 1.3 is asked without a key, so that the server
names version and cipher suite in a HelloRetryRequest (RFC 8446, 4.1.4).
"""
import os
import socket
from dataclasses import dataclass

VERSIONS = {"SSL 3.0": 0x0300, "TLS 1.0": 0x0301, "TLS 1.1": 0x0302, "TLS 1.2": 0x0303, "TLS 1.3": 0x0304}
# Suites of TLS 1.3, and all that were ever registered for the versions before, but for the signals among them.
SUITES_13 = list(range(0x1301, 0x1306))
SUITES_12 = [*range(0x0001, 0x00FF), *range(0xC001, 0xC100), *range(0xCC00, 0xCD00)]
WEAK_SUITES = {
    "no encryption": [0x0001, 0x0002, 0x002C, 0x002D, 0x002E, 0x003B, 0xC001, 0xC006, 0xC00B, 0xC010, 0xC015],
    "export": [0x0003, 0x0006, 0x0008, 0x000B, 0x000E, 0x0011, 0x0014, 0x0017, 0x0019],
    "RC4": [0x0004, 0x0005, 0x0018, 0xC002, 0xC007, 0xC00C, 0xC011, 0xC016],
    "DES, 3DES": [0x0009, 0x000A, 0x000C, 0x000D, 0x000F, 0x0010, 0x0012, 0x0013, 0x0015, 0x0016, 0x001A, 0x001B, 0xC008, 0xC012],
    "anonymous": [0x0034, 0x003A, 0x006C, 0x006D, 0x00A6, 0x00A7, 0xC018, 0xC019],
    "RSA without forward secrecy": [0x002F, 0x0035, 0x003C, 0x003D, 0x009C, 0x009D],
    "CBC": [0x0033, 0x0039, 0x0067, 0x006B, 0xC009, 0xC00A, 0xC013, 0xC014, 0xC023, 0xC024, 0xC027, 0xC028],
}
ALERT, HANDSHAKE, SERVER_HELLO = 21, 22, 2
SUPPORTED_VERSIONS, KEY_SHARE = 43, 51
DEFLATE, NO_COMPRESSION = 1, 0
TIME_LIMIT = 20


@dataclass
class ServerHello:
    """What a server would speak."""

    version: int
    suite: int
    compression: int
    random: bytes

    def says_downgrade(self):
        """True if it says that it could speak TLS 1.3, as RFC 8446 (4.1.3) wants of a server that is asked for 1.2."""
        return self.random.endswith(b"DOWNGRD\x01")


def sized(content, size):
    """Content behind its length."""
    return len(content).to_bytes(size, "big") + content


def numbers(values, size=2):
    """Numbers behind their length in bytes."""
    return sized(b"".join(value.to_bytes(size, "big") for value in values), 2)


def client_hello(version, suites):
    """The record."""
    name = b"\0" + sized(b"localhost", 2)
    extensions = {
        0: sized(name, 2),
        10: numbers([29, 23, 24, 25, 256]),
        11: sized(b"\0", 1),
        13: numbers([0x0403, 0x0503, 0x0603, 0x0804, 0x0805, 0x0806, 0x0401, 0x0501, 0x0601, 0x0203, 0x0201]),
        0xFF01: sized(b"", 1),
    }
    if version == VERSIONS["TLS 1.3"]:
        extensions |= {SUPPORTED_VERSIONS: sized(version.to_bytes(2, "big"), 1), KEY_SHARE: sized(b"", 2)}
    listed = b"".join(number.to_bytes(2, "big") + sized(content, 2) for number, content in extensions.items())
    offered = bytes([NO_COMPRESSION]) if version == VERSIONS["TLS 1.3"] else bytes([DEFLATE, NO_COMPRESSION])
    body = min(version, VERSIONS["TLS 1.2"]).to_bytes(2, "big") + os.urandom(32) + sized(b"", 1) + numbers(suites) + sized(offered, 1)
    if version > VERSIONS["SSL 3.0"]:
        body += sized(listed, 2)
    record = min(version, VERSIONS["TLS 1.0"]).to_bytes(2, "big")
    return bytes([HANDSHAKE]) + record + sized(b"\1" + sized(body, 3), 2)


def read_whole(stream, length):
    """So many bytes; None if the connection ends before."""
    content = b""
    while len(content) < length:
        part = stream.recv(length - len(content))
        if not part:
            return None
        content += part
    return content


def parse_server_hello(message):
    """The message of a record."""
    if message[0] != SERVER_HELLO:
        raise ValueError(f"message {message[0]} came, expected a ServerHello")
    version, random, at = int.from_bytes(message[4:6], "big"), message[6:38], 39 + message[38]
    suite, compression = int.from_bytes(message[at : at + 2], "big"), message[at + 2]
    at += 5
    while at + 4 <= len(message):
        number, length = int.from_bytes(message[at : at + 2], "big"), int.from_bytes(message[at + 2 : at + 4], "big")
        if number == SUPPORTED_VERSIONS:
            version = int.from_bytes(message[at + 4 : at + 4 + length], "big")
        at += 4 + length
    return ServerHello(version, suite, compression, random)


def ask(connect, version, suites):
    """The server's answer; None if it refuses by an alert or by closing."""
    with connect() as stream:
        try:
            stream.sendall(client_hello(version, suites))
            head = read_whole(stream, 5)
            if head is None or head[0] == ALERT:
                return None
            if head[0] != HANDSHAKE:
                raise ValueError(f"a record of type {head[0]} came, expected a handshake or an alert")
            return parse_server_hello(read_whole(stream, int.from_bytes(head[3:5], "big")) or b"\0")
        except (ConnectionResetError, BrokenPipeError):
            return None


def accepted_suites(connect, version, suites):
    """Those that the server takes: it is asked for the rest until it takes none."""
    rest, taken = list(suites), []
    while answer := ask(connect, version, rest):
        if answer.version != version or answer.suite not in rest:
            raise ValueError(f"version {answer.version:04x} with suite {answer.suite:04x} came, which was not offered")
        taken.append(answer.suite)
        rest.remove(answer.suite)
    return taken


def plain_connection(port):
    """A connection on which TLS begins at once."""
    return socket.create_connection(("127.0.0.1", port), timeout=TIME_LIMIT)


def postgres_connection(port):
    """One of Postgres' protocol, after its SSLRequest."""
    stream = plain_connection(port)
    stream.sendall((8).to_bytes(4, "big") + (80877103).to_bytes(4, "big"))
    answer = stream.recv(1)
    if answer != b"S":
        raise ValueError(f"{answer!r} came upon an SSLRequest, expected b'S'")
    return stream
