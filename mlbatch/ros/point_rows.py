"""Rows of a decoded cloud to arrays: the points that have a place and a finite time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F32Array

# A structured array, fields named by role; numpy has no type for the fields of a dtype.
Rows: TypeAlias = npt.NDArray[Any]
AXES = ("x", "y", "z")
REAL_ROLES = (*AXES, "intensity")


@dataclass(frozen=True, slots=True)
class TakenRows:
    """Points that were kept, in their order; placed: number of rows that have a place.

    reals: (4, n) float32, x, y, z in m and intensity, 0 where there is no finite one; fields: (n,)
    the other fields by role.
    """

    reals: F32Array
    fields: dict[str, npt.NDArray[Any]]
    placed: int


# Takes the points of rows (n,); `ros.native_points` has a compiled one.
Take: TypeAlias = Callable[[Rows], TakenRows]


def take_rows(rows: Rows) -> TakenRows:
    """The points of rows (n,)."""
    reals = _reals(rows)
    x, y, z, _ = reals
    with np.errstate(over="ignore", invalid="ignore"):
        squared = x * x + y * y + z * z
    keep: BoolArray = (squared > 0) & (squared < np.inf)
    placed = int(np.count_nonzero(keep))
    time = np.ascontiguousarray(rows["time"])
    if time.dtype.kind == "f":
        keep &= np.isfinite(time)
    fields = {role: rows[role] for role in rows.dtype.names or () if role not in REAL_ROLES}
    fields["time"] = time
    if keep.all():
        return TakenRows(reals, {key: field.copy() for key, field in fields.items()}, placed)
    # An index is several times faster than a mask.
    index = keep.nonzero()[0]
    kept = {role: field.take(index) for role, field in fields.items()}
    return TakenRows(reals.take(index, axis=1), kept, placed)


def _reals(rows: Rows) -> F32Array:
    """x, y, z and intensity, (4, n)."""
    reals = np.zeros((len(REAL_ROLES), len(rows)), np.float32)
    # A place beyond all float32 is infinite, and is left out as such.
    with np.errstate(over="ignore", invalid="ignore"):
        for plane, name in zip(reals, REAL_ROLES, strict=True):
            if name in (rows.dtype.names or ()):
                plane[:] = rows[name]
    intensity = reals[3]
    intensity[~np.isfinite(intensity)] = 0
    return reals
