"""Velodyne lidars: VLP-16, Puck LITE, Puck Hi-Res, VLP-32C, HDL-32E, HDL-64E, VLS-128.

Source: docs/sources/velodyne.md. Beams hardly differ from unit to unit, so all models
but the HDL-64E have built-in tables, which a file of angles (YAML or db.xml) replaces.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from mlbatch.arrays import median
from mlbatch.errors import RigError
from mlbatch.lidar.headers import HeaderReader
from mlbatch.lidar.interface import NAMED_ONLY, Calibration, Evidence, Recorded, SensorModel
from mlbatch.sensors.options import check_options
from mlbatch.sensors.velodyne.calibration import VelodyneFile, read_velodyne
from mlbatch.sensors.velodyne.clock import (
    clock_offset_ns,
    measured_sequence_ns,
    pulse,
    rotor_speed,
    top_of_hour_ns,
)
from mlbatch.sensors.velodyne.identify import Identity, describe, identify, is_pace
from mlbatch.sensors.velodyne.models import ALL, Model, layout
from mlbatch.sensors.velodyne.packets import (
    DEFAULTS,
    VENDOR,
    Measured,
    VelodyneLidar,
    first_azimuths,
    header_table,
    mean_step,
    steps,
)
from mlbatch.units import M_PER_MM, RAD_PER_DEG

__all__ = [
    "BUILT_IN",
    "MODELS",
    "VENDOR",
    "VelodyneCalibration",
    "describe",
    "read_calibration",
]

_FITS_BYTES = 100
_FITS_FILE = 200
# Largest mean difference between the angles of a file and those of its model.
_ANGLE_TOLERANCE_DEG = 3.0
_UNIT_TOLERANCE = 1e-6
# Default ports: docs/sources/messages.md, section 7; topics and messages: section 1.
RECORDED = Recorded(
    port=2368,
    topic="velodyne_packets",
    message="velodyne_msgs/VelodyneScan",
    message_ros1="velodyne_msgs/VelodyneScan",
    device_port=8308,
)

MODELS: tuple[SensorModel, ...] = tuple(
    SensorModel(
        name=model.name,
        vendor=VENDOR,
        channels=model.lasers,
        returns=(1, 2),
        clock="us past the hour, GPS or free; hour from NMEA or receive time",
        calibration="YAML or db.xml, required" if model.needs_file else "built in; YAML or db.xml",
        verified=model.verified,
    )
    for model in ALL
)


class VelodyneCalibration(Calibration):
    """Built-in table of a model, or a file that replaces it.

    is_guessed: packets and file fit several models.
    is_named: the rig names this model.
    """

    # Neither packets nor files have serial numbers.
    is_shared = True

    def __init__(
        self,
        row: Model,
        file: VelodyneFile | None = None,
        *,
        is_guessed: bool = False,
        is_named: bool = False,
    ) -> None:
        self.row = row
        self.file = file
        self.is_guessed = is_guessed
        self.is_named = is_named
        self.path = None if file is None else file.path
        self.model = row.name

    def for_model(self, name: str) -> VelodyneCalibration | None:
        """The same calibration for the model named in the rig; None if it has other beams."""
        rows = [row for row in ALL if row.name == name and row.lasers == self.row.lasers]
        return VelodyneCalibration(rows[0], self.file, is_named=True) if rows else None

    def match_score(self, evidence: Evidence) -> int:
        """Match score of packets: by the model that they name, or by layout and pace."""
        seen = identify(evidence.size, evidence.sample)
        if seen is None or seen.banks != self.row.banks:
            return 0
        # Only the rig names models that packets do not (Puck LITE, series of the HDL-64E).
        first = next((row for row in ALL if row.reported_as == seen.model), None)
        if first is None or first.reported_as != self.row.reported_as:
            return NAMED_ONLY if _is_paced(self.row, seen) else 0
        if self.file is not None:
            return _FITS_FILE
        return _FITS_BYTES if first is self.row or self.is_named else NAMED_ONLY

    def lidar(self, options: Mapping[str, str], evidence: Evidence | None) -> VelodyneLidar:
        """Decoder of the sensor; RigError if its model needs a file."""
        check_options(options)
        chosen = {**DEFAULTS, **options}
        if self.row.needs_file and self.file is None:
            raise RigError(
                f"{self.row.reported_as}: expected its calibration, found none; give the unit's "
                "YAML or db.xml with --metadata or as `metadata:` in the rig"
            )
        has_heights = chosen["vertical_offset"] == "on"
        measured, notes = _measure(self.row, evidence)
        file = self.file
        if file is not None and self.is_named:
            _refuse_other_beams(self.row, file)
        if file is not None:
            notes += [*file.notes, *_file_notes(self)]
            if has_heights and self.row.height_mm and not file.vert_offset_m.any():
                file, note = _with_built_in_heights(file, self.row)
                notes.append(note)
        return VelodyneLidar(self.row, file, measured, chosen, tuple(notes))


# Includes the HDL-64E, whose entry raises the error about its missing file.
BUILT_IN: tuple[Calibration, ...] = tuple(VelodyneCalibration(model) for model in ALL)


def read_calibration(path: Path, content: bytes) -> VelodyneCalibration | None:
    """Parse a file of angles, for the model with the nearest angles; None if it is another file."""
    file = read_velodyne(path, content)
    if file is None:
        return None
    difference_deg, row = _nearest(file)
    if difference_deg > _ANGLE_TOLERANCE_DEG:
        raise RigError(
            f"{path}: Velodyne calibration: expected vertical angles of {row.name} or another "
            f"model with {file.lasers} lasers, found a mean difference of "
            f"{difference_deg:.1f} degrees; give the file of a supported model"
        )
    return VelodyneCalibration(row, file, is_guessed=row.needs_file)


def _nearest(file: VelodyneFile) -> tuple[float, Model]:
    """Mean elevation difference to the model with the nearest angles, and this model."""
    rows = [row for row in ALL if row.lasers == file.lasers]
    return min(((_difference_deg(row, file), row) for row in rows), key=lambda pair: pair[0])


def _refuse_other_beams(row: Model, file: VelodyneFile) -> None:
    """Raise RigError if the angles of a file are nearest to those of another model."""
    _, nearest = _nearest(file)
    if nearest.elevation_deg != row.elevation_deg:
        raise RigError(
            f"{file.path}: Velodyne calibration: expected vertical angles of a {row.name}, which "
            f"the rig names, found those of a {nearest.name}; give the file of this lidar, or "
            "correct the model"
        )


def _difference_deg(row: Model, file: VelodyneFile) -> float:
    """Mean elevation difference between a file and a model; 0 if the model has no table."""
    if row.needs_file:
        return 0.0
    difference = np.abs(file.elevation_rad / RAD_PER_DEG - np.array(row.elevation_deg))
    return float(difference.mean())


def _is_paced(row: Model, seen: Identity) -> bool:
    """Whether the pace of packets fits the model; product bytes may be wrong, the pace is not."""
    return seen.block_us is None or is_pace(row.block_us, seen.block_us)


def _file_notes(calibration: VelodyneCalibration) -> list[str]:
    notes = []
    file = calibration.file
    row = calibration.row
    if calibration.is_guessed:
        others = ", ".join(
            one.name for one in ALL if one.reported_as == row.reported_as and one != row
        )
        notes.append(
            f"assumed to be an {row.name}; if it is an {others}, name its model in the rig"
        )
    if file is not None and file.unit_m is not None:
        unit_m = 1 / row.units_per_m
        if abs(file.unit_m - unit_m) > _UNIT_TOLERANCE:
            notes.append(
                f"{file.path}: distance_resolution is {file.unit_m:g} m, but a {row.name} counts "
                f"in {unit_m:g} m, which is used"
            )
    return notes


def _with_built_in_heights(file: VelodyneFile, row: Model) -> tuple[VelodyneFile, str]:
    """The file with the heights of the model, and a note.

    ROS drivers write 0 for all lasers where they do not know the heights (docs/sources/velodyne.md
    sections 5 and 9).
    """
    height_m = np.array(row.height_mm) * M_PER_MM
    note = (
        f"{file.path}: the vertical offsets of all lasers are 0; those of a {row.name} are used, "
        f"up to {np.abs(row.height_mm).max():.1f} mm (vertical_offset=off: none)"
    )
    return replace(file, vert_offset_m=height_m), note


def _measure(row: Model, evidence: Evidence | None) -> tuple[Measured, list[str]]:
    seen = None if evidence is None else identify(evidence.size, evidence.sample)
    if evidence is None or seen is None:
        note = "no packets in the first 10 seconds: single return assumed"
        return Measured("single return", row.sequence_ns), [note]
    notes = _identity_notes(row, seen)
    where = layout(row, seen.returns)
    packets = evidence.sample
    host_ns = evidence.host_ns
    first = Measured(seen.mode, row.sequence_ns)
    table = header_table(row, where, first, DEFAULTS, row.firing_ns(row.sequence_ns))
    good = HeaderReader(table, has_number=False).read_rows(packets).faults == 0
    packets = packets[good]
    host_ns = host_ns[good]
    stamp_ns = top_of_hour_ns(packets)
    azimuth = first_azimuths(packets, where)
    sequence_ns = float(row.sequence_ns)
    if row.banks == 4:
        measured_ns = measured_sequence_ns(stamp_ns, where.sequences)
        sequence_ns = measured_ns or sequence_ns
        if measured_ns is None:
            notes.append(
                f"too few packets to measure its firing sequence: {sequence_ns:g} ns assumed"
            )
    within = None
    if where.sequences > 1 and len(packets):
        within = median(mean_step(*steps(azimuth))) / (sequence_ns * row.halves)
    speed = rotor_speed(stamp_ns, azimuth[:, 0], within) or 0.0
    offset_ns = clock_offset_ns(packets, host_ns, evidence.neighbours)
    return Measured(seen.mode, sequence_ns, offset_ns, speed, pulse(evidence.neighbours)), notes


def _identity_notes(row: Model, seen: Identity) -> list[str]:
    if seen.model == row.reported_as and seen.label:
        return [f"model by the pace of its packets: {seen.model}, although {seen.label}"]
    return []
