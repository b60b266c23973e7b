"""Loaders give every row once, whatever the workers, and turn maps and positions together."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pq = pytest.importorskip("pyarrow.parquet")
torch = pytest.importorskip("torch")
from torch.utils.data import DataLoader  # noqa: E402

from echolake.symmetry import NAMES, turn_heights, turn_positions  # noqa: E402
from echolake.torch import Batch, Measurements  # noqa: E402


def rows(dataset: Measurements, workers: int = 0) -> list[tuple[str, str, int]]:
    found = []
    for batch in DataLoader(dataset, batch_size=None, num_workers=workers):
        for place, pair in zip(batch["surface"].tolist(), batch["pair_id"].tolist(), strict=True):
            found.append((batch["surface_ids"][place], batch["symmetries"][place], pair))
    return found


@pytest.mark.parametrize("workers", [0, 2, 4])
def test_every_row_comes_once(training_set: Path, workers: int) -> None:
    dataset = Measurements(training_set, columns=["pair_id"])
    found = rows(dataset, workers)
    assert len(found) == len(set(found)) == rows_of(training_set)


def rows_of(training_set: Path) -> int:
    """Rows of split train."""
    return sum(pq.read_metadata(file).num_rows for file in (training_set / "data").glob("train-*.parquet"))


@pytest.mark.parametrize("shuffle", [True, False])
@pytest.mark.parametrize("ranks", [1, 2, 3, 5, 40])
def test_every_rank_has_as_many_batches_as_its_length_says(training_set: Path, ranks: int, shuffle: bool) -> None:
    counts, seen, surfaces = set(), set(), set()
    for rank in range(ranks):
        dataset = Measurements(
            training_set, columns=["pair_id"], batch_size=100, shuffle=shuffle, rank=rank, world_size=ranks
        )
        batches = list(dataset)
        counts |= {len(batches), len(dataset), len(DataLoader(dataset, batch_size=None))}
        for batch in batches:
            assert len(batch["pair_id"]) > 0
            places = [batch["surface_ids"][place] for place in batch["surface"].tolist()]
            seen |= set(zip(places, batch["pair_id"].tolist(), strict=True))
            surfaces |= set(places)
    assert len(counts) == 1
    assert len(seen) == rows_of(training_set)
    # Surfaces of one size are dealt evenly, so no rank has more than its share and one surface.
    most = -(-len(surfaces) // ranks) * -(-len(seen) // len(surfaces))
    assert counts.pop() <= -(-most // 100) + -(-len(surfaces) // ranks // 4) + 1


def test_workers_change_neither_the_number_of_batches_nor_what_is_in_them(training_set: Path) -> None:
    def batches(workers: int) -> list[Any]:
        dataset = Measurements(training_set, columns=["pair_id"], batch_size=128, rank=1, world_size=2)
        loader = DataLoader(dataset, batch_size=None, num_workers=workers)
        found = [(batch["surface_ids"], batch["surface"].tolist(), batch["pair_id"].tolist()) for batch in loader]
        assert len(found) == len(loader) == len(dataset)
        return sorted(found)

    assert batches(0) == batches(1) == batches(3)


def test_shuffling_mixes_surfaces_and_is_repeatable(training_set: Path) -> None:
    def first(epoch: int) -> list[tuple[str, str, int]]:
        dataset = Measurements(training_set, columns=["pair_id"], batch_size=64)
        dataset.set_epoch(epoch)
        return rows(dataset)[:64]

    assert first(0) == first(0) != first(1)
    assert len({surface for surface, _, _ in first(0)}) > 1


def test_turns_are_those_of_the_rows_as_measured(training_set: Path) -> None:
    columns = ["microphone_mm", "speaker_mm", "ir"]
    plain, maps = {}, {}
    for batch in Measurements(training_set, columns=columns, shuffle=False, heights=True):
        for row, place in enumerate(batch["surface"].tolist()):
            surface = batch["surface_ids"][place]
            maps[surface] = batch["heights"][place].numpy()
            key = (surface, batch["ir"][row].numpy().tobytes())
            plain[key] = batch["microphone_mm"][row].numpy(), batch["speaker_mm"][row].numpy()
    seen = set()
    for batch in Measurements(training_set, columns=columns, symmetries="all", heights=True, seed=3):
        for place, (surface, symmetry) in enumerate(zip(batch["surface_ids"], batch["symmetries"], strict=True)):
            seen.add(symmetry)
            assert np.array_equal(batch["heights"][place], turn_heights(maps[surface], symmetry))
        for row in range(0, len(batch["surface"]), 97):
            place = int(batch["surface"][row])
            microphone, speaker = plain[batch["surface_ids"][place], batch["ir"][row].numpy().tobytes()]
            symmetry = batch["symmetries"][place]
            assert np.allclose(batch["microphone_mm"][row], turn_positions(microphone, symmetry))
            assert np.allclose(batch["speaker_mm"][row], turn_positions(speaker, symmetry))
    assert seen == set(NAMES)


def contents(batch: Batch) -> dict[str, Any]:
    return {name: value.numpy().copy() if isinstance(value, torch.Tensor) else value for name, value in batch.items()}


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return list(one) == list(other) and all(np.array_equal(one[name], other[name]) for name in one)


# More are kept than a worker has memory for again and again: none may change when the next ones come.
def test_a_worker_sends_what_is_read_without_one(training_set: Path) -> None:
    dataset = Measurements(training_set, heights=True, symmetries="random", batch_size=128)
    expected = [contents(batch) for batch in dataset]
    kept = list(DataLoader(dataset, batch_size=None, num_workers=1))
    assert len(kept) == len(expected) > 40
    assert all(same(contents(batch), other) for batch, other in zip(kept, expected, strict=True))
    assert kept[0]["ir"].is_contiguous()


@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_memory_is_used_again_only_when_nothing_points_to_it(training_set: Path, start: str) -> None:
    dataset = Measurements(training_set, columns=["ir"], batch_size=128)
    expected = [batch["ir"].clone() for batch in dataset]
    loader = DataLoader(dataset, batch_size=None, num_workers=1, multiprocessing_context=start, persistent_workers=True)
    for _ in range(2):
        kept = {number: batch["ir"][5:] for number, batch in enumerate(loader) if number % 7 == 0}
        assert all(torch.equal(rows, expected[number][5:]) for number, rows in kept.items())


def scaled(batch: Batch) -> Batch:
    batch["ir"] = batch["ir"] * 2
    batch["peak"] = batch["ir"].abs().amax(1)
    del batch["surface_ids"]
    return batch


def test_what_a_collate_function_does_arrives(training_set: Path) -> None:
    dataset = Measurements(training_set, columns=["ir", "tnce_total"])
    plain = next(iter(dataset))
    batch = next(iter(DataLoader(dataset, batch_size=None, num_workers=1, collate_fn=scaled)))
    assert list(batch) == ["ir", "tnce_total", "surface", "symmetries", "peak"]
    assert torch.equal(batch["ir"], plain["ir"] * 2)
    assert torch.equal(batch["tnce_total"], plain["tnce_total"])


def test_batches_are_kept_by_pickle(training_set: Path) -> None:
    for workers in (0, 1):
        batch = next(iter(DataLoader(Measurements(training_set), batch_size=None, num_workers=workers)))
        assert same(contents(pickle.loads(pickle.dumps(batch))), contents(batch))


def test_mistakes_are_named(training_set: Path, turned_set: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="echolake export ml"):
        Measurements(tmp_path)
    with pytest.raises(KeyError, match="tnce_total"):
        Measurements(training_set, columns=["nope"])
    with pytest.raises(KeyError):
        Measurements(training_set, columns=["pair_id"], symmetries="random")
    with pytest.raises(ValueError, match="its symmetries already"):
        next(iter(Measurements(turned_set, columns=["tnce_total"], symmetries="all")))
