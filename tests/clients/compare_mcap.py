"""Compares how Python's mcap and `echolake sql` read MCAP files: `compare_mcap.py FOLDER [ECHOLAKE]`. ECHOLAKE is the
command, by default that of the PATH. Of each file below FOLDER: its topics with their schemas, encodings and numbers of
messages, and of each message its topic, times, sequence and bytes. A file that Python refuses must be refused, too, or
give at least the messages that Python gave before it stopped.

Needs the PyPI packages mcap and pyarrow. Prints each file that differs and a summary; exits with 1 if any differs.
"""
import collections
import concurrent.futures
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile

import pyarrow.ipc
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

# A time beyond this is no timestamp of 64 bits in nanoseconds; echolake gives null.
LAST_NANOS = (1 << 63) - 1
COLUMNS = "topic, log_time_ns, cast(publish_time as bigint) as publish_time_ns, sequence, data"
TOPICS = "topic, schema_name, schema_encoding, message_encoding, messages"


class EcholakeLake:
    """A lake in a folder of its own, whose inbox has one file at a time and process."""

    def __init__(self, command, folder):
        self.command, self.folder = command, pathlib.Path(folder)
        # No command makes a lake that is empty.
        made = self.run("demo", "--surfaces", "1", "--ir-only", "--no-serve")
        if made.returncode:
            raise RuntimeError(made.stderr.decode(errors="replace"))

    def run(self, *arguments):
        command = [self.command, "--lake", str(self.folder), *arguments]
        return subprocess.run(command, capture_output=True, check=False, timeout=600)

    def rows(self, query):
        """The answer as tuples; a RuntimeError of the command's own words if it refuses."""
        ended = self.run("sql", query, "--format", "arrow")
        if ended.returncode:
            raise RuntimeError(ended.stderr.decode(errors="replace").strip())
        table = pyarrow.ipc.open_stream(ended.stdout).read_all()
        return list(zip(*(column.to_pylist() for column in table.columns)))

    def read(self, path, name):
        """Topics and messages of a file, which is placed in the lake under a name."""
        place = self.folder / "inbox" / f"{name}.mcap"
        place.parent.mkdir(exist_ok=True)
        shutil.copyfile(path, place)
        try:
            topics = self.rows(f"select {TOPICS} from mcap_topics('inbox/{name}.mcap')")
            messages = self.rows(f"select {COLUMNS} from mcap_messages('inbox/{name}.mcap')")
            return topics, messages
        finally:
            place.unlink()


class PythonReading:
    """What Python's mcap makes of a file, up to the first error."""

    def __init__(self, path):
        self.schemas = {0: Schema(id=0, name="", encoding="", data=b"")}
        self.channels, self.messages, self.error = {}, [], None
        try:
            with open(path, "rb") as stream:
                for record in StreamReader(stream).records:
                    self.take(record)
        except Exception as error:  # whatever the library raises is its refusal
            self.error = f"{type(error).__name__}: {error}".splitlines()[0]

    def take(self, record):
        if isinstance(record, Schema):
            self.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self.channels.setdefault(record.id, record)
        elif isinstance(record, Message):
            topic = self.channels[record.channel_id].topic
            times = (nanos(record.log_time), nanos(record.publish_time))
            self.messages.append((topic, *times, record.sequence, bytes(record.data), record.channel_id))

    def rows(self):
        return [message[:-1] for message in self.messages]

    def topics(self):
        counts = collections.Counter(message[-1] for message in self.messages)
        named = [(channel, self.schemas[channel.schema_id]) for channel in self.channels.values()]
        return [(c.topic, s.name, s.encoding, c.message_encoding, counts[c.id]) for c, s in named]


def nanos(time):
    return time if time <= LAST_NANOS else None


def ordered(rows):
    return sorted(rows, key=repr)


def difference(path, lake, name):
    """A pair of how a file compares and what is different, which is None if nothing is."""
    python = PythonReading(path)
    try:
        topics, messages = lake.read(path, name)
    except RuntimeError as refusal:
        if python.error:
            return "refused by both", None
        return "refused by echolake alone", str(refusal)
    if python.error:
        missing = collections.Counter(python.rows()) - collections.Counter(messages)
        if missing:
            return "refused by Python alone", f"{missing.total()} of its messages are missing ({python.error})"
        return "refused by Python alone", None
    if ordered(messages) != ordered(python.rows()):
        missing = collections.Counter(python.rows()) - collections.Counter(messages)
        more = collections.Counter(messages) - collections.Counter(python.rows())
        both = f"{len(python.rows())} messages, here {len(messages)}"
        return "read by both", f"{both}; {missing.total()} are missing, {more.total()} are not Python's"
    if ordered(topics) != ordered(python.topics()):
        return "read by both", f"topics {ordered(python.topics())}, here {ordered(topics)}"
    return "read by both", None


def main(folder, command):
    files = sorted(pathlib.Path(folder).rglob("*.mcap"))
    same, different = collections.Counter(), collections.Counter()
    with tempfile.TemporaryDirectory() as place:
        lake = EcholakeLake(command, place)
        with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
            compared = pool.map(lambda numbered: difference(numbered[1], lake, numbered[0]), enumerate(files))
            for path, (how, what) in zip(files, compared):
                (same if what is None else different)[how] += 1
                if what is not None:
                    print(f"FAIL {path.relative_to(folder)}: {how}: {what}", flush=True)
    for how in sorted(same | different):
        print(f"{how}: {same[how]} alike, {different[how]} different")
    print(f"{same.total()} of {len(files)} files are alike")
    return 0 if files and not different else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else "echolake"))
