"""The messages of an SQLite file straight from its pages, many rows at once.

Source: sqlite.org/fileformat2.html, sections 1.6 (pages of b-trees, overflow) and 2.1 (records).
The library needs one call for each page and each row, twice as long as this. Recorders append, so
that rows, and the pages that a row overflows into, follow each other in the file; whatever is laid
out in another way is left to the library (`HandOver`).
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from io import FileIO

import numpy as np

from mlbatch.readers.byte_records import SLACK, copy_runs, records
from mlbatch.types import BoolArray, I64Array, U8Array

WINDOW_BYTES = 4 << 20
_INTERIOR, _LEAF = 5, 13
_HEAD_BYTES, _INTERIOR_HEAD_BYTES = 8, 12
_MAX_DEPTH = 20
# Bytes of values by their serial type; texts and blobs begin at 12, blobs are even.
_SIZES = np.array([0, 1, 2, 3, 4, 6, 8, 8, 0, 0, 0, 0], np.int64)
_FLOAT, _ZERO, _ONE, _BLOB = 7, 8, 9, 12
_U16, _U32, _I64 = (np.dtype([("value", code)]) for code in (">u2", ">u4", ">i8"))
# So much may be read in vain (bytes of topics that nobody asked for) before the library is faster.
_WASTE_BYTES, _WASTE_SHARE = 32 << 20, 4


class HandOver(Exception):
    """Pages that the library has to read; it knows more, or tells what is wrong with them."""


@dataclass(frozen=True, slots=True)
class Rows:
    """n rows in the order of their numbers; what is wanted of them lies in a buffer.

    number, topic, log_ns: (n,) int64; wanted: (n,) bool; start, size: (w,) int64, the bytes of
    those that are wanted.
    """

    number: I64Array
    topic: I64Array
    log_ns: I64Array
    wanted: BoolArray
    start: I64Array
    size: I64Array


@dataclass(frozen=True, slots=True)
class _Cells:
    """Cells of leaves: leaf, number, record (place), local, payload (bytes): (n,) int64."""

    leaf: I64Array
    number: I64Array
    record: I64Array
    local: I64Array
    payload: I64Array


@dataclass(slots=True)
class Table:
    """The table `messages` (id, topic_id, timestamp, data); usable: bytes of a page in use."""

    file: FileIO
    page_bytes: int
    usable: int
    root: int

    def rows(self, topics: I64Array, out: U8Array) -> Generator[Rows, None, None]:
        """All rows; the bytes of those of `topics` are copied to `out`, of WINDOW_BYTES."""
        window = np.zeros(WINDOW_BYTES + SLACK, np.uint8)
        read = used = 0
        for leaves in self._leaves(self.root, _MAX_DEPTH):
            at = 0
            while at < len(leaves):
                first = self._first_page(window, int(leaves[at]))
                pages = self._fill(window, first, leaves[at:])
                near = leaves[at:] - first
                outside = np.flatnonzero((near < 0) | (near >= pages))
                near = near[: int(outside[0]) if len(outside) else None]
                done, rows = self._parse(window, pages, near, first, topics, out)
                read, used = read + pages * self.page_bytes, used + int(rows.size.sum())
                if not done or read > _WASTE_SHARE * used + _WASTE_BYTES:
                    raise HandOver
                at += done
                yield rows

    def _first_page(self, window: U8Array, leaf: int) -> int:
        """The first page that rows of a leaf overflow into, or the leaf's own.

        A leaf is begun when a row did not fit into the one before; that row's other pages were
        written already.
        """
        self._read(window, leaf, 1)
        cells = self._cells(window, np.zeros(1, np.int64), most=1)
        if not len(cells.leaf) or cells.payload[0] <= cells.local[0]:
            return leaf
        return min(leaf, int(_number(window, _U32, cells.record + cells.local)[0]))

    def _fill(self, window: U8Array, first: int, leaves: I64Array) -> int:
        """Read pages from the first on, as many as are of interest; return how many."""
        most = WINDOW_BYTES // self.page_bytes
        last = int(leaves[-1]) - first
        # Behind the last leaf lie the pages that its rows overflow into.
        behind = 2 * int(np.diff(leaves[-2:]).max(initial=8))
        return self._read(window, first, most if last < 0 else min(most, last + behind))

    def _read(self, window: U8Array, page: int, count: int) -> int:
        """Read pages; return how many there are."""
        if page < 2:  # The first one holds the schema.
            raise HandOver
        self.file.seek((page - 1) * self.page_bytes)
        view, done = window.data[: count * self.page_bytes], 0
        while done < len(view) and (got := self.file.readinto(view[done:])):
            done += got
        return done // self.page_bytes

    def _leaves(self, page: int, depth: int) -> Generator[I64Array, None, None]:
        """Numbers of the leaves in order, those of one interior page at a time."""
        data = np.zeros(self.page_bytes + SLACK, np.uint8)
        if not depth or not self._read(data, page, 1):
            raise HandOver
        if data[0] == _LEAF:
            yield np.array([page], np.int64)
            return
        cells = int(_number(data, _U16, np.array([3]))[0])
        if data[0] != _INTERIOR or _INTERIOR_HEAD_BYTES + 2 * cells > self.page_bytes:
            raise HandOver
        place = _number(data, _U16, _INTERIOR_HEAD_BYTES + 2 * np.arange(cells))
        if (place > self.page_bytes - 4).any():
            raise HandOver
        children = _number(data, _U32, np.append(place, _HEAD_BYTES))
        self._read(data, int(children[0]), 1)
        if data[0] == _LEAF:  # All leaves of a tree lie equally deep.
            yield children
            return
        for child in children.tolist():
            yield from self._leaves(child, depth - 1)

    def _parse(
        self,
        window: U8Array,
        pages: int,
        near: I64Array,
        first: int,
        topics: I64Array,
        out: U8Array,
    ) -> tuple[int, Rows]:
        """Rows of the leaves `near` (pages of the window), and how many leaves are whole."""
        cells = self._cells(window, near)
        topic, log_ns, blob, size = self._values(window, cells)
        wanted = (topic[:, None] == topics).any(axis=1)
        spilled = (cells.payload - cells.local + self.usable - 5) // (self.usable - 4)
        page = np.zeros(len(cells.leaf), np.int64)
        over = spilled > 0
        page[over] = _number(window, _U32, (cells.record + cells.local)[over]) - first
        missing = wanted & over & ((page < 0) | (page + spilled > pages))
        done = int(cells.leaf[missing].min()) if missing.any() else len(near)
        keep = np.flatnonzero(cells.leaf < done)
        pick = keep[wanted[keep]]
        here = np.minimum(cells.local - blob, size)[pick]
        begin = cells.record[pick] + blob[pick]
        self._copy(window, first, begin, here, page[pick], spilled[pick], size[pick], out)
        start = np.cumsum(size[pick]) - size[pick]
        return done, Rows(
            cells.number[keep], topic[keep], log_ns[keep], wanted[keep], start, size[pick]
        )

    def _copy(
        self,
        window: U8Array,
        first: int,
        begin: I64Array,
        here: I64Array,
        page: I64Array,
        spilled: I64Array,
        size: I64Array,
        out: U8Array,
    ) -> None:
        """Copy bytes that begin at `begin`, `here` of them, and go on in pages from `page` on."""
        room, at = self.usable - 4, np.cumsum(size) - size
        if int(size.sum()) > len(out):
            raise HandOver
        row = np.repeat(np.arange(len(size)), spilled)
        nth = np.arange(len(row)) - np.repeat(np.cumsum(spilled) - spilled, spilled)
        link = (page[row] + nth) * self.page_bytes
        # Each page names the next; the last one's word is of no interest.
        goes_on = nth + 1 < spilled[row]
        told = _number(window, _U32, link[goes_on]) - first
        if (told != (page[row] + nth + 1)[goes_on]).any():
            raise HandOver
        rest = (size - here)[row] - nth * room
        copy_runs(
            window,
            np.concatenate([begin, link + 4]),
            np.concatenate([here, np.minimum(rest, room)]),
            out,
            np.concatenate([at, (at + here)[row] + nth * room]),
        )

    def _cells(self, window: U8Array, near: I64Array, most: int = 1 << 16) -> _Cells:
        """The cells of leaves (`most` of each), which stand at pages `near` of the window."""
        begin = near * self.page_bytes
        count = np.minimum(_number(window, _U16, begin + 3), most)
        if (window[begin] != _LEAF).any() or (count > self.page_bytes // 4).any():
            raise HandOver
        leaf = np.repeat(np.arange(len(near)), count)
        nth = np.arange(len(leaf)) - np.repeat(np.cumsum(count) - count, count)
        page = begin[leaf]
        place = _number(window, _U16, page + _HEAD_BYTES + 2 * nth)
        if (place > self.page_bytes - 4).any():
            raise HandOver
        payload, at = _varint(window, page + place)
        number, record = _varint(window, at)
        least = (self.usable - 12) * 32 // 255 - 23
        part = least + (payload - least) % (self.usable - 4)
        local = np.where(part <= self.usable - 35, part, least)
        local = np.where(payload <= self.usable - 35, payload, local)
        if (record + local > page + self.usable).any():
            raise HandOver
        return _Cells(leaf, number, record, local, payload)

    def _values(
        self, window: U8Array, cells: _Cells
    ) -> tuple[I64Array, I64Array, I64Array, I64Array]:
        """Topic, time, place of the bytes in the payload, and their number."""
        head, at = _varint(window, cells.record)
        kinds = []
        for _ in range(4):
            kind, at = _varint(window, at)
            kinds.append(kind)
        number, topic, time, data = kinds
        values = np.concatenate([number, topic, time])
        if (
            (at != cells.record + head).any()
            or (values >= _BLOB).any()
            or (np.concatenate([topic, time]) == 0).any()
            or (values == _FLOAT).any()
            or (data < _BLOB).any()
            or (data % 2).any()
        ):
            raise HandOver
        topic_at = at + _SIZES[number]
        time_at = topic_at + _SIZES[topic]
        blob = time_at + _SIZES[time] - cells.record
        size = (data - _BLOB) // 2
        if (blob + size != cells.payload).any() or (blob > cells.local).any():
            raise HandOver
        return _integer(window, topic_at, topic), _integer(window, time_at, time), blob, size


def _number(data: U8Array, layout: np.dtype[np.void], at: I64Array) -> I64Array:
    """Big-endian numbers at bytes `at`."""
    if not len(at):
        return np.zeros(0, np.int64)
    found: I64Array = records(data, layout, at)["value"].astype(np.int64)
    return found


def _varint(data: U8Array, at: I64Array) -> tuple[I64Array, I64Array]:
    """Numbers of 7 bits a byte that begin at `at`, and where they end."""
    byte = data[at]
    value, end = byte.astype(np.int64), at + 1
    if not len(at) or byte.max() <= 0x7F:
        return value, end
    value, more = value & 0x7F, byte > 0x7F
    for _ in range(7):
        byte = data[np.minimum(end, len(data) - 1)]
        value = np.where(more, value << 7 | byte & 0x7F, value)
        end = end + more
        more = more & (byte > 0x7F)
        if not more.any():
            return value, end
    raise HandOver


def _integer(data: U8Array, at: I64Array, kind: I64Array) -> I64Array:
    """Integers of serial types `kind` at bytes `at`."""
    found = np.where(kind == _ONE, 1, 0)
    for one in np.unique(kind).tolist():
        rows, size = np.flatnonzero(kind == one), int(_SIZES[one])
        if size == 8:
            found[rows] = _number(data, _I64, at[rows])
        elif size:
            raw = data[at[rows, None] + np.arange(size)].astype(np.int64)
            value = (raw << (8 * np.arange(size - 1, -1, -1))).sum(axis=1)
            found[rows] = np.where(raw[:, 0] > 0x7F, value - (1 << 8 * size), value)
    return found
