"""Packet layout of a HESAI stream: the model's table with the values of its headers.

Source: docs/sources/hesai.md sections 2 and 3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mlbatch.sensors.hesai.models import Model

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
