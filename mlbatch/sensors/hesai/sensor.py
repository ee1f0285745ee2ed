"""HESAI lidars: Pandar, XT, QT, OT128, AT128, JT, described by an angle file and their packets.

Source: docs/sources/hesai.md (HesaiLidar_SDK_2.0, HesaiLidar_General_SDK, tier4/nebula, user
manuals). An angle file belongs to one unit and has no model name, so packets identify the model.
Channels are numbered from 0 in packet order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from mlbatch.arrays import F32Array, F64Array, median
from mlbatch.errors import RigError
from mlbatch.lidar.geometry import BeamTable, Mirrors, OffAxis, Projection, spherical
from mlbatch.lidar.headers import HeaderReader
from mlbatch.lidar.interface import Calibration, Evidence, Lidar, Recorded, SensorModel
from mlbatch.sensors.hesai import models as rows
from mlbatch.sensors.hesai.angles import At128File, HesaiAngles, read_angles, read_at128
from mlbatch.sensors.hesai.identify import describe, identify
from mlbatch.sensors.hesai.models import Model
from mlbatch.sensors.hesai.packets import (
    Layout,
    firing_tables,
    first_azimuths,
    header_table,
    pixels,
    records_of,
    wrong_crc,
)
from mlbatch.sensors.nominal import apart_deg, refuse_other_beams
from mlbatch.sensors.options import check_options
from mlbatch.units import M_PER_MM, RAD_PER_DEG

__all__ = ["BUILT_IN", "MODELS", "VENDOR", "HesaiCalibration", "HesaiLidar", "describe"]

VENDOR = "HESAI"
# Default ports: docs/sources/messages.md, section 7; topics and messages: section 1.
RECORDED = Recorded(
    port=2368,
    topic="hesai_packets",
    message="hesai_ros_driver/UdpFrame",
    message_ros1="hesai_ros_driver/UdpFrame",
    device_port=10110,
)
BUILT_IN: tuple[Calibration, ...] = ()
_CSV = "angle csv of the unit, required"
_DAT = "correction dat of the unit, required"
MODELS: tuple[SensorModel, ...] = tuple(
    SensorModel(
        name=row.name,
        vendor=VENDOR,
        channels=row.channels,
        returns=tuple(range(1, row.most_returns + 1)),
        clock="free-running, GPS or PTP; date and us in every packet",
        calibration=_DAT if row is rows.AT128 else _CSV,
        verified=row.verified,
        same_packets_as=row.same_packets_as,
    )
    for row in rows.ALL
)
# A file whose beams fit the model within the unit-to-unit tolerance is preferred.
_FITS = 200
_FITS_BEAMS = 300
_ELEVATION_TOLERANCE_DEG = 4.0
# Number of consecutive packets at the start of a sample.
_PACKETS_IN_A_ROW = 16


def read_calibration(path: Path, content: bytes) -> Calibration | None:
    """Parse the angles in a csv or dat file; None if it is something else."""
    at128 = read_at128(path, content)
    if at128 is not None:
        return At128Calibration(at128)
    angles = read_angles(path, content)
    return None if angles is None else HesaiCalibration(angles)


class HesaiCalibration(Calibration):
    """Angle csv, for any model with as many channels."""

    def __init__(self, angles: HesaiAngles) -> None:
        self._angles = angles
        self.path = angles.path
        self.model = f"{VENDOR} of {len(angles.azimuth_rad)} channels"

    def match_score(self, evidence: Evidence) -> int:
        """Match score of packets: by channels, then by the elevations of the outer beams."""
        layout = _layout(evidence)
        if layout is None or layout.model.channels != len(self._angles.azimuth_rad):
            return 0
        layout = _model_by_beams(layout, self._angles)
        if layout.model.name == rows.AT128.name:
            return 1
        return _FITS if _note_on_beams(self._angles, layout.model) else _FITS_BEAMS

    def lidar(self, options: Mapping[str, str], evidence: Evidence | None) -> HesaiLidar:
        """Decoder of the sensor; RigError if the file is of another model."""
        check_options(options)
        angles = self._angles
        layout = _model_by_beams(_require_layout(self.path, evidence), angles)
        model = layout.model
        if model.name == rows.AT128.name:
            raise RigError(
                f"{self.path}: HESAI {model.name}: expected its correction file (.dat), found a "
                "csv, which has no data of the mirrors; read the file from the lidar"
            )
        if len(angles.azimuth_rad) != model.channels:
            raise RigError(
                f"{self.path}: HESAI angles: expected {model.channels} channels for the packets "
                f"of a {model.name}, found {len(angles.azimuth_rad)}; give the file of this lidar"
            )
        if model.elevation_deg is not None:
            elevation_deg = angles.elevation_rad / RAD_PER_DEG
            refuse_other_beams(self.path, model.name, elevation_deg, [model.elevation_deg])
        centre = np.array(model.centre_mm) * M_PER_MM if _is_on(options, "optical_centre") else None
        lidar = HesaiLidar(layout, options, evidence, angles, centre)
        note = _note_on_beams(angles, model)
        lidar.notes = (note,) if note else ()
        return lidar


class At128Calibration(Calibration):
    """Correction file of an AT128."""

    model = rows.AT128.name

    def __init__(self, file: At128File) -> None:
        self._file = file
        self.path = file.path

    def match_score(self, evidence: Evidence) -> int:
        """Match score of packets."""
        layout = _layout(evidence)
        return _FITS_BEAMS if layout is not None and layout.model.name == self.model else 0

    def lidar(self, options: Mapping[str, str], evidence: Evidence | None) -> HesaiLidar:
        """Decoder of the sensor; RigError if the file is of another model."""
        check_options(options)
        layout = _require_layout(self.path, evidence)
        if layout.model.name != self.model:
            raise RigError(
                f"{self.path}: HESAI angles: expected the csv of a {layout.model.name} for these "
                f"packets, found the file of an {self.model}; give the file of this lidar"
            )
        return At128Lidar(layout, options, evidence, self._file)


class HesaiLidar(Lidar):
    """Decoder of one sensor. Frame: x right, y forward, z up."""

    def __init__(
        self,
        layout: Layout,
        options: Mapping[str, str],
        evidence: Evidence | None,
        angles: HesaiAngles | At128File,
        centre_m: F64Array | None = None,
    ) -> None:
        """centre_m: (3,) optical centre; None: beams leave from the axis."""
        model = layout.model
        follows_rotor = _is_on(options, "firing_azimuth", "on")
        table = header_table(layout, sense=_sense(layout, evidence), follows_rotor=follows_rotor)
        self.reader = HeaderReader(
            table,
            has_number=layout.sequence_at is not None,
            wrong_crc=(lambda packets: wrong_crc(packets, layout)) if "crc" in options else None,
        )
        self.vendor = VENDOR
        self.model = model.name
        self.mode = layout.mode.text
        self.channels = model.channels
        self.returns = layout.mode.returns
        self.packet_size = layout.size
        self.columns_per_packet = layout.columns
        self.column_period_ns = model.timing.step_ns / model.timing.divisor
        self.records = records_of(layout)
        self.pixels = pixels(layout)
        self.return_types = layout.mode.types
        self.channel = np.arange(model.channels)
        self.firing_ns, _ = firing_tables(model)
        self.calibration = str(angles.path)
        self.sequence_modulus = layout.sequence_modulus
        direction = spherical(angles.azimuth_rad, angles.elevation_rad, clockwise_from="y")
        self._on_axis = BeamTable(direction, np.zeros((3, 1, 3)), np.zeros(1))
        self._from_centre = model.from_centre
        self._centre_m = centre_m
        self.beams = self._on_axis
        if centre_m is not None:
            self.beams = off_axis(self._on_axis, centre_m, from_centre=model.from_centre)

    def projection(self, body_from_sensor: F64Array) -> Projection | None:
        """Projection of off-axis beams whose ranges count from the axis; else None."""
        if self._centre_m is None or self._from_centre:
            return None
        return axis_ranges(self._on_axis, self._centre_m, body_from_sensor)


class At128Lidar(HesaiLidar):
    """AT128: each of its mirrors sweeps the beams once through the field of view."""

    def __init__(
        self,
        layout: Layout,
        options: Mapping[str, str],
        evidence: Evidence | None,
        file: At128File,
    ) -> None:
        super().__init__(layout, options, evidence, file)
        self._file = file

    def projection(self, body_from_sensor: F64Array) -> Projection | None:
        """Projection by the mirrors."""
        return at128_projection(self._file, body_from_sensor)


def _is_on(options: Mapping[str, str], key: str, default: str = "off") -> bool:
    return options.get(key, default) == "on"


def _layout(evidence: Evidence) -> Layout | None:
    identity = identify(evidence.size, evidence.sample) if len(evidence.sample) else None
    return None if identity is None else identity.layout


def _require_layout(path: Path | None, evidence: Evidence | None) -> Layout:
    """Layout of the packets; RigError without packets, since a file has no model name."""
    layout = None if evidence is None else _layout(evidence)
    if layout is None:
        raise RigError(
            f"{path}: HESAI angles: expected packets of the lidar in the first 10 seconds, which "
            "define its model and mode, found none; check its stream in the rig file, or leave it "
            "out"
        )
    return layout


def _model_by_beams(layout: Layout, angles: HesaiAngles) -> Layout:
    """Layout with the model of the file's beams, if packets fit several models."""
    is_b = layout.model is rows.PANDAR20A and not _note_on_beams(angles, rows.PANDAR20B)
    return replace(layout, model=rows.PANDAR20B) if is_b else layout


def _note_on_beams(angles: HesaiAngles, model: Model) -> str:
    """Note on elevations of a file that do not fit a model, or ""."""
    if model.elevation_deg is None:
        return ""
    found_deg = angles.elevation_rad / RAD_PER_DEG
    if apart_deg(found_deg, model.elevation_deg) <= _ELEVATION_TOLERANCE_DEG:
        return ""
    return (
        f"{angles.path}: expected elevations from about {model.elevation_deg[0]:g} to "
        f"{model.elevation_deg[1]:g} deg for a {model.name}, found {found_deg.min():.1f} to "
        f"{found_deg.max():.1f}; check that the file is of this lidar"
    )


def _sense(layout: Layout, evidence: Evidence | None) -> int:
    """1 for a clockwise rotor, seen from above; -1 for a counter-clockwise one."""
    if evidence is None or len(evidence.sample) < 2:
        return 1
    step = np.diff(first_azimuths(evidence.sample[:_PACKETS_IN_A_ROW], layout))
    return -1 if median(step - np.rint(step)) < 0 else 1


# -- points of beams that follow no cones from the axis of the rotor (section 6) -------------------
#
# `--decode optical_centre=on` (refinement 2): the centre c rotates with the rotor; a beam of unit
# vector u ends k behind it, where the range r is that from the axis: k = sqrt(r^2 - p^2) - u.c with
# p^2 = |c|^2 - (u.c)^2. Where ranges count from the centre itself (JT models), k is r.
#
# The rotor of an AT128 carries three mirrors, each with a range of rotor angles that begins at its
# start. A beam leaves at azimuth 2 (rotor - start) - azimuth[channel] and elevation[channel], both
# corrected by tables over the rotor angle, interpolated linearly between steps of 2 deg. So
# directions are computed for every beam of every column, at the rotor angle of its firing
# (`native/decode.c`). All beams of a column belong to one mirror, since the ranges of mirrors meet
# outside the field of view.


def off_axis(on_axis: BeamTable, centre_m: F64Array, *, from_centre: bool) -> BeamTable:
    """Beams from an optical centre (3,), x right, y forward, z up."""
    right, forward, up = centre_m
    # As in `spherical`: clockwise by a, (x, y) becomes (x cos a + y sin a, y cos a - x sin a).
    origin = np.array([[[right, forward, 0.0]], [[forward, -right, 0.0]], [[0.0, 0.0, up]]])
    reach_m = np.zeros(1) if from_centre else -_along(on_axis, centre_m)
    return replace(on_axis, origin=origin, reach_m=reach_m)


def axis_ranges(on_axis: BeamTable, centre_m: F64Array, body_from_sensor: F64Array) -> OffAxis:
    """Off-axis beams whose ranges count from the axis; on_axis: in the sensor frame."""
    beams = off_axis(on_axis, centre_m, from_centre=False)
    miss_m2 = (centre_m**2).sum() - _along(on_axis, centre_m) ** 2
    return OffAxis(
        beams.moved(body_from_sensor),
        miss_m2.astype(np.float32),
        on_axis.moved(body_from_sensor).origin[2, 0].astype(np.float32),
    )


def _along(beams: BeamTable, centre_m: F64Array) -> F64Array:
    """(B,) u.c, m, constant under rotation of the rotor."""
    at_zero = beams.direction[0] + beams.direction[2]
    along: F64Array = (at_zero * centre_m).sum(axis=1)
    return along


def at128_projection(file: At128File, body_from_sensor: F64Array) -> Mirrors:
    """Ranges to points of a sensor at `body_from_sensor` (4, 4), m; x right, y forward, z up."""
    angles = (-file.azimuth_rad, file.elevation_rad)
    planes = [part for angle in angles for part in (np.cos(angle), np.sin(angle))]
    return Mirrors(
        file.start_rad,
        np.stack(planes).astype(np.float32),
        _steps(file.azimuth_adjust_rad),
        _steps(file.elevation_adjust_rad),
        body_from_sensor[:3].astype(np.float32),
    )


def _steps(adjust_rad: F64Array) -> F32Array:
    """Corrections (channels, steps) as values and changes to the next step, (2, steps, channels).

    The last step is followed by the first.
    """
    rows = adjust_rad.T
    return np.stack([rows, np.roll(rows, -1, axis=0) - rows]).astype(np.float32)
