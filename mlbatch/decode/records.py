"""Point records by the compiled packer (`native/pack.c`): of a decoder, or of a scan's arrays."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import U8Array
from mlbatch.decode.scan_buffer import LABEL
from mlbatch.native import library as native
from mlbatch.native.library import address, library
from mlbatch.types import RECORD_KINDS, PackedTotals, RecordLayout, Scan
from mlbatch.units import NS_PER_S

# Items of the arrays of a scan, as `decode/scan_buffer.py` has them.
POINT = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")])
_RANGE = np.dtype([("range_m", "<f4")])
_REFLECTIVITY = np.dtype([("reflectivity", "<u2")])


class RecordPacker:
    """Packs points to the records of a layout."""

    def __init__(self, record: RecordLayout, *, has_reflectivity: bool = True) -> None:
        """has_reflectivity: without a sensor that has reflectivities they stay 0."""
        pieces = [
            native.Piece(RECORD_KINDS.index(piece.kind), piece.offset, piece.source, piece.bytes)
            for piece in record.pieces
            if has_reflectivity or piece.kind != "reflectivity"
        ]
        self.record = record
        self.kinds = frozenset(RECORD_KINDS[piece.kind] for piece in pieces)
        self._pieces = (native.Piece * len(pieces))(*pieces)
        self._totals = native.Totals()

    def describe(self, scan: native.Scan) -> None:
        """Point a struct to the pieces and the totals."""
        scan.record_bytes = self.record.step
        scan.piece_count = len(self._pieces)
        scan.pieces = self._pieces
        scan.totals = self._totals

    def start(self, scan: native.Scan, start_ns: int, timescale: str) -> None:
        """Set the start of a scan, and begin its totals."""
        epoch_s = self.record.epoch_s
        scan.start_ns = start_ns
        scan.stamp_start_ns = start_ns
        if epoch_s is not None:
            scan.stamp_start_ns = start_ns - epoch_s(timescale, start_ns) * NS_PER_S
        totals = self._totals
        totals.low[:], totals.high[:] = [math.inf] * 4, [-math.inf] * 4
        totals.second = 0

    @property
    def totals(self) -> PackedTotals | None:
        """Totals of the points since `start`; None if the layout has none."""
        if "las" not in self.kinds:
            return None
        low, high = self._totals.low, self._totals.high
        return PackedTotals(tuple(low[:3]), tuple(high[:3]), self._totals.second)

    def pack(self, scan: Scan, out: U8Array) -> None:
        """Pack the arrays of a scan; out: bytes of the records, those between pieces are kept.

        Records of organized scans are in rows of slots.
        """
        struct = native.Scan()
        self.describe(struct)
        self.start(struct, scan.start_ns, scan.info.timescale)
        columns, *rest = scan.time_ns.shape
        slots = math.prod(rest)
        arrays = [
            _side_by_side(POINT, *np.moveaxis(scan.xyz, -1, 0), scan.intensity),
            _side_by_side(LABEL, scan.time_ns, scan.ring, scan.return_type, scan.lidar_id),
            None if scan.range_m is None else _side_by_side(_RANGE, scan.range_m),
            None if scan.reflectivity is None else _side_by_side(_REFLECTIVITY, scan.reflectivity),
        ]
        for slot in range(slots if columns else 0):
            places = (None if one is None else one.first + slot * one.step for one in arrays)
            rows = native.Rows(*places, slots)
            records = address(out) + slot * columns * self.record.step
            library().mlbatch_pack(struct, rows, columns, records)


class _Items(NamedTuple):
    """Items in memory: address of the first, bytes of each; kept: the arrays."""

    first: int
    step: int
    kept: Any


def _side_by_side(dtype: np.dtype[Any], *parts: npt.NDArray[Any]) -> _Items:
    """Return the parts of items as items: where they are, if they are side by side, or copied."""
    names = dtype.names or ()
    shape = parts[0].shape
    strides = tuple(dtype.itemsize * math.prod(shape[axis + 1 :]) for axis in range(len(shape)))
    first = int(parts[0].__array_interface__["data"][0])
    for name, part in zip(names, parts, strict=True):
        kind, offset = dtype.fields[name][:2] if dtype.fields else (dtype, 0)
        at = int(part.__array_interface__["data"][0])
        if (part.dtype, part.strides, at - first) != (kind, strides, offset):
            break
    else:
        return _Items(first, dtype.itemsize, parts)
    items = np.empty(shape, dtype)
    for name, part in zip(names, parts, strict=True):
        items[name] = part
    return _Items(int(items.__array_interface__["data"][0]), dtype.itemsize, items)
