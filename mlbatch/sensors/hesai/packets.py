"""HESAI packets: their layout by the headers, then timestamps, rotor positions and ranges.

Source: docs/sources/hesai.md sections 2 to 5 (dates: 4) and 7. A column is a firing group: one
block for each return, all of one azimuth. Time of a block is that of firing offset 0, and so is its
azimuth, but for XT models (`Timing.azimuth_ns`); some models count offsets back from there, so
timestamp and angle of a column belong to its earliest firing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.lidar.headers import DatedGroups, checks
from mlbatch.lidar.interface import PixelTable, Records, readings
from mlbatch.sensors.hesai.firing import NEVER
from mlbatch.sensors.hesai.models import OPERATIONS, Model
from mlbatch.sensors.packet_bytes import number
from mlbatch.units import MM_PER_M

_S_PER_MINUTE = 60
# Header flags of optional fields.
SEQUENCE = 0x01
_IMU = 0x02
SAFETY = 0x04
# Each adds a byte per channel in the 128-channel family; AMBIENT of a QT128 means that it sends a
# selection of channels.
_CONFIDENCE = 0x10
_WEIGHT = 0x20
AMBIENT = 0x40
_IMU_SIZE = 22
CRC_SIZE = 4
SAFETY_SIZE = 17
_DEFAULT_UNIT_MM = 4


@dataclass(frozen=True, slots=True)
class ReturnMode:
    """Meaning of a return mode code; types: see docs/sources/outputs.md section 3, per return."""

    text: str
    returns: int
    types: tuple[int, ...]


_DUAL = (0, 0)
RETURN_MODES: Mapping[int, ReturnMode] = {
    0x33: ReturnMode("first return", 1, (0,)),
    0x34: ReturnMode("second return", 1, (0,)),
    0x37: ReturnMode("strongest return", 1, (1,)),
    0x38: ReturnMode("last return", 1, (2,)),
    0x39: ReturnMode("dual return, last and strongest", 2, _DUAL),
    0x3A: ReturnMode("dual return, first and second", 2, _DUAL),
    0x3B: ReturnMode("dual return, first and last", 2, _DUAL),
    0x3C: ReturnMode("dual return, first and strongest", 2, _DUAL),
    0x3D: ReturnMode("triple return, first, last and strongest", 3, (0, 0, 0)),
    0x3E: ReturnMode("dual return, strongest and second strongest", 2, _DUAL),
}
# Models without a mode byte send one return.
ONLY_RETURN = ReturnMode("single return", 1, (0,))


@dataclass(frozen=True, slots=True)
class Layout:
    """Packets of a stream according to their headers; offsets count from the end of the prefix.

    size: of the payload, including `prefix` bytes.
    flags, unit_mm: of the header.
    fixed: constant bytes of the header by offset.
    """

    model: Model
    size: int
    prefix: int
    blocks: int
    flags: int
    unit_mm: int
    mode: ReturnMode
    fixed: Mapping[int, int]

    @property
    def unit(self) -> int:
        """Bytes per channel."""
        return unit_size(self.model, self.flags)

    @property
    def stride(self) -> int:
        """Bytes of a block."""
        return self.model.lead + self.model.channels * self.unit

    @property
    def columns(self) -> int:
        """Firing groups of a packet, each with a block for every return."""
        return self.blocks // self.mode.returns

    @property
    def body_end(self) -> int:
        """First byte after the blocks."""
        return self.model.header + self.blocks * self.stride

    @property
    def tail_at(self) -> int:
        """First byte of the tail."""
        return tail_at(self.model, self.blocks, self.flags)

    @property
    def sequence_at(self) -> int | None:
        """Byte of the sequence number, None without one."""
        return self.tail_at + self.model.tail.size if self.flags & SEQUENCE else None

    @property
    def sequence_modulus(self) -> int:
        """Modulus of the sequence number, 0 without one."""
        bits = 8 * self.model.tail.sequence_bytes
        return 1 << bits if self.flags & SEQUENCE else 0

    @property
    def crc_at(self) -> int | None:
        """Byte of the CRC over the tail, None without one."""
        if not self.model.tail.has_crc:
            return None
        imu = _IMU_SIZE if self.model.has_flagged_units and self.flags & _IMU else 0
        at = least_size(self.model, self.blocks, self.flags) + imu
        return at if self.prefix + at + CRC_SIZE <= self.size else None


def unit_size(model: Model, flags: int) -> int:
    """Bytes per channel."""
    extra = (_CONFIDENCE, _WEIGHT, AMBIENT) if model.has_flagged_units else ()
    return model.unit + sum(bool(flags & flag) for flag in extra)


def tail_at(model: Model, blocks: int, flags: int) -> int:
    """First byte of the tail, by blocks and flags of the header."""
    if model.tail_at is not None:
        return model.tail_at
    body = blocks * (model.lead + model.channels * unit_size(model, flags))
    safety = SAFETY_SIZE if flags & SAFETY else 0
    return model.header + body + (CRC_SIZE + safety if model.has_checks else 0)


def least_size(model: Model, blocks: int, flags: int) -> int:
    """Bytes up to the end of the sequence number, the least that can be decoded."""
    sequence = model.tail.sequence_bytes if flags & SEQUENCE else 0
    return tail_at(model, blocks, flags) + model.tail.size + sequence


def unit_mm(model: Model, head: Mapping[int, int]) -> int:
    """Distance unit; head: header bytes by offset."""
    return _DEFAULT_UNIT_MM if model.unit_mm_at is None else head[model.unit_mm_at]


def records_of(layout: Layout) -> Records:
    """Positions of the columns: a block for every return."""
    size = layout.stride * layout.mode.returns
    return Records(layout.prefix + layout.model.header, size, size)


def firing_tables(model: Model) -> tuple[I64Array, I64Array]:
    """Firing times (T, channels) after the earliest of each table, and those (T,)."""
    fires = model.firing_ns != NEVER
    huge = np.iinfo(np.int64).max
    first_ns: I64Array = np.where(fires, model.firing_ns, huge).min(axis=1)
    return np.where(fires, model.firing_ns - first_ns[:, None], NEVER), first_ns


def header_table(layout: Layout, *, sense: int, follows_rotor: bool) -> DatedGroups:
    """Layout of the headers.

    sense: 1 for a clockwise rotor, else -1; follows_rotor: apply rotor motion during a firing.
    """
    model = layout.model
    timing = model.timing
    tail = model.tail
    has_speed = follows_rotor and tail.rpm_at is not None
    tail_at = layout.prefix + layout.tail_at
    fixed = [(layout.prefix + at, 1, value) for at, value in layout.fixed.items()]
    sequence_at = layout.sequence_at
    _, first_ns = firing_tables(model)

    def place(at: int | None) -> int:
        return -1 if at is None else tail_at + at

    first_block = layout.prefix + model.header
    return DatedGroups(
        packet_bytes=layout.size,
        columns=layout.columns,
        returns=layout.mode.returns,
        first_block=first_block,
        block_bytes=layout.stride,
        azimuth_at=first_block + model.azimuth_at,
        azimuth_bytes=3 if model.ticks > 1 << 16 else 2,
        circle=model.ticks,
        check_count=len(fixed),
        checks=checks(*fixed),
        has_flags=not layout.fixed,
        mode_at=place(tail.mode_at),
        modes=None if tail.mode_at is None else _same_modes(layout.mode),
        date_at=tail_at + tail.date_at,
        us_at=tail_at + tail.us_at,
        sequence_at=-1 if sequence_at is None else layout.prefix + sequence_at,
        sequence_bytes=tail.sequence_bytes,
        operation_at=place(tail.operation_at),
        operations=OPERATIONS,
        loop_at=place(tail.loop_at),
        states_at=place(tail.states_at),
        state_count=model.tables.shape[1],
        tables=model.tables.astype(np.int64),
        first_ns=first_ns,
        base_ns=timing.base_ns,
        step_ns=timing.step_ns * np.array(timing.slower, np.int64),
        divisor=timing.divisor,
        counts_back=timing.counts_back,
        azimuth_ns=timing.azimuth_ns,
        rpm_at=place(tail.rpm_at) if has_speed else -1,
        rpm_is_signed=tail.rpm_is_signed,
        turns_per_s=tail.rpm_step * sense / _S_PER_MINUTE,
    )


def _same_modes(mode: ReturnMode) -> U8Array:
    """(256,) whether a return mode has the number and types of returns of this one."""
    same = np.zeros(256, np.uint8)
    for code, one in RETURN_MODES.items():
        same[code] = (one.returns, one.types) == (mode.returns, mode.types)
    return same


def pixels(layout: Layout) -> PixelTable:
    """Pixel layout for compiled decoding."""
    unit_mm = layout.unit_mm
    firsts = tuple(
        (which * layout.stride + layout.model.lead,) for which in range(layout.mode.returns)
    )
    is_whole = MM_PER_M % unit_mm == 0
    return PixelTable(
        layout.unit,
        readings(firsts, layout.model.channels, "<u2"),
        MM_PER_M // unit_mm if is_whole else MM_PER_M,
        1 if is_whole else unit_mm,
        layout.model.silent,
    )


def first_azimuths(packets: U8Array, layout: Layout) -> F64Array:
    """(P,) azimuth of the first block, in revolutions."""
    at = layout.prefix + layout.model.header + layout.model.azimuth_at
    azimuth = number(packets, at, 2)
    if layout.model.ticks > 1 << 16:
        azimuth = azimuth << 8 | packets[:, at + 2]
    return np.asarray(azimuth / layout.model.ticks, np.float64)


def wrong_crc(packets: U8Array, layout: Layout) -> BoolArray:
    """(P,) whether a checksum of packets is wrong."""
    from mlbatch.sensors.crc import crc32

    body = packets[:, layout.prefix :]
    wrong = np.zeros(len(body), np.bool_)
    parts = []
    if layout.model.has_checks:
        parts.append((layout.model.header, layout.body_end))
        if layout.flags & SAFETY:
            safety_at = layout.body_end + CRC_SIZE
            # Without the version byte and the checksum.
            parts.append((safety_at + 1, safety_at + SAFETY_SIZE - CRC_SIZE))
    if layout.crc_at is not None:
        parts.append((layout.tail_at, layout.crc_at))
    for begin, end in parts:
        wrong |= crc32(body[:, begin:end]) != number(body, end, CRC_SIZE)
    return wrong
