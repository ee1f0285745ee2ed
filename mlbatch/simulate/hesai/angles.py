"""Angles of HESAI beams and the files with them (docs/sources/hesai.md section 6)."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mlbatch.arrays import F64Array


class Beams(Protocol):
    """Where the beams of a lidar look."""

    def aim(self, rotor_deg: F64Array) -> tuple[F64Array, F64Array]:
        """Azimuth and elevation (n, channels), deg, at rotor angles (n, channels)."""
        ...


@dataclass(frozen=True)
class Angles:
    """Beams of a turning lidar, deg, (channels,)."""

    elevation_deg: Sequence[float]
    azimuth_deg: Sequence[float]

    def aim(self, rotor_deg: F64Array) -> tuple[F64Array, F64Array]:
        """The rotor's angle is added to the azimuths."""
        elevation = np.asarray(self.elevation_deg, np.float64)
        return rotor_deg + np.asarray(self.azimuth_deg), np.broadcast_to(elevation, rotor_deg.shape)


@dataclass(frozen=True)
class MirrorAngles:
    """Beams of an AT128, deg: starts of the three fields, which have no gaps; (128,) angles."""

    start_deg: tuple[float, float, float]
    elevation_deg: Sequence[float]
    azimuth_deg: Sequence[float]

    def aim(self, rotor_deg: F64Array) -> tuple[F64Array, F64Array]:
        """Twice the angle since the start of the mirror; no adjustments."""
        past = np.stack([(rotor_deg - start) % 360 for start in self.start_deg]).min(axis=0)
        elevation = np.asarray(self.elevation_deg, np.float64)
        return 2 * past - np.asarray(self.azimuth_deg), np.broadcast_to(elevation, past.shape)

    def dat(self) -> bytes:
        """The correction file of the unit, in steps of 1/25600 deg."""
        starts = [round(deg * 25600) for deg in self.start_deg]
        body = bytes.fromhex("eeff0105800303") + bytes(8) + bytes([1])
        body += struct.pack("<6I", *starts, *starts[1:], starts[0])
        for angles in (self.azimuth_deg, self.elevation_deg):
            body += struct.pack("<128i", *(round(deg * 25600) for deg in angles))
        body += bytes(2 * 128 * 180)
        return body + hashlib.sha256(body).digest()


# Highest and lowest beam by the data sheets, deg; of other models as of a PandarXT-16.
_SPAN_DEG = (14.9, -15.1)
_WIDE_DEG = (14.9, -24.9)
_SPANS_DEG = {
    "Pandar20A": (7.9, -24.9),
    "Pandar20B": (2.9, -18.9),
    "Pandar40P": _WIDE_DEG,
    "Pandar40M": _WIDE_DEG,
    "Pandar64": _WIDE_DEG,
    "Pandar64-7": _WIDE_DEG,
    "PandarQT64": (52.1, -52.1),
    "QT128C2X": (52.6, -52.6),
    "XT32M2X": (19.5, -20.8),
    "Pandar128E3X": _WIDE_DEG,
    "OT128": _WIDE_DEG,
}


def fan(model: str, channels: int) -> tuple[list[float], list[float]]:
    """Elevations and azimuths of a made-up unit, deg: evenly spread."""
    elevation = np.linspace(*_SPANS_DEG.get(model, _SPAN_DEG), channels)
    return elevation.round(3).tolist(), np.linspace(-4.0, 4.0, channels).round(3).tolist()


def angles_csv(elevation_deg: Sequence[float], azimuth_deg: Sequence[float]) -> bytes:
    """The angle file of a unit."""
    rows = enumerate(zip(elevation_deg, azimuth_deg, strict=True), 1)
    lines = [f"{channel},{elevation},{azimuth}\n" for channel, (elevation, azimuth) in rows]
    return "".join(["Laser id,Elevation,Azimuth\n", *lines]).encode()
