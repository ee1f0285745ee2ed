"""Names of ROBOSENSE packets by content: magic bytes, type bytes, block ids, return modes.

Source: facts/robosense.md sections 1 to 4 and 7.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mlbatch.sensors._recognise_bytes import (
    NO_DECODER,
    block_azimuths,
    block_time_us,
    in_pairs,
    mostly,
    number,
    starts,
    usual,
)
from mlbatch.types import I64Array, U8Array

_FIRST_KIND = bytes.fromhex("55aa050a5aa550a0")
_SECOND_KIND = bytes.fromhex("55aa055a")
_SOLID_STATE = bytes.fromhex("55aa5aa5")
_DIFOP = bytes.fromhex("a5ff005a11115555")
_IMU = bytes.fromhex("aa555a05")
_BLOCK_ID, _RUBY_ID = b"\xff\xee", b"\xfe"
_BLOCKS_AT, _BLOCKS, _STRIDE = 42, 12, 100
_RUBY_AT, _TIME_AT, _LEAST_SIZE, _IMU_SIZE = 80, 20, 1200, 51
_MODE_BYTE_AT, _OLD_TYPE_AT, _TYPE_AT, _MODEL_AT = 17, 30, 31, 32
_WAVE_MODE_AT = 7
_MINUTE_US = 60_000_000
# Rounds of 55.5 us: two returns of one round in a block, or two rounds.
_DUAL_ROUND_US, _ROUND_TOLERANCE = 55.5, 0.1


@dataclass(frozen=True, slots=True)
class _Model:
    """A model; lines: channels of one firing round; calendar: form of its time."""

    name: str
    lines: int
    calendar: bool = False


_OLD_TYPES = {
    1: _Model("RS-LiDAR-16", 16, calendar=True),
    2: _Model("RS-LiDAR-32", 32, calendar=True),
    3: _Model("RS-Bpearl v3", 32, calendar=True),
}
_BPEARL_V4 = _Model("RS-Bpearl v4", 32)
_BPEARL_V4_TYPE, _BPEARL_V4_MODELS = 3, (0, 4)
# Second kind, by type and model; None: whatever the model.
_TYPES: Mapping[tuple[int, int | None], _Model] = {
    (6, 1): _Model("Helios 32, 70 degrees", 32),
    (6, 2): _Model("Helios 32, 31 degrees", 32),
    (6, 3): _Model("Helios 16", 16),
    (6, 4): _Model("Helios 32, 26 degrees", 32),
    (7, None): _Model("Helios 16", 16),
    (0x31, 1): _Model("Airy 48", 0),
    (0x31, 2): _Model("Airy 96", 0),
    (0x31, 3): _Model("Airy 192", 0),
}
_AIRY = 0x31
_AIRY_DUAL = 3
# Ruby: distance from block to block.
_RUBY_STRIDES = {
    388: "Ruby 128 or Ruby Plus 128",
    244: "Ruby 80 or Plus 80",
    148: "Ruby 48 or Plus 48",
}
_WAVE_MODES = {1: "single return", 3: "dual return"}
_SOLID_SIZES = {1210: "M1", 1342: "M2", 1448: "M3", 1404: "MX", 1200: "E1", 812: "EM"}


def robosense(size: int, packets: U8Array) -> str | None:
    """A line on ROBOSENSE packets, or None."""
    if mostly(packets, starts(packets, _DIFOP)) is not None:
        return "ROBOSENSE DIFOP packet"
    if size == _IMU_SIZE and mostly(packets, starts(packets, _IMU)) is not None:
        return "ROBOSENSE IMU packet, Airy"
    if size in _SOLID_SIZES and mostly(packets, starts(packets, _SOLID_STATE)) is not None:
        return _lidar(_SOLID_SIZES[size])
    if size < _LEAST_SIZE:
        return None
    first = mostly(packets, starts(packets, _FIRST_KIND) & starts(packets, _BLOCK_ID, _BLOCKS_AT))
    if first is not None:
        return _describe_first(first)
    return _describe_second(packets) or _describe_ruby(packets)


def _describe_first(packets: U8Array) -> str:
    old, kind, model = (usual(number(packets, at, 1)) for at in (_OLD_TYPE_AT, _TYPE_AT, _MODEL_AT))
    if kind == _BPEARL_V4_TYPE and model in _BPEARL_V4_MODELS:
        return _lidar(_BPEARL_V4.name, _returns(packets, _BPEARL_V4))
    found = _OLD_TYPES.get(old)
    if found is None:
        return _lidar(f"of unknown model (type bytes {old:02X} {kind:02X})")
    return _lidar(found.name, _returns(packets, found))


def _describe_second(packets: U8Array) -> str | None:
    good = starts(packets, _SECOND_KIND) & starts(packets, _BLOCK_ID, _BLOCKS_AT)
    chosen = mostly(packets, good)
    if chosen is None:
        return None
    kind, model = (usual(number(chosen, at, 1)) for at in (_TYPE_AT, _MODEL_AT))
    found = _TYPES.get((kind, model)) or _TYPES.get((kind, None))
    if found is None:
        return _lidar(f"of unknown model (type bytes {kind:02X} {model:02X})")
    if kind == _AIRY:
        dual = usual(number(chosen, _MODE_BYTE_AT, 1)) == _AIRY_DUAL
        return _lidar(found.name, "dual return" if dual else "single return")
    return _lidar(found.name, _returns(chosen, found))


def _describe_ruby(packets: U8Array) -> str | None:
    good = starts(packets, _SECOND_KIND) & starts(packets, _RUBY_ID, _RUBY_AT)
    for stride, name in _RUBY_STRIDES.items():
        chosen = mostly(packets, good & starts(packets, _RUBY_ID, _RUBY_AT + stride))
        if chosen is not None:
            return _lidar(name, _WAVE_MODES.get(usual(number(chosen, _WAVE_MODE_AT, 1)), ""))
    return None


def _returns(packets: U8Array, model: _Model) -> str:
    """Returns of a model whose point packets do not say it: by azimuths, or by their pace."""
    azimuth = block_azimuths(packets, _BLOCKS_AT, _STRIDE, _BLOCKS, ">")
    if model.lines == 32:
        turning = bool((azimuth[:, 0] != azimuth[:, -1]).all())
        dual = in_pairs(azimuth)
        return ("dual return" if dual else "single return") if turning else ""
    took_us = block_time_us(_stamp_us(packets, calendar=model.calendar), azimuth, _MINUTE_US)
    for returns, name in ((1, "single return"), (2, "dual return")):
        wanted_us = _DUAL_ROUND_US * 2 / returns
        if took_us is not None and abs(took_us - wanted_us) < _ROUND_TOLERANCE * wanted_us:
            return name
    return ""


def _stamp_us(packets: U8Array, *, calendar: bool) -> I64Array:
    """(k,) time within the minute, us."""
    if calendar:
        second = number(packets, _TIME_AT + 5, 1)
        milli, micro = (number(packets, _TIME_AT + at, 2, ">") for at in (6, 8))
        return second * 1_000_000 + milli * 1000 + micro
    second, micro = number(packets, _TIME_AT, 6, ">"), number(packets, _TIME_AT + 6, 4, ">")
    return np.asarray((second % 60) * 1_000_000 + micro, np.int64)


def _lidar(model: str, mode: str = "") -> str:
    return f"ROBOSENSE lidar {model}{', ' if mode else ''}{mode}{NO_DECODER}"
