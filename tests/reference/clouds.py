"""Clouds literally: which rows are points, and their packets, point by point."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np

from mlbatch.arrays import BoolArray, F32Array, U8Array
from mlbatch.ros.point_packets import Layout, Points
from mlbatch.ros.point_rows import REAL_ROLES, Rows, TakenRows

_Slots = dict[int, int]


def taken_rows(rows: Rows) -> TakenRows:
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


def packets_of(points: Points, layout: Layout) -> U8Array:
    """Packets (P, size): a column for each stamp, and more where a slot is taken."""
    rings = [0] * len(points) if points.ring is None else points.ring.tolist()
    stamps = points.stamp_ns.tolist()
    order = sorted(range(len(points)), key=lambda point: (stamps[point], rings[point], point))
    columns: list[tuple[int, _Slots]] = []
    for stamp, same in groupby(order, key=stamps.__getitem__):
        layers: list[_Slots] = []
        for rank, point in enumerate(same):
            slot = rings[point] if layout.by_ring else rank % layout.slots
            free = next((layer for layer in layers if slot not in layer), None)
            if free is None:
                free = {}
                layers.append(free)
            free[slot] = point
        columns += [(stamp, layer) for layer in layers]
    planes = (*points.reals, np.array(rings, np.uint16), points.return_type, points.tag)
    packets = [_packet(planes, layout, number, *one) for number, one in enumerate(columns)]
    return np.frombuffer(b"".join(packets), np.uint8).reshape(len(packets), layout.size)


def _packet(planes: Sequence[Any], layout: Layout, number: int, stamp: int, slots: _Slots) -> bytes:
    """Version 1 of the format in `ros/point_packets.py`, field by field."""
    fixed = (1, layout.kind, layout.slots, stamp, number, len(slots), layout.by_ring, 0)
    parts = [b"MLPC", struct.pack("<BBHqIHBB", *fixed)]
    filled = [slots.get(slot) for slot in range(layout.slots)]
    for plane in planes:
        empty = bytes(plane.dtype.itemsize)
        parts += [empty if point is None else plane[point].tobytes() for point in filled]
    content = b"".join(parts)
    return content + bytes(-len(content) % 8)
