"""Every file is of one shard, whatever the number of shards."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.errors import UsageError
from mlbatch.pipeline.job import Shard, parse_shard


@given(file=st.integers(-100, 10**9), count=st.integers(1, 200))
def test_every_file_is_of_one_shard(file: int, count: int) -> None:
    """Slices of the head have negative numbers."""
    assert [Shard(number, count).has(file) for number in range(1, count + 1)].count(True) == 1


@given(count=st.integers(1, 50), each=st.integers(1, 7))
def test_shards_have_the_same_number_of_files(count: int, each: int) -> None:
    shards = [Shard(number, count) for number in range(1, count + 1)]
    assert {sum(map(shard.has, range(count * each))) for shard in shards} == {each}


@given(count=st.integers(1, 999_999), data=st.data())
def test_a_shard_is_written_as_it_is_read(count: int, data: st.DataObject) -> None:
    shard = Shard(data.draw(st.integers(1, count)), count)
    assert parse_shard("--shard", str(shard)) == shard


@pytest.mark.parametrize("text", ["3/2", "2", "1/0", "a/b", "-1/2", "1/2/3", "٣/٤", ""])
def test_what_is_no_shard(text: str) -> None:
    with pytest.raises(UsageError, match=f"^--part: expected K/N .*found '{text}'; write"):
        parse_shard("--part", text)
