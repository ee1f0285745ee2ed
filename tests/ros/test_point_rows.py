"""Rows of clouds, and points in any order: the literal bytes, or nothing at once if unusual."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.arrays import I64Array, U8Array
from mlbatch.lidar.headers import content_keys, hash_factors
from mlbatch.ros.point_packets import CloudError, Layout, Points, layout_of, pack
from mlbatch.ros.point_rows import PackedRows, RowPacker, Rows, take_rows
from tests.builders.points import read_packets
from tests.reference.clouds import packets_of, taken_rows

STAMP_NS = 1_700_000_000_000_000_000
WHOLE = ("i1", "u1", "<i2", "<u2", "<i4", "<u4")
SPECIAL = (0.0, -0.0, np.nan, np.inf, -np.inf, 1e-30, 3e38, 1e300)


@st.composite
def rows(draw: st.DrawFn) -> Rows:
    """Rows with fields of all types in any order, gaps, and values that are no places."""
    count = draw(st.sampled_from([0, 1, 255, 256, 257, 700]))
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    real = draw(st.sampled_from(["<f4", "<f8"]))
    kinds = {name: real for name in "xyz"}
    kinds["time"] = draw(st.sampled_from(["<f4", "<f8", *WHOLE]))
    for name in draw(st.sets(st.sampled_from(["intensity", "ring", "return_type", "tag"]))):
        kinds[name] = draw(st.sampled_from([*WHOLE, "<f4", "<f8"]))
    names = draw(st.permutations(sorted(kinds)))
    offsets = []
    end = draw(st.integers(0, 3))
    for name in names:
        offsets.append(end)
        end += np.dtype(kinds[name]).itemsize + draw(st.integers(0, 3))
    formats = [kinds[name] for name in names]
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": end})
    found = np.zeros(count, layout)
    for name, kind in kinds.items():
        values = random.normal(50, 30, count)
        if kind[1:] in ("f4", "f8"):
            special = random.random(count) < draw(st.sampled_from([0, 0.01, 0.5, 1]))
            values[special] = random.choice(SPECIAL, int(special.sum()))
        with np.errstate(over="ignore", invalid="ignore"):
            found[name] = values.astype(kind)
    if draw(st.booleans()):
        # No place at all.
        found[: count // 2] = np.zeros((), layout)
    return found


@settings(max_examples=150)
@given(rows())
def test_rows_are_taken_literally(given_rows: Rows) -> None:
    expected = taken_rows(given_rows)
    found = take_rows(given_rows)
    assert found.placed == expected.placed
    assert found.reals.tobytes() == expected.reals.tobytes()
    assert found.fields.keys() == expected.fields.keys()
    for role, values in expected.fields.items():
        assert found.fields[role].dtype == values.dtype
        assert found.fields[role].tobytes() == values.tobytes()


def _points(
    stamp: npt.NDArray[np.int64], ring: npt.NDArray[np.int64] | None, random: np.random.Generator
) -> Points:
    count = len(stamp)
    return Points(
        stamp.astype(np.int64) + STAMP_NS,
        random.random((4, count)).astype(np.float32) + 1,
        None if ring is None else ring.astype(np.uint16),
        random.integers(0, 9, count).astype(np.uint8),
        random.integers(0, 255, count).astype(np.uint8),
    )


def _assert_equal(points: Points, layout: Layout) -> None:
    expected = packets_of(points, layout)
    found = pack(points, layout, 1 << 30)
    assert found.shape == expected.shape
    assert found.tobytes() == expected.tobytes()


@settings(max_examples=150)
@given(
    # Few times, all times, as far apart as those of a cloud can be.
    st.tuples(st.integers(1, 600), st.integers(0, 2**32), st.integers(1, 300)),
    st.sampled_from([1, 997, 9_999_999]),
    st.one_of(st.none(), st.integers(1, 60)),
    st.one_of(st.none(), st.integers(1, 9)),
)
def test_points_in_any_order_are_packed_literally(
    size: tuple[int, int, int], step_ns: int, rings: int | None, slots: int | None
) -> None:
    count, seed, times = size
    random = np.random.default_rng(seed)
    stamp = random.integers(0, times, count) * step_ns
    ring = None if rings is None else random.integers(0, rings, count)
    points = _points(stamp, ring, random)
    _assert_equal(points, layout_of(points, 1) if slots is None else Layout(1, slots))


def test_times_that_do_not_fit_one_word_with_their_rings_are_packed() -> None:
    random = np.random.default_rng(1)
    stamp = random.permutation(70_000) * 142_000
    points = _points(stamp, random.permutation(70_000) % 65_536, random)
    _assert_equal(points, Layout(0, 1))


# -- at once --------------------------------------------------------------------------------------

BIG = 1 << 30


def stamps(time: npt.NDArray[Any]) -> tuple[I64Array, str]:
    """Times in ns."""
    return STAMP_NS + np.rint(time).astype(np.int64), "ns"


def room(count: int, size: int) -> U8Array:
    """Memory that other packets were in."""
    return np.full((count, size), 0xA5, np.uint8)


def packed(rows: Rows, slots: int) -> PackedRows | None:
    """The rows by the compiled loops."""
    layout = Layout(0, slots, by_ring=True)
    factors = hash_factors(layout.size // 8)
    return RowPacker().pack(rows, stamps, layout, BIG, room, factors)


def assert_as_literally(rows: Rows, slots: int) -> None:
    """Compare packets, counts and keys with the literal ones."""
    taken = taken_rows(rows)
    fields = taken.fields
    nothing = np.zeros(len(taken.reals[0]), np.uint8)
    points = Points(
        stamps(fields["time"])[0],
        taken.reals,
        fields["ring"].astype(np.uint16),
        fields.get("return_type", nothing),
        fields.get("tag", nothing),
    )
    expected = packets_of(points, Layout(0, slots, by_ring=True))
    found = packed(rows, slots)
    assert found is not None
    assert found.packets.shape == expected.shape
    assert found.packets.tobytes() == expected.tobytes()
    assert (found.placed, found.points) == (taken.placed, len(points))
    assert found.content_key is not None
    assert found.content_key.tolist() == content_keys(expected).tolist()


def spinning(
    rings: int, columns: int, order: str, kinds: dict[str, str], random: np.random.Generator
) -> Rows:
    """A cloud by column or by ring, some of its points without a place."""
    offsets = []
    end = int(random.integers(0, 3))
    for kind in kinds.values():
        offsets.append(end)
        end += np.dtype(kind).itemsize + int(random.integers(0, 3))
    layout = np.dtype(
        {"names": list(kinds), "formats": list(kinds.values()), "offsets": offsets, "itemsize": end}
    )
    rows = np.zeros((rings, columns), layout)
    for name, kind in kinds.items():
        rows[name] = random.integers(1, 100, rows.shape).astype(kind)
    rows["ring"] = np.arange(rings)[:, None]
    rows["time"] = np.arange(columns) * 48_828
    gone = random.random(rows.shape) < random.choice([0, 0.03, 0.6])
    # Whole columns as well.
    gone[:, random.random(columns) < 0.1] = True
    gone[0, 0] = gone[-1, -1] = False
    for axis in "xyz":
        rows[axis][gone] = random.choice([0, np.nan, np.inf])
    return (rows if order == "ring" else rows.T).reshape(-1)


KINDS = {"x": "<f4", "y": "<f4", "z": "<f4"}


@settings(max_examples=100)
@given(
    st.sampled_from([(16, 300), (64, 200), (3, 90), (200, 70), (2, 2)]),
    st.sampled_from(["ring", "column"]),
    st.sampled_from(["<u4", "<i4", "<f4", "<f8"]),
    st.sampled_from(["", "<f4", "<f8", "u1", "i1", "<u2", "<i2", "<u4", "<i4"]),
    st.sampled_from([("u1", ()), ("<u2", ("tag",)), ("<u2", ("return_type", "tag"))]),
    st.integers(0, 2**32),
)
def test_clouds_of_a_spinning_lidar_are_packed_as_by_numpy(
    size: tuple[int, int],
    order: str,
    time: str,
    intensity: str,
    more: tuple[str, tuple[str, ...]],
    seed: int,
) -> None:
    kinds = KINDS | {"time": time, "ring": more[0]} | dict.fromkeys(more[1], "u1")
    if intensity:
        kinds["intensity"] = intensity
    rows = spinning(*size, order, kinds, np.random.default_rng(seed))
    assert_as_literally(rows, 256 if size[0] > 64 else 64)


def simple(points: Sequence[tuple[float, int, int]]) -> Rows:
    """Rows of x, time and ring."""
    kinds = {**KINDS, "time": "<u4", "ring": "<u2"}
    rows = np.zeros(len(points), np.dtype(list(kinds.items())))
    rows["x"], rows["time"], rows["ring"] = zip(*points, strict=True)
    return rows


def test_a_time_that_only_a_later_ring_has_is_inserted() -> None:
    """By hand: ring 0 has times 10 and 30, ring 1 has 20, 30 and 40."""
    rows = simple([(1, 10, 0), (2, 30, 0), (3, 20, 1), (4, 30, 1), (5, 40, 1)])
    found = packed(rows, 16)
    assert found is not None
    columns = read_packets(found.packets)
    assert [one.stamp_ns - STAMP_NS for one in columns] == [10, 20, 30, 40]
    assert [one.count for one in columns] == [1, 1, 2, 1]
    assert columns.x[:, :2].tolist() == [[1, 0], [0, 3], [2, 4], [0, 5]]
    assert_as_literally(rows, 16)


def test_times_without_a_value_are_left_out_and_counted() -> None:
    kinds = {**KINDS, "time": "<f4", "ring": "u1"}
    rows = np.zeros(5, np.dtype(list(kinds.items())))
    rows["x"] = 1
    rows["time"] = [0, np.nan, 10, np.inf, 20]
    found = packed(rows, 16)
    assert found is not None
    assert (found.placed, found.points) == (5, 3)
    assert_as_literally(rows, 16)


@pytest.mark.parametrize(
    "points",
    [
        pytest.param([(1, 10, 0), (2, 10, 0), (3, 20, 1)], id="two points of a ring at one time"),
        pytest.param([(1, 10, 0), (2, 20, 16)], id="a ring beyond the slots"),
        pytest.param([(1, 10, 0), (2, 10, 1)], id="one time"),
        pytest.param([(0, 10, 0), (0, 20, 1)], id="no point"),
        pytest.param([(1, 600 - n, 0) for n in range(600)], id="more runs than are followed"),
    ],
)
def test_unusual_clouds_are_left_to_others(points: list[tuple[float, int, int]]) -> None:
    assert packed(simple(points), 16) is None


@pytest.mark.parametrize(
    ("name", "kind"),
    [("x", "<f8"), ("ring", "<i4"), ("time", "<u2"), ("tag", "<f4"), ("lidar_id", "u1")],
)
def test_unusual_types_are_left_to_others(name: str, kind: str) -> None:
    kinds = KINDS | {"time": "<u4", "ring": "<u2"} | {name: kind}
    random = np.random.default_rng(1)
    assert packed(spinning(4, 8, "ring", kinds, random), 16) is None


def test_times_that_are_one_in_ns_are_left_to_others() -> None:
    kinds = KINDS | {"time": "<f8", "ring": "u1"}
    rows = spinning(4, 8, "column", kinds, np.random.default_rng(1))
    rows["time"] /= 1e9
    assert packed(rows, 16) is None


def test_more_columns_than_the_memory_should_have_are_an_error() -> None:
    rows = simple([(1, n, 0) for n in range(20_000)])
    layout = Layout(0, 256, by_ring=True)
    with pytest.raises(CloudError, match="found 20000 times for 20000 points"):
        RowPacker().pack(rows, stamps, layout, rows.nbytes, room)
