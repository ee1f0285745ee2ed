"""Layouts of the headers of packets as data, for compiled loops.

`Lidar.sent_by_me`, `faults`, `sequence` and `column_headers` read the same in numpy, and all that
is unusual: columns out of order or without a measurement, gaps within a packet, damage. Tests
compare both, packet by packet.
"""

from __future__ import annotations

from typing import NamedTuple

from mlbatch.arrays import BoolArray, F64Array, I64Array, U64Array


class FixedNumber(NamedTuple):
    """A little-endian number that all packets of a sensor share."""

    first_byte: int
    size: int
    value: int


class StampedColumns(NamedTuple):
    """Packets whose columns have a timestamp, a position and a status each.

    A column begins with its timestamp, 8 bytes, ns; its position has 2 bytes. The sequence number
    of a packet is its frame number times `packets_per_frame` plus its rank in the frame.
    """

    columns: int  # of a packet
    first_column: int  # first byte
    column_bytes: int
    # Bytes of a column; of the status, bit 0 is set if it was measured.
    position_at: int
    status_at: int
    positions: int  # of a revolution
    # First byte and size, in the packet, or (frames_in_columns) in each column.
    frame_field: tuple[int, int]
    frames: int  # frame numbers wrap there
    frames_in_columns: bool
    rank: I64Array  # (positions // columns,) of the packets of a frame, -1: not sent
    packets_per_frame: int
    fixed: tuple[FixedNumber, ...]


class PacedBlocks(NamedTuple):
    """Packets with one timestamp, and blocks with a flag and an azimuth, 2 bytes each.

    The timestamp has 4 bytes, microseconds. A group of blocks has one azimuth, and is one column or
    several. The sequence number of a packet is the hash of its content.
    """

    packet_bytes: int
    columns: int
    groups: int
    block_bytes: int
    flags: I64Array  # (blocks,)
    hash_factors: U64Array  # (packet_bytes // 8,), as `lidar.content_keys`
    circle: int  # azimuths of a revolution
    widest: int  # step between groups without a gap
    stamp_at: int  # first byte
    period_ns: int  # of the timestamps
    clock_offset_ns: int  # true time minus receive time
    mode_at: int
    modes: BoolArray | None  # (256,) allowed values of the byte there
    start_ns: I64Array  # (columns,) after the packet's timestamp
    ahead_ns: F64Array  # (columns,) after the azimuth of their group
    group_ns: float  # time from group to group
    known_speed: float  # azimuths in a ns, of packets with one group
    follows_rotor: bool  # rotor words have the speed


class SingleColumns(NamedTuple):
    """Packets of one column, whose first eight bytes all packets of a sensor share.

    The timestamp has 8 bytes, ns; rotors do not matter. The sequence number of a packet is the hash
    of its content.
    """

    packet_bytes: int
    first_word: int
    stamp_at: int  # first byte
    hash_factors: U64Array  # (packet_bytes // 8,), as `lidar.content_keys`
    columns: int = 1


HeaderTable = StampedColumns | PacedBlocks | SingleColumns
