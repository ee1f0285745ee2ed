"""Every scan is of one shard, whatever the number of shards."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from mlbatch.pipeline.shards import Shard, parse_shard


@given(
    index=st.integers(-1, 10**7),
    slices=st.integers(1, 100),
    count=st.integers(1, 200),
    data=st.data(),
)
def test_every_scan_is_of_one_shard(
    index: int, slices: int, count: int, data: st.DataObject
) -> None:
    part = data.draw(st.integers(0, slices - 1))
    owners = [n for n in range(1, count + 1) if Shard(n, count).has(index, part, slices)]
    assert len(owners) == 1


@given(count=st.integers(1, 50), slices=st.integers(1, 7))
def test_shards_have_the_same_number_of_scans(count: int, slices: int) -> None:
    scans = [(index, part) for index in range(count) for part in range(slices)]
    sizes = {sum(Shard(n, count).has(*scan, slices) for scan in scans) for n in range(1, count + 1)}
    assert sizes == {slices}


@given(count=st.integers(1, 999_999), data=st.data())
def test_a_shard_is_written_as_it_is_read(count: int, data: st.DataObject) -> None:
    shard = Shard(data.draw(st.integers(1, count)), count)
    assert parse_shard(str(shard)) == shard
