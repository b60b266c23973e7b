"""Compares what `echolake recover` keeps of damaged recordings with Python's mcap: `compare_recover.py RUN.mcap [ECHOLAKE]
[--rounds N] [--seed N] [--first N]`. RUN.mcap is a whole run of a rig's; each round damages it in one way or several, the
same for its seed and number. Of each damaged file:

- every verdict in a chunk that Python's mcap accepts, its CRC checked, is in the recovered file, unless the command names
  the chunk's bytes as lost. Chunks are those that Python's reader comes to from the front, and all others that are still
  as they were;
- the recovered file is whole for Python's mcap, and has no verdict that was not recorded;
- a verdict that is missing is never missing in silence: the command ends with 3 and names bytes or damage, or the file
  was cut off and says that its run was not finished;
- only what no run can be made of is refused, and nothing is said to be unmeasured that was measured.

Needs the PyPI package mcap. Prints each round that fails and a summary; exits with 1 if any fails.
"""
import argparse
import collections
import concurrent.futures
import io
import json
import os
import pathlib
import random
import subprocess
import sys
import tempfile

from mcap.data_stream import ReadDataStream
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

FRAME, MAGIC = 9, b"\x89MCAP0\r\n"
CHUNK, ATTACHMENT, METADATA = 6, 9, 12
VERDICTS = "/measurement"


class Recording:
    """A whole run and where its parts are."""

    def __init__(self, path):
        self.name, self.bytes = path.name, path.read_bytes()
        self.records, at = [], len(MAGIC)
        while at < len(self.bytes) - len(MAGIC):
            end = at + FRAME + int.from_bytes(self.bytes[at + 1 : at + FRAME], "little")
            self.records.append((self.bytes[at], at, end))
            at = end
        self.chunks = [(at, end) for code, at, end in self.records if code == CHUNK]
        self.topics = {}
        self.verdicts = set()
        for at, end in self.chunks:
            self.verdicts |= self.verdicts_of(chunk_at(self.bytes, at, end))

    def verdicts_of(self, chunk):
        """The verdicts of a chunk as time and bytes; an exception if Python's mcap does not accept it."""
        records = breakup_chunk(chunk, validate_crc=True)
        for record in records:
            if isinstance(record, Channel):
                self.topics.setdefault(record.id, record.topic)
        messages = (record for record in records if isinstance(record, Message))
        return {(m.log_time, m.data) for m in messages if self.topics.get(m.channel_id) == VERDICTS}

    def manifest(self):
        """The bytes without which no run can be made: those of the manifest and the file's first record."""
        header = self.bytes[: self.records[0][2]]
        named = b"\x0c\0\0\0echolake.run"
        found = [self.bytes[at:end] for code, at, end in self.records if code == METADATA]
        return [header[len(MAGIC) :], next(part for part in found if part[FRAME:].startswith(named))]


def chunk_at(data, start, end):
    return Chunk.read(ReadDataStream(io.BytesIO(data[start + FRAME : end])))


def damage_once(recording, data, draw):
    """One kind of damage; returns its name."""
    size = len(data)
    # Most of a run's bytes are its mesh and its sweeps, whose damage costs no verdict: half of the damage is to a chunk.
    low, high = draw.choice([(0, size), *recording.chunks]) if draw.random() < 0.5 else (0, size)
    low, high = (low, min(high, size)) if low < size else (0, size)
    start = draw.randrange(low, high)
    length = min(int(65536 ** draw.random()), size - start)
    kind = draw.choice(
        ["flips", "flips near frames", "cut", "cut near the end", "inserted", "removed", "zeroed", "doubled", "never closed",
         "appended"]
    )
    match kind:
        case "flips":
            for _ in range(draw.randint(1, 8)):
                data[draw.randrange(low, high)] ^= 1 << draw.randrange(8)
        case "flips near frames":
            for _ in range(draw.randint(1, 4)):
                data[min(draw.choice(recording.records)[1] + draw.randrange(48), size - 1)] ^= draw.randrange(1, 256)
        case "cut":
            del data[start:]
        case "cut near the end":
            del data[max(size - draw.randrange(1, 4000), 0) :]
        case "inserted":
            data[start:start] = draw.randbytes(length)
        case "removed":
            del data[start : start + length]
        case "zeroed":
            data[start : start + length] = bytes(length)
        case "doubled":
            data[start + length : start + length] = data[start : start + length]
        case "never closed":
            start, end = draw.choice(recording.chunks)
            if end <= size:
                for place in (start + 1, start + FRAME + 16):
                    data[place : place + 8] = b"\xff" * 8
                if draw.random() < 0.5:
                    del data[draw.randrange(start + FRAME + 24, end) :]
        case "appended":
            data += recording.bytes if draw.random() < 0.5 else recording.bytes[: draw.randrange(len(recording.bytes))]
    return kind


def damaged(recording, draw):
    """A damaged file, and the kinds of its damage."""
    data, kinds = bytearray(recording.bytes), []
    for _ in range(draw.choice([1, 1, 1, 2, 3])):
        if data:
            kinds.append(damage_once(recording, data, draw))
    return bytes(data), kinds


def accepted(recording, data):
    """Pairs of a verdict and its chunk's place, of all chunks that Python's mcap accepts."""
    found = []
    try:
        for record in StreamReader(io.BytesIO(data), emit_chunks=True, validate_crcs=True).records:
            if isinstance(record, Chunk):
                found.append((record, data.find(record.data)))
    except Exception:  # whatever the library raises ends what it reads from the front
        pass
    for start, end in recording.chunks:
        place = data.find(recording.bytes[start:end])
        if place >= 0:
            found.append((chunk_at(data, place, place + end - start), place))
    for chunk, place in found:
        try:
            yield from ((verdict, place) for verdict in recording.verdicts_of(chunk))
        except Exception:  # not accepted
            continue


def check(recording, command, folder, seed, number):
    """The kinds of a round's damage, how the command ended, and what is wrong, if anything is."""
    draw = random.Random(f"{seed}-{number}")
    data, kinds = damaged(recording, draw)
    place = pathlib.Path(folder) / str(number)
    place.mkdir()
    name, out = place / (recording.name + draw.choice(["", ".partial"])), place / "out.mcap"
    name.write_bytes(data)
    ended = subprocess.run(
        [command, "recover", str(name), "-o", str(out), "--json"], capture_output=True, check=False, timeout=300
    )
    said = ended.stderr.decode(errors="replace")
    measured = list(accepted(recording, data))
    if ended.returncode not in (0, 1, 3) or "panicked" in said:
        return kinds, "crashed", f"ended with {ended.returncode}: {said}"
    if ended.returncode == 1:
        if measured and all(part in data for part in recording.manifest()):
            return kinds, "refused", f"{len(measured)} verdicts are whole, but: {said}"
        if measured and "no measurement" in said and data.startswith(MAGIC):
            return kinds, "refused", f"of {len(measured)} whole verdicts: {said}"
        return kinds, "refused", None
    report = json.loads(ended.stdout)
    kept = out if report["to"] else name
    try:
        verdicts = set()
        topics = {}
        for record in StreamReader(io.BytesIO(kept.read_bytes()), validate_crcs=True).records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message) and topics[record.channel_id] == VERDICTS:
                verdicts.add((record.log_time, record.data))
    except Exception as error:  # it must be whole
        return kinds, "kept", f"what was recovered is not whole: {type(error).__name__}: {error}"
    lost = [(part["start"], part["end"]) for part in report["lost"]]
    named = sum(end - start for start, end in lost)
    if named != report["bytes"] - report["verified_bytes"]:
        return kinds, "kept", f"{named} bytes are named as lost: {report}"
    missing = {place for verdict, place in measured if verdict not in verdicts}
    unnamed = [place for place in missing if not any(start <= place < end for start, end in lost)]
    if unnamed:
        return kinds, "kept", f"whole chunks near bytes {sorted(unnamed)} are not kept; lost: {lost}, {report['damage']}"
    if verdicts - recording.verdicts:
        return kinds, "kept", f"{len(verdicts - recording.verdicts)} verdicts were never recorded"
    is_told = ended.returncode == 3 and (lost or report["damage"])
    is_cut = recording.bytes.startswith(data) and not report["has_end"]
    if recording.verdicts - verdicts and not is_told and not is_cut:
        return kinds, "kept", f"{len(recording.verdicts - verdicts)} verdicts are missing, in silence: {report}"
    return kinds, "whole" if verdicts == recording.verdicts else "in part", None


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=pathlib.Path)
    parser.add_argument("command", nargs="?", default="echolake")
    for name, default in (("--rounds", 500), ("--seed", 1), ("--first", 0)):
        parser.add_argument(name, type=int, default=default)
    args = parser.parse_args()
    recording = Recording(args.run)
    outcomes, failed = collections.Counter(), 0
    with tempfile.TemporaryDirectory() as folder, concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        numbers = range(args.first, args.first + args.rounds)
        rounds = pool.map(lambda number: check(recording, args.command, folder, args.seed, number), numbers)
        for number, (kinds, outcome, wrong) in zip(numbers, rounds):
            outcomes[outcome] += 1
            if wrong:
                failed += 1
                print(f"FAIL --seed {args.seed} --first {number} --rounds 1 ({', '.join(kinds)}): {wrong}", flush=True)
    print(f"{len(recording.verdicts)} verdicts in {len(recording.chunks)} chunks; " + ", ".join(
        f"{outcome}: {count}" for outcome, count in sorted(outcomes.items())
    ))
    print(f"{args.rounds - failed} of {args.rounds} rounds are right")
    return 1 if failed or len(outcomes) < 2 else 0


if __name__ == "__main__":
    sys.exit(main())
