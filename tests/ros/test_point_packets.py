"""Points as columns: which share one, their slots, and that none is lost."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.ros.point_packets import CloudError, Layout, Points, layout_of, pack
from tests.builders.points import STAMP_NS, read_packets


def _points(stamps_ns: Sequence[int], rings: Sequence[int] | None = None) -> Points:
    """Points with distinct x."""
    count = len(stamps_ns)
    reals = np.zeros((4, count), np.float32)
    reals[0] = np.arange(1, count + 1)
    ring = None if rings is None else np.array(rings, np.uint16)
    nothing = np.zeros(count, np.uint8)
    return Points(np.array(stamps_ns, np.int64) + STAMP_NS, reals, ring, nothing, nothing)


def _columns(packets: npt.NDArray[np.uint8]) -> list[tuple[int, list[int]]]:
    """Stamp and x of all slots of each packet; 0: empty."""
    columns = read_packets(packets)
    return [*zip((columns.stamp_ns - STAMP_NS).tolist(), columns.x.tolist(), strict=True)]


def test_runs_that_are_too_long_go_on_in_a_column_of_the_same_stamp() -> None:
    packets = pack(_points([0, 0, 0, 0, 0, 7]), Layout(0, 2), 0)
    assert _columns(packets) == [(0, [1, 2]), (0, [3, 4]), (0, [5, 0]), (7, [6, 0])]
    assert [column.count for column in read_packets(packets)] == [2, 2, 1, 1]
    assert [column.number for column in read_packets(packets)] == [0, 1, 2, 3]


def test_points_lie_at_their_ring_where_columns_are_full_enough() -> None:
    stamps_ns = [stamp for stamp in (0, 10) for _ in range(12)]
    points = _points(stamps_ns, rings=[*range(12)] * 2)
    layout = layout_of(points, 0)
    assert layout == Layout(0, 16, by_ring=True)
    first, second = _columns(pack(points, layout, 0))
    assert first == (0, [*range(1, 13), 0, 0, 0, 0])
    assert second == (10, [*range(13, 25), 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("stamps_ns", "rings", "slots"),
    [
        # No stamp is informative; the widest; no more than is mostly used; the most of all.
        ([0] * 5000, None, 16),
        ([0] * 128 + [1] * 120, None, 128),
        ([0] * 50 + [*range(1, 51)], None, 2),
        ([0] * 3000 + [1] * 3000, None, 256),
        # Two of 32 rings at a time: by ring most slots would be empty.
        ([0, 0, 1, 1, 2, 2], [0, 31, 1, 30, 2, 29], 2),
        # More rings than an output's column has.
        ([0] * 300 + [1] * 300, [*range(300)] * 2, 256),
    ],
)
def test_slots_suit_the_first_cloud(
    stamps_ns: list[int], rings: list[int] | None, slots: int
) -> None:
    assert layout_of(_points(stamps_ns, rings), 0) == Layout(0, slots)


def test_memory_is_bounded_where_later_clouds_share_no_times() -> None:
    points = _points(range(10_000))
    with pytest.raises(CloudError, match="expected points that share times as in the first cloud"):
        pack(points, Layout(0, 256), 22 * 10_000)


@settings(max_examples=60)
@given(
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 40)), min_size=1, max_size=120),
    st.booleans(),
    st.one_of(st.none(), st.integers(1, 9)),
)
def test_every_point_is_in_one_slot_under_its_stamp(
    given_points: list[tuple[int, int]], has_rings: bool, slots: int | None
) -> None:
    stamps_ns = [stamp for stamp, _ in given_points]
    points = _points(stamps_ns, [ring for _, ring in given_points] if has_rings else None)
    layout = layout_of(points, 1) if slots is None else Layout(1, slots)
    packets = pack(points, layout, 0)
    assert packets.shape[1] == layout.size
    found = []
    for column in read_packets(packets):
        filled = [(at, int(x)) for at, x in enumerate(column.x) if x]
        assert len(filled) == column.count > 0
        assert not layout.by_ring or all(given_points[x - 1][1] == at for at, x in filled)
        assert all(column.ring[at] == (given_points[x - 1][1] * has_rings) for at, x in filled)
        found += [(column.stamp_ns - STAMP_NS, x) for _, x in filled]
    assert [stamp for stamp, _ in found] == sorted(stamps_ns)
    assert sorted((x, stamp) for stamp, x in found) == [*enumerate(stamps_ns, 1)]
