"""Names of HESAI packets by content: sizes, header versions, return modes in the tail.

Source: docs/sources/hesai.md sections 1 to 4; docs/sources/messages.md section 2 (correction);
HesaiTechnology/ HesaiLidar_SDK_2.0 `libhesai` (fault messages of 99 bytes begin with CD DC),
HesaiLidar_General_SDK (Pandar20: 8 + 20 x 62 + 22 = 1270 bytes, never a sequence number).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import BoolArray, U8Array
from mlbatch.sensors.hesai import PREFIX_SIZE
from mlbatch.sensors.hesai import models as rows
from mlbatch.sensors.hesai.models import Model
from mlbatch.sensors.hesai.packets import (
    AMBIENT,
    ONLY_RETURN,
    RETURN_MODES,
    SEQUENCE,
    Layout,
    ReturnMode,
    least_size,
    tail_at,
    unit_mm,
)
from mlbatch.sensors.packet_bytes import (
    NO_DECODER,
    has_bytes,
    majority,
    most_common,
    number,
    payload_rows,
)

_SOP = b"\xee\xff"
_BLOCK_FLAG = b"\xff\xee"
_HEADER_SIZE = 12
_OTHERS = (
    (512, _BLOCK_FLAG, "GPS packet"),
    (99, b"\xcd\xdc", "fault packet"),
    (0, bytes.fromhex("47740500"), "correction"),
)
_SEQUENCE_SIZE = 4
# Bytes of a header that stay the same: marker, version, lasers, blocks, distance unit, flags.
_FIXED = (0, 1, 2, 3, 6, 7, 9, 11)
_FIXED_64 = (0, 1, 2, 3, 5)
_FIXED_JT16 = (0, 1, 2, 3, 5)
_PANDAR40_BLOCKS = 10
_PANDAR40_STRIDE = 124
# Models whose header has lasers and blocks: payloads without and with a sequence number.
_SIZED: tuple[tuple[Model, int, tuple[int, ...]], ...] = (
    (rows.PANDAR64, 6, (1194, 1198)),
    (rows.PANDAR64, 7, (1388, 1392)),
    (rows.PANDAR20A, 20, (1270,)),
)
_PANDAR40_SIZE = 1262
_PANDAR40_UNDATED_SIZE = 1256
_PANDAR20_MAGIC = _SOP + bytes((20, 20))
_JT16_IMU_SIZE = 34
_JT16_SIZE = 80


@dataclass(frozen=True, slots=True)
class Identity:
    """Model and mode of packets of a stream.

    mode: None if unknown.
    layout: None without a decoder.
    """

    name: str
    mode: ReturnMode | None = None
    layout: Layout | None = None


@dataclass(frozen=True, slots=True)
class _Family:
    """Models of a protocol version, distinguished by lasers and blocks.

    name: of models that are not in the list.
    spins: False for automotive models, which may have a prefix.
    """

    name: str
    models: tuple[Model, ...] = ()
    spins: bool = True


# Early firmware, known only from the manual: named, not decoded.
_PANDAR128 = replace(
    rows.PANDAR128E3X,
    name="Pandar128",
    tail=rows.Tail(24, date_at=18, us_at=12, mode_at=16),
    has_flagged_units=False,
    has_checks=False,
)
_FAMILIES: Mapping[tuple[int, int], _Family] = {
    (1, 3): _Family("Pandar128", (_PANDAR128,)),
    (1, 8): _Family("JT16", (rows.JT16,)),
    (3, 1): _Family("PandarQT{}", (rows.PANDARQT64,)),
    (3, 2): _Family("QT128C2X", (rows.QT128,)),
    (4, 1): _Family("AT128", (rows.AT128,), spins=False),
    (4, 3): _Family("AT128", (rows.AT128,), spins=False),
    (4, 7): _Family("ATX", spins=False),
    (6, 1): _Family("PandarXT of {} channels", (rows.XT16, rows.XT32, rows.XT32M2X)),
    (7, 2): _Family("FT120", spins=False),
}
_UNDECODED = frozenset({"Pandar128"})
# Packets sent by several models.
_ALIKE = {
    rows.PANDAR40P.name: "Pandar40P or Pandar40M",
    rows.PANDAR20A.name: "Pandar20A or Pandar20B",
}
# Protocol 1.4 by the version of the status info: the first one at or below it.
_STATUS_VERSION = (1, 4)
_STATUS_VERSIONS = ((137, rows.JT128), (128, rows.OT128), (0, rows.PANDAR128E3X))


def describe(size: int, sample: U8Array) -> str | None:
    """Name payloads (k, size); None if they are not HESAI's."""
    packets = payload_rows(size, sample)
    if packets is None:
        return None
    for expected, magic, name in _OTHERS:
        good = has_bytes(packets, magic)
        if name == "GPS packet":
            good &= _digits(packets, 2, 14)
        if expected in (0, size) and majority(packets, good) is not None:
            return f"HESAI {name}"
    are_imu = has_bytes(packets, _SOP + b"\x01\x08")
    if size == _JT16_IMU_SIZE and majority(packets, are_imu) is not None:
        return "HESAI IMU packet, JT16"
    found = identify(size, packets)
    if found is None:
        return None
    name = _ALIKE.get(found.name, found.name)
    mode = "" if found.mode is None else f", {found.mode.text}"
    return f"HESAI lidar {name}{mode}{'' if found.layout else NO_DECODER}"


def identify(size: int, packets: U8Array) -> Identity | None:
    """Identify payloads (k, size) of a stream; None if they are not of a HESAI lidar."""
    return (
        _identify_sized(size, packets)
        or _identify_version(size, 0, packets)
        or _identify_version(size, PREFIX_SIZE, packets[:, PREFIX_SIZE:])
    )


def _digits(packets: U8Array, begin: int, end: int) -> BoolArray:
    """(k,) whether these bytes are ASCII digits."""
    text = packets[:, begin:end]
    return np.asarray(((text >= ord("0")) & (text <= ord("9"))).all(axis=1))


def _identify_sized(size: int, packets: U8Array) -> Identity | None:
    """Models whose headers have no protocol version."""
    flagged = np.ones(len(packets), np.bool_)
    for block in range(_PANDAR40_BLOCKS):
        flagged &= has_bytes(packets, _BLOCK_FLAG, _PANDAR40_STRIDE * block)
    chosen = majority(packets, flagged)
    if chosen is not None:
        if size == _PANDAR40_UNDATED_SIZE:
            return Identity("Pandar40", RETURN_MODES.get(most_common(number(chosen, 1254, 1))))
        if size in (_PANDAR40_SIZE, _PANDAR40_SIZE + _SEQUENCE_SIZE):
            flags = SEQUENCE if size > _PANDAR40_SIZE else 0
            return _identity(rows.PANDAR40P, size, 0, chosen, _PANDAR40_BLOCKS, flags, ())
    for model, blocks, sizes in _SIZED:
        chosen = majority(packets, has_bytes(packets, _SOP + bytes((model.channels, blocks))))
        if chosen is not None and size in sizes:
            flags = SEQUENCE if size > sizes[0] else 0
            return _identity(model, size, 0, chosen, blocks, flags, _FIXED_64)
    if majority(packets, has_bytes(packets, _PANDAR20_MAGIC)) is not None:
        return Identity("Pandar20")
    return None


def _identify_version(size: int, prefix: int, packets: U8Array) -> Identity | None:
    """Models whose header has a protocol version; the size must suffice for its blocks."""
    if packets.shape[1] < _HEADER_SIZE:
        return None
    chosen = majority(packets, has_bytes(packets, _SOP))
    if chosen is None:
        return None
    head = [most_common(number(chosen, at, 1)) for at in range(_HEADER_SIZE)]
    version = head[2], head[3]
    same = majority(packets, has_bytes(packets, bytes((*_SOP, *version))))
    family = _family(version, head[4])
    if family is None or same is None or (prefix and family.spins):
        return None
    if not family.models:
        return Identity(family.name)
    lasers = head[6]
    blocks = head[7]
    flags = head[11]
    fixed: tuple[int, ...] = _FIXED
    if family.models == (rows.JT16,):
        # Its header has no lasers, blocks or flags, but it always has a sequence number.
        lasers = rows.JT16.channels
        blocks = 1
        flags = SEQUENCE
        fixed = _FIXED_JT16
        if size != _JT16_SIZE or head[5] != 0:
            return None
    return _identity(_model(family, lasers, blocks), size, prefix, same, blocks, flags, fixed)


def _family(version: tuple[int, int], status: int) -> _Family | None:
    if version != _STATUS_VERSION:
        return _FAMILIES.get(version)
    model = next(model for least, model in _STATUS_VERSIONS if status >= least)
    return _Family(model.name + ", {} channels", (model,))


def _model(family: _Family, lasers: int, blocks: int) -> Model:
    """Model with these lasers and blocks; if there is none, a model without decoder to name."""
    for model in family.models:
        if model.channels == lasers and blocks in model.blocks:
            return model
    first = family.models[0]
    name = family.name.format(lasers)
    return replace(first, name=name, channels=lasers, blocks=(), most_returns=0)


def _identity(
    model: Model,
    size: int,
    prefix: int,
    packets: U8Array,
    blocks: int,
    flags: int,
    fixed: tuple[int, ...],
) -> Identity | None:
    """Identify packets of a model; packets: without their prefix."""
    tail = tail_at(model, blocks, flags)
    if prefix + least_size(model, blocks, flags) > size:
        return None
    mode: ReturnMode | None = ONLY_RETURN
    if model.tail.mode_at is not None:
        mode = RETURN_MODES.get(most_common(number(packets, tail + model.tail.mode_at, 1)))
    # Use the most frequent value, since single headers may be damaged.
    head = {at: most_common(number(packets, at, 1)) for at in fixed}
    is_selection = model is rows.QT128 and bool(flags & AMBIENT)
    millimetres = unit_mm(model, head)
    if (
        mode is None
        or model.name in _UNDECODED
        or is_selection
        or not millimetres
        or mode.returns > model.most_returns
        or blocks % mode.returns
    ):
        return Identity(model.name, mode)
    layout = Layout(model, size, prefix, blocks, flags, millimetres, mode, head)
    return Identity(model.name, mode, layout)
