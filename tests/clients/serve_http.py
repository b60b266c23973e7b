"""Checks a served lake over HTTP with PyArrow, polars and the standard library: `serve_http.py http://127.0.0.1:8080`.

Needs the PyPI packages pyarrow and polars. Prints a line a check, exits with 1 where one fails.
"""
import io
import json
import sys
import urllib.error
import urllib.request

import polars
import pyarrow.ipc
import pyarrow.parquet

from checks import Checks


def main(url):
    checks = Checks()

    def ask(query, form, **headers):
        headers = {"content-type": "application/sql", **headers}
        request = urllib.request.Request(f"{url}/api/v1/sql?format={form}", query.encode(), headers)
        with urllib.request.urlopen(request) as answer:
            return answer.read()

    count = json.loads(ask("select count(*) n from measurements", "json"))[0]["n"]
    rows = "select * from measurements"
    checks.same("Arrow in PyArrow", count, lambda: pyarrow.ipc.open_stream(ask(rows, "arrow")).read_all().num_rows)
    checks.same("Arrow in polars", count, lambda: polars.read_ipc_stream(ask(rows, "arrow")).height)
    checks.same("Parquet in PyArrow", count, lambda: pyarrow.parquet.read_table(io.BytesIO(ask(rows, "parquet"))).num_rows)
    checks.same("CSV in polars", count, lambda: polars.read_csv(ask(rows, "csv")).height)
    checks.same("JSON", count, lambda: len(json.loads(ask(rows, "json"))))

    def refused():
        try:
            ask("drop table runs", "json")
        except urllib.error.HTTPError as error:
            return json.load(error)["code"]

    checks.same("refusal", "read_only", refused)
    return checks.done()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
