"""ROBOSENSE packets by model, for the encoder: where their bytes lie.

Source: docs/sources/robosense.md sections 1 to 4, 6 and 7. Firing times, lenses and units are those
of the rows in `mlbatch/sensors/robosense/models.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from mlbatch.sensors.robosense import models as rows
from mlbatch.sensors.robosense.models import Model

FIRST = bytes.fromhex("55aa050a5aa550a0")
SECOND = bytes.fromhex("55aa055a")
STRONGEST = "strongest"
LAST = "last"
NEAREST = "nearest"
DUAL = "dual"
# Suffix of rows for packets that name their model a byte earlier.
EARLY = ", early type"


@dataclass(frozen=True, slots=True)
class AngleLayout:
    """Where a DIFOP has angles, and degrees per count; `azimuth_at` 0: nowhere.

    sign_bytes: without them elevations are three-byte numbers, negative in the lower half.
    """

    elevation_at: int
    azimuth_at: int
    slots: int
    unit_deg: float
    sign_bytes: bool = True


@dataclass(frozen=True, slots=True)
class RobosenseModel:
    """Packets of a row.

    name: of this kind of packets; marks: bytes of all its MSOP packets; firing: which of the row's
    firing times; counter_at, range_step_at: 0 where there is none; block_id: one byte, followed by
    the return number, or two; slots: readings of a block; modes: DIFOP byte 300; wave_modes: offset
    in MSOP packets, and the values of single and dual ones there; span_deg: elevations of a made-up
    unit.
    """

    name: str
    row: Model
    marks: Mapping[int, bytes]
    angles: AngleLayout
    modes: Mapping[str, int]
    firing: int = 0
    size: int = 1248
    header: int = 42
    time_at: int = 20
    is_calendar: bool = False
    block_id: bytes = b"\xff\xee"
    blocks: int = 12
    slots: int = 32
    counter_at: int = 0
    range_step_at: int = 0
    wave_modes: tuple[int, int, int] | None = None
    span_deg: tuple[float, float] = (-25.0, 15.0)


_OLD_MODES = {DUAL: 0, STRONGEST: 1, LAST: 2}
_NEW_MODES = {DUAL: 0, STRONGEST: 4, LAST: 5, NEAREST: 6}
_RUBY_MODES = {DUAL: 3, STRONGEST: 1, LAST: 2}
_PLUS_MODES = {STRONGEST: 0, LAST: 1, NEAREST: 2, DUAL: 3}
# The manual lists no dual mode here; 3 is what the point packets say.
_AIRY_MODES = {STRONGEST: 0, NEAREST: 1, LAST: 2, DUAL: 3}
_CENTI = AngleLayout(468, 564, 32, 0.01)
_RUBY_ANGLES = AngleLayout(468, 852, 128, 0.01)

_RS16 = RobosenseModel(
    "RS-16",
    rows.RS16,
    {0: FIRST, 30: b"\x01"},
    AngleLayout(1165, 0, 16, 0.0001, sign_bytes=False),
    _OLD_MODES,
    is_calendar=True,
    span_deg=(-15.0, 15.0),
)
_RS32 = replace(
    _RS16,
    name="RS-32",
    row=rows.RS32,
    marks={0: FIRST, 30: b"\x02"},
    angles=AngleLayout(468, 564, 32, 0.001),
    span_deg=(-25.0, 15.0),
)
_BPEARL_V3 = replace(
    _RS32,
    name="Bpearl v3",
    row=rows.BPEARL_V3,
    marks={0: FIRST, 30: b"\x03"},
    angles=_CENTI,
    counter_at=12,
    span_deg=(2.0, 88.0),
)
_BPEARL_V4 = replace(
    _BPEARL_V3,
    name="Bpearl v4",
    row=rows.BPEARL_V4,
    marks={0: FIRST, 31: b"\x03\x04"},
    modes=_NEW_MODES,
    is_calendar=False,
)
_HELIOS_32 = replace(
    _BPEARL_V4,
    name="Helios 32",
    row=rows.HELIOS_32,
    marks={0: SECOND, 4: b"\x00\x01", 31: b"\x06\x01"},
    range_step_at=17,
    span_deg=(-55.0, 15.0),
)
_HELIOS_16 = replace(
    _HELIOS_32,
    name="Helios 16",
    row=rows.HELIOS_16,
    marks={0: SECOND, 4: b"\x00\x01", 31: b"\x06\x03"},
    span_deg=(-15.0, 15.0),
)
_AIRY_96 = replace(
    _HELIOS_32,
    name="Airy 96",
    row=rows.AIRY_96,
    marks={0: SECOND, 4: b"\x00\x01", 31: b"\x31\x02"},
    angles=AngleLayout(468, 756, 96, 0.01),
    modes=_AIRY_MODES,
    blocks=8,
    slots=48,
    range_step_at=0,
    wave_modes=(17, 0, 3),
    span_deg=(0.0, 89.0),
)
_RUBY_128 = replace(
    _HELIOS_32,
    name="Ruby 128",
    row=rows.RUBY_128,
    marks={0: SECOND, 4: b"\x00\x01", 31: b"\x04"},
    angles=_RUBY_ANGLES,
    modes=_RUBY_MODES,
    header=80,
    time_at=10,
    block_id=b"\xfe",
    blocks=3,
    slots=128,
    counter_at=0,
    range_step_at=0,
    wave_modes=(7, 1, 3),
    span_deg=(-25.0, 15.0),
)
_RUBY_80 = replace(_RUBY_128, name="Ruby 80", row=rows.RUBY_80, slots=80, blocks=4)
_RUBY_48 = replace(_RUBY_80, name="Ruby 48", row=rows.RUBY_48, slots=48, blocks=8, size=1268)


def _plus(old: RobosenseModel, row: Model, kind: int) -> RobosenseModel:
    marks = {0: SECOND, 4: b"\x00\x01", 31: bytes((5, kind))}
    return replace(old, name=row.name, row=row, marks=marks, modes=_PLUS_MODES)


def _early(model: RobosenseModel, *kinds: int) -> RobosenseModel:
    """Type and model a byte earlier, as in the header of rs_driver."""
    marks = {0: SECOND, 4: b"\x00\x01", 30: bytes(kinds)}
    return replace(model, name=model.name + EARLY, marks=marks)


_PLUS_80 = _plus(_RUBY_80, rows.RUBY_PLUS_80, 2)
_PLUS_80V = replace(_plus(_RUBY_80, rows.RUBY_PLUS_80, 3), name="Ruby Plus 80v", firing=1)
MODELS: Mapping[str, RobosenseModel] = {
    model.name: model
    for model in (
        _RS16,
        _RS32,
        _BPEARL_V3,
        _BPEARL_V4,
        _HELIOS_32,
        # Seen on a real unit: the type where rs_driver has it, and no model.
        _early(_HELIOS_32, 6, 0, 0),
        replace(_HELIOS_32, name="Helios 32-31", marks={**_HELIOS_32.marks, 32: b"\x02"}),
        replace(_HELIOS_32, name="Helios 32-26", marks={**_HELIOS_32.marks, 32: b"\x04"}),
        _HELIOS_16,
        replace(_HELIOS_16, name="Helios 1615", marks={**_HELIOS_16.marks, 31: b"\x07\x00"}),
        _early(_HELIOS_16, 6, 0, 0),
        _AIRY_96,
        replace(_AIRY_96, name="Airy 48", row=rows.AIRY_48, marks={**_AIRY_96.marks, 32: b"\x01"}),
        _RUBY_128,
        _RUBY_80,
        _RUBY_48,
        _plus(_RUBY_128, rows.RUBY_PLUS_128, 0),
        _PLUS_80,
        _PLUS_80V,
        _early(_PLUS_80, 5, 2),
        _early(_PLUS_80V, 5, 3),
        _plus(_RUBY_48, rows.RUBY_PLUS_48, 0),
    )
}
# How an Airy is mounted: its number is DIFOP byte 289, and that of its firing times.
AIRY_MOUNTS = ("normal", "side", "M")
