"""HESAI models as tables: packet layouts, firing times, optical centres.

Source: docs/sources/hesai.md sections 2 (layout), 3 (tails), 5 (times), 6 (optical centres), 8
(JT16) and 12; the vertical fields of view are those of the data sheets. The Pandar128E3X fires a
few of its channels at other times at targets nearer than 2.85 m; the times of the far field are
used for all (up to 55 us apart). Pandar20A and B:
HesaiTechnology/HesaiLidar_General_SDK. Its versions have one of two tables of elevations; each is
assigned to the model whose beams fire at the times of a Pandar40P at these elevations.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.sensors.hesai import firing

# Operation mode in the tail of the 128-channel families: its firing table, and the duration of its
# blocks in blocks of the fast mode.
_HIGH, _SHUTDOWN, _STANDARD, _SAVING = range(4)
OPERATIONS = 4
AZIMUTH_STATES = 4
_MODE = {
    _HIGH: firing.HIGH,
    _SHUTDOWN: firing.STANDARD,
    _STANDARD: firing.STANDARD,
    _SAVING: firing.SAVING,
}
_SLOWER = (1, 2, 2, 2)


@dataclass(frozen=True, slots=True)
class Tail:
    """Offsets in a tail.

    size: without optional fields.
    rpm_step: rpm of one step of the speed field.
    loop_at, states_at, operation_at: fields that choose the firing table of columns.
    has_crc: a CRC over the tail follows the sequence number and the IMU block.
    """

    size: int
    # Date and time of day to 1 s, 6 bytes.
    date_at: int
    # Microseconds, u32.
    us_at: int
    # Return mode.
    mode_at: int | None = None
    # Rotor speed.
    rpm_at: int | None = None
    rpm_step: float = 1.0
    rpm_is_signed: bool = False
    sequence_bytes: int = 4
    loop_at: int | None = None
    states_at: int | None = None
    operation_at: int | None = None
    has_crc: bool = False


@dataclass(frozen=True, slots=True)
class Timing:
    """Firing times of blocks, ns after the packet's time: base + step * k / divisor.

    counts_back: k is 0 for the last firing group and negative before it; else 0 for the first.
    azimuth_ns: when the rotor is at a block's azimuth, after the block's time.
    slower: factor of the step in each operation mode.
    """

    base_ns: int
    step_ns: int
    divisor: int = 1
    counts_back: bool = True
    azimuth_ns: int = 0
    slower: tuple[int, ...] = (1, 1, 1, 1)


@dataclass(frozen=True, slots=True)
class Model:
    """Packets of a model, apart from the values in their headers.

    lead: bytes of a block before its channels.
    azimuth_at: in the block.
    ticks: azimuth ticks of a revolution (36000, or more with a third byte).
    unit: bytes per channel without optional fields.
    unit_mm_at: header byte of the distance unit (None: 4 mm).
    has_checks: a CRC of the body before the tail.
    tail_at: None for after the body and its checks. `firing_ns` has a row for every table, `tables`
        is the row by operation mode and azimuth state.
    silent: largest raw distance that means no return.
    elevation_deg: lowest and highest beam of the data sheet, None: not checked.
    same_packets_as: a model with equal packets.
    """

    name: str
    channels: int
    # Possible numbers of blocks in a packet.
    blocks: tuple[int, ...]
    tail: Tail
    timing: Timing
    firing_ns: I64Array
    # Optical centre in the sensor frame.
    centre_mm: tuple[float, float, float]
    elevation_deg: tuple[float, float] | None
    # Text for the table of `mlbatch sensors`.
    verified: str
    same_packets_as: str = ""
    header: int = 12
    lead: int = 2
    azimuth_at: int = 0
    ticks: int = 36000
    unit: int = 4
    has_flagged_units: bool = False
    unit_mm_at: int | None = 9
    has_checks: bool = False
    tail_at: int | None = None
    most_returns: int = 2
    silent: int = 0
    # Ranges are measured from the optical centre, not from the axis.
    from_centre: bool = False
    tables: I64Array = field(default_factory=lambda: np.zeros((OPERATIONS, AZIMUTH_STATES), int))


def _by_state(times: Mapping[tuple[str, int], I64Array]) -> tuple[I64Array, I64Array]:
    """Firing tables of a model, (T, channels), and the row by operation mode and azimuth state.

    Modes without own tables use the standard one, which has only two states.
    """
    names = list(times)
    rows = np.zeros((OPERATIONS, AZIMUTH_STATES), np.int64)
    for operation, mode in _MODE.items():
        known = mode if (mode, 0) in times else firing.STANDARD
        for state in range(AZIMUTH_STATES):
            used = state if (known, state) in times else state % 2
            rows[operation, state] = names.index((known, used))
    return np.stack([times[name] for name in names]), rows


def _clockwise(point: tuple[float, float, float], angle_deg: float) -> tuple[float, float, float]:
    """A point rotated about z, seen from above; x right, y forward."""
    x, y, z = point
    cosine = math.cos(math.radians(angle_deg))
    sine = math.sin(math.radians(angle_deg))
    return x * cosine + y * sine, y * cosine - x * sine, z


_TAIL_40P = Tail(22, date_at=16, us_at=10, mode_at=14, rpm_at=8)
_TAIL_QT64 = Tail(24, date_at=18, us_at=12, mode_at=16, rpm_at=10)
_TAIL_XT = Tail(24, date_at=13, us_at=19, mode_at=10, rpm_at=11)
_TAIL_QT128 = Tail(26, date_at=15, us_at=21, mode_at=12, rpm_at=13, loop_at=5, has_crc=True)
_TAIL_128 = Tail(
    26, date_at=15, us_at=21, mode_at=12, rpm_at=13, states_at=9, operation_at=11, has_crc=True
)
_TAIL_JT128 = replace(_TAIL_128, rpm_step=0.1, states_at=None, operation_at=None)
_TAIL_AT128 = Tail(32, 26, 20, mode_at=24, rpm_at=18, rpm_is_signed=True, has_crc=True)
# The JT16 has its date in the header, and its sequence number and CRC after the channels.
_TAIL_JT16 = Tail(74, date_at=6, us_at=12, sequence_bytes=2, has_crc=True)

_TO_15_DEG = (-25.0, 15.0)
# The SDK rotates an XT by its firing-time file, which begins at 6 us (5632 + 368 ns): the azimuth
# of a block is that of 5632 ns before the time of the block (section 6).
_XT_BACK = Timing(5632, 50000, azimuth_ns=-5632)

PANDAR40P = Model(
    "Pandar40P",
    channels=40,
    blocks=(10,),
    tail=_TAIL_40P,
    timing=Timing(-28580, 55560),
    firing_ns=firing.P40[None],
    centre_mm=(-12.0, 38.73, 0.0),
    elevation_deg=_TO_15_DEG,
    verified="real recording",
    header=0,
    lead=4,
    azimuth_at=2,
    unit=3,
    unit_mm_at=None,
)
# Only its angles differ from a Pandar40P.
PANDAR40M = replace(
    PANDAR40P, name="Pandar40M", verified="two sources", same_packets_as="Pandar40P"
)
PANDAR64 = Model(
    "Pandar64",
    channels=64,
    blocks=(6, 7),
    tail=_TAIL_40P,
    timing=Timing(-42580, 55560),
    firing_ns=firing.P64[None],
    centre_mm=(-12.0, 38.73, 0.0),
    elevation_deg=_TO_15_DEG,
    verified="real recording",
    header=8,
    unit=3,
    unit_mm_at=5,
)
# No source gives its optical centre.
PANDAR20A = replace(
    PANDAR64,
    name="Pandar20A",
    channels=20,
    blocks=(20,),
    timing=PANDAR40P.timing,
    firing_ns=firing.P20A[None],
    centre_mm=(0.0, 0.0, 0.0),
    elevation_deg=(-25.0, 8.0),
    verified="one source",
)
PANDAR20B = replace(
    PANDAR20A, name="Pandar20B", firing_ns=firing.P20B[None], elevation_deg=(-18.9, 3.1)
)
PANDARQT64 = Model(
    "PandarQT64",
    channels=64,
    blocks=(4,),
    tail=_TAIL_QT64,
    timing=Timing(25710, 500000, divisor=3, counts_back=False),
    firing_ns=firing.QT64[None],
    centre_mm=(-7.2, 29.8, 0.0),
    elevation_deg=(-52.1, 52.1),
    verified="real recording",
)
QT128 = Model(
    "QT128C2X",
    channels=128,
    blocks=(2,),
    tail=_TAIL_QT128,
    timing=Timing(9000, 111110, counts_back=False),
    firing_ns=firing.QT128,
    centre_mm=(7.2, 35.4, 0.0),
    elevation_deg=(-52.6, 52.6),
    verified="real recording",
    has_checks=True,
)
XT16 = Model(
    "PandarXT-16",
    channels=16,
    blocks=(8,),
    tail=_TAIL_XT,
    timing=_XT_BACK,
    firing_ns=firing.XT16[None],
    centre_mm=(-13.0, 31.5, 0.0),
    elevation_deg=(-15.0, 15.0),
    verified="real recording",
)
XT32 = replace(
    XT16,
    name="PandarXT-32",
    channels=32,
    firing_ns=firing.XT32[None],
    elevation_deg=(-16.0, 15.0),
)
XT32M2X = replace(
    XT32,
    name="XT32M2X",
    blocks=(6,),
    firing_ns=firing.XT32M2X[None],
    centre_mm=(-13.0, 30.5, 0.0),
    elevation_deg=(-20.8, 19.5),
    verified="real recording",
    most_returns=3,
)
_e128_ns, _e128_tables = _by_state(firing.E128)
PANDAR128E3X = Model(
    "Pandar128E3X",
    channels=128,
    blocks=(2,),
    tail=_TAIL_128,
    timing=Timing(3148, 27778, slower=_SLOWER),
    firing_ns=_e128_ns,
    tables=_e128_tables,
    centre_mm=(-12.0, 43.56, 0.0),
    elevation_deg=_TO_15_DEG,
    verified="two sources",
    unit=3,
    has_flagged_units=True,
    has_checks=True,
)
_ot128_ns, _ot128_tables = _by_state(firing.OT128)
OT128 = replace(
    PANDAR128E3X,
    name="OT128",
    timing=Timing(0, 27778, slower=_SLOWER),
    firing_ns=_ot128_ns,
    tables=_ot128_tables,
    centre_mm=(-10.0, 45.0, 0.0),
    silent=3,
)
JT128 = replace(
    PANDAR128E3X,
    name="JT128",
    tail=_TAIL_JT128,
    timing=Timing(-1888000, 111000),
    firing_ns=firing.JT128[None],
    tables=np.zeros_like(_e128_tables),
    centre_mm=(-7.6, 13.67, 12.74),
    elevation_deg=None,
    verified="one source",
    from_centre=True,
)
AT128 = Model(
    "AT128",
    channels=128,
    blocks=(2,),
    tail=_TAIL_AT128,
    timing=Timing(-50915, 41666),
    firing_ns=firing.AT128[None],
    centre_mm=(0.0, 0.0, 0.0),
    elevation_deg=None,
    verified="two sources",
    lead=3,
    ticks=360 * 25600,
    has_checks=True,
)
JT16 = Model(
    "JT16",
    channels=16,
    blocks=(1,),
    tail=_TAIL_JT16,
    timing=Timing(0, 0),
    firing_ns=np.zeros((1, 16), np.int64),
    # Its angles are 190 deg ahead of the axes of the centre (section 6).
    centre_mm=_clockwise((-6.25, 10.955, 3.911), 190.0),
    elevation_deg=None,
    verified="one source",
    header=16,
    unit=3,
    unit_mm_at=None,
    tail_at=0,
    most_returns=1,
    from_centre=True,
)
ALL = (
    PANDAR20A,
    PANDAR20B,
    PANDAR40P,
    PANDAR40M,
    PANDAR64,
    PANDARQT64,
    QT128,
    XT16,
    XT32,
    XT32M2X,
    PANDAR128E3X,
    OT128,
    AT128,
    JT16,
    JT128,
)
