"""ROBOSENSE packets by model, for the encoder: what the rows of the decoder do not say.

Source: docs/sources/robosense.md sections 1 to 4. Where fields are, firing times, lenses, units and
modes are taken from the rows in `mlbatch/sensors/robosense/models.py`, which tests compare with
the tables of that page.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from mlbatch.sensors.robosense import models as rows
from mlbatch.sensors.robosense.models import SECOND_KIND, Layout, Model

STRONGEST = "strongest"
LAST = "last"
NEAREST = "nearest"
DUAL = "dual"
# Suffix of rows for packets that name their model a byte earlier.
EARLY = ", early type"
# How an Airy is mounted: its number is DIFOP byte 289, and that of its firing times.
AIRY_MOUNTS = ("normal", "side", "M")
_NAMES = {"strongest": STRONGEST, "last": LAST, "first": NEAREST, "": DUAL}


@dataclass(frozen=True, slots=True)
class RobosenseModel:
    """Packets of a row.

    name: of this kind of packets; type_at, type: bytes that name the model; span_deg: elevations of
    a made-up unit; firing: which of the row's firing times; counter_at, range_step_at: 0 where
    there is none.
    """

    name: str
    row: Model
    type_at: int
    type: bytes
    span_deg: tuple[float, float] = (-25.0, 15.0)
    firing: int = 0
    size: int = 1248
    counter_at: int = 0
    range_step_at: int = 0

    @property
    def layout(self) -> Layout:
        """Blocks of a packet."""
        return self.row.layout

    @property
    def marks(self) -> dict[int, bytes]:
        """Bytes of all its MSOP packets."""
        more = b"\x00\x01" if self.layout.magic == SECOND_KIND else b""
        return {0: self.layout.magic + more, self.type_at: self.type}

    @property
    def modes(self) -> dict[str, int]:
        """DIFOP byte 300 by mode.

        The manual of an Airy lists no dual mode; 3 is what its point packets say.
        """
        codes: dict[str, int] = {}
        for code, mode in self.row.modes.items():
            codes.setdefault(_NAMES[mode.name], code)
        codes.setdefault(DUAL, 3)
        return codes

    @property
    def angle_slots(self) -> int:
        """Angles for which a DIFOP has room."""
        angles = self.row.angles
        room = (angles.azimuth_at - angles.elevation_at) // 3
        return room if angles.azimuth_at else self.row.channels


_RS32 = RobosenseModel("RS-32", rows.RS32, 30, b"\x02")
_BPEARL_V3 = RobosenseModel("Bpearl v3", rows.BPEARL_V3, 30, b"\x03", (2.0, 88.0), counter_at=12)
_HELIOS_32 = RobosenseModel(
    *("Helios 32", rows.HELIOS_32, 31, b"\x06\x01", (-55.0, 15.0)), counter_at=12, range_step_at=17
)
_HELIOS_16 = replace(
    _HELIOS_32, name="Helios 16", row=rows.HELIOS_16, type=b"\x06\x03", span_deg=(-15.0, 15.0)
)
_AIRY_96 = RobosenseModel("Airy 96", rows.AIRY_96, 31, b"\x31\x02", (0.0, 89.0), counter_at=12)
_RUBY_128 = RobosenseModel("Ruby 128", rows.RUBY_128, 31, b"\x04")
_RUBY_48 = replace(_RUBY_128, name="Ruby 48", row=rows.RUBY_48, size=1268)
_PLUS_80 = RobosenseModel("Ruby Plus 80", rows.RUBY_PLUS_80, 31, b"\x05\x02")
_PLUS_80V = replace(_PLUS_80, name="Ruby Plus 80v", type=b"\x05\x03", firing=1)


def _early(model: RobosenseModel, kinds: bytes) -> RobosenseModel:
    """Type and model a byte earlier, as in the header of rs_driver."""
    return replace(model, name=model.name + EARLY, type_at=30, type=kinds)


MODELS: Mapping[str, RobosenseModel] = {
    model.name: model
    for model in (
        RobosenseModel("RS-16", rows.RS16, 30, b"\x01", (-15.0, 15.0)),
        _RS32,
        _BPEARL_V3,
        replace(_BPEARL_V3, name="Bpearl v4", row=rows.BPEARL_V4, type_at=31, type=b"\x03\x04"),
        _HELIOS_32,
        # Seen on a real unit: the type where rs_driver has it, and no model.
        _early(_HELIOS_32, b"\x06\x00\x00"),
        replace(_HELIOS_32, name="Helios 32-31", type=b"\x06\x02"),
        replace(_HELIOS_32, name="Helios 32-26", type=b"\x06\x04"),
        _HELIOS_16,
        replace(_HELIOS_16, name="Helios 1615", type=b"\x07\x00"),
        _early(_HELIOS_16, b"\x06\x00\x00"),
        _AIRY_96,
        replace(_AIRY_96, name="Airy 48", row=rows.AIRY_48, type=b"\x31\x01"),
        _RUBY_128,
        replace(_RUBY_128, name="Ruby 80", row=rows.RUBY_80),
        _RUBY_48,
        RobosenseModel("Ruby Plus 128", rows.RUBY_PLUS_128, 31, b"\x05\x00"),
        _PLUS_80,
        _PLUS_80V,
        _early(_PLUS_80, b"\x05\x02"),
        _early(_PLUS_80V, b"\x05\x03"),
        replace(_RUBY_48, name="Ruby Plus 48", row=rows.RUBY_PLUS_48, type=b"\x05\x00"),
    )
}
