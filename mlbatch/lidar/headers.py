"""Headers of packets by compiled loops (`native/headers.c`), from their layouts as tables.

A vendor describes its packets by one of the tuples below, which has the fields of the struct of
the same name in C. All that is read of a packet but its pixels follows from it: whether it is the
sensor's and good, its number, and the columns. Checks are rows of first byte, bytes and the
little-endian value there; places of numbers are first bytes of the packet, -1 where it has none.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.native.library import Reader, Struct, library
from mlbatch.types import ColumnHeaders

_KEY_WORD = 8


def checks(*rows: Sequence[int]) -> I64Array:
    """Return checks: (n, 3) first byte, number of bytes, value."""
    return np.array(rows, np.int64).reshape(-1, 3)


def check_of(at: int, content: bytes) -> tuple[int, int, int]:
    """Return the check that a packet has these bytes, 8 at most, at a byte."""
    return at, len(content), int.from_bytes(content, "little", signed=len(content) == _KEY_WORD)


class StampedColumns(NamedTuple):
    """Packets whose columns have a timestamp, a position and a status each: Ouster.

    A column begins with its timestamp, 8 bytes, ns; its position has 2 bytes; bit 0 of the status
    is set if it was measured. The number of a packet is its frame number times `packets_per_frame`
    plus its rank in the frame; it is negative for packets without a rank.
    """

    packet_bytes: int
    columns: int
    first_column: int
    column_bytes: int
    # Bytes of a column.
    position_at: int
    status_at: int
    positions: int  # of a revolution
    # Without a header the columns have the frame number, at `frame_at`, 2 bytes.
    form_count: int
    # (form_count, 3, 2) first byte and bytes of packet type, serial number, frame number. Further
    # forms hold for packets whose serial number is found by them only.
    forms: I64Array
    packet_type: int
    serial: int  # 0: not known
    frame_at: int
    frames: int  # frame numbers wrap there
    rank_count: int
    rank: I64Array  # (rank_count,) of the packets of a frame by block of columns, -1: not sent
    packets_per_frame: int


class PacedBlocks(NamedTuple):
    """Packets with one timestamp, and blocks with a flag and an azimuth of 2 bytes: Velodyne.

    The timestamp has 4 bytes, microseconds. A group of blocks has one azimuth, and is one column or
    several. The speed of the rotor follows from the steps between groups; a step that is wider
    than others spans a blind sector, whose duration follows from the speed.
    """

    packet_bytes: int
    columns: int
    groups: int
    blocks_per_group: int
    block_count: int
    block_bytes: int
    flags: I64Array  # (block_count,)
    circle: int  # azimuths of a revolution
    widest: int  # step between groups that may be no gap; a resting rotor steps back by less
    gap_factor: int  # of the middle step, beyond which a wider one is a gap
    stamp_at: int
    period_ns: int  # of the timestamps
    clock_offset_ns: int  # true time minus receive time
    mode_at: int
    modes: U8Array | None  # (256,) not 0: allowed values of the byte there
    start_ns: I64Array  # (columns,) after the packet's timestamp
    ahead_ns: F64Array  # (columns,) after the azimuth of their group
    group_ns: float  # time from group to group
    known_speed: float  # azimuths in a ns, of packets with one group
    slowest: float  # below, a wide step is no blind sector
    tolerance: float  # of the known speed, which is used across blind sectors
    follows_rotor: bool  # rotor words have the speed


class DatedGroups(NamedTuple):
    """Packets with a date, and blocks with an azimuth each, one block per return: HESAI.

    A column is a group of blocks. Its time is that of the packet, plus `base_ns`, plus a step for
    each group, plus `first_ns` of its firing table.
    """

    packet_bytes: int
    columns: int
    returns: int
    first_block: int
    block_bytes: int
    azimuth_at: int  # of the first block
    azimuth_bytes: int  # 2, or 3 with a fine byte
    circle: int  # azimuths of a revolution
    check_count: int
    checks: I64Array
    has_flags: bool  # blocks begin with FF EE
    mode_at: int
    modes: U8Array | None  # (256,) not 0: allowed values of the byte there
    date_at: int  # 6 bytes
    us_at: int  # 4 bytes
    sequence_at: int
    sequence_bytes: int
    operation_at: int
    operations: int
    # Fields that choose the firing table: its number is (value + column + 1) modulo 2, or it
    # follows from operation and azimuth state.
    loop_at: int
    states_at: int
    state_count: int
    tables: I64Array  # (operations, state_count)
    first_ns: I64Array  # of each table, of the earliest beam
    base_ns: int
    step_ns: I64Array  # (operations,) of `divisor` groups
    divisor: int
    counts_back: bool  # the last group has step 0, and those before it negative ones
    azimuth_ns: int  # when the rotor is at a block's azimuth, after the block's time
    rpm_at: int
    rpm_is_signed: bool
    turns_per_s: float  # of one step of the speed field


class TimedRows(NamedTuple):
    """Packets with one timestamp, and rows of blocks with an id and an azimuth each: ROBOSENSE.

    The time has 10 bytes, big-endian: seconds and microseconds, or calendar. The speed of the rotor
    follows from the steps between rows; at most one of them spans a gap in the field of view.
    """

    packet_bytes: int
    columns: int  # of a row
    rows: int
    first_row: int
    row_bytes: int
    check_count: int
    checks: I64Array
    foreign_count: int
    foreign: I64Array  # checks of device packets on the same topic
    point_at: int  # byte that is 0 in point packets
    row_id: int
    row_id_bytes: int
    circle: int  # azimuths of a revolution
    widest: int  # step between rows without a gap
    time_at: int
    is_calendar: bool
    counter_at: int  # 4 bytes, big-endian
    repeats: bool  # rows of equal azimuth have equal times
    row_ns: int  # time from row to row
    start_ns: I64Array  # (columns,) after the begin of their row
    start_s: F64Array  # (columns,) the same
    known_speed: float  # azimuths in a s, 0: unknown
    turns: float  # revolutions of an azimuth; negative if the rotor is mirrored
    following: float  # the same for the speed in rotor words, 0 to ignore it


class EvenColumns(NamedTuple):
    """Packets of columns that follow each other evenly: Livox, and clouds of one column each."""

    packet_bytes: int
    columns: int
    check_count: int
    checks: I64Array
    stamp_at: int  # 8 bytes, ns
    interval_at: int  # 2 bytes, of all columns
    interval_ns: int  # a step of it
    counter_at: int  # 2 bytes
    ring_at: int  # 2 bytes, modulo `rings`: the firing table of the columns
    rings: int


HeaderTable = StampedColumns | PacedBlocks | DatedGroups | TimedRows | EvenColumns
_KINDS: tuple[type, ...] = (StampedColumns, PacedBlocks, DatedGroups, TimedRows, EvenColumns)
_C_TYPES = {"int": ctypes.c_int64, "bool": ctypes.c_int64, "float": ctypes.c_double}


def fields_of(table: type) -> list[tuple[str, type[Any]]]:
    """Return names and C types of the members of a table's struct; arrays are pointers."""
    words = {
        name: getattr(kind, "__forward_arg__", "") for name, kind in table.__annotations__.items()
    }
    return [(name, _C_TYPES.get(word, ctypes.c_void_p)) for name, word in words.items()]


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
            layout=_struct_of(table),
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


def _struct_of(table: HeaderTable) -> Struct:
    """Return the struct of a table."""
    values = {
        name: np.ascontiguousarray(value) if isinstance(value, np.ndarray) else value
        for name, value in table._asdict().items()
    }
    struct = type(type(table).__name__, (Struct,), {"_fields_": fields_of(type(table))})
    found: Struct = struct(**values)
    return found


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
