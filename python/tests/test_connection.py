"""Queries against a served lake."""

import pytest

import echolake


def test_answers_are_arrow(served: str) -> None:
    with echolake.connect(served) as lake:
        table = lake.sql("select surface_id, count(*) n from measurements where surface_id = $1 group by 1", ["flat"])
        assert table.to_pylist() == [{"surface_id": "flat", "n": 2951}]
        with lake.stream("select pair_id, ir from measurements where surface_id = 'flat'") as reader:
            assert sum(batch.num_rows for batch in reader) == 2951
        assert "tnce" in lake.tables()


def test_addresses_are_checked() -> None:
    with pytest.raises(ValueError, match="no Flight SQL address"):
        echolake.connect("http://localhost:8080")
