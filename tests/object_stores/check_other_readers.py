#!/usr/bin/env python3
"""Other programs read a bucket's tables: check_other_readers.py ECHOLAKE

The same runs are taken in by a lake in a folder and by one in Ceph's gateway. deltalake, polars and DuckDB must count as
many rows in each table of the bucket as `sql` does in the folder. DuckDB reads the bucket by its extension httpfs if
that can be installed, else through fsspec, and says so.

Needs the PyPI packages deltalake, polars, duckdb, pyarrow and s3fs.
"""
import argparse
import os
import pathlib
import sys

import deltalake
import duckdb
import polars
import s3fs

import bucket_lab as lab


def duckdb_connection(settings):
    """Returns a connection that reads the bucket, and by what it does so."""
    connection = duckdb.connect()
    try:
        connection.execute("install httpfs")
        connection.execute("load httpfs")
    except duckdb.Error as error:
        print(f"DuckDB cannot install httpfs, it reads through fsspec: {str(error).splitlines()[0]}", file=sys.stderr)
        connection.register_filesystem(
            s3fs.S3FileSystem(
                key=settings["AWS_ACCESS_KEY_ID"],
                secret=settings["AWS_SECRET_ACCESS_KEY"],
                endpoint_url=settings["AWS_ENDPOINT_URL"],
            )
        )
        return connection, "duckdb through fsspec"
    address = settings["AWS_ENDPOINT_URL"].removeprefix("http://")
    connection.execute(
        f"create secret (type s3, key_id '{settings['AWS_ACCESS_KEY_ID']}', secret"
        f" '{settings['AWS_SECRET_ACCESS_KEY']}', region '{settings['AWS_REGION']}', endpoint '{address}',"
        " url_style 'path', use_ssl false)"
    )
    return connection, "duckdb by httpfs"


def compare_counts(settings, remote, rows):
    """Counts the rows of each table by each reader."""
    options = {name: value for name, value in settings.items() if name.startswith("AWS_")}
    connection, duckdb_name = duckdb_connection(settings)
    for name, expected in rows.items():
        location = f"{remote}/tables/{name}"
        table = deltalake.DeltaTable(location, storage_options=options)
        files = [f"{location}/{path}" for path in table.get_add_actions(flatten=True).column("path").to_pylist()]
        counts = {
            "deltalake": table.to_pyarrow_table().num_rows,
            "polars": polars.scan_delta(location, storage_options=options).collect().height,
            duckdb_name: connection.execute("select * from read_parquet($1)", [files]).to_arrow_table().num_rows,
        }
        wrong = {reader: count for reader, count in counts.items() if count != expected}
        lab.require(not wrong, f"{name}: the folder has {expected} rows, {wrong}")
        print(f"{name}: {expected} rows as in the folder, by {', '.join(counts)}; {len(files)} files")


def main(args):
    with lab.work_folder() as folder:
        program = pathlib.Path(args.echolake).resolve()
        settings = lab.Gateway().start()
        bucket, prefix = lab.Bucket(settings), f"readers-{os.getpid()}"
        lab.record_runs(program, folder, args.runs)
        local = lab.Command(program, folder, "lake")
        local.ok("ingest")
        rows = {name: len(local.rows(name)) - 1 for name in lab.TABLES}
        remote = lab.Command(program, folder, f"s3://{settings['S3_BUCKET']}/{prefix}", settings)
        remote.ok("ingest", *sorted(str(path) for path in (folder / "copies").iterdir()))
        compare_counts(settings, remote.lake, rows)
        remote.ok("optimize")
        print("merged:")
        compare_counts(settings, remote.lake, rows)
        bucket.delete(f"{prefix}/")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("echolake", help="the program")
    parser.add_argument("--runs", type=int, default=12)
    arguments = parser.parse_args()
    lab.run_check(lambda: main(arguments))
