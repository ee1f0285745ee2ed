"""The ring of raw packets: stored columns are found at their ring index while they are needed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.arrays import U8Array
from mlbatch.decode.packet_ring import PacketRing
from mlbatch.lidar.interface import Records
from tests.reference.decoder import record_of


def _sum(payload: bytes) -> int:
    """Sum of the words of 8 bytes, and of the last 8 bytes if these are no word."""
    if len(payload) < 8:
        return sum(payload)
    words = [payload[at : at + 8] for at in range(0, len(payload) - 7, 8)]
    words += [payload[-8:]] * bool(len(payload) % 8)
    return sum(int.from_bytes(word, "little") for word in words) % 2**64


@dataclass
class Stored:
    """A ring, and the expected column of each ring index in a dictionary."""

    packet_size: int
    record_start: int
    record_size: int
    columns: int
    ring: PacketRing = field(init=False)
    records: dict[int, bytes] = field(default_factory=dict)
    sums: dict[int, int] = field(default_factory=dict)
    sum: int = 0
    count: int = 0

    def __post_init__(self) -> None:
        self.ring = PacketRing(
            self.packet_size, Records(self.record_start, self.record_size, self.record_size)
        )
        self.ring.keep_sums()

    def store(self, count: int, gap: int = 0) -> U8Array:
        """Store packets that are `gap` bytes apart in a batch; return the view of the ring."""
        rng = np.random.default_rng(self.count)
        stride = self.packet_size + gap
        data = rng.integers(0, 256, max(1, count * stride), np.uint8)
        start = np.arange(count, dtype=np.int64) * stride
        packets, place = self.ring.store(data, start, min(self.records, default=None))
        assert packets.shape == (count, self.packet_size)
        for number, first in enumerate(place.tolist()):
            payload = data[number * stride :][: self.packet_size]
            np.testing.assert_array_equal(packets[number], payload)
            self.sum = (self.sum + _sum(payload.tobytes())) % 2**64
            for column in range(self.columns):
                begin = self.record_start + column * self.record_size
                self.records[first + column] = payload[begin : begin + self.record_size].tobytes()
                self.sums[first + column] = self.sum
        self.count += 1
        return packets

    def forget(self, count: int) -> None:
        """The oldest places are no longer needed."""
        for place in sorted(self.records)[:count]:
            del self.records[place]

    def check(self) -> None:
        """Every needed record is found where it was put."""
        for place, record in self.records.items():
            assert self.ring.sum_until(place) == self.sums[place]
            assert record_of(self.ring, place).tobytes() == record


steps = st.lists(
    st.tuples(st.integers(0, 150), st.integers(0, 9), st.integers(0, 600)), min_size=1, max_size=12
)


@given(steps, st.sampled_from([(50, 7, 12, 3), (36, 0, 12, 3), (33, 32, 1, 1), (64, 8, 24, 2)]))
@settings(max_examples=60)
def test_needed_records_survive_growth_and_wrap(
    plan: list[tuple[int, int, int]], sizes: tuple[int, int, int, int]
) -> None:
    stored = Stored(*sizes)
    for count, gap, forgotten in plan:
        stored.store(count, gap)
        stored.check()
        stored.forget(forgotten)


def test_a_ring_that_is_emptied_does_not_grow() -> None:
    """Millions of packets pass through the memory that a window needs."""
    stored = Stored(50, 7, 12, 3)
    sizes = set()
    for _ in range(200):
        stored.store(60)
        sizes.add(stored.ring.nbytes)
        stored.check()
        stored.forget(3 * 60)
    assert len(sizes) == 1


def test_places_never_come_twice() -> None:
    ring = PacketRing(36, Records(0, 12, 12))
    seen = set[int]()
    for count in (3, 64, 1, 70, 5, 64):
        data = np.zeros(count * 36, np.uint8)
        _, place = ring.store(data, np.arange(count, dtype=np.int64) * 36, None)
        assert not seen & set(place.tolist())
        assert place.tolist() == sorted(place.tolist())
        seen |= set(place.tolist())


@pytest.mark.parametrize("waiting", [1, 63, 64, 65, 500])
def test_all_of_a_stalled_sensor_is_kept(waiting: int) -> None:
    stored = Stored(36, 0, 12, 3)
    for _ in range(waiting):
        stored.store(1)
    stored.check()
    assert len(stored.records) == 3 * waiting


@pytest.mark.parametrize("size", [1, 7, 8, 9, 15, 16, 23])
def test_every_change_of_a_byte_changes_the_checksum(size: int) -> None:
    """Also by the top bit of a byte, which could overflow the sum."""
    packet = np.full(size, 0x7F, np.uint8)
    changed = np.array(
        [
            np.where(np.arange(size) == at, 0x7F ^ flip, packet)
            for at in range(size)
            for flip in range(1, 256)
        ],
        np.uint8,
    )
    ring = PacketRing(size, Records(0, size, size))
    ring.keep_sums()
    data = np.concatenate([packet, changed.reshape(-1)])
    start = np.arange(len(changed) + 1, dtype=np.int64) * size
    _, place = ring.store(data, start, None)
    totals = np.array([ring.sum_until(one) for one in place.tolist()], np.uint64)
    assert not (np.diff(totals) == totals[0]).any()
