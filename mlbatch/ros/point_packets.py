"""An own packet format for points of decoded clouds: one column per packet.

Points that share a timestamp are a column. A packet contains one column, so that none is padded
with columns that nobody measured, and every column is counted. Layout, little endian (version 1): a
head of 24 bytes, then planes of B slots each: x, y, z (m), intensity (float32), ring (uint16),
return type and tag (uint8); zeros up to a multiple of 8 bytes. A slot at x = y = z = 0 is empty.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F32Array, I64Array, U8Array, U16Array
from mlbatch.errors import RecordingError

# Source of the points, by its number in packets.
KINDS = ("PointCloud2", "CustomMsg")
MAGIC = int.from_bytes(b"MLPC", "little")
VERSION = 1
# `number`: of the column in its message, so that equal columns of one message stay distinct.
HEAD = np.dtype(
    [
        ("magic", "<u4"),
        ("version", "u1"),
        ("kind", "u1"),
        ("slots", "<u2"),
        ("stamp_ns", "<i8"),
        ("number", "<u4"),
        ("count", "<u2"),
        ("by_ring", "u1"),
        ("spare", "u1"),
    ]
)
REALS = 4  # x, y, z, intensity
_SLOT_BYTES = 4 * REALS + 2 + 1 + 1
MOST_SLOTS = 256
# By ring only where at least a quarter of the slots would be used.
_RING_SLOTS = (16, 32, 64, 128, MOST_SLOTS)
_MOST_PER_POINT = 4
# If all points of the first cloud have one time, it says nothing about columns.
_DEFAULT_SLOTS = 16
# A cloud whose points share fewer times than those of the first one must not fill the memory.
_MOST_GROWTH = 32
_FREE_BYTES = 16 << 20


class CloudError(RecordingError):
    """A cloud that cannot be used."""


@dataclass(frozen=True, slots=True)
class Points:
    """n points of one message that have a place and a time, in its order.

    stamp_ns: (n,) int64; reals: (4, n) float32, x, y, z in m and intensity; ring: (n,) uint16, or
    None without such a field; return_type, tag: (n,) uint8.
    """

    stamp_ns: I64Array
    reals: F32Array
    ring: U16Array | None
    return_type: U8Array
    tag: U8Array

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def take(self, index: BoolArray | I64Array) -> Points:
        """The points at `index`."""
        return Points(
            self.stamp_ns[index],
            self.reals[:, index],
            None if self.ring is None else self.ring[index],
            self.return_type[index],
            self.tag[index],
        )


@dataclass(frozen=True, slots=True)
class Layout:
    """Packets of a topic; kind: index into KINDS.

    slots: most points of a column; by_ring: the slot of a point is its ring, else its order.
    """

    kind: int
    slots: int
    by_ring: bool = False

    def __str__(self) -> str:
        if self.slots == 1:
            return "every point is a column"
        return f"up to {self.slots} points a column {'by ring' if self.by_ring else 'in turn'}"

    @property
    def size(self) -> int:
        """Bytes of a packet."""
        return -(-(HEAD.itemsize + self.slots * _SLOT_BYTES) // 8) * 8

    @property
    def begin(self) -> npt.NDArray[np.void]:
        """The head, (1,), with the fields that all packets share."""
        head = np.zeros(1, HEAD)
        head["magic"] = MAGIC
        head["version"] = VERSION
        head["kind"] = self.kind
        head["slots"] = self.slots
        head["by_ring"] = self.by_ring
        return head


def layout_of(points: Points, kind: int) -> Layout:
    """The layout for the first cloud of a topic, and then for all of them."""
    order, is_first = _by_stamp(points)
    if points.ring is not None and int(points.ring.max()) < MOST_SLOTS:
        rings = int(points.ring.max()) + 1
        slots = next(slots for slots in _RING_SLOTS if slots >= rings)
        column = _column(_same_ring(points.ring[order], is_first), is_first)
        if slots * (int(column.max()) + 1) <= _MOST_PER_POINT * len(points):
            return Layout(kind, slots, by_ring=True)
    starts = is_first.nonzero()[0]
    if len(starts) == 1:
        return Layout(kind, min(len(points), _DEFAULT_SLOTS))
    widest = int(np.diff(starts, append=len(points)).max())
    # Few long runs among short ones are split, so that most slots are used.
    usual = 2 * len(points) // len(starts) - 1
    return Layout(kind, min(widest, usual, MOST_SLOTS))


# Packs the points of one message; `ros.native_points` has a compiled one.
Pack: TypeAlias = Callable[["Points", "Layout", int], U8Array]


def pack(points: Points, layout: Layout, message_bytes: int) -> U8Array:
    """Packets (P, layout.size) of the points of one message, columns in order of time.

    With slots by ring, all rings are below `layout.slots`.
    """
    order, is_first = _by_stamp(points)
    rings = np.zeros(len(points), np.uint16) if points.ring is None else points.ring
    if layout.by_ring:
        slot = rings[order].astype(np.int64)
        column = _column(_same_ring(slot, is_first), is_first)
    else:
        rank = _rank(is_first)
        slot = rank % layout.slots
        column = _column(rank // layout.slots, is_first)
    # The last ring of the last time may have fewer points than others.
    columns = int(column.max()) + 1
    size = layout.size
    check_columns(columns, len(points), layout, message_bytes)
    packets = np.zeros((columns, size), np.uint8)
    head = packets[:, : HEAD.itemsize].view(HEAD)[:, 0]
    head[:] = layout.begin
    head["number"] = np.arange(columns)
    head["stamp_ns"][column] = points.stamp_ns[order]
    head["count"] = np.bincount(column)
    flat = packets.reshape(-1)
    at = HEAD.itemsize
    for plane in (*points.reals, rings, points.return_type, points.tag):
        width = plane.dtype.itemsize
        place = column * (size // width) + (at // width + slot)
        flat.view(plane.dtype.newbyteorder("<"))[place] = plane[order]
        at += width * layout.slots
    return packets


def check_columns(columns: int, points: int, layout: Layout, message_bytes: int) -> None:
    """CloudError where so many columns of a message would fill the memory."""
    if columns * layout.size > _MOST_GROWTH * message_bytes + _FREE_BYTES:
        raise CloudError(
            f"expected points that share times as in the first cloud (up to {layout.slots} one), "
            f"found {columns} times for {points} points; record the clouds of one driver alone"
        )


def _by_stamp(points: Points) -> tuple[I64Array, BoolArray]:
    """Points by stamp, then ring, then message order: their order, and which begin a new stamp.

    The stamps are within seconds, so that a ring fits below them in 64 bits.
    """
    key = (points.stamp_ns - points.stamp_ns.min()) << 16
    if points.ring is not None:
        key |= points.ring
    order: I64Array = np.arange(len(key))
    if bool((key[1:] < key[:-1]).any()):
        order = np.argsort(key, kind="stable")
    stamp_ns = points.stamp_ns[order]
    is_first = np.ones(len(key), np.bool_)
    np.not_equal(stamp_ns[1:], stamp_ns[:-1], out=is_first[1:])
    return order, is_first


def _rank(is_first: BoolArray) -> I64Array:
    """Place of each element in its run; runs begin where `is_first`."""
    place = np.arange(len(is_first))
    begin: I64Array = np.maximum.accumulate(np.where(is_first, place, 0))
    return place - begin


def _same_ring(ring: U16Array | I64Array, is_first: BoolArray) -> I64Array:
    """Number of earlier points of each point's run on its ring; rings rise in a run."""
    begins = is_first.copy()
    begins[1:] |= ring[1:] != ring[:-1]
    return _rank(begins)


def _column(layer: I64Array, is_first: BoolArray) -> I64Array:
    """Column of each point; each run takes as many columns as it has layers."""
    columns = np.maximum.reduceat(layer, is_first.nonzero()[0]) + 1
    before = np.cumsum(columns) - columns
    column: I64Array = before[np.cumsum(is_first) - 1] + layer
    return column
