#!/usr/bin/env python3
"""Asks a server that sends its spans to a collector of this check: `check_traces.py ECHOLAKE`.

ECHOLAKE was built with `--features otlp`. It makes a small lake, serves it, and asks over HTTP with a trace of its own and
without one, and over Postgres' protocol. Each request must be one span of its client's trace, or of a new one, which its line
in the log names, too; no text of a statement may be in a span; and without a collector answers must come all the same.
Needs grpcio and opentelemetry-proto from PyPI.
"""
import concurrent.futures
import http.client
import pathlib
import queue
import re
import socket
import subprocess
import sys
import tempfile
import time

import grpc
from opentelemetry.proto.collector.trace.v1 import trace_service_pb2, trace_service_pb2_grpc

from checks import Checks

TRACE, PARENT = "4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7"
SQL = "select count(*) as secret_of_the_statement from points"
SMALL_RIG = pathlib.Path(__file__).resolve().parent.parent / "fixtures" / "small_rig.toml"
STARTED_WITHIN_SECONDS, SENT_WITHIN_SECONDS = 60, 30


class TraceCollector(trace_service_pb2_grpc.TraceServiceServicer):
    """A collector on loopback."""

    def __init__(self):
        self.spans, self.names = queue.Queue(), set()
        self.server = grpc.server(concurrent.futures.ThreadPoolExecutor(2))
        trace_service_pb2_grpc.add_TraceServiceServicer_to_server(self, self.server)
        self.url = f"http://127.0.0.1:{self.server.add_insecure_port('127.0.0.1:0')}"
        self.server.start()

    def Export(self, request, context):
        for resource in request.resource_spans:
            self.names |= {a.value.string_value for a in resource.resource.attributes if a.key == "service.name"}
            for scope in resource.scope_spans:
                for span in scope.spans:
                    self.spans.put(span)
        return trace_service_pb2.ExportTraceServiceResponse()

    def wait_for(self, is_right):
        """Returns the next span that is right."""
        end = time.monotonic() + SENT_WITHIN_SECONDS
        while True:
            span = self.spans.get(timeout=max(0.01, end - time.monotonic()))
            if is_right(span):
                return span


class TracedServer:
    """`serve` with a collector, or with an address at which there is none."""

    def __init__(self, program, folder, collector):
        command = [program, "--lake", "lake", "--log-format", "json", "serve"]
        command += [part for name in ("listen", "flight-sql", "postgres") for part in (f"--{name}", "127.0.0.1:0")]
        environment = {"OTEL_EXPORTER_OTLP_ENDPOINT": collector, "OTEL_BSP_SCHEDULE_DELAY": "200", "RUST_LOG": "warn,echolake=debug"}
        self.log = pathlib.Path(folder) / "serve.log"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(command, cwd=folder, env=environment, stderr=log, stdout=log)
        end = time.monotonic() + STARTED_WITHIN_SECONDS
        while len(found := re.findall(r"(http|grpc|postgresql)://(?:\w+@)?127\.0\.0\.1:(\d+)", self.log.read_text())) < 3:
            if self.process.poll() is not None or time.monotonic() > end:
                sys.exit(f"the server has not started: {self.log.read_text()}")
            time.sleep(0.05)
        self.ports = {name: int(port) for name, port in found}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait(STARTED_WITHIN_SECONDS)

    def ask(self, sql, **headers):
        """Returns status and headers of an answer over HTTP."""
        connection = http.client.HTTPConnection("127.0.0.1", self.ports["http"], timeout=60)
        connection.request("POST", "/api/v1/sql", sql, {"content-type": "application/sql", **headers})
        answer = connection.getresponse()
        answer.read()
        return answer.status, answer.headers

    def log_in(self):
        """Opens a connection of Postgres' protocol, hears that it is ready, and ends it."""
        with socket.create_connection(("127.0.0.1", self.ports["postgresql"]), timeout=60) as stream:
            body = b"\0\3\0\0user\0ann\0database\0datafusion\0\0"
            stream.sendall((len(body) + 4).to_bytes(4, "big") + body)
            heard = b""
            while b"Z\0\0\0\5" not in heard:
                heard += stream.recv(4096) or sys.exit(f"the connection ended: {heard!r}")
            stream.sendall(b"X\0\0\0\4")


def attributes(span):
    return {a.key: a.value.string_value or a.value.int_value for a in span.attributes}


def check(program, folder, checks):
    collector = TraceCollector()
    with TracedServer(program, folder, collector.url) as server:
        status, headers = server.ask(SQL, traceparent=f"00-{TRACE}-{PARENT}-01")
        span = collector.wait_for(lambda span: span.trace_id.hex() == TRACE)
        checks.same("a request with a trace is answered", 200, lambda: status)
        checks.same("its span's parent is the client's", PARENT, lambda: span.parent_span_id.hex())
        checks.same("its span has its name", headers["x-request-id"], lambda: attributes(span)["request_id"])
        checks.same("its span has its protocol", "http", lambda: attributes(span)["protocol"])
        checks.holds("no text of a statement is in a span", lambda: "secret_of" not in str(span))
        checks.same("the service has a name", {"echolake"}, lambda: collector.names)

        status, headers = server.ask(f"select wrong from ({SQL})")
        name = headers["x-request-id"]
        span = collector.wait_for(lambda span: attributes(span).get("request_id") == name)
        checks.same("a request without a trace is answered", 400, lambda: status)
        checks.same("its span begins a trace", "", lambda: span.parent_span_id.hex())
        line = lambda: next(line for line in server.log.read_text().splitlines() if name in line)
        checks.holds("the log names that trace", line, lambda line: span.trace_id.hex() in line)

        server.log_in()
        span = collector.wait_for(lambda span: span.name == "connection")
        checks.same("a connection of Postgres' protocol is a span", "postgres", lambda: attributes(span)["protocol"])
    collector.server.stop(None)
    with TracedServer(program, folder, collector.url) as server:
        begun = time.monotonic()
        checks.same("without a collector, a request is answered", 200, lambda: server.ask(SQL)[0])
        checks.holds("within 30 s", lambda: time.monotonic() - begun, lambda took: took < SENT_WITHIN_SECONDS)
    checks.holds("and the log says what was not sent", server.log.read_text, lambda text: "pentelemetry" in text)


def main():
    program = str(pathlib.Path(sys.argv[1]).resolve())
    checks = Checks()
    with tempfile.TemporaryDirectory() as folder:
        for command in (["acquire", "--surface", "flat", "--rig", str(SMALL_RIG), "--ir-only"], ["ingest"]):
            subprocess.run([program, "--lake", "lake", *command], cwd=folder, check=True, capture_output=True, timeout=600)
        check(program, folder, checks)
    return checks.done()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    sys.exit(main())
