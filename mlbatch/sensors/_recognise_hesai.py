"""Names of HESAI packets by content: lengths, header versions, return modes in the tail.

Source: facts/hesai.md sections 1 to 4; facts/messages.md section 2 (correction); HesaiTechnology/
HesaiLidar_SDK_2.0 `libhesai` (fault messages of 99 bytes begin with CD DC).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mlbatch.sensors._recognise_bytes import NO_DECODER, mostly, number, starts, usual
from mlbatch.types import BoolArray, U8Array

_SOP = b"\xee\xff"
_BLOCK_FLAG = b"\xff\xee"
_HEADER_SIZE = 12
# Automotive models may put a SOME/IP header in front.
_PREFIX_SIZE = 21
_RETURNS = {
    0x33: "first return",
    0x34: "second return",
    0x37: "strongest return",
    0x38: "last return",
    0x39: "dual return, last and strongest",
    0x3A: "dual return, first and second",
    0x3B: "dual return, first and last",
    0x3C: "dual return, first and strongest",
    0x3D: "triple return, first, last and strongest",
    0x3E: "dual return, strongest and second strongest",
}
_OTHERS = (
    (512, _BLOCK_FLAG, "GPS packet"),
    (99, b"\xcd\xdc", "fault packet"),
    (0, bytes.fromhex("47740500"), "correction"),
)
_SAFETY, _CONFIDENCE, _WEIGHT, _AMBIENT = 0x04, 0x10, 0x20, 0x40
_CRC_SIZE, _SAFETY_SIZE = 4, 17


@dataclass(frozen=True, slots=True)
class _Sized:
    """A model told by its sizes and first bytes; mode_at: byte of the return mode, 0 unknown."""

    name: str
    sizes: tuple[int, ...]
    magic: bytes
    mode_at: int


_PANDAR40_BLOCKS = 10
_PANDAR40_STRIDE = 124
_PANDAR40 = (
    _Sized("Pandar40", (1256,), _BLOCK_FLAG, 1254),
    _Sized("Pandar40P or Pandar40M", (1262, 1266), _BLOCK_FLAG, 1254),
)
_PANDAR64 = (
    _Sized("Pandar64", (1194, 1198), _SOP + bytes((64, 6)), 1186),
    _Sized("Pandar64", (1388, 1392), _SOP, 1380),
)
_PANDAR20 = _Sized("Pandar20", (), _SOP + bytes((20, 20)), 0)


@dataclass(frozen=True, slots=True)
class _Version:
    """A family by its protocol version.

    mode_at: return mode in the tail, 0 unknown; unit: bytes per channel, with those that flags add;
    lead: bytes of a block before its channels; checked: body CRC and, if flagged, safety bytes.
    """

    name: str
    mode_at: int = 0
    unit: int = 4
    lead: int = 2
    checked: bool = False
    flagged: bool = False
    turns: bool = True


_VERSIONS: Mapping[tuple[int, int], _Version] = {
    (1, 3): _Version("Pandar128", 16, unit=3),
    (1, 4): _Version("", 12, unit=3, checked=True, flagged=True),
    (1, 8): _Version("JT16"),
    (3, 1): _Version("PandarQT", 16),
    (3, 2): _Version("QT128C2X", 12, checked=True),
    (4, 1): _Version("AT128", 24, lead=3, checked=True, turns=False),
    (4, 3): _Version("AT128", 24, lead=3, checked=True, turns=False),
    (4, 7): _Version("ATX", turns=False),
    (6, 1): _Version("", 10),
    (7, 2): _Version("FT120", turns=False),
}
# Protocol 6.1 by lasers and blocks.
_XT = {(16, 8): "PandarXT-16", (32, 8): "PandarXT-32", (32, 6): "XT32M2X"}
# Protocol 1.4 by the version of the status info: the first one at or below it.
_STATUS_VERSIONS = ((137, "JT128"), (128, "OT128"), (0, "Pandar128 family"))
_IMU_SIZE = 34


def hesai(size: int, packets: U8Array) -> str | None:
    """A line on HESAI packets, or None."""
    for wanted, magic, name in _OTHERS:
        good = starts(packets, magic)
        if name == "GPS packet":
            good &= _digits(packets, 2, 14)
        if wanted in (0, size) and mostly(packets, good) is not None:
            return f"HESAI {name}"
    return (
        _describe_sized(size, packets)
        or _describe_version(size, packets, prefixed=False)
        or _describe_version(size - _PREFIX_SIZE, packets[:, _PREFIX_SIZE:], prefixed=True)
    )


def _digits(packets: U8Array, begin: int, end: int) -> BoolArray:
    """(k,) whether these bytes are ASCII digits."""
    text = packets[:, begin:end]
    return np.asarray(((text >= ord("0")) & (text <= ord("9"))).all(axis=1))


def _describe_sized(size: int, packets: U8Array) -> str | None:
    for model in (*_PANDAR40, *_PANDAR64, _PANDAR20):
        if model.sizes and size not in model.sizes:
            continue
        good = starts(packets, model.magic)
        if model in _PANDAR40:
            for block in range(1, _PANDAR40_BLOCKS):
                good &= starts(packets, model.magic, _PANDAR40_STRIDE * block)
        chosen = mostly(packets, good)
        if chosen is not None:
            return _lidar(model.name, chosen, model.mode_at)
    return None


def _describe_version(size: int, packets: U8Array, *, prefixed: bool) -> str | None:
    """Models whose header has a protocol version; their size must hold the blocks announced."""
    if size < _HEADER_SIZE:
        return None
    chosen = mostly(packets, starts(packets, _SOP))
    if chosen is None:
        return None
    head = [usual(number(chosen, at, 1)) for at in range(_HEADER_SIZE)]
    version = _VERSIONS.get((head[2], head[3]))
    same = mostly(packets, starts(packets, bytes((*_SOP, head[2], head[3]))))
    if version is None or same is None or (prefixed and version.turns):
        return None
    if not version.mode_at:
        if version.name == "JT16" and size == _IMU_SIZE:
            return "HESAI IMU packet, JT16"
        return _lidar(version.name, same, 0)
    tail = _tail_at(version, head)
    if tail + version.mode_at >= size:
        return None
    return _lidar(_name(version, head), same, tail + version.mode_at)


def _name(version: _Version, head: list[int]) -> str:
    if (head[2], head[3]) == (6, 1):
        return _XT.get((head[6], head[7]), f"PandarXT of {head[6]} channels")
    if (head[2], head[3]) == (1, 4):
        family = next(name for least, name in _STATUS_VERSIONS if head[4] >= least)
        return family if head[6] == 128 else f"{family}, {head[6]} channels"
    return f"{version.name}{head[6]}" if version.name == "PandarQT" else version.name


def _tail_at(version: _Version, head: list[int]) -> int:
    """Byte at which the tail begins, by lasers, blocks and flags of the header."""
    lasers, blocks, flags = head[6], head[7], head[11]
    unit = version.unit
    if version.flagged:
        unit += sum(bool(flags & flag) for flag in (_CONFIDENCE, _WEIGHT, _AMBIENT))
    body = blocks * (version.lead + lasers * unit)
    checks = _CRC_SIZE + (_SAFETY_SIZE if flags & _SAFETY else 0) if version.checked else 0
    return _HEADER_SIZE + body + checks


def _lidar(model: str, packets: U8Array, mode_at: int) -> str:
    mode = _RETURNS.get(usual(number(packets, mode_at, 1))) if mode_at else None
    named = f"HESAI lidar {model}" if mode is None else f"HESAI lidar {model}, {mode}"
    return f"{named}{NO_DECODER}"
