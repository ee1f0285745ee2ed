"""Rows of a decoded cloud to arrays: the points that have a place and a finite time."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F32Array
from mlbatch.native.library import address, library

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
        rows.strides[0],
        address(real_at),
        address(real_type),
        FIELD_NUMBERS[known["time"][0].str[1:]],
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
        return _NONE
    dtype, first = known[name][:2]
    return first, FIELD_NUMBERS[dtype.str[1:]]
