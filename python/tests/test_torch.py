"""Torch's loaders give the same batches on every topology, and what they give stays as it is."""

import hashlib
import pickle
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pq = pytest.importorskip("pyarrow.parquet")
torch = pytest.importorskip("torch")
from torch.utils.data import DataLoader  # noqa: E402

from echolake.torch import Batch, MeasurementRows, Measurements  # noqa: E402

COLUMNS = ["pair_id", "microphone_mm", "ir"]


def digest(batch: Batch) -> str:
    """Of a batch's rows, whatever their order: surface, symmetry and all columns."""
    named = [(batch["surface_ids"][place], batch["symmetries"][place]) for place in batch["surface"].tolist()]
    numbers = [batch[name].numpy() for name in COLUMNS if name in batch]
    rows = sorted((name, *(values[row].tobytes() for values in numbers)) for row, name in enumerate(named))
    return hashlib.sha256(repr(rows).encode()).hexdigest()


def of_rank(path: Path, rank: int, world_size: int, **settings: Any) -> Measurements:
    return Measurements(path, columns=COLUMNS, batch_size=32, clump=8, rank=rank, world_size=world_size, **settings)


def undisturbed(path: Path, epoch: int) -> list[str]:
    dataset = of_rank(path, 0, 1)
    dataset.set_epoch(epoch)
    return [digest(batch) for batch in dataset]


def test_batches_are_the_same_for_all_ranks_and_workers(small_set: Path) -> None:
    def digests(world_size: int, workers: int) -> dict[int, str]:
        found: dict[int, str] = {}
        for rank in range(world_size):
            dataset = Measurements(
                small_set,
                columns=["microphone_mm", "ir"],
                batch_size=32,
                symmetries="random",
                heights=True,
                rank=rank,
                world_size=world_size,
            )
            loader = DataLoader(dataset, batch_size=None, num_workers=workers)
            batches = list(loader)
            assert len(batches) == len(loader) == len(dataset)
            # They come in their order.
            assert [batch["batch"] for batch in batches] == list(range(rank, len(batches) * world_size, world_size))
            for batch in batches:
                number = batch["batch"] % -(-dataset.rows() // 32)
                assert found.setdefault(number, digest(batch)) == digest(batch)
        return found

    expected = digests(1, 0)
    assert len(expected) == 19
    for world_size in (1, 2, 4, 8):
        for workers in (0, 1, 4):
            assert digests(world_size, workers) == expected


def test_a_run_that_stops_continues_with_other_ranks_and_workers(small_set: Path) -> None:
    dice = random.Random(2)
    for _ in range(3):
        found: dict[int, dict[int, str]] = {1: {}, 2: {}}
        state = of_rank(small_set, 0, 1).state_dict() | {"epoch": 1}
        while state["epoch"] < 3:
            world_size, workers, stop = dice.choice([1, 2, 4, 8]), dice.choice([0, 1, 4]), dice.randrange(1, 9)
            epoch = found[state["epoch"]]
            for rank in range(world_size):
                dataset = of_rank(small_set, rank, world_size)
                dataset.load_state_dict(pickle.loads(pickle.dumps(state)))
                loader = iter(DataLoader(dataset, batch_size=None, num_workers=workers))
                for batch, _ in zip(loader, range(stop), strict=False):
                    if batch["batch"] < 19:
                        assert batch["batch"] not in epoch
                        epoch[batch["batch"]] = digest(batch)
                    after = dataset.state_dict(after=batch)
            state = after
        for epoch_number, digests in found.items():
            assert [digests[number] for number in range(19)] == undisturbed(small_set, epoch_number)


@pytest.mark.parametrize("workers", [0, 1, 3])
def test_stateful_loaders_continue(small_set: Path, workers: int) -> None:
    stateful = pytest.importorskip("torchdata.stateful_dataloader").StatefulDataLoader

    def loader(state: dict[str, Any] | None) -> Iterator[Any]:
        dataset = of_rank(small_set, 0, 1)
        dataset.set_epoch(2)
        made = stateful(dataset, batch_size=None, num_workers=workers)
        if state is not None:
            made.load_state_dict(state)
        loaders.append(made)
        return iter(made)

    loaders: list[Any] = []
    begun = loader(None)
    first = [digest(next(begun)) for _ in range(7)]
    state = pickle.loads(pickle.dumps(loaders[0].state_dict()))
    assert first + [digest(batch) for batch in loader(state)] == undisturbed(small_set, 2)


@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_workers_that_stay_see_the_next_epoch(small_set: Path, start: str) -> None:
    dataset = of_rank(small_set, 0, 1)
    loader = DataLoader(dataset, batch_size=None, num_workers=2, persistent_workers=True, multiprocessing_context=start)
    for epoch in (0, 1, 5):
        dataset.set_epoch(epoch)
        assert [digest(batch) for batch in loader] == undisturbed(small_set, epoch)


# E30: without `set_epoch` the first iteration after a state was loaded is the epoch's rest, and later ones are whole.
@pytest.mark.parametrize(("workers", "persistent"), [(0, False), (2, False), (2, True)])
def test_an_epoch_is_whole_again_after_its_rest(small_set: Path, workers: int, persistent: bool) -> None:
    whole = undisturbed(small_set, 2)
    dataset = of_rank(small_set, 0, 1)
    dataset.load_state_dict(dataset.state_dict() | {"epoch": 2, "batch": 7})
    loader = DataLoader(dataset, batch_size=None, num_workers=workers, persistent_workers=persistent)
    assert [[digest(batch) for batch in loader] for _ in range(3)] == [whole[7:], whole, whole]
    more = DataLoader(dataset, batch_size=None, num_workers=4)
    assert [digest(batch) for batch in more] == whole


def test_a_state_of_workers_needs_the_batch(small_set: Path) -> None:
    dataset = of_rank(small_set, 0, 1)
    assert dataset.state_dict()["batch"] == 0
    batch = next(iter(DataLoader(dataset, batch_size=None, num_workers=1)))
    with pytest.raises(ValueError, match="after=batch"):
        dataset.state_dict()
    assert dataset.state_dict(after=batch)["batch"] == 1


def test_samplers_choose_rows(small_set: Path) -> None:
    rows = MeasurementRows(small_set, columns=["pair_id", "ir"], heights=True)
    sampler = torch.utils.data.WeightedRandomSampler(torch.arange(len(rows)) == 41, 64)
    for batch in DataLoader(rows, batch_size=16, sampler=sampler, num_workers=2):
        assert set(batch["surface_id"]) == {"0004_0"}
        assert batch["ir"].tolist() == [[4, 1, 0, 0]] * 16
        assert batch["heights"].shape == (16, 2, 2)


def test_grain_chooses_rows(small_set: Path) -> None:
    grain = pytest.importorskip("grain")
    rows = MeasurementRows(small_set, columns=["samples"])
    loaded = grain.MapDataset.source(rows).shuffle(seed=1).batch(32)
    found = [int(number) for batch in loaded for number in batch["samples"] if not np.isnan(number)]
    assert len(found) == len(set(found)) == len(rows) - 13


@pytest.mark.parametrize("workers", [0, 2])
def test_rows_of_an_export_come_as_its_files_have_them(training_set: Path, workers: int) -> None:
    files = sorted((training_set / "data").glob("train-*.parquet"))
    table = pq.read_table(files, columns=["surface_id", "pair_id", "ir", "tnce_total"]).to_pydict()
    places = zip(table["surface_id"], table["pair_id"], strict=True)
    expected = {key: (ir, level) for key, ir, level in zip(places, table["ir"], table["tnce_total"], strict=True)}
    dataset = Measurements(training_set)
    assert dataset.rows() == len(expected)
    for batch in DataLoader(dataset, batch_size=None, num_workers=workers):
        for row in range(len(batch["surface"])):
            key = batch["surface_ids"][batch["surface"][row]], int(batch["pair_id"][row])
            ir, level = expected.pop(key)
            assert batch["ir"][row].tolist() == ir
            assert batch["tnce_total"][row] == level
    assert not expected


def contents(batch: Batch) -> dict[str, Any]:
    return {name: value.numpy().copy() if isinstance(value, torch.Tensor) else value for name, value in batch.items()}


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    np.testing.assert_equal(one, other)
    return list(one) == list(other)


# More are kept than a worker has memory for again and again: none may change when the next ones come.
def test_a_worker_sends_what_is_read_without_one(small_set: Path) -> None:
    dataset = Measurements(small_set, heights=True, symmetries="random", batch_size=8)
    expected = [contents(batch) for batch in dataset]
    kept = list(DataLoader(dataset, batch_size=None, num_workers=1))
    assert len(kept) == len(expected) > 40
    assert all(same(contents(batch), other) for batch, other in zip(kept, expected, strict=True))
    assert kept[0]["ir"].is_contiguous()


@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_memory_is_used_again_only_when_nothing_points_to_it(small_set: Path, start: str) -> None:
    dataset = Measurements(small_set, columns=["ir"], batch_size=8)
    expected = [batch["ir"].clone() for batch in dataset]
    loader = DataLoader(dataset, batch_size=None, num_workers=1, multiprocessing_context=start, persistent_workers=True)
    for _ in range(2):
        kept = {number: batch["ir"][5:] for number, batch in enumerate(loader) if number % 7 == 0}
        assert all(np.array_equal(rows, expected[number][5:], equal_nan=True) for number, rows in kept.items())


def scaled(batch: Batch) -> Batch:
    batch["ir"] = batch["ir"] * 2
    batch["peak"] = batch["ir"].abs().amax(1)
    del batch["surface_ids"]
    return batch


def test_what_a_collate_function_does_arrives(small_set: Path) -> None:
    dataset = Measurements(small_set, columns=["ir", "samples"])
    plain = next(iter(dataset))
    batch = next(iter(DataLoader(dataset, batch_size=None, num_workers=1, collate_fn=scaled)))
    assert list(batch) == ["ir", "samples", "microphone_mm", "surface", "symmetries", "batch", "peak"]
    assert np.array_equal(batch["ir"], plain["ir"] * 2, equal_nan=True)
    assert np.array_equal(batch["samples"], plain["samples"], equal_nan=True)


def test_batches_are_kept_by_pickle(small_set: Path) -> None:
    for workers in (0, 1):
        batch = next(iter(DataLoader(Measurements(small_set), batch_size=None, num_workers=workers)))
        assert same(contents(pickle.loads(pickle.dumps(batch))), contents(batch))


def test_a_set_with_all_symmetries_is_read_as_it_is(turned_set: Path) -> None:
    found = set()
    for batch in Measurements(turned_set, columns=["pair_id"]):
        for place, pair in zip(batch["surface"].tolist(), batch["pair_id"].tolist(), strict=True):
            found.add((batch["surface_ids"][place], batch["symmetries"][place], pair))
    files = sorted((turned_set / "data").glob("train-*.parquet"))
    table = pq.read_table(files, columns=["surface_id", "symmetry", "pair_id"]).to_pydict()
    assert found == set(zip(table["surface_id"], table["symmetry"], table["pair_id"], strict=True))
    with pytest.raises(ValueError, match="its symmetries already"):
        Measurements(turned_set, columns=["tnce_total"], symmetries="all")
