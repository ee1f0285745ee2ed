"""Headers of packets by compiled loops (`native/headers.c`), from their layouts as tables.

A vendor describes its packets by one of the structs of `native.h`. All that is read of a packet but
its pixels follows from it: whether it is the sensor's and good, its number, and the columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import ClassVar, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.native.library import Reader, Struct, library, members
from mlbatch.types import ColumnHeaders

_KEY_WORD = 8
HeaderValue: TypeAlias = float | npt.NDArray[np.generic] | None


def checks(*rows: Sequence[int]) -> I64Array:
    """Return checks: (n, 3) first byte, number of bytes, value."""
    return np.array(rows, np.int64).reshape(-1, 3)


def check_of(at: int, content: bytes) -> tuple[int, int, int]:
    """Return the check that a packet has these bytes, 8 at most, at a byte."""
    return at, len(content), int.from_bytes(content, "little", signed=len(content) == _KEY_WORD)


class HeaderTable(Struct):
    """Layout of the packets of a sensor; all members have to be given."""

    def __init__(self, **values: HeaderValue) -> None:
        """Raise TypeError for other members than those of `native.h`."""
        names = {name for name, *_ in self._fields_}
        if values.keys() != names:
            raise TypeError(f"{type(self).__name__}: {sorted(values.keys() ^ names)}")
        for name, value in values.items():
            is_array = isinstance(value, np.ndarray)
            setattr(self, name, np.ascontiguousarray(value) if is_array else value)


class StampedColumns(HeaderTable):
    """Packets whose columns have a timestamp, a position and a status each: Ouster."""

    _fields_: ClassVar = members("StampedColumns")


class PacedBlocks(HeaderTable):
    """Packets with one timestamp, and blocks with a flag and an azimuth: Velodyne."""

    _fields_: ClassVar = members("PacedBlocks")


class DatedGroups(HeaderTable):
    """Packets with a date, and blocks with an azimuth each, one block per return: HESAI."""

    _fields_: ClassVar = members("DatedGroups")


class TimedRows(HeaderTable):
    """Packets with one timestamp, and rows of blocks with an id and an azimuth each: ROBOSENSE."""

    _fields_: ClassVar = members("TimedRows")


class EvenColumns(HeaderTable):
    """Packets of columns that follow each other evenly: Livox, and clouds of one column each."""

    _fields_: ClassVar = members("EvenColumns")


_KINDS: tuple[type, ...] = (StampedColumns, PacedBlocks, DatedGroups, TimedRows, EvenColumns)


class Headers(NamedTuple):
    """Headers of packets (P,); undefined where a packet is not the sensor's or has a fault."""

    is_mine: BoolArray
    faults: U8Array  # indices into FAULTS
    key: I64Array  # as `Lidar.sequence`
    columns: ColumnHeaders


class HeaderReader:
    """Reads the headers of a sensor's packets.

    wrong_crc: which packets (P, size) have a wrong checksum; None: checksums are not read, so that
    compiled loops may use `struct` alone.
    """

    def __init__(
        self,
        table: HeaderTable,
        *,
        has_number: bool,
        wrong_crc: Callable[[U8Array], BoolArray] | None = None,
    ) -> None:
        """has_number: packets have a number of their own; else it is the hash of the content."""
        self.table = table
        self.columns = table.columns * (table.rows if isinstance(table, TimedRows) else 1)
        self.wrong_crc = wrong_crc
        self._size = table.packet_bytes
        self.struct = Reader(
            kind=_KINDS.index(type(table)),
            layout=table,
            packet_bytes=table.packet_bytes,
            columns=self.columns,
            has_number=has_number,
            odd=hash_factors(table.packet_bytes // _KEY_WORD),
        )

    def read(
        self, data: U8Array, start: I64Array, host_ns: I64Array, keys: I64Array | None = None
    ) -> Headers:
        """Read packets `data[start[i] :][:size]`, received at host_ns (P,).

        keys: (P,) hashes of their contents, None: not known.
        """
        count = len(start)
        self.refuse_outside(data, start)
        start = np.ascontiguousarray(start)
        host_ns = np.ascontiguousarray(host_ns)
        keys = None if keys is None else np.ascontiguousarray(keys)
        shape = (count, self.columns)
        found = Headers(
            np.empty(count, np.bool_),
            np.empty(count, np.uint8),
            np.empty(count, np.int64),
            ColumnHeaders(
                np.empty(shape, np.int64), np.empty(shape, np.int64), np.empty(shape, np.bool_)
            ),
        )
        columns = found.columns
        library().mlbatch_headers(
            *(self.struct, data, count, start, host_ns, keys),
            *(found.is_mine, found.faults, found.key),
            *(columns.stamp_ns, columns.encoder, columns.valid),
        )
        if self.wrong_crc is not None:
            packets = data[start[:, None] + np.arange(self._size)]
            found.faults[(found.faults == 0) & self.wrong_crc(packets)] = _BAD_CRC
        return found

    def refuse_outside(self, data: U8Array, start: I64Array) -> None:
        """Raise IndexError unless all packets are within `data`."""
        if len(start) and (int(start.min()) < 0 or int(start.max()) + self._size > len(data)):
            raise IndexError("packets outside of their array")

    def read_rows(self, packets: U8Array, host_ns: I64Array | None = None) -> Headers:
        """Read packets (P, size or more) received at host_ns (P,); None: at any time."""
        rows = np.ascontiguousarray(packets[:, : self._size])
        start = np.arange(len(rows)) * self._size
        times_ns = np.zeros(len(rows), np.int64) if host_ns is None else host_ns
        return self.read(rows.reshape(-1), start, times_ns)


# `lidar.interface.FAULTS` has the same order.
_BAD_CRC = 3


# -- hashes, by which repeated packets are found --------------------------------------------------


def content_keys(packets: U8Array) -> I64Array:
    """(P,) hashes >= 0 of packets (P, size).

    The sum of the packet's words times odd numbers, modulo 2**64: a single bit changes it.
    """
    size = packets.shape[1]
    words = size // 8
    # Bytes beyond whole words are hashed as the last eight bytes, which may overlap the words.
    if words and packets.strides[1] == 1:
        keys = np.einsum("ij,j->i", packets[:, : words * 8].view("<u8"), hash_factors(words))
        if size % 8:
            keys = keys * _ODD + packets[:, size - 8 :].view("<u8")[:, 0]
    else:
        keys = np.zeros(len(packets), np.uint64)
        for at in range(size):
            keys = keys * _ODD + packets[:, at]
    keys ^= keys >> np.uint64(29)
    return np.asarray(keys * _ODD >> np.uint64(1), np.int64)


# The golden ratio of 2**64, made odd (Knuth, multiplicative hashing).
_ODD = np.uint64(0x9E3779B97F4A7C15)


@lru_cache(maxsize=16)
def hash_factors(count: int) -> npt.NDArray[np.uint64]:
    """Return the factors of the words of a packet in `content_keys`: (count,) odd numbers."""
    numbers = np.arange(1, count + 1, dtype=np.uint64) * _ODD
    return np.asarray((numbers ^ numbers >> np.uint64(31)) | np.uint64(1), np.uint64)
