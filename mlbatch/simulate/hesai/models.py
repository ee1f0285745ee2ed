"""HESAI packets by model, for the encoder: what the rows of the decoder do not say.

Source: docs/sources/hesai.md sections 1 (versions), 2 (layout) and 5 (times of blocks). Where
fields are, and when beams fire, is taken from the rows in `mlbatch/sensors/hesai/models.py`, which
tests compare with the tables of that page. Pandar20: HesaiTechnology/HesaiLidar_General_SDK.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction

from mlbatch.sensors.hesai import models as rows
from mlbatch.sensors.hesai.models import Model
from mlbatch.sensors.hesai.packets import unit_size

SEQUENCE = 0x01
IMU = 0x02
SAFETY = 0x04
SIGNATURE = 0x08
CONFIDENCE = 0x10
SINCE_1900 = "since 1900"
SINCE_2000 = "since 2000"
EPOCH = "epoch"
# Operation modes of the 128-channel families by their number, and how many azimuth states follow
# each other in them.
HIGH, STANDARD, SAVING = "high", "standard", "saving"
OPERATIONS = {HIGH: (0, 4), STANDARD: (2, 2), SAVING: (3, 2)}


@dataclass(frozen=True)
class HesaiModel:
    """Packets of a row.

    head: without return type, unit and flags; flags: those it has; cadence_ns: from group to group,
    where the row does not say it; operations: modes that choose the firing table, with azimuth
    states; operation: number of the one in use.
    """

    row: Model
    blocks: int
    head: str
    flags: int = SEQUENCE
    date: str = SINCE_1900
    unit_mm: int = 4
    cadence_ns: int = 0
    operations: tuple[str, ...] = ()
    operation: int = 0

    @property
    def step_ns(self) -> Fraction:
        """From group to group of blocks."""
        timing = self.row.timing
        step_ns = self.cadence_ns or timing.step_ns * timing.slower[self.operation]
        return Fraction(step_ns, timing.divisor)

    @property
    def unit(self) -> int:
        """Bytes of a channel."""
        return unit_size(self.row, self.flags)

    @property
    def stride(self) -> int:
        """Bytes of a block."""
        return self.row.lead + self.row.channels * self.unit

    @property
    def units_per_deg(self) -> int:
        """Azimuths of a degree."""
        return self.row.ticks // 360


_P20 = HesaiModel(rows.PANDAR20A, 20, "eeff141400000000", 0, SINCE_2000)
_P64 = HesaiModel(rows.PANDAR64, 6, "eeff400600000000")
_XT32 = HesaiModel(rows.XT32, 8, "eeff06010000200800000200")
_E128 = HesaiModel(
    rows.PANDAR128E3X,
    2,
    "eeff01040300800200000200",
    SEQUENCE | IMU | SAFETY | SIGNATURE,
    operations=(HIGH, STANDARD, SAVING),
)
MODELS: Mapping[str, HesaiModel] = {
    "Pandar20A": _P20,
    "Pandar20B": replace(_P20, row=rows.PANDAR20B),
    "Pandar40P": HesaiModel(rows.PANDAR40P, 10, "", 0, SINCE_2000),
    "Pandar64": _P64,
    "Pandar64-7": replace(_P64, blocks=7, head="eeff400700000000"),
    "PandarQT64": HesaiModel(rows.PANDARQT64, 4, "eeff03010000400400000200"),
    "QT128C2X": HesaiModel(
        rows.QT128, 2, "eeff03020300800200000200", SEQUENCE | SAFETY | SIGNATURE | CONFIDENCE
    ),
    "PandarXT-16": replace(_XT32, row=rows.XT16, head="eeff06010000100800000200"),
    "PandarXT-32": _XT32,
    "XT32M2X": HesaiModel(rows.XT32M2X, 6, "eeff06010000200600000300", unit_mm=5),
    "Pandar128E3X": _E128,
    "OT128": replace(
        _E128, row=rows.OT128, head="eeff01048000800200000200", operations=(HIGH, STANDARD)
    ),
    "JT128": replace(_E128, row=rows.JT128, head="eeff01048900800200000200", operations=()),
    "AT128": HesaiModel(
        rows.AT128, 2, "eeff04010000800200000200", SEQUENCE | SIGNATURE, date=EPOCH
    ),
    # Its cadence is not known: that of the XT.
    "JT16": HesaiModel(rows.JT16, 1, "", cadence_ns=50000),
}
