"""Names of ROBOSENSE packets by content: magic bytes, type bytes, block ids, return modes.

Source: docs/sources/robosense.md sections 1 to 4 and 7.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.sensors.packet_bytes import (
    NO_DECODER,
    US_PER_MINUTE,
    block_azimuths,
    block_time_us,
    has_bytes,
    in_pairs,
    majority,
    most_common,
    number,
    payload_rows,
)
from mlbatch.sensors.robosense import models as rows
from mlbatch.sensors.robosense.models import DIFOP, SECOND_KIND, VENDOR, Layout, Model
from mlbatch.sensors.robosense.packets import in_time_form, times_ns
from mlbatch.units import NS_PER_US

_SOLID_STATE = bytes.fromhex("55aa5aa5")
_IMU = bytes.fromhex("aa555a05")
_IMU_SIZE = 51
# Bytes of type and model, which sources place differently (section 2).
_TYPE_BYTES = (30, 31, 32)
_PACE_TOLERANCE = 0.1
_SOLID_SIZES = {1210: "M1", 1342: "M2", 1448: "M3", 1404: "MX", 1200: "E1", 812: "EM"}


@dataclass(frozen=True, slots=True)
class Identity:
    """Model of point packets.

    name: in words.
    model: its row, None without a decoder.
    other: another model that packets may be of; doubt: why, and what differs.
    """

    name: str
    model: Model | None
    other: Model | None = None
    doubt: str = ""


# First kind, by type: byte 30, else 31.
_FIRST_TYPES = {
    1: Identity("RS-LiDAR-16", rows.RS16),
    2: Identity("RS-LiDAR-32", rows.RS32),
    3: Identity("RS-Bpearl v3", rows.BPEARL_V3),
}
_BPEARL = 3
_BPEARL_V4 = Identity("RS-Bpearl v4", rows.BPEARL_V4)
_BPEARL_V4_MODEL = 4
_BPEARL_DOUBT = (
    "packets of type 3 and model 0 are those of an RS-Bpearl v4 in its manual and of a v3 in "
    "rs_driver; ranges differ by a factor of 2"
)
# Second kind, by bytes 31 and 32; None: any model.
_TYPES: Mapping[tuple[int, int | None], Identity] = {
    (6, 1): Identity("Helios 32, 70 degrees", rows.HELIOS_32),
    (6, 2): Identity("Helios 32, 31 degrees", rows.HELIOS_32),
    (6, 3): Identity("Helios 16", rows.HELIOS_16),
    (6, 4): Identity("Helios 32, 26 degrees", rows.HELIOS_32),
    (7, None): Identity("Helios 16", rows.HELIOS_16),
    (0x31, 1): Identity("Airy 48", rows.AIRY_48),
    (0x31, 2): Identity("Airy 96", rows.AIRY_96),
    (0x31, 3): Identity("Airy 192", None),
}
# Without a model byte: rs_driver has the type at byte 30, some manuals have it at 31.
_HELIOS = 6
_HELIOS_16 = 7
_HELIOS_DOUBT = (
    "packets of a Helios 32 with one return and of a Helios 16 with two are alike; channels differ"
)
# Ruby: by readings per block.
_RUBIES = {
    128: (rows.RUBY_128, rows.RUBY_PLUS_128),
    80: (rows.RUBY_80, rows.RUBY_PLUS_80),
    48: (rows.RUBY_48, rows.RUBY_PLUS_48),
}
_RUBY_TYPES = (4, 5)
_RUBY_PLUS_TYPE = 5
# Ruby Plus 80 and 80v, where rs_driver has the model: byte 31.
_PLUS_80_MODELS = (2, 3)
_RUBY_DOUBT = "type bytes do not distinguish them; times differ by up to 34 us"
MODE_WORDS = {0: "", 1: "single return", 2: "dual return"}


def describe(size: int, sample: U8Array) -> str | None:
    """Name payloads (k, size); None if they are not ROBOSENSE's."""
    packets = payload_rows(size, sample)
    if packets is None:
        return None
    points = point_packets(packets)
    found = identify(points)
    if found is not None and found.model is not None:
        return _lidar(found.name, MODE_WORDS[returns_of(points, found.model)])
    if found is not None:
        return _lidar(found.name) + NO_DECODER
    if 2 * len(points) < len(packets):
        return f"{VENDOR} DIFOP packet"
    if size == _IMU_SIZE and majority(packets, has_bytes(packets, _IMU)) is not None:
        return f"{VENDOR} IMU packet, Airy"
    if size in _SOLID_SIZES and majority(packets, has_bytes(packets, _SOLID_STATE)) is not None:
        return _lidar(_SOLID_SIZES[size]) + NO_DECODER
    return None


def is_difop(packets: U8Array) -> BoolArray:
    """(P,) whether packets are device packets."""
    return has_bytes(packets, DIFOP)


def point_packets(packets: U8Array) -> U8Array:
    """Packets without the device packets that share their topic."""
    return packets[~is_difop(packets)]


def fits(packets: U8Array, layout: Layout) -> BoolArray:
    """(k,) whether packets have the magic bytes and the first two blocks of a layout."""
    if packets.shape[1] < layout.end:
        return np.zeros(len(packets), bool)
    good = has_bytes(packets, layout.magic) & has_bytes(packets, layout.block_id, layout.header)
    return good & has_bytes(packets, layout.block_id, layout.header + layout.stride)


def identify(packets: U8Array) -> Identity | None:
    """Identify point packets (k, size); None if they are not ROBOSENSE's."""
    for layout in rows.LAYOUTS:
        chosen = majority(packets, fits(packets, layout))
        if chosen is not None:
            return _identity(chosen, layout)
    return None


def _identity(packets: U8Array, layout: Layout) -> Identity:
    if layout.block_id == b"\xfe":
        return _ruby(packets, layout)
    old, kind, model = _type_bytes(packets)
    if layout.magic == SECOND_KIND:
        found = _TYPES.get((kind, model)) or _TYPES.get((kind, None))
        if found is None and layout is rows.HELIOS_LAYOUT and {_HELIOS, _HELIOS_16} & {old, kind}:
            found = _helios(packets, kind if kind in (_HELIOS, _HELIOS_16) else old)
    else:
        found = _FIRST_TYPES.get(old) or _FIRST_TYPES.get(kind)
        if kind == _BPEARL and model in (0, _BPEARL_V4_MODEL):
            found = _bpearl(packets, model)
    if found is None or (found.model is not None and found.model.layout != layout):
        return Identity(f"of unknown model (type bytes {old:02X} {kind:02X} {model:02X})", None)
    return found


def _type_bytes(packets: U8Array) -> tuple[int, int, int]:
    old, kind, model = (most_common(number(packets, at, 1)) for at in _TYPE_BYTES)
    return old, kind, model


def _bpearl(packets: U8Array, model: int) -> Identity:
    """Bpearl of type 3: model 4 is a v4; model 0 is either, distinguished by the form of times."""
    if model == _BPEARL_V4_MODEL:
        return _BPEARL_V4
    versions = [_BPEARL_V4, _FIRST_TYPES[_BPEARL]]
    if in_time_form(packets, rows.BPEARL_V4).is_calendar:
        versions.reverse()
    return replace(versions[0], other=versions[1].model, doubt=_BPEARL_DOUBT)


def _helios(packets: U8Array, kind: int) -> Identity:
    """Helios of a type without model byte, distinguished by the time a block takes.

    A block is one round of 32 lines, or two rounds of 16 (one round with two returns).
    """
    narrow = Identity("Helios 16", rows.HELIOS_16)
    wide = Identity("Helios 32", rows.HELIOS_32)
    if kind == _HELIOS_16 or returns_of(packets, rows.HELIOS_16) == 1:
        return narrow
    if returns_of(packets, rows.HELIOS_32) == 2:
        return wide
    return replace(wide, other=rows.HELIOS_16, doubt=_HELIOS_DOUBT)


def ruby_type(packets: U8Array) -> tuple[int, int, bool]:
    """Type and model of Ruby packets, and whether they are at bytes 30 and 31, not 31 and 32."""
    old, kind, model = _type_bytes(packets)
    if old not in _RUBY_TYPES and kind in _RUBY_TYPES:
        return kind, model, False
    return old, kind, True


def _ruby(packets: U8Array, layout: Layout) -> Identity:
    ruby, plus = _RUBIES[layout.per_block]
    kind, model, is_early = ruby_type(packets)
    if is_early and layout is rows.RUBY_80_LAYOUT and model in _PLUS_80_MODELS:
        return Identity(plus.name, plus)
    own, other = (plus, ruby) if kind == _RUBY_PLUS_TYPE else (ruby, plus)
    return Identity(f"{ruby.name} or {plus.name}", own, other, _RUBY_DOUBT)


def returns_of(packets: U8Array, model: Model) -> int:
    """Returns per shot: by the mode byte, by azimuths, or by pace; 0: unknown."""
    layout = model.layout
    chosen = majority(packets, fits(packets, layout))
    if chosen is None:
        return 0
    if layout.modes is not None:
        code = most_common(number(chosen, layout.mode_at, 1))
        stated = layout.modes.get(code, layout.other_modes)
        if stated:
            return stated
    azimuth = block_azimuths(chosen, layout.header, layout.stride, layout.blocks, ">")
    if model.rounds_per_block == 1:
        is_moving = bool((azimuth[:, 0] != azimuth[:, -1]).all())
        is_dual = in_pairs(azimuth) if layout.blocks % 2 == 0 else _repeats(azimuth)
        return 1 + is_dual if is_moving else 0
    # A block has one round of two returns, or two rounds of one.
    stamp_ns, _ = times_ns(chosen, model)
    took_us = block_time_us(stamp_ns // NS_PER_US % US_PER_MINUTE, azimuth, US_PER_MINUTE)
    for returns in (1, 2):
        expected_us = model.rounds_per_block / returns * model.round_ns / 1000
        if took_us is not None and abs(took_us - expected_us) < _PACE_TOLERANCE * expected_us:
            return returns
    return 0


def _repeats(azimuth: I64Array) -> bool:
    """Whether most packets have a pair of equal azimuths, with an odd number of blocks."""
    return float((azimuth[:, 1:] == azimuth[:, :-1]).any(axis=1).mean()) > 0.75


def _lidar(model: str, mode: str = "") -> str:
    return f"{VENDOR} lidar {model}{', ' if mode else ''}{mode}"
