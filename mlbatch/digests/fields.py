"""Arrays of a scan, and their description in a golden file."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.digests.values import Json, mean, values
from mlbatch.outputs.scan import Scan

Values: TypeAlias = npt.NDArray[Any]

POINT_FIELDS = (
    *("xyz", "intensity", "reflectivity", "range_m", "time_ns", "ring", "return_type"),
    *("lidar_id", "column"),
)
COLUMN_FIELDS = ("column_stamp_ns", "column_lidar_id")
_DIGITS = 16
# Places of the four points, as parts of the number of points.
_PARTS = 3


def fields_of(scan: Scan) -> Iterator[tuple[str, Values]]:
    """Name and values of each array that the output stores; of organized scans with empty slots."""
    for name in (*POINT_FIELDS, *COLUMN_FIELDS):
        array = getattr(scan, name)
        if array is not None and name not in scan.absent:
            yield name, array


def describe(array: Values, valid: npt.NDArray[np.bool_] | None) -> dict[str, Json]:
    """A checksum of all values; mean, least, largest and four of the valid ones (None: all)."""
    found: dict[str, Json] = {"sha256": checksum(array)}
    kept = array if valid is None else array[valid]
    if len(kept):
        last = len(kept) - 1
        samples = [last * part // _PARTS for part in range(_PARTS + 1)]
        found["mean"] = mean(kept)
        found["min"] = values(kept.min(axis=0))
        found["max"] = values(kept.max(axis=0))
        found["samples"] = values(kept[samples])
    return found


def checksum(array: Values) -> str:
    """The first digits of the SHA-256 of the values, in little endian."""
    data = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    return hashlib.sha256(data.data).hexdigest()[:_DIGITS]
