"""Velodyne models for the encoder: the layout of their packets, and the beams of a unit.

Source: docs/sources/velodyne.md sections 1 to 3. Beams and times come from the rows in
`mlbatch/sensors/velodyne/models.py`. The HDL-64E has no beams of its own: here is a unit that
does not exist, in which corrections have the usual size.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from mlbatch.sensors.velodyne.models import ALL, Model

EE = 0xEEFF
DD = 0xDDFF
CC = 0xCCFF
BB = 0xBBFF


@dataclass(frozen=True)
class Form:
    """Packets of models with so many lasers.

    columns_per_row: sequences of one azimuth; flags: of the blocks of an azimuth, one return;
    returns_apart: all blocks of one return come first; stamp_after_us: stamp of a packet, after its
    first firing; time_scales: firings change with the time of the sequence; product: byte 1205, if
    the decoder does without it.
    """

    columns_per_row: int = 1
    flags: tuple[int, ...] = (EE,)
    returns_apart: bool = False
    stamp_after_us: float = 0.0
    time_scales: bool = False
    product: int | None = None


_FORMS = {
    16: Form(columns_per_row=2),
    32: Form(),
    64: Form(flags=(EE, DD), returns_apart=True),
    128: Form(flags=(EE, DD, CC, BB), stamp_after_us=8.7, time_scales=True, product=0xA1),
}


@dataclass(frozen=True)
class Table:
    """A unit of a model; tuples are by laser id.

    firing_us: after the first firing of the sequence; azimuth_deg: clockwise, the manual's "azimuth
    offset".
    """

    row: Model
    form: Form
    unit_m: float
    sequence_us: float
    firing_us: tuple[float, ...]
    elevation_deg: tuple[float, ...]
    azimuth_deg: tuple[float, ...]
    vertical_m: tuple[float, ...]
    horizontal_m: tuple[float, ...]
    dist_m: tuple[float, ...]


def _table(row: Model) -> Table:
    lasers = range(row.lasers)
    elevation_deg, azimuth_deg = row.elevation_deg, row.clockwise_deg
    vertical_m = tuple(mm / 1000 for mm in row.height_mm)
    horizontal_m = dist_m = (0.0,) * row.lasers
    if row.needs_file:
        upper, lower = ([2.0 - j / 3 for j in range(32)], [-8.83 - j / 2 for j in range(32)])
        elevation_deg = tuple(round(angle, 6) for angle in upper + lower)
        azimuth_deg = tuple((1.5 - laser % 4) * 3.0 for laser in lasers)
        vertical_m = (0.2,) * 32 + (0.13,) * 32
        horizontal_m = (0.026, -0.026) * 32
        dist_m = tuple(round(1.2 + 0.005 * laser, 6) for laser in lasers)
    return Table(
        row=row,
        form=_FORMS[row.lasers],
        unit_m=1 / row.units_per_m,
        sequence_us=row.sequence_ns / 1000,
        firing_us=tuple(row.sequence_ns / 1000 / row.slots * slot for slot in row.slot),
        elevation_deg=elevation_deg,
        azimuth_deg=azimuth_deg,
        vertical_m=vertical_m,
        horizontal_m=horizontal_m,
        dist_m=dist_m,
    )


MODELS: Mapping[str, Table] = {row.name: _table(row) for row in ALL}


def calibration_yaml(model: str) -> str:
    """The calibration of a model as ROS drivers write it, section 9."""
    table = MODELS[model]
    lines = ["lasers:"]
    for laser in range(len(table.elevation_deg)):
        lines += [
            f"- laser_id: {laser}",
            f"  rot_correction: {-math.radians(table.azimuth_deg[laser])!r}",
            f"  vert_correction: {math.radians(table.elevation_deg[laser])!r}",
            f"  dist_correction: {table.dist_m[laser]}",
            f"  vert_offset_correction: {table.vertical_m[laser]}",
            f"  horiz_offset_correction: {table.horizontal_m[laser]}",
        ]
    lines += [f"num_lasers: {len(table.elevation_deg)}", f"distance_resolution: {table.unit_m}"]
    return "\n".join(lines) + "\n"
