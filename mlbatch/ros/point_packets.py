"""mlbatch's own packet format for points of decoded clouds: one column per packet.

Points that share a timestamp are a column. A packet contains one column, so that none is padded
with columns that nobody measured, and every column is counted. Layout, little endian (version 1): a
head of 24 bytes, then planes of B slots each: x, y, z (m), intensity (float32), ring (uint16),
return type and tag (uint8); zeros up to a multiple of 8 bytes. A slot at x = y = z = 0 is empty.
Version 2 ends with a plane of labels (int64): time after the stamp, ns (32 bits), ring (16), return
type (8).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F32Array, I64Array, U8Array, U16Array
from mlbatch.errors import RecordingError
from mlbatch.native.library import library

MAGIC = int.from_bytes(b"MLPC", "little")
VERSION = 1
WITH_LABELS = 2
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
# A later cloud with more distinct times than the first one must not fill the memory.
_MOST_GROWTH = 32
_FREE_BYTES = 16 << 20


class CloudError(RecordingError):
    """A cloud that cannot be used."""


@dataclass(frozen=True, slots=True)
class Points:
    """n points of one message that have a place and a time, in its order.

    stamp_ns: (n,) int64; reals: (4, n) float32, x, y, z in m and intensity; ring: (n,) uint16, or
    None without such a field; return_type, tag: (n,) uint8; label: (n,) int64 as in packets of
    version 2, or None.
    """

    stamp_ns: I64Array
    reals: F32Array
    ring: U16Array | None
    return_type: U8Array
    tag: U8Array
    label: I64Array | None = None

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
            None if self.label is None else self.label[index],
        )


@dataclass(frozen=True, slots=True)
class Layout:
    """Packets of a topic; kind: index into CLOUDS.

    slots: most points of a column; by_ring: the slot of a point is its ring, else its order;
    has_labels: packets of version 2.
    """

    kind: int
    slots: int
    by_ring: bool = False
    has_labels: bool = False

    def __str__(self) -> str:
        if self.slots == 1:
            return "every point is a column"
        return f"up to {self.slots} points per column {'by ring' if self.by_ring else 'in turn'}"

    @property
    def labels_at(self) -> int:
        """First byte of the labels."""
        return -(-(HEAD.itemsize + self.slots * _SLOT_BYTES) // 8) * 8

    @property
    def size(self) -> int:
        """Bytes of a packet."""
        return self.labels_at + 8 * self.slots * self.has_labels

    @property
    def begin(self) -> npt.NDArray[np.void]:
        """The head, (1,), with the fields that all packets share."""
        head = np.zeros(1, HEAD)
        head["magic"] = MAGIC
        head["version"] = WITH_LABELS if self.has_labels else VERSION
        head["kind"] = self.kind
        head["slots"] = self.slots
        head["by_ring"] = self.by_ring
        return head


def layout_of(points: Points, kind: int) -> Layout:
    """The layout for the first cloud of a topic, and then for all of them."""
    if points.ring is not None and int(points.ring.max()) < MOST_SLOTS:
        rings = int(points.ring.max()) + 1
        by_ring = Layout(kind, next(s for s in _RING_SLOTS if s >= rings), by_ring=True)
        if by_ring.slots * _placed(points, by_ring).columns <= _MOST_PER_POINT * len(points):
            return by_ring
    # A column for each stamp.
    stamps = _placed(points, Layout(kind, len(points)))
    if stamps.columns == 1:
        return Layout(kind, min(len(points), _DEFAULT_SLOTS))
    widest = int(np.bincount(stamps.column).max())
    # Few long runs among short ones are split, so that most slots are used.
    usual = 2 * len(points) // stamps.columns - 1
    return Layout(kind, min(widest, usual, MOST_SLOTS))


def pack(points: Points, layout: Layout, message_bytes: int) -> U8Array:
    """Packets (P, layout.size) of the points of one message, columns in order of time.

    With slots by ring, all rings are below `layout.slots`.
    """
    placed = _placed(points, layout)
    columns = placed.columns
    check_columns(columns, len(points), layout, message_bytes)
    packets = np.zeros((columns, layout.size), np.uint8)
    packets[:, : HEAD.itemsize] = layout.begin.view(np.uint8)
    reals = points.reals
    if reals.strides[1] != reals.itemsize:
        reals = np.ascontiguousarray(reals)
    ring = None if points.ring is None else np.ascontiguousarray(points.ring)
    library().mlbatch_cloud_pack(
        *(len(points), placed.order, placed.column, placed.slot),
        *(np.ascontiguousarray(points.stamp_ns), reals.strides[0] // reals.itemsize),
        *(reals.__array_interface__["data"][0], ring),
        *map(np.ascontiguousarray, (points.return_type, points.tag)),
        *(layout.slots, layout.size, columns, np.zeros(columns, np.uint16), packets),
    )
    if points.label is not None:
        labels = packets[:, layout.labels_at :].view(np.int64)
        labels[placed.column, placed.slot] = (
            points.label if placed.order is None else points.label[placed.order]
        )
    return packets


def check_columns(columns: int, points: int, layout: Layout, message_bytes: int) -> None:
    """CloudError where so many columns of a message would fill the memory."""
    if columns * layout.size > _MOST_GROWTH * message_bytes + _FREE_BYTES:
        raise CloudError(
            f"expected points that share times as in the first cloud (up to {layout.slots} one), "
            f"found {columns} times for {points} points; record the clouds of one driver alone"
        )


class _Placed(NamedTuple):
    """Column and slot of points (n,), by `order` (None: their own); columns: their number."""

    columns: int
    column: npt.NDArray[np.int32]
    slot: U16Array
    order: I64Array | None


def _placed(points: Points, layout: Layout) -> _Placed:
    """Points by stamp, then ring, then message order, in columns."""
    count = len(points)
    stamp_ns = np.ascontiguousarray(points.stamp_ns)
    ring = None if points.ring is None else np.ascontiguousarray(points.ring)
    order = _order(stamp_ns, ring)
    column = np.empty(count, np.int32)
    slot: U16Array = np.empty(count, np.uint16)
    columns = library().mlbatch_cloud_columns(
        count, stamp_ns, ring, order, layout.slots, layout.by_ring, column, slot
    )
    return _Placed(columns, column, slot, order)


def _order(stamp_ns: I64Array, ring: U16Array | None) -> I64Array | None:
    """Numbers of points by stamp, then ring, then their order; None if they are in this order."""
    falls = stamp_ns[1:] < stamp_ns[:-1]
    if ring is not None:
        falls |= (stamp_ns[1:] == stamp_ns[:-1]) & (ring[1:] < ring[:-1])
    if not falls.any():
        return None
    low_ns = int(stamp_ns.min())
    ring_bits = 0 if ring is None else int(ring.max()).bit_length()
    number_bits = len(stamp_ns).bit_length()
    key_bits = (int(stamp_ns.max()) - low_ns).bit_length() + ring_bits
    if key_bits + number_bits > 64:
        # Stamps so far apart that no word takes them with ring and number.
        keys = (stamp_ns,) if ring is None else (ring, stamp_ns)
        return np.asarray(np.lexsort(keys), np.int64)
    # Stamp, ring and number in one word: all differ, so that the fastest sort is a stable one.
    words = (stamp_ns - low_ns).astype(np.uint64) << np.uint64(ring_bits)
    if ring is not None:
        words |= ring
    words = words << np.uint64(number_bits) | np.arange(len(words), dtype=np.uint64)
    words.sort()
    return np.asarray(words & np.uint64((1 << number_bits) - 1), np.int64)
