"""ROBOSENSE models as rows: where their bytes lie, when their channels fire.

Source: docs/sources/robosense.md sections 1 to 6; the firing times of 80- and 48-line models, for
which it names the files of the vendor's driver: `decoder_RS80`, `RS48`, `RSP80`, `RSP48.hpp` of
rs_driver.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

FIRST = bytes.fromhex("55aa050a5aa550a0")
SECOND = bytes.fromhex("55aa055a")
STRONGEST = "strongest"
LAST = "last"
NEAREST = "nearest"
DUAL = "dual"


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
    """A model.

    marks: bytes of all its MSOP packets; counter_at, range_step_at: 0 where there is none;
    block_id: one byte, followed by the return number, or two; slots: readings of a block;
    channels: of a column; firing_us: after the column begins; lens_m: radius and height;
    modes: DIFOP byte 300; wave_modes: offset in MSOP packets, and the values of single and dual
    ones there; span_deg: elevations of a made-up unit.
    """

    name: str
    marks: Mapping[int, bytes]
    channels: int
    unit_m: float
    round_us: float
    firing_us: tuple[float, ...]
    lens_m: tuple[float, float]
    angles: AngleLayout
    modes: Mapping[str, int]
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


def _runs(step_us: float, counts: str) -> tuple[float, ...]:
    """Times 0, step, 2 steps...: the n-th as often as the n-th digit says."""
    return tuple(step_us * n for n, count in enumerate(counts) for _ in range(int(count)))


def _grouped(times_us: str, counts: str) -> tuple[float, ...]:
    """The n-th time as often as the n-th digit says; one digit is for all."""
    times = [float(text) for text in times_us.split()]
    digits = counts if len(counts) > 1 else counts * len(times)
    pairs = zip(times, digits, strict=True)
    return tuple(time for time, count in pairs for _ in range(int(count)))


_BPEARL_V4_US = _grouped(
    "0 1.67 3.34 5.00 6.67 8.34 10.01 11.68 13.34 15.01 16.68 18.35 20.02 21.68 23.35 25.02 26.69"
    " 28.36 30.02 31.69 33.36 35.03 36.70 38.36 40.03 41.70 43.37 45.04 46.70 48.37 50.04 51.71",
    "1",
)
AIRY_NORMAL_US = "0 5.712 12.376 19.040 25.704 33.320 41.888 50.456 59.024 70.448 81.872 93.296"
AIRY_SIDE_US = "0 11.424 22.848 34.272 45.696 54.264 62.832 71.400 79.016 85.680 92.344 99.008"
AIRY_M_US = "0 7.616 16.184 24.752 33.320 42.840 52.360 61.880 71.400 79.968 88.536 97.104"
_RUBY_PLUS_128_US = _grouped(
    "0 1.13 2.13 3.26 4.26 5.38 6.38 7.51 8.51 10.01 11.38 13.31 15.11 17.04 18.85 21.14 23.31"
    " 25.61 27.78 30.07 32.24 34.54 36.70 38.64 40.44 41.94 43.30 44.80 46.17 47.66 49.03 50.53"
    " 53.771",
    "4" * 15 + "5" + "4" * 15 + "21",
)
_PLUS_US = (
    "0 1.217 2.434 3.652 4.869 6.086 7.304 8.521 9.739 11.323 12.907 14.924 16.941 18.959 20.976"
    " 23.127 25.278 27.428 29.579 31.963"
)
_PLUS_LATER_US = " 34.347 36.498 38.648 40.666"
_RUBY_80_US = _runs(3.236, "3243333222222223") + _runs(3.236, "3332423322232123")
_RUBY_48_US = _runs(3.236, "1111222211112222") * 2

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
    {0: FIRST, 30: b"\x01"},
    channels=16,
    unit_m=0.005,
    round_us=55.5,
    firing_us=tuple(2.8 * k for k in range(16)),
    lens_m=(0.03825, 0.0),
    angles=AngleLayout(1165, 0, 16, 0.0001, sign_bytes=False),
    modes=_OLD_MODES,
    is_calendar=True,
    span_deg=(-15.0, 15.0),
)
_RS32 = replace(
    _RS16,
    name="RS-32",
    marks={0: FIRST, 30: b"\x02"},
    channels=32,
    round_us=55.52,
    # The sheet counts channels from 1: k / 16, so that 16 and 32 are the odd ones out.
    firing_us=tuple(2.88 * ((k - 1) % 16) + 1.44 * (k // 16) for k in range(1, 33)),
    lens_m=(0.03997, 0.0),
    angles=AngleLayout(468, 564, 32, 0.001),
    span_deg=(-25.0, 15.0),
)
_BPEARL_V3 = replace(
    _RS32,
    name="Bpearl v3",
    marks={0: FIRST, 30: b"\x03"},
    firing_us=tuple(2.56 * (k % 16) + 1.28 * (k // 16) + 5.2 * (k % 16 > 7) for k in range(32)),
    lens_m=(0.01473, 0.09427),
    angles=_CENTI,
    counter_at=12,
    span_deg=(2.0, 88.0),
)
_BPEARL_V4 = replace(
    _BPEARL_V3,
    name="Bpearl v4",
    marks={0: FIRST, 31: b"\x03\x04"},
    unit_m=0.0025,
    round_us=55.56,
    firing_us=_BPEARL_V4_US,
    lens_m=(0.01619, 0.09571),
    modes=_NEW_MODES,
    is_calendar=False,
)
_HELIOS_32 = replace(
    _BPEARL_V4,
    name="Helios 32",
    marks={0: SECOND, 4: b"\x00\x01", 31: b"\x06\x01"},
    firing_us=tuple(1.73 * k for k in range(32)),
    lens_m=(0.03498, 0.0),
    range_step_at=17,
    span_deg=(-55.0, 15.0),
)
_HELIOS_16 = replace(
    _HELIOS_32,
    name="Helios 16",
    marks={0: SECOND, 4: b"\x00\x01", 31: b"\x06\x03"},
    channels=16,
    # By the manual; the driver begins at 0.
    firing_us=tuple(27.68 + 1.73 * k for k in range(16)),
    span_deg=(-15.0, 15.0),
)
_AIRY_96 = replace(
    _HELIOS_32,
    name="Airy 96",
    marks={0: SECOND, 4: b"\x00\x01", 31: b"\x31\x02"},
    channels=96,
    unit_m=0.005,
    round_us=111.08,
    firing_us=_grouped(AIRY_NORMAL_US, "8"),
    lens_m=(0.01002, 0.04532),
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
    marks={0: SECOND, 4: b"\x00\x01", 31: b"\x04"},
    channels=128,
    unit_m=0.005,
    round_us=55.55,
    firing_us=tuple(3.236 * (k % 64 // 4) for k in range(128)),
    lens_m=(0.03615, 0.0),
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
_RUBY_80 = replace(
    _RUBY_128, name="Ruby 80", channels=80, slots=80, blocks=4, round_us=55.552,
    firing_us=_RUBY_80_US,
)  # fmt: skip
_RUBY_48 = replace(
    _RUBY_80, name="Ruby 48", channels=48, slots=48, blocks=8, size=1268, firing_us=_RUBY_48_US
)


def _plus(
    old: RobosenseModel, name: str, firing_us: tuple[float, ...], kind: int
) -> RobosenseModel:
    return replace(
        old,
        name=name,
        marks={0: SECOND, 4: b"\x00\x01", 31: bytes((5, kind))},
        round_us=55.56,
        firing_us=firing_us,
        lens_m=(0.02892, 0.0),
        modes=_PLUS_MODES,
    )


def _early_plus(plus: RobosenseModel, kind: int) -> RobosenseModel:
    """Type and model a byte earlier, as in the header of rs_driver."""
    return replace(plus, marks={0: SECOND, 4: b"\x00\x01", 30: bytes((5, kind))})


_PLUS_80_US = _grouped(
    _PLUS_US + _PLUS_LATER_US + " 42.683 50.603 52.187 53.771", "4423222222224444444444221132"
)
MODELS: Mapping[str, RobosenseModel] = {
    model.name: model
    for model in (
        _RS16,
        _RS32,
        _BPEARL_V3,
        _BPEARL_V4,
        _HELIOS_32,
        # Seen on a real unit: the type where rs_driver has it, and no model.
        replace(
            _HELIOS_32,
            name="Helios 32, early type",
            marks={0: SECOND, 4: b"\x00\x01", 30: b"\x06\x00\x00"},
        ),
        replace(_HELIOS_32, name="Helios 32-31", marks={**_HELIOS_32.marks, 32: b"\x02"}),
        replace(_HELIOS_32, name="Helios 32-26", marks={**_HELIOS_32.marks, 32: b"\x04"}),
        _HELIOS_16,
        replace(_HELIOS_16, name="Helios 1615", marks={**_HELIOS_16.marks, 31: b"\x07\x00"}),
        replace(
            _HELIOS_16,
            name="Helios 16, early type",
            marks={0: SECOND, 4: b"\x00\x01", 30: b"\x06\x00\x00"},
        ),
        _AIRY_96,
        replace(
            _AIRY_96,
            name="Airy 48",
            marks={**_AIRY_96.marks, 32: b"\x01"},
            channels=48,
            firing_us=_grouped(AIRY_M_US, "4"),
        ),
        _RUBY_128,
        _RUBY_80,
        _RUBY_48,
        _plus(_RUBY_128, "Ruby Plus 128", _RUBY_PLUS_128_US, 0),
        _plus(_RUBY_80, "Ruby Plus 80", _PLUS_80_US, 2),
        _plus(_RUBY_80, "Ruby Plus 80v", _grouped(_PLUS_US, "4"), 3),
        _early_plus(_plus(_RUBY_80, "Ruby Plus 80, early type", _PLUS_80_US, 2), 2),
        _early_plus(_plus(_RUBY_80, "Ruby Plus 80v, early type", _grouped(_PLUS_US, "4"), 3), 3),
        _plus(_RUBY_48, "Ruby Plus 48", _grouped(_PLUS_US + _PLUS_LATER_US, "2"), 0),
    )
}
# DIFOP byte 289 and the firing times of an Airy that is mounted so.
AIRY_MOUNTS: Mapping[str, tuple[int, tuple[float, ...]]] = {
    "normal": (0, _grouped(AIRY_NORMAL_US, "8")),
    "side": (1, _grouped(AIRY_SIDE_US, "8")),
    "M": (2, _grouped(AIRY_M_US, "8")),
}
