#!/usr/bin/env python3
"""An S3 server that reads a folder, for measurements of reading: GET with ranges, HEAD and listings.

    s3_folder.py FOLDER --listen 7481      the object /BUCKET/KEY is the file FOLDER/KEY, whatever the bucket

Nothing is written, and no signature is looked at. Listens on loopback. Python's standard library alone.
"""
import argparse
import datetime
import email.utils
import http.server
import os
import pathlib
import sys
import urllib.parse
from xml.sax.saxutils import escape


class FolderRequest(http.server.BaseHTTPRequestHandler):
    """One connection."""

    protocol_version = "HTTP/1.1"
    folder = pathlib.Path()

    def log_message(self, *_):
        pass

    def do_HEAD(self):
        self.answer_object(is_head=True)

    def do_GET(self):
        parsed = urllib.parse.urlsplit(self.path)
        query = dict(urllib.parse.parse_qsl(parsed.query, keep_blank_values=True))
        if "list-type" in query:
            self.answer_listing(query)
        else:
            self.answer_object(is_head=False)

    def answer_listing(self, query):
        prefix, delimiter, after = (query.get(name, "") for name in ("prefix", "delimiter", "start-after"))
        keys, prefixes = [], set()
        # Only folders that can have such keys.
        top = self.folder / prefix.rpartition("/")[0]
        for path, folders, files in os.walk(top):
            below = os.path.relpath(path, self.folder)
            below = "" if below == "." else below + "/"
            keys += [below + name for name in files if (below + name).startswith(prefix)]
            if delimiter and len(below) >= len(prefix):
                prefixes.update(below + name + "/" for name in folders)
                folders.clear()
        entries = []
        for key in sorted(key for key in keys if key > after):
            about = (self.folder / key).stat()
            changed = datetime.datetime.fromtimestamp(about.st_mtime, datetime.timezone.utc)
            entries.append(f"<Contents><Key>{escape(key)}</Key>"
                           f"<LastModified>{changed.strftime('%Y-%m-%dT%H:%M:%S.000Z')}</LastModified>"
                           f"<ETag>{self.tag(about)}</ETag><Size>{about.st_size}</Size></Contents>")
        common = [f"<CommonPrefixes><Prefix>{escape(name)}</Prefix></CommonPrefixes>" for name in sorted(prefixes)]
        body = ("<?xml version='1.0'?><ListBucketResult xmlns='http://s3.amazonaws.com/doc/2006-03-01/'>"
                f"<IsTruncated>false</IsTruncated>{''.join(entries)}{''.join(common)}</ListBucketResult>").encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/xml")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def answer_object(self, is_head):
        key = urllib.parse.unquote(urllib.parse.urlsplit(self.path).path).lstrip("/").partition("/")[2]
        path = (self.folder / key).resolve()
        if not path.is_file() or self.folder not in path.parents:
            self.send_error_code(404, "NoSuchKey")
            return
        with path.open("rb") as file:
            about = os.fstat(file.fileno())
            start, end = self.wanted_range(about.st_size)
            self.send_response(206 if "range" in self.headers else 200)
            if "range" in self.headers:
                self.send_header("Content-Range", f"bytes {start}-{end - 1}/{about.st_size}")
            self.send_header("Content-Length", str(end - start))
            self.send_header("ETag", self.tag(about))
            self.send_header("Last-Modified", email.utils.formatdate(about.st_mtime, usegmt=True))
            self.end_headers()
            if not is_head:
                self.wfile.flush()
                self.connection.sendfile(file, start, end - start)

    def wanted_range(self, size):
        given = self.headers.get("range", "bytes=0-").removeprefix("bytes=")
        first, _, last = given.partition("-")
        if not first:
            return max(0, size - int(last)), size
        return int(first), min(size, int(last) + 1 if last else size)

    def send_error_code(self, status, code):
        body = f"<?xml version='1.0'?><Error><Code>{code}</Code></Error>".encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/xml")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    @staticmethod
    def tag(about):
        return f'"{about.st_mtime_ns:x}-{about.st_size:x}"'


class FolderServer(http.server.ThreadingHTTPServer):
    """A thread for each connection."""

    daemon_threads = True
    request_queue_size = 256

    def handle_error(self, request, client_address):
        # Clients are killed while they are answered.
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--listen", type=int, default=7481)
    args = parser.parse_args()
    FolderRequest.folder = args.folder.resolve()
    server = FolderServer(("127.0.0.1", args.listen), FolderRequest)
    print(f"http://127.0.0.1:{server.server_address[1]} reads {FolderRequest.folder}", flush=True)
    server.serve_forever()


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(0)
