"""Records at their places in the arena: what was stored is what is read, however it moves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.arrays import I64Array, U8Array
from mlbatch.decode.packet_ring import PacketRing
from mlbatch.lidar.interface import Records
from mlbatch.native.arena import PacketArena
from tests.reference.decoder import record_of

SIZE = 40
# Four columns of 9 bytes from byte 4, two in a row.
RECORDS = Records(start=4, stride=18, size=9, per_row=2, step=9)
COLUMNS = 4


def _packets(seed: int, count: int) -> U8Array:
    return np.random.default_rng(seed).integers(1, 256, (count, SIZE), np.uint8)


def _columns(packets: U8Array) -> U8Array:
    """Records (P * 4, 9) of packets, by hand."""
    parts = [packets[:, 4 + 9 * column : 13 + 9 * column] for column in range(COLUMNS)]
    return np.stack(parts, axis=1).reshape(-1, 9)


def _gathered(ring: PacketRing, first: I64Array) -> U8Array:
    index = (first[:, None] + ring.column_offsets(COLUMNS)).reshape(-1)
    return np.stack([record_of(ring, one) for one in index.tolist()])


def _read(arena: PacketArena, packets: U8Array, gap: int) -> tuple[U8Array, I64Array, int]:
    """Packets in a region of an arena, `gap` bytes apart, as a reader leaves them."""
    step = SIZE + gap
    region, place = arena.reserve_for_reading(len(packets) * step + 10)
    start = 5 + np.arange(len(packets)) * step
    for at, packet in zip(start.tolist(), packets, strict=True):
        region[at : at + SIZE] = packet
    return region, start, place


@given(
    sizes=st.lists(st.integers(1, 30), min_size=1, max_size=12),
    behind=st.integers(0, 4),
    is_read=st.lists(st.booleans(), min_size=12, max_size=12),
)
def test_records_stay_until_they_are_not_needed(
    sizes: list[int], behind: int, is_read: list[bool]
) -> None:
    """behind: batches whose records are still needed when the next is read."""
    arena = PacketArena()
    ring = PacketRing(SIZE, RECORDS, arena)
    kept: list[tuple[I64Array, U8Array]] = []
    for number, count in enumerate(sizes):
        packets = _packets(number, count)
        oldest = min((int(first.min()) for first, _ in kept), default=None)
        arena.keep_from(oldest)
        if is_read[number]:
            region, start, place = _read(arena, packets, number % 3)
            kept_now = ring.keep(region, start, place)
        else:
            # The reader's own memory.
            start = np.arange(count) * SIZE
            kept_now = ring.keep(packets.reshape(-1).copy(), start)
        read = kept_now.data[kept_now.start[:, None] + np.arange(SIZE)]
        assert np.array_equal(read, packets)
        kept.append((kept_now.ring_index, _columns(packets)))
        for one, expected in kept:
            assert np.array_equal(_gathered(ring, one), expected)
        kept = kept[len(kept) - behind :] if behind else []


def test_memory_is_used_again() -> None:
    arena = PacketArena()
    ring = PacketRing(SIZE, RECORDS, arena)
    sizes = []
    for number in range(100):
        region, start, place = _read(arena, _packets(number, 20), 2)
        first = ring.keep(region, start, place).ring_index
        arena.keep_from(int(first[-1]))
        sizes.append(ring.nbytes)
    assert len(set(sizes[3:])) == 1
    assert arena.capacity <= 4 * (20 * (SIZE + 2) + 10)


def test_packets_of_one_batch_do_not_replace_each_other() -> None:
    """Nothing waits when the first sensor's packets are copied; the second's come to others."""
    arena = PacketArena()
    rings = [PacketRing(SIZE, RECORDS, arena) for _ in range(3)]
    for number in range(20):
        arena.keep_from(None)
        stored = []
        for one, ring in enumerate(rings):
            packets = _packets(3 * number + one, 10)
            first = ring.keep(packets.reshape(-1).copy(), np.arange(10) * SIZE).ring_index
            stored.append((ring, first, _columns(packets)))
        for ring, first, expected in stored:
            assert np.array_equal(_gathered(ring, first), expected)


def test_sums_are_those_of_all_packets_so_far() -> None:
    """By hand: five words of 8 bytes, added up."""
    arena = PacketArena()
    ring = PacketRing(SIZE, RECORDS, arena)
    ring.keep_sums()
    total = 0
    for number in range(20):
        packets = _packets(number, 7)
        region, start, place = _read(arena, packets, 3)
        arena.keep_from(None)
        first = ring.keep(region, start, place if number % 2 else None).ring_index
        for packet, row in enumerate(packets):
            words = [row[at : at + 8].tobytes() for at in range(0, SIZE, 8)]
            total += sum(int.from_bytes(word, "little") for word in words)
            assert ring.sum_until(int(first[packet])) == total % 2**64
            last = int(first[packet] + ring.column_offsets(COLUMNS)[-1])
            assert ring.sum_until(last) == total % 2**64


def test_packets_beyond_their_array_are_an_error() -> None:
    ring = PacketRing(SIZE, RECORDS, PacketArena())
    with pytest.raises(IndexError):
        ring.keep(np.zeros(100, np.uint8), np.array([61]))
