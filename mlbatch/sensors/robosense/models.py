"""ROBOSENSE models as tables: packet layouts, firing times, lens positions.

Source: docs/sources/robosense.md sections 1 to 6 (the vendor's rs_driver and manuals). Firing times
of the 80- and 48-line models (section 5): rs_driver, `decoder_RS80.hpp`, `decoder_RS48.hpp`,
`decoder_RSP80.hpp`, `decoder_RSP48.hpp`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace


def _ns(times_us: str) -> tuple[int, ...]:
    """Times in us as ns; `t*n`: n channels fire at t."""
    times_ns: list[int] = []
    for text in times_us.split():
        time, _, count = text.partition("*")
        times_ns += [round(float(time) * 1000)] * int(count or 1)
    return tuple(times_ns)


def _each(times_us: str, channels: int) -> tuple[int, ...]:
    """Times in us as ns, with so many channels at each."""
    return _ns(" ".join(f"{time}*{channels}" for time in times_us.split()))


def _steps(counts: str) -> tuple[int, ...]:
    """Ruby: groups of channels 3.236 us apart; counts: channels of each group."""
    return tuple(3236 * group for group, count in enumerate(counts) for _ in range(int(count)))


_BPEARL_V4_NS = _ns(
    "0 1.67 3.34 5.00 6.67 8.34 10.01 11.68 13.34 15.01 16.68 18.35 20.02 21.68 23.35 25.02 "
    "26.69 28.36 30.02 31.69 33.36 35.03 36.70 38.36 40.03 41.70 43.37 45.04 46.70 48.37 50.04 "
    "51.71"
)
_AIRY_NORMAL = "0 5.712 12.376 19.040 25.704 33.320 41.888 50.456 59.024 70.448 81.872 93.296"
_AIRY_SIDE = "0 11.424 22.848 34.272 45.696 54.264 62.832 71.400 79.016 85.680 92.344 99.008"
_AIRY_M = "0 7.616 16.184 24.752 33.320 42.840 52.360 61.880 71.400 79.968 88.536 97.104"
_RUBY_PLUS_128_NS = _ns(
    "0*4 1.13*4 2.13*4 3.26*4 4.26*4 5.38*4 6.38*4 7.51*4 8.51*4 10.01*4 11.38*4 13.31*4 15.11*4 "
    "17.04*4 18.85*4 21.14*5 23.31*4 25.61*4 27.78*4 30.07*4 32.24*4 34.54*4 36.70*4 38.64*4 "
    "40.44*4 41.94*4 43.30*4 44.80*4 46.17*4 47.66*4 49.03*4 50.53*2 53.771"
)
_RUBY_PLUS_80_NS = _ns(
    "0*4 1.217*4 2.434*2 3.652*3 4.869*2 6.086*2 7.304*2 8.521*2 9.739*2 11.323*2 12.907*2 "
    "14.924*2 16.941*4 18.959*4 20.976*4 23.127*4 25.278*4 27.428*4 29.579*4 31.963*4 34.347*4 "
    "36.498*4 38.648*2 40.666*2 42.683 50.603 52.187*3 53.771*2"
)
_RUBY_PLUS = (
    "0 1.217 2.434 3.652 4.869 6.086 7.304 8.521 9.739 11.323 12.907 14.924 16.941 18.959 20.976 "
    "23.127 25.278 27.428 29.579 31.963"
)
_RUBY_PLUS_LONG = _RUBY_PLUS + " 34.347 36.498 38.648 40.666"
_RUBY_80_NS = _steps("3243333222222223") + _steps("3332423322232123")
_RUBY_48_NS = _steps("1111222211112222") * 2
_AIRY_96_NS = (_each(_AIRY_NORMAL, 8), _each(_AIRY_SIDE, 8), _each(_AIRY_M, 8))
_AIRY_48_NS = _each(_AIRY_M, 4)
_RUBY_PLUS_80V_NS = _each(_RUBY_PLUS, 4)
_RUBY_PLUS_48_NS = _each(_RUBY_PLUS_LONG, 2)


VENDOR = "ROBOSENSE"
FIRST_KIND = bytes.fromhex("55aa050a5aa550a0")
SECOND_KIND = bytes.fromhex("55aa055a")
# First bytes of a device packet.
DIFOP = bytes.fromhex("a5ff005a11115555")
# Numbers of return types, docs/sources/outputs.md section 3; the nearest return has none of its
# own.
STRONGEST = 1
LAST = 2
OTHER = 0
READING = 3  # bytes: distance u16, reflectivity u8


@dataclass(frozen=True, slots=True)
class Layout:
    """Packet layout: `header` bytes, then `blocks` of four bytes and `per_block` readings.

    mode_at: byte of the return mode (0: none).
    modes: returns by its values, else `other_modes` (0: unknown).
    point_at: byte that is 0 in point packets (0: none).
    """

    # First bytes of a packet.
    magic: bytes
    header: int
    # First bytes of a block.
    block_id: bytes
    blocks: int
    per_block: int
    # Byte of the timestamp.
    time_at: int = 20
    mode_at: int = 0
    modes: Mapping[int, int] | None = None
    other_modes: int = 0
    point_at: int = 0

    @property
    def stride(self) -> int:
        """Bytes from block to block."""
        return 4 + READING * self.per_block

    @property
    def end(self) -> int:
        """Least size of a packet."""
        return self.header + self.blocks * self.stride


@dataclass(frozen=True, slots=True)
class AngleOffsets:
    """Offsets of angles in a DIFOP packet; azimuth_at 0: none.

    Without a sign byte (not `signed`) the lower half of the channels points down.
    """

    elevation_at: int
    azimuth_at: int
    unit_deg: float
    signed: bool = True


@dataclass(frozen=True, slots=True)
class ReturnMode:
    """A value of DIFOP byte 300: returns of a shot, and the type of a single one."""

    returns: int
    type: int
    name: str = ""


@dataclass(frozen=True, slots=True)
class Model:
    """A model.

    round_ns: column period.
    firing_ns: of each channel after the begin of its round, several if packets choose.
    units_per_m: raw distances in a metre.
    range_mask: their bits.
    lens_m: radius and height of the lens.
    nominal_deg: elevations to assume without the unit's.
    spans_deg: lowest and highest beam by the data sheets, of each variant; empty where all models
        with as many channels have the same.
    mirrors: azimuths count backwards if the rotor is set to reverse (DIFOP byte 337).
    has_sync: DIFOP bytes 301 and 302 are the state of synchronisation.
    """

    name: str
    layout: Layout
    channels: int
    round_ns: int
    firing_ns: tuple[tuple[int, ...], ...]
    units_per_m: int
    lens_m: tuple[float, float]
    # Place of the beam angles in DIFOP packets.
    angles: AngleOffsets
    # By value of DIFOP byte 300.
    modes: Mapping[int, ReturnMode]
    # Text for the table of `mlbatch sensors`.
    verified: str = "one source"
    is_calendar: bool = False
    range_mask: int = 0xFFFF
    nominal_deg: tuple[float, ...] = ()
    spans_deg: tuple[tuple[float, float], ...] = ()
    counter_at: int = 0
    mirrors: bool = False
    has_sync: bool = True

    @property
    def rounds_per_block(self) -> int:
        """Rounds per block: two of 16-line models."""
        return max(1, self.layout.per_block // self.channels)

    @property
    def blocks_per_round(self) -> int:
        """Blocks per round: two of 96-line models."""
        return max(1, self.channels // self.layout.per_block)


# fmt: off
_BPEARL_V4_DEG = (
    2.19, 47.29, 5.01, 50.12, 7.84, 52.94, 10.66, 55.75, 13.47, 58.57, 16.29, 61.39,
    19.11, 64.20, 21.92, 67.01, 24.74, 69.82, 27.56, 72.63, 30.37, 75.44, 33.20, 78.26,
    36.02, 81.07, 38.84, 83.89, 41.66, 86.71, 44.47, 89.55,
)
# fmt: on
_TO_15_DEG = (-25.0, 15.0)
_HEMISPHERE_DEG = (0.0, 90.0)
_DUAL = ReturnMode(2, OTHER)
_STRONGEST = ReturnMode(1, STRONGEST, "strongest")
_LAST = ReturnMode(1, LAST, "last")
_FIRST = ReturnMode(1, OTHER, "first")
_OLD_MODES = {0: _DUAL, 1: _STRONGEST, 2: _LAST}
_NEW_MODES = {0: _DUAL, 4: _STRONGEST, 5: _LAST, 6: _FIRST}
_RUBY_MODES = {3: _DUAL, 1: _STRONGEST, 2: _LAST}
_PLUS_MODES = {0: _STRONGEST, 1: _LAST, 2: _FIRST, 3: _DUAL, 4: _DUAL, 5: _DUAL}
# The manual has no dual mode; point packets state it (byte 17).
_AIRY_MODES = {0: _STRONGEST, 1: _FIRST, 2: _LAST}

FIRST_LAYOUT = Layout(FIRST_KIND, 42, b"\xff\xee", 12, 32)
HELIOS_LAYOUT = replace(FIRST_LAYOUT, magic=SECOND_KIND)
AIRY_LAYOUT = Layout(
    SECOND_KIND, 42, b"\xff\xee", 8, 48, mode_at=17, modes={3: 2}, other_modes=1, point_at=16
)
RUBY_128_LAYOUT = Layout(
    SECOND_KIND, 80, b"\xfe", 3, 128, time_at=10, mode_at=7, modes={1: 1, 3: 2}
)
RUBY_80_LAYOUT = replace(RUBY_128_LAYOUT, blocks=4, per_block=80)
RUBY_48_LAYOUT = replace(RUBY_128_LAYOUT, blocks=8, per_block=48)
LAYOUTS = (
    FIRST_LAYOUT,
    HELIOS_LAYOUT,
    AIRY_LAYOUT,
    RUBY_128_LAYOUT,
    RUBY_80_LAYOUT,
    RUBY_48_LAYOUT,
)

RS16 = Model(
    "RS-LiDAR-16",
    FIRST_LAYOUT,
    channels=16,
    round_ns=55_500,
    firing_ns=(tuple(2800 * k for k in range(16)),),
    units_per_m=200,
    lens_m=(0.03825, 0.0),
    angles=AngleOffsets(1165, 0, 0.0001, signed=False),
    modes=_OLD_MODES,
    verified="two sources",
    is_calendar=True,
    has_sync=False,
)
RS32 = replace(
    RS16,
    name="RS-LiDAR-32",
    channels=32,
    round_ns=55_520,
    # The sheet counts from 1 and divides k by 16, so that channels 16 and 32 fire later.
    firing_ns=(tuple(2880 * ((k - 1) % 16) + 1440 * (k // 16) for k in range(1, 33)),),
    lens_m=(0.03997, 0.0),
    angles=AngleOffsets(468, 564, 0.001),
    spans_deg=(_TO_15_DEG,),
)
BPEARL_V3 = replace(
    RS32,
    name="RS-Bpearl v3",
    firing_ns=(
        tuple(2560 * (k % 16) + 1280 * (k // 16) + 5200 * (k % 16 // 8) for k in range(32)),
    ),
    lens_m=(0.01473, 0.09427),
    angles=AngleOffsets(468, 564, 0.01),
    spans_deg=(_HEMISPHERE_DEG,),
    counter_at=12,
    has_sync=True,
    mirrors=True,
)
BPEARL_V4 = replace(
    BPEARL_V3,
    name="RS-Bpearl v4",
    round_ns=55_560,
    firing_ns=(_BPEARL_V4_NS,),
    units_per_m=400,
    lens_m=(0.01619, 0.09571),
    modes=_NEW_MODES,
    is_calendar=False,
    nominal_deg=_BPEARL_V4_DEG,
)
HELIOS_32 = Model(
    "Helios 32",
    HELIOS_LAYOUT,
    channels=32,
    round_ns=55_560,
    firing_ns=(tuple(1730 * k for k in range(32)),),
    units_per_m=400,
    lens_m=(0.03498, 0.0),
    angles=AngleOffsets(468, 564, 0.01),
    # 5515, 1615 and 1610.
    spans_deg=((-55.0, 15.0), (-16.0, 15.0), (-16.0, 10.0)),
    modes=_NEW_MODES,
    verified="real recording",
)
HELIOS_16 = replace(
    HELIOS_32,
    name="Helios 16",
    channels=16,
    spans_deg=(),
    # By the manual: the upper half of a 32-line round. The driver begins at 0.
    firing_ns=(tuple(27_680 + 1730 * k for k in range(16)),),
    verified="one source",
)
AIRY_96 = Model(
    "Airy 96",
    AIRY_LAYOUT,
    channels=96,
    round_ns=111_080,
    # In the order of DIFOP byte 289: normal, on its side, M.
    firing_ns=_AIRY_96_NS,
    units_per_m=200,
    lens_m=(0.01002, 0.04532),
    angles=AngleOffsets(468, 756, 0.01),
    modes=_AIRY_MODES,
    verified="two sources",
    range_mask=0x3FFF,
)
AIRY_48 = replace(
    AIRY_96,
    name="Airy 48",
    channels=48,
    firing_ns=(_AIRY_48_NS,),
    spans_deg=(_HEMISPHERE_DEG,),
    verified="one source",
)
RUBY_128 = Model(
    "Ruby 128",
    RUBY_128_LAYOUT,
    channels=128,
    round_ns=55_550,
    firing_ns=(tuple(3236 * (k % 64 // 4) for k in range(128)),),
    units_per_m=200,
    lens_m=(0.03615, 0.0),
    angles=AngleOffsets(468, 852, 0.01),
    modes=_RUBY_MODES,
)
RUBY_80 = replace(
    RUBY_128,
    name="Ruby 80",
    layout=RUBY_80_LAYOUT,
    channels=80,
    round_ns=55_552,
    firing_ns=(_RUBY_80_NS,),
)
RUBY_48 = replace(
    RUBY_80,
    name="Ruby 48",
    layout=RUBY_48_LAYOUT,
    channels=48,
    firing_ns=(_RUBY_48_NS,),
    spans_deg=(_TO_15_DEG,),
)
RUBY_PLUS_128 = replace(
    RUBY_128,
    name="Ruby Plus 128",
    round_ns=55_560,
    firing_ns=(_RUBY_PLUS_128_NS,),
    lens_m=(0.02892, 0.0),
    modes=_PLUS_MODES,
    verified="two sources",
)
RUBY_PLUS_80 = replace(
    RUBY_PLUS_128,
    name="Ruby Plus 80",
    layout=RUBY_80_LAYOUT,
    channels=80,
    # The second for the 80v, whose model byte is 3.
    firing_ns=(_RUBY_PLUS_80_NS, _RUBY_PLUS_80V_NS),
    verified="one source",
)
RUBY_PLUS_48 = replace(
    RUBY_PLUS_80,
    name="Ruby Plus 48",
    layout=RUBY_48_LAYOUT,
    channels=48,
    firing_ns=(_RUBY_PLUS_48_NS,),
    spans_deg=(_TO_15_DEG,),
)
ROWS = (
    RS16,
    RS32,
    BPEARL_V3,
    BPEARL_V4,
    HELIOS_16,
    HELIOS_32,
    AIRY_48,
    AIRY_96,
    RUBY_48,
    RUBY_80,
    RUBY_128,
    RUBY_PLUS_48,
    RUBY_PLUS_80,
    RUBY_PLUS_128,
)
