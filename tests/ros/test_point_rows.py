"""Points of clouds: the literal bytes, for rows of any fields and points in any order."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.ros.point_packets import Layout, Points, layout_of, pack
from mlbatch.ros.point_rows import Rows, take_rows
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


def _columns_of(rings: int, columns: int, order: str, random: np.random.Generator) -> Points:
    """Points of a spinning lidar, some missing: by column, by ring, or in no order."""
    stamp = np.tile(np.arange(columns) * 48_828, rings)
    ring = np.repeat(np.arange(rings), columns)
    keep = random.random(len(stamp)) < 0.9
    keep[0] = True
    stamp, ring = stamp[keep], ring[keep]
    if order != "ring":
        index = np.argsort(stamp, kind="stable") if order == "column" else None
        index = random.permutation(len(stamp)) if index is None else index
        stamp, ring = stamp[index], ring[index]
    return _points(stamp, ring, random)


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


@pytest.mark.parametrize("order", ["column", "ring", "none"])
@pytest.mark.parametrize(("rings", "columns"), [(16, 300), (64, 200), (128, 130), (1, 700)])
def test_clouds_of_a_spinning_lidar_are_packed_literally(
    rings: int, columns: int, order: str
) -> None:
    points = _columns_of(rings, columns, order, np.random.default_rng(rings + columns))
    _assert_equal(points, layout_of(points, 0))
    _assert_equal(points, Layout(0, 7))


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


def test_many_short_runs_are_packed_literally() -> None:
    """More runs than the loops follow at once."""
    random = np.random.default_rng(1)
    points = _points(np.tile([3, 2, 1, 0], 400), None, random)
    _assert_equal(points, Layout(0, 16))


def test_times_that_do_not_fit_one_word_with_their_rings_are_packed() -> None:
    random = np.random.default_rng(1)
    stamp = random.permutation(70_000) * 142_000
    points = _points(stamp, random.permutation(70_000) % 65_536, random)
    _assert_equal(points, Layout(0, 1))
