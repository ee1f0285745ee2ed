"""Layouts of HESAI packets by model, for the encoder.

Source: docs/sources/hesai.md sections 1 (versions), 2 (layout), 3 (tails), 5 (times of blocks),
laid out here once more, apart from the decoder. Firing times come from the rows in
`mlbatch/sensors/hesai/models.py`. Pandar20: HesaiTechnology/HesaiLidar_General_SDK.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction

from mlbatch.sensors.hesai import models as rows
from mlbatch.sensors.hesai.models import Model

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
# Operation modes of the 128-channel families by their number, and how many azimuth states follow
# each other in them.
HIGH, STANDARD, SAVING = "high", "standard", "saving"
OPERATIONS = {HIGH: (0, 4), STANDARD: (2, 2), SAVING: (3, 2)}


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
    """Packets of a row; times of blocks are first_ns +- step_ns * group.

    head: without return type, unit and flags; unit: bytes of a channel; counts_back: groups are
    counted from the packet's last one; checked: with checksums; flags: those it has; grows: its
    channels do with flags; azimuth_lag_ns: a block's time minus that of its azimuth; operations:
    modes that choose the firing table, with azimuth states.
    """

    row: Model
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
    operations: tuple[str, ...] = ()

    @property
    def channels(self) -> int:
        """Channels of a block."""
        return self.row.channels

    @property
    def stride(self) -> int:
        """Bytes of a block."""
        return self.lead + self.channels * self.unit

    @property
    def azimuth_at(self) -> int:
        """Byte of the azimuth in a block."""
        return len(self.block_flag)


_P40 = HesaiModel(
    rows.PANDAR40P,
    10,
    "",
    _PANDAR,
    -28580,
    Fraction(55560),
    3,
    4,
    b"\xff\xee",
    date=SINCE_2000,
    flags=0,
)
_P64 = HesaiModel(rows.PANDAR64, 6, "eeff400600000000", _PANDAR, -42580, Fraction(55560), 3)
_P20 = HesaiModel(
    rows.PANDAR20A,
    20,
    "eeff141400000000",
    _PANDAR,
    -28580,
    Fraction(55560),
    3,
    date=SINCE_2000,
    flags=0,
)
_QT64 = HesaiModel(
    rows.PANDARQT64,
    4,
    "eeff03010000400400000200",
    _QT,
    25710,
    Fraction(500000, 3),
    counts_back=False,
)
_QT128C2X = HesaiModel(
    rows.QT128,
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
    rows.XT32, 8, "eeff06010000200800000200", _XT, 5632, Fraction(50000), azimuth_lag_ns=5632
)
_E128 = HesaiModel(
    rows.PANDAR128E3X,
    2,
    "eeff01040300800200000200",
    _P128,
    3148,
    Fraction(27778),
    unit=3,
    checked=True,
    flags=SEQUENCE | IMU | SAFETY | SIGNATURE,
    grows=True,
    operations=(HIGH, STANDARD, SAVING),
)
_AT128 = HesaiModel(
    rows.AT128,
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
    "Pandar20B": replace(_P20, row=rows.PANDAR20B),
    "Pandar40P": _P40,
    "Pandar64": _P64,
    "Pandar64-7": replace(_P64, blocks=7, head="eeff400700000000"),
    "PandarQT64": _QT64,
    "QT128C2X": _QT128C2X,
    "PandarXT-16": replace(_XT32, row=rows.XT16, head="eeff06010000100800000200"),
    "PandarXT-32": _XT32,
    "XT32M2X": replace(
        _XT32, row=rows.XT32M2X, blocks=6, head="eeff06010000200600000300", unit_mm=5
    ),
    "Pandar128E3X": _E128,
    "OT128": replace(
        _E128,
        row=rows.OT128,
        head="eeff01048000800200000200",
        first_ns=0,
        operations=(HIGH, STANDARD),
    ),
    "JT128": replace(
        _E128,
        row=rows.JT128,
        operations=(),
        head="eeff01048900800200000200",
        first_ns=-1888000,
        step_ns=Fraction(111000),
        speed_units_per_rpm=10,
    ),
    "AT128": _AT128,
    # Its cadence is not known: that of the XT.
    "JT16": HesaiModel(rows.JT16, 1, "", _XT, 0, Fraction(50000), 3),
}
