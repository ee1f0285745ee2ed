"""Rows of decoded clouds by compiled loops (`native/clouds.c`): to arrays, or at once to packets.

At once are clouds of a spinning lidar: a ring for each point, times that rise in a few runs, one
lidar per message. The packets equal what `pointcloud2.read_cloud` and `point_packets.pack` give,
which read all other clouds.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F32Array, I64Array, U8Array, U64Array
from mlbatch.native.library import address, library
from mlbatch.ros.point_packets import Layout, check_columns

# A structured array, fields named by role; numpy has no type for the fields of a dtype.
Rows: TypeAlias = npt.NDArray[Any]
AXES = ("x", "y", "z")
REAL_ROLES = (*AXES, "intensity")
# sensor_msgs/PointField: datatypes by numpy's names of types.
FIELD_NUMBERS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
# A field that is not there.
_NONE = (0, 0)


@dataclass(frozen=True, slots=True)
class TakenRows:
    """Points that were kept, in their order; placed: number of rows that have a place.

    reals: (4, n) float32, x, y, z in m and intensity, 0 where there is no finite one; fields: (n,)
    the other fields by role.
    """

    reals: F32Array
    fields: dict[str, npt.NDArray[Any]]
    placed: int


def take_rows(rows: Rows) -> TakenRows:
    """The points of rows (n,)."""
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
        *(rows.strides[0], real_at, real_type, FIELD_NUMBERS[known["time"][0].str[1:]]),
        *(len(roles), field_at, field_bytes, count, reals, targets, placed),
    )
    return TakenRows(
        reals[:, :kept], {role: field[:kept] for role, field in fields.items()}, int(placed[0])
    )


def field_of(known: dict[str, Any], name: str) -> tuple[int, int]:
    """Byte in a row and number of the type of a field."""
    if name not in known:
        return _NONE
    dtype, first = known[name][:2]
    return first, FIELD_NUMBERS[dtype.str[1:]]


# -- at once --------------------------------------------------------------------------------------

# In the order of `clouds.c`, and types that these fields may have; None: any.
_ROLES = (*AXES, "intensity", "ring", "return_type", "tag")
_TYPES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(AXES, ("f4",)),
    "ring": ("u1", "u2"),
    "return_type": ("u1",),
    "tag": ("u1",),
    "time": ("i4", "u4", "f4", "f8"),
}
# As in `clouds.c`.
_MOST_RUNS = 512
# Distinct times of the points of a cloud that are followed.
_MOST_TIMES = 1 << 15

# Stamps (n,) of times (n,), and their meaning.
Stamps: TypeAlias = Callable[[npt.NDArray[Any]], tuple[I64Array, str]]
# Memory (packets, bytes) for packets, with any content.
Room: TypeAlias = Callable[[int, int], U8Array]


class PackedRows(NamedTuple):
    """Packets (P, size) of a message; placed: rows with a place; points: placed rows with a time.

    content_key: (P,) as `lidar.headers.content_keys`, None without factors.
    """

    packets: U8Array
    content_key: I64Array | None
    time_meaning: str
    placed: int
    points: int


class _Form:
    """Fields of rows of one dtype, for the loops.

    is_usual: whether the loops read them; the others are only set if they do.
    """

    def __init__(self, dtype: np.dtype[Any]) -> None:
        known = dict(dtype.fields or {})
        self.dtype = dtype
        self.is_usual = _is_usual(known)
        if not self.is_usual:
            return
        fields = np.array([field_of(known, role) for role in _ROLES], np.int64)
        self.fields_at, self.types = fields.T.copy()
        self.time_at, self.time_type = field_of(known, "time")
        self.time_kind = known["time"][0]


class RowPacker:
    """Packs the rows of messages; its scratch arrays are used again."""

    def __init__(self) -> None:
        self._times: npt.NDArray[np.uint64] = np.empty(_MOST_TIMES, np.uint64)
        self._number: npt.NDArray[np.int32] = np.empty(0, np.int32)
        # By order, whether they are used, ranks, begins of runs; and figures.
        self._scratch: tuple[npt.NDArray[Any], ...] = (
            np.empty(_MOST_TIMES, np.int32),
            np.empty(_MOST_TIMES, np.uint8),
            np.empty(_MOST_TIMES + 1, np.int32),
            np.empty(_MOST_RUNS + 1, np.int64),
            np.empty(3, np.int64),
        )
        self._form = _Form(np.dtype([]))

    def pack(
        self,
        rows: Rows,
        stamps: Stamps,
        layout: Layout,
        message_bytes: int,
        room: Room,
        factors: U64Array | None = None,
    ) -> PackedRows | None:
        """Packets of rows (n,) by ring; None where these are unusual. CloudError as `pack`.

        factors: (layout.size // 8,) of their words in content keys, or None.
        """
        if not layout.by_ring or not len(rows):
            return None
        if rows.dtype is not self._form.dtype:
            self._form = _Form(rows.dtype)
        form = self._form
        if not form.is_usual:
            return None
        loops = library()
        if len(rows) > len(self._number):
            self._number = np.empty(len(rows), np.int32)
        # Not by `__array_interface__`, which describes all fields.
        rows_at = rows.ctypes.data
        columns = loops.mlbatch_cloud_times(
            *(len(rows), rows_at, rows.strides[0], form.fields_at, form.time_at, form.time_type),
            *(_MOST_TIMES, self._times, self._number, *self._scratch),
        )
        placed, points, runs = self._scratch[-1].tolist()
        # One time for all points is an error elsewhere.
        if columns < 2:
            return None
        stamp_ns, meaning = stamps(self._times.view(form.time_kind)[:columns])
        # Times in s may be the same in ns.
        if not bool((stamp_ns[1:] > stamp_ns[:-1]).all()):
            return None
        check_columns(columns, points, layout, message_bytes)
        packets = room(columns, layout.size)
        content_key = np.empty(columns, np.int64)
        _, _, ranks, begins, _ = self._scratch
        is_packed = loops.mlbatch_cloud_fill(
            *(rows_at, rows.strides[0], form.fields_at, form.types, runs, begins),
            *(self._number, ranks, columns, stamp_ns, _head_of(layout)),
            *(layout.slots, layout.size, factors, packets, content_key),
        )
        if not is_packed:
            return None
        known_key = None if factors is None else content_key
        return PackedRows(packets, known_key, meaning, placed, points)


@lru_cache(maxsize=16)
def _head_of(layout: Layout) -> npt.NDArray[np.void]:
    return layout.begin


def _is_usual(known: dict[str, Any]) -> bool:
    """Whether the loops read all fields of rows; of clouds of one lidar."""
    if "lidar_id" in known or not {*AXES, "ring", "time"} <= known.keys():
        return False
    return all(known[role][0].str[1:] in types for role, types in _TYPES.items() if role in known)
