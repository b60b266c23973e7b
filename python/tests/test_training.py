"""Batches are the same on every topology, before and after a stop, from a folder and over HTTP; rows are right."""

from __future__ import annotations

import hashlib
import http.server
import random
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pa = pytest.importorskip("pyarrow")
pytest.importorskip("pyarrow.parquet")

from echolake.symmetry import turn_heights, turn_positions  # noqa: E402
from echolake.training import EpochOrder, MeasurementBatches, MeasurementRows, OrderSettings  # noqa: E402

ROWS = sum(range(40, 53))
Key = tuple[str, str, int]


def keys(batch: dict[str, Any]) -> list[Key]:
    """Surface, symmetry and pair of each row, sorted; their samples and responses are checked."""
    found = []
    for row, place in enumerate(batch["surface"].tolist()):
        surface, pair = batch["surface_ids"][place], int(batch["pair_id"][row])
        number = int(surface[:4])
        assert np.array_equal(batch["ir"][row], [np.nan] * 4 if pair == 3 else [number, pair, 0, 0], equal_nan=True)
        assert np.array_equal(batch["samples"][row], np.nan if pair == 5 else 1000 * number + pair, equal_nan=True)
        found.append((surface, batch["symmetries"][place], pair))
    return sorted(found)


@pytest.mark.parametrize("clump", [1, 8, "surface"])
@pytest.mark.parametrize("mix", [1, 3])
@pytest.mark.parametrize("symmetries", ["none", "all"])
def test_every_row_comes_once_with_its_values(small_set: Path, clump: Any, mix: int, symmetries: Any) -> None:
    columns = ["ir", "samples", *(["pair_id"] if symmetries == "none" else [])]
    batches = MeasurementBatches(small_set, columns=columns, batch_size=32, clump=clump, mix=mix, symmetries=symmetries)
    found: list[Key] = []
    for batch in batches:
        batch["pair_id"] = batch.get("pair_id", batch["samples"] % 1000)
        rows = np.isnan(batch["samples"]) & (symmetries == "all")
        found += keys({name: v[~rows] if isinstance(v, np.ndarray) else v for name, v in batch.items()})
    assert len(found) == len(set(found)) == (ROWS if symmetries == "none" else (ROWS - 13) * 8)
    assert batches.rows() == ROWS * (1 if symmetries == "none" else 8)


def test_an_epoch_is_a_permutation_that_seed_and_epoch_decide() -> None:
    sizes = np.array([40, 1, 300, 7])

    def order(epoch: int, **settings: Any) -> list[int]:
        made = EpochOrder(sizes, OrderSettings(batch_size=16, **settings), epoch)
        return [int(row) for batch in range(made.batches) for row in made.compute_rows(batch)]

    for settings in ({}, {"clump": 1}, {"clump": 8, "mix": 1}, {"lanes": 64}, {"lanes": 1}):
        assert sorted(order(2, **settings)) == list(range(348))
        assert order(2, **settings) == order(2, **settings) != order(3, **settings) != order(3, seed=1, **settings)
    assert order(0, shuffle=False) == list(range(348))
    assert len(order(0, drop_last=True)) == 348 // 16 * 16


# Written down once: a state that was saved must continue after an update of echolake, NumPy or the machine, too.
def test_the_order_stays_as_it_was() -> None:
    order = EpochOrder(np.array([40, 1, 300, 7]), OrderSettings(batch_size=8, clump=32, mix=2, seed=5), epoch=3)
    assert order.compute_rows(0).tolist() == [255, 94, 86, 248, 91, 261, 246, 75]


def test_a_symmetry_is_drawn_for_each_surface_and_epoch_and_turns_positions_and_maps(small_set: Path) -> None:
    def drawn(epoch: int, world_size: int) -> dict[str, str]:
        found: dict[str, str] = {}
        for rank in range(world_size):
            batches = MeasurementBatches(
                small_set,
                columns=["microphone_mm", "samples"],
                heights=True,
                symmetries="random",
                batch_size=16,
                rank=rank,
                world_size=world_size,
            )
            batches.set_epoch(epoch)
            for batch in batches:
                for surface, symmetry, height in zip(
                    batch["surface_ids"], batch["symmetries"], batch["heights"], strict=True
                ):
                    plain = np.array([[int(surface[:4]), 1], [2, 3]], np.float32)
                    assert found.setdefault(surface, symmetry) == symmetry
                    assert np.array_equal(height, turn_heights(plain, symmetry))
                for row in np.flatnonzero(~np.isnan(batch["samples"])):
                    number, pair = divmod(int(batch["samples"][row]), 1000)
                    symmetry = batch["symmetries"][batch["surface"][row]]
                    expected = turn_positions(np.array([number, pair, 7.0]), symmetry)
                    assert np.array_equal(batch["microphone_mm"][row], expected)
        return found

    assert drawn(0, 1) == drawn(0, 3) != drawn(1, 1)
    assert len(set(drawn(0, 1).values())) > 3


@pytest.mark.parametrize("drop_last", [False, True])
def test_ranks_have_as_many_batches_by_padding_or_dropping(small_set: Path, drop_last: bool) -> None:
    for world_size in (1, 2, 5, 32):
        given = []
        for rank in range(world_size):
            batches = MeasurementBatches(
                small_set, columns=["pair_id"], batch_size=32, drop_last=drop_last, rank=rank, world_size=world_size
            )
            given.append([batch["batch"] for batch in batches])
            assert len(given[-1]) == len(batches) == (18 // world_size if drop_last else -(-19 // world_size))
        assert sorted(number for numbers in given for number in numbers) == list(range(len(given[0]) * world_size))


def test_runs_stopped_at_random_continue_on_other_topologies(small_set: Path) -> None:
    def of(rank: int, world_size: int) -> MeasurementBatches:
        return MeasurementBatches(
            small_set, columns=["pair_id", "ir", "samples"], batch_size=16, clump=8, rank=rank, world_size=world_size
        )

    dice = random.Random(1)
    for epoch in (0, 1, 2):
        whole = of(0, 1)
        whole.set_epoch(epoch)
        expected = {batch["batch"]: keys(batch) for batch in whole}
        for _ in range(6):
            state: dict[str, Any] = of(0, 1).state_dict() | {"epoch": epoch}
            found: dict[int, list[Key]] = {}
            while state["epoch"] == epoch:
                world_size, workers, stop = dice.choice([1, 2, 4, 8]), dice.choice([1, 4]), dice.randrange(1, 20)
                states = []
                for rank in range(world_size):
                    batches = of(rank, world_size)
                    batches.load_state_dict(state)
                    for batch in in_turns(batches, workers, stop):
                        repeated = batch["batch"] >= len(expected)
                        assert repeated or batch["batch"] not in found
                        found[batch["batch"] % len(expected)] = keys(batch)
                        after = batches.state_dict(after=batch)
                    states.append(after)
                assert all(other == states[0] for other in states)
                state = states[0]
            assert found == expected
            assert (state["epoch"], state["batch"]) == (epoch + 1, 0)


def in_turns(batches: MeasurementBatches, workers: int, stop: int) -> Iterator[dict[str, Any]]:
    """What a DataLoader takes of its workers, up to a stop, while they read ahead."""
    shares = [batches.iterate_share(worker, workers) for worker in range(workers)]
    for number in range(stop):
        batch = next(shares[number % workers], None)
        if batch is None:
            return
        yield batch


# E30: 17 batches of two ranks, the last of which is left out.
def test_the_state_after_the_last_batch_of_all_ranks_is_the_next_epoch(small_set: Path) -> None:
    def of(rank: int, world_size: int) -> MeasurementBatches:
        order: dict[str, Any] = {"batch_size": 35, "drop_last": True, "rank": rank, "world_size": world_size}
        return MeasurementBatches(small_set, columns=["pair_id"], **order)

    for rank in (0, 1):
        batches = of(rank, 2)
        given = list(batches)
        assert len(given) == 8
        after = batches.state_dict(after=given[-1])
        assert (after["epoch"], after["batch"]) == (1, 0)
        assert batches.state_dict() == after
        batches.load_state_dict(after)
        assert (batches.epoch, len(list(batches))) == (1, 8)
    # One rank has a batch left there, which two leave out.
    alone = of(0, 1)
    state = alone.state_dict() | {"batch": 16}
    alone.load_state_dict(state)
    assert [batch["batch"] for batch in alone] == [16]
    pair = of(0, 2)
    pair.load_state_dict(state)
    assert (pair.epoch, len(list(pair))) == (1, 8)


# E30: also if the iteration after the state was left early, by whom has more workers then.
def test_iterations_after_the_rest_of_an_epoch_are_whole(small_set: Path) -> None:
    batches = MeasurementBatches(small_set, columns=["pair_id"], batch_size=32)
    whole = [batch["batch"] for batch in batches]
    state = batches.state_dict() | {"epoch": 0, "batch": 12}
    for workers in (1, 3):
        batches.load_state_dict(state)
        assert batches.state_dict() == state
        assert [batch["batch"] for batch in in_turns(batches, workers, 4)] == whole[12:16]
        for others in (1, 2, 4):
            assert [batch["batch"] for batch in in_turns(batches, others, 99)] == whole
    # The epoch after it was never begun in the middle.
    batches.load_state_dict(state)
    batches.set_epoch(1)
    assert len(list(batches)) == len(whole)


# B6
@pytest.mark.parametrize("symmetries", ["none", "all"])
def test_positions_are_there_whatever_columns_are_named(small_set: Path, symmetries: Any) -> None:
    named = MeasurementBatches(small_set, columns=["samples"], symmetries=symmetries, shuffle=False)
    every = MeasurementBatches(small_set, symmetries=symmetries, shuffle=False)
    assert named.columns == ["samples", "microphone_mm"]
    for one, other in zip(named, every, strict=True):
        assert np.array_equal(one["microphone_mm"], other["microphone_mm"])
    assert MeasurementRows(small_set, columns=["samples"])[0]["microphone_mm"].tolist() == [0, 0, 7]


def test_a_state_of_another_set_is_refused(small_set: Path) -> None:
    state = MeasurementBatches(small_set, batch_size=16).state_dict()
    with pytest.raises(ValueError, match="batch_size 16, this one has 32"):
        MeasurementBatches(small_set, batch_size=32).load_state_dict(state)
    with pytest.raises(ValueError, match="set 'other'"):
        MeasurementBatches(small_set, batch_size=16).load_state_dict(state | {"set": "other"})


def test_eight_million_rows_continue_within_a_second() -> None:
    sizes = np.full(2800, 2951)
    for clump in (1, 256, "surface"):
        start = time.perf_counter()
        order = EpochOrder(sizes, OrderSettings(clump=clump), 7)
        assert len(order.compute_rows(order.batches // 2)) == 512
        # 0.3 s where nothing else runs.
        assert time.perf_counter() - start < 5


def test_rows_by_number(small_set: Path) -> None:
    rows = MeasurementRows(small_set, columns=["pair_id", "ir"], heights=True, memory=1)
    assert len(rows) == ROWS
    assert rows.capacity == 1
    found = rows.__getitems__([ROWS - 1, 0, 41, 0])
    # Files come in their order: 0, 4, 8, 12; 1, ...
    assert [(row["surface_id"], int(row["pair_id"])) for row in found] == [
        ("0011_0", 50),
        ("0000_0", 0),
        ("0004_0", 1),
        ("0000_0", 0),
    ]
    assert found[2]["ir"].tolist() == [4, 1, 0, 0]
    assert found[2]["heights"].tolist() == [[4, 1], [2, 3]]
    assert rows[-1]["surface_id"] == "0011_0"
    with pytest.raises(IndexError):
        rows[ROWS]


def test_it_needs_no_torch() -> None:
    code = "import sys, echolake.training; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, env={"PYTHONPATH": str(Path(__file__).parents[1] / "src")})


class Ranges(http.server.SimpleHTTPRequestHandler):
    """A folder by ranges; every seventh answer for data is a fault: 503, or a body that breaks off."""

    folder: Path
    asked = 0
    faults = 0

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        path = self.folder / self.path.lstrip("/")
        if not path.is_file():
            self.send_error(404)
            return
        body = path.read_bytes()
        Ranges.asked += 1
        is_fault = path.suffix == ".parquet" and Ranges.asked % 7 == 0
        Ranges.faults += is_fault
        if is_fault and Ranges.asked % 2:
            self.send_error(503)
            return
        first, stop = 0, len(body)
        if asked := self.headers.get("Range"):
            start, _, end = asked.removeprefix("bytes=").partition("-")
            first, stop = int(start), min(int(end) + 1 if end else len(body), len(body))
        self.send_response(206 if asked else 200)
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("Content-Range", f"bytes {first}-{stop - 1}/{len(body)}")
        self.send_header("Content-Length", str(stop - first))
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(body[first : (first + stop) // 2 if is_fault else stop])

    def log_message(self, *_: Any) -> None:
        pass


def test_a_folder_over_http_gives_the_same_batches_in_spite_of_faults(small_set: Path, tmp_path: Path) -> None:
    pytest.importorskip("fsspec")
    pytest.importorskip("aiohttp")
    sums = []
    for file in sorted(small_set.rglob("*.parquet")):
        name = file.relative_to(small_set)
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(file.read_bytes())
        sums.append(f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {name}\n")
    (tmp_path / "SHA256SUMS").write_text("".join(sums))
    Ranges.folder = tmp_path
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Ranges) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            found = {}
            for path in (str(tmp_path), f"http://127.0.0.1:{server.server_port}"):
                batches = MeasurementBatches(path, batch_size=16, symmetries="none", heights=True, memory=1 << 14)
                found[path] = [(batch["batch"], keys(batch), batch["heights"].tolist()) for batch in batches]
                state = batches.state_dict()
        finally:
            server.shutdown()
    one, other = found.values()
    assert one == other
    assert Ranges.faults > 5
    # The state of the folder is that of the address.
    MeasurementBatches(tmp_path, batch_size=16).load_state_dict(state)


def test_mistakes_are_named(small_set: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="echolake export ml"):
        MeasurementBatches(tmp_path)
    with pytest.raises(KeyError, match="samples"):
        MeasurementBatches(small_set, columns=["nope"])
    with pytest.raises(KeyError):
        MeasurementBatches(small_set, columns=["pair_id"], symmetries="random")
    with pytest.raises(ValueError, match="clump 0"):
        MeasurementBatches(small_set, clump=0)
    with pytest.warns(UserWarning, match="all of them take 1 MiB, memory has 0 MiB"):
        MeasurementBatches(small_set, clump=8, memory=1 << 10)
    with pytest.raises(TypeError, match="clumps"):
        MeasurementBatches(small_set, clumps=3)


def test_heights_come_in_coarser_cells_with_their_size(small_set: Path) -> None:
    rows = MeasurementRows(small_set, columns=["pair_id"], heights=1)
    row = rows[0]
    assert row["heights"].tolist() == [[1.5]]
    assert row["size_mm"] == 100
    with pytest.raises(ValueError, match="heights=3, expected a divisor of the 2 cells"):
        MeasurementRows(small_set, columns=["pair_id"], heights=3)[0]


def test_spectra_have_the_energy_of_responses(training_set: Path) -> None:
    batch = next(iter(MeasurementBatches(training_set, columns=["ir"], spectra=["ir"], batch_size=16)))
    spectrum, response = batch["ir_spectrum"], batch["ir"].astype(np.float64)
    # Parseval, with the bins between first and last standing for their mirror images, too.
    power = np.abs(spectrum.astype(np.complex128)) ** 2
    energy = (power[:, 0] + 2 * power[:, 1:-1].sum(1) + power[:, -1]) / response.shape[1]
    assert np.allclose(energy, (response**2).sum(1), rtol=1e-5)
    rows = MeasurementRows(training_set, columns=["ir"], spectra=["ir"])
    assert rows.frequencies_hz("ir")[[0, 1, -1]].tolist() == [0, 250, 48_000]
    assert rows[0]["ir_spectrum"].shape == (193,)
    with pytest.raises(KeyError, match="no columns of responses"):
        MeasurementRows(training_set, columns=["ir", "snr_db"], spectra=["snr_db"])


def test_normalised_columns_have_mean_0_and_deviation_1_over_split_train(training_set: Path) -> None:
    columns = ["pair_id", "ir", "tnce_total", "microphone_mm"]
    batches = list(MeasurementBatches(training_set, columns=columns, heights=True, normalise=True, shuffle=False))
    for name in ("ir", "tnce_total"):
        values = np.concatenate([batch[name].astype(np.float64).ravel() for batch in batches])
        assert abs(values.mean()) < 1e-5
        assert abs(values.std() - 1) < 1e-5
    positions = np.concatenate([batch["microphone_mm"].astype(np.float64) for batch in batches])
    assert np.allclose([positions.mean(0), positions.std(0)], [[0] * 3, [1] * 3], atol=1e-5)
    plain = list(MeasurementBatches(training_set, columns=["pair_id"], heights=True, shuffle=False))
    assert all(np.array_equal(one["pair_id"], other["pair_id"]) for one, other in zip(batches, plain, strict=True))
    maps = {
        name: height for batch in batches for name, height in zip(batch["surface_ids"], batch["heights"], strict=True)
    }
    heights = np.stack(list(maps.values())).astype(np.float64)
    assert abs(heights.mean()) < 1e-4
    assert abs(heights.std() - 1) < 1e-4


def test_units_and_rates_are_in_the_schema(training_set: Path) -> None:
    schema = pa.parquet.read_schema(next((training_set / "data").glob("train-*.parquet")))
    units = {name: schema.field(name).metadata[b"unit"] for name in ("ir", "tnce_total", "temperature_c", "speaker_mm")}
    assert units == {"ir": b"1", "tnce_total": b"1", "temperature_c": b"C", "speaker_mm": b"mm"}
    assert schema.field("ir").metadata[b"rate_hz"] == b"96000"


@pytest.mark.parametrize("program", ["pyarrow", "polars", "datasets"])
def test_missing_lists_do_not_move_the_rows_behind_them(small_set: Path, program: str, tmp_path: Path) -> None:
    read = pytest.importorskip(program)
    file = str(small_set / "data" / "train-1.parquet")
    found: list[dict[str, Any]]
    if program == "pyarrow":
        found = pa.parquet.read_table(file).to_pylist()
    elif program == "polars":
        found = read.read_parquet(file).to_dicts()
    else:
        found = list(read.load_dataset("parquet", data_files=file, split="train", cache_dir=str(tmp_path)))
    assert len(found) == 41 + 45 + 49
    for row in found:
        surface, pair = int(row["surface_id"][:4]), row["pair_id"]
        assert row["ir"] == (None if pair == 3 else [surface, pair, 0, 0])
        assert row["microphone_mm"] == [surface, pair, 7]
