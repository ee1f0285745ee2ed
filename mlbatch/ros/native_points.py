"""Points of clouds by compiled loops (`native/clouds.c`): the same values as by numpy."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I64Array, U8Array, U16Array
from mlbatch.native.library import address, library
from mlbatch.ros.point_packets import HEAD, Layout, Points, check_columns, pack
from mlbatch.ros.point_rows import REAL_ROLES, Rows, TakenRows

# sensor_msgs/PointField, by numpy's name of the type.
NUMBERS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
# A field that is not there.
NONE = (0, 0)
# As in `clouds.c`.
MOST_RUNS = 512
# Slots of a point: else most of them are empty, and the points are sorted.
_MOST_USED = 8


def take_rows_compiled(rows: Rows) -> TakenRows:
    """See `point_rows.take_rows`."""
    known = dict(rows.dtype.fields or {})
    reals_of = [field_of(known, name) for name in REAL_ROLES]
    # The time is the first: it decides which points are kept.
    roles = ["time", *(role for role in known if role not in ("time", *REAL_ROLES))]
    others = [known[role] for role in roles]
    count = len(rows)
    reals = np.empty((len(REAL_ROLES), count), np.float32)
    fields = {role: np.empty(count, known[role][0]) for role in roles}
    targets = (ctypes.c_void_p * len(roles))(*map(address, fields.values()))
    real_at, real_type = np.array(reals_of, np.int64).T.copy()
    field_at = np.array([one[1] for one in others], np.int64)
    field_bytes = np.array([one[0].itemsize for one in others], np.int64)
    placed = np.zeros(1, np.int64)
    kept = library().mlbatch_cloud_points(
        count,
        rows.__array_interface__["data"][0],
        rows.strides[0],
        address(real_at),
        address(real_type),
        NUMBERS[known["time"][0].str[1:]],
        len(roles),
        address(field_at),
        address(field_bytes),
        count,
        address(reals),
        targets,
        address(placed),
    )
    return TakenRows(
        reals[:, :kept], {role: field[:kept] for role, field in fields.items()}, int(placed[0])
    )


def field_of(known: dict[str, Any], name: str) -> tuple[int, int]:
    """Byte in a row and number of the type of a field."""
    if name not in known:
        return NONE
    dtype, first = known[name][:2]
    return first, NUMBERS[dtype.str[1:]]


def pack_compiled(points: Points, layout: Layout, message_bytes: int) -> U8Array:
    """See `point_packets.pack`, which packs points whose times are too far apart for the loops."""
    placed = _by_runs(points, layout) or _by_sort(points, layout)
    if placed is None:
        return pack(points, layout, message_bytes)
    columns = placed.columns
    check_columns(columns, len(points), layout, message_bytes)
    packets = np.zeros((columns, layout.size), np.uint8)
    packets[:, : HEAD.itemsize] = layout.begin.view(np.uint8)
    reals = points.reals
    if reals.strides[1] != reals.itemsize:
        reals = np.ascontiguousarray(reals)
    stamp_ns = np.ascontiguousarray(points.stamp_ns)
    ring = None if points.ring is None else np.ascontiguousarray(points.ring)
    return_type = np.ascontiguousarray(points.return_type)
    tag = np.ascontiguousarray(points.tag)
    used = np.zeros(columns, np.uint16)
    library().mlbatch_cloud_pack(
        _address(placed.order),
        len(placed.begins) - 1,
        address(placed.begins),
        address(placed.column),
        address(placed.slot),
        address(stamp_ns),
        reals.strides[0] // reals.itemsize,
        reals.__array_interface__["data"][0],
        _address(ring),
        address(return_type),
        address(tag),
        layout.slots,
        layout.size,
        columns,
        address(used),
        address(packets),
    )
    return packets


@dataclass(frozen=True, slots=True)
class _Placed:
    """Column and slot of points (n,), by `order` (None: their own); columns: their number.

    begins: first points of runs in which columns do not fall, and the end.
    """

    columns: int
    column: npt.NDArray[np.int32]
    slot: U16Array
    begins: I64Array
    order: I64Array | None = None


def _by_runs(points: Points, layout: Layout) -> _Placed | None:
    """Place points that are a few runs of rising stamps; None where they are not."""
    ring = points.ring
    if ring is not None and not layout.by_ring and bool((ring[1:] < ring[:-1]).any()):
        # Points of one stamp are in the order of their rings.
        return None
    loops = library()
    count = len(points)
    stamp_ns = np.ascontiguousarray(points.stamp_ns)
    stamps, spare = np.empty((2, count), np.int64)
    column = np.empty(count, np.int32)
    begins = np.empty(MOST_RUNS + 1, np.int64)
    found = np.zeros(1, np.int64)
    runs = loops.mlbatch_cloud_runs(
        count,
        address(stamp_ns),
        address(stamps),
        address(spare),
        address(column),
        address(begins),
        address(found),
    )
    width = layout.slots if layout.by_ring else 1
    if not runs or int(found[0]) * width > _MOST_USED * count:
        return None
    slot: U16Array = np.empty(count, np.uint16)
    used = np.zeros(int(found[0]) * width, np.int32)
    layers = np.zeros(int(found[0]), np.int32)
    kept = None if ring is None or not layout.by_ring else np.ascontiguousarray(ring)
    columns = loops.mlbatch_cloud_slots(
        count,
        _address(kept),
        layout.slots,
        int(found[0]),
        address(used),
        address(layers),
        address(column),
        address(slot),
    )
    return _Placed(columns, column, slot, begins[: runs + 1])


def _by_sort(points: Points, layout: Layout) -> _Placed | None:
    """Place points in any order; None where their times are too far apart."""
    loops = library()
    count = len(points)
    stamp_ns = np.ascontiguousarray(points.stamp_ns)
    ring = None if points.ring is None else np.ascontiguousarray(points.ring)
    order: I64Array | None = np.empty(count, np.int64)
    words, spare = np.empty((2, count), np.uint64)
    state = loops.mlbatch_cloud_order(
        count, address(stamp_ns), _address(ring), address(words), address(spare), _address(order)
    )
    if state < 0:
        return None
    if state:
        order = None
    column = np.empty(count, np.int32)
    slot: U16Array = np.empty(count, np.uint16)
    columns = loops.mlbatch_cloud_columns(
        count,
        address(stamp_ns),
        _address(ring),
        _address(order),
        layout.slots,
        layout.by_ring,
        address(column),
        address(slot),
    )
    return _Placed(columns, column, slot, np.array([0, count]), order)


def _address(array: npt.NDArray[Any] | None) -> int | None:
    return None if array is None else address(array)
