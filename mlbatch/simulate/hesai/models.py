"""Layouts of HESAI packets by model, for the encoder.

Source: docs/sources/hesai.md sections 1 (versions), 2 (layout), 3 (tails), 5 (times), laid out here
once more, apart from the decoder; only the firing tables of section 12 are shared. Pandar20:
HesaiTechnology/HesaiLidar_General_SDK.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.sensors.hesai import firing

SEQUENCE = 0x01
IMU = 0x02
SAFETY = 0x04
SIGNATURE = 0x08
CONFIDENCE = 0x10
# Each adds a byte to the channels of protocol 1.4: confidence, weight factor, ambient light.
UNIT_FLAGS = 0x70
SINCE_1900 = "since 1900"
SINCE_2000 = "since 2000"
EPOCH = "epoch"
HIGH = firing.HIGH
NEVER = firing.NEVER
OPERATIONS = {firing.HIGH: 0, firing.STANDARD: 2, firing.SAVING: 3}


@dataclass(frozen=True)
class Tail:
    """Where the fields of a tail lie; 0: it has none."""

    size: int
    mode: int
    speed: int
    date: int
    micros: int
    factory: int
    loop: int = 0
    state: int = 0
    operation: int = 0


_PANDAR = Tail(22, 14, 8, 16, 10, 15)
_QT = Tail(24, 16, 10, 18, 12, 17)
_XT = Tail(24, 10, 11, 13, 19, 23)
_QT128 = Tail(26, 12, 13, 15, 21, 25, loop=5, state=9, operation=11)
_P128 = replace(_QT128, loop=0)
_AT = Tail(32, 24, 18, 26, 20, 25)


@dataclass(frozen=True)
class HesaiModel:
    """A model's packets; times of blocks are first_ns +- step_ns * group.

    head: without return type, unit and flags; unit: bytes of a channel; counts_back: groups are
    counted from the packet's last one; checked: with checksums; flags: those it has; grows: its
    channels do with flags; azimuth_lag_ns: a block's time minus that of its azimuth.
    """

    channels: int
    blocks: int
    head: str
    tail: Tail
    first_ns: int
    step_ns: Fraction
    unit: int = 4
    lead: int = 2
    block_flag: bytes = b""
    counts_back: bool = True
    checked: bool = False
    flags: int = SEQUENCE
    date: str = SINCE_1900
    unit_mm: int = 4
    units_per_deg: int = 100
    speed_units_per_rpm: int = 1
    grows: bool = False
    azimuth_lag_ns: int = 0

    @property
    def stride(self) -> int:
        """Bytes of a block."""
        return self.lead + self.channels * self.unit

    @property
    def azimuth_at(self) -> int:
        """Byte of the azimuth in a block."""
        return len(self.block_flag)


_P40 = HesaiModel(
    40, 10, "", _PANDAR, -28580, Fraction(55560), 3, 4, b"\xff\xee", date=SINCE_2000, flags=0
)
_P64 = HesaiModel(64, 6, "eeff400600000000", _PANDAR, -42580, Fraction(55560), 3)
_P20 = HesaiModel(
    20, 20, "eeff141400000000", _PANDAR, -28580, Fraction(55560), 3, date=SINCE_2000, flags=0
)
_QT64 = HesaiModel(
    64, 4, "eeff03010000400400000200", _QT, 25710, Fraction(500000, 3), counts_back=False
)
_QT128C2X = HesaiModel(
    128,
    2,
    "eeff03020300800200000200",
    _QT128,
    9000,
    Fraction(111110),
    counts_back=False,
    checked=True,
    flags=SEQUENCE | SAFETY | SIGNATURE | CONFIDENCE,
)
_XT32 = HesaiModel(
    32, 8, "eeff06010000200800000200", _XT, 5632, Fraction(50000), azimuth_lag_ns=5632
)
_E128 = HesaiModel(
    128,
    2,
    "eeff01040300800200000200",
    _P128,
    3148,
    Fraction(27778),
    unit=3,
    checked=True,
    flags=SEQUENCE | IMU | SAFETY | SIGNATURE,
    grows=True,
)
_AT128 = HesaiModel(
    128,
    2,
    "eeff04010000800200000200",
    _AT,
    -50915,
    Fraction(41666),
    lead=3,
    checked=True,
    flags=SEQUENCE | SIGNATURE,
    date=EPOCH,
    units_per_deg=25600,
)
MODELS: Mapping[str, HesaiModel] = {
    "Pandar20A": _P20,
    "Pandar20B": _P20,
    "Pandar40P": _P40,
    "Pandar64": _P64,
    "Pandar64-7": replace(_P64, blocks=7, head="eeff400700000000"),
    "PandarQT64": _QT64,
    "QT128C2X": _QT128C2X,
    "PandarXT-16": replace(_XT32, channels=16, head="eeff06010000100800000200"),
    "PandarXT-32": _XT32,
    "XT32M2X": replace(_XT32, blocks=6, head="eeff06010000200600000300", unit_mm=5),
    "Pandar128E3X": _E128,
    "OT128": replace(_E128, head="eeff01048000800200000200", first_ns=0),
    "JT128": replace(
        _E128,
        head="eeff01048900800200000200",
        first_ns=-1888000,
        step_ns=Fraction(111000),
        speed_units_per_rpm=10,
    ),
    "AT128": _AT128,
    # Its cadence is not known: that of the XT.
    "JT16": HesaiModel(16, 1, "", _XT, 0, Fraction(50000), 3),
}
# JT16 has none: all at once.
TABLES: Mapping[str, I64Array] = {
    "Pandar20A": firing.P20A,
    "Pandar20B": firing.P20B,
    "Pandar40P": firing.P40,
    "Pandar64": firing.P64,
    "Pandar64-7": firing.P64,
    "PandarQT64": firing.QT64,
    "QT128C2X": firing.QT128,
    "PandarXT-16": firing.XT16,
    "PandarXT-32": firing.XT32,
    "XT32M2X": firing.XT32M2X,
    "AT128": firing.AT128,
    "JT128": firing.JT128,
    "JT16": np.zeros(16, np.int64),
}
# Models whose packets select the firing table, by operation mode and azimuth state.
STATES: Mapping[str, Mapping[tuple[str, int], I64Array]] = {
    "Pandar128E3X": firing.E128,
    "OT128": firing.OT128,
}
