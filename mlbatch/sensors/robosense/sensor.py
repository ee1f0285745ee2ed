"""ROBOSENSE spinning lidars: RS-LiDAR-16 and -32, Bpearl, Helios, Ruby, Ruby Plus, Airy.

Source: docs/sources/robosense.md (the vendor's rs_driver and manuals). Point packets (MSOP) name
the model; device packets (DIFOP, on another port or the same topic) contain the unit's angles and
return mode. Without them a csv of angles is required, and the mode comes from the point packets
alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn

import numpy as np

from mlbatch.arrays import U8Array
from mlbatch.errors import RigError
from mlbatch.lidar.geometry import BeamTable, spherical
from mlbatch.lidar.headers import HeaderReader
from mlbatch.lidar.interface import NAMED_ONLY, Calibration, Evidence, Lidar, Recorded, SensorModel
from mlbatch.sensors.nominal import refuse_other_beams
from mlbatch.sensors.options import check_options
from mlbatch.sensors.packet_bytes import majority
from mlbatch.sensors.robosense.difop import (
    COUNTER_MODULUS,
    RANGE_UNIT,
    Angles,
    Difop,
    find_difop,
    firing_ns,
    identify_unit,
    is_counted,
    notes_on_model,
    read_angles,
    return_mode,
    units_per_m,
)
from mlbatch.sensors.robosense.identify import (
    MODE_WORDS,
    Identity,
    describe,
    fits,
    point_packets,
)
from mlbatch.sensors.robosense.models import DIFOP, FIRST_LAYOUT, ROWS, VENDOR, Model
from mlbatch.sensors.robosense.packets import (
    header_table,
    in_time_form,
    mean_speed,
    pixels,
    shape_of,
    times_ns,
)
from mlbatch.units import RAD_PER_DEG

__all__ = [
    "BUILT_IN",
    "MODELS",
    "VENDOR",
    "RobosenseLidar",
    "describe",
    "read_calibration",
]

# Match scores: packets name the model; a file is preferred to device packets.
_FITS_MODEL = 100
_FITS_FILE = 200
_DIFOP_PORT = 7788
# Default ports: docs/sources/messages.md, section 7; topics and messages: section 1.
RECORDED = Recorded(
    port=6699,
    topic="rslidar_packets",
    message="rslidar_msg/RslidarPacket",
    message_ros1="rslidar_msg/RslidarPacket",
    imu_port=6688,
    device_port=_DIFOP_PORT,
    device_magic=DIFOP,
)

MODELS: tuple[SensorModel, ...] = tuple(
    SensorModel(
        name=row.name,
        vendor=VENDOR,
        channels=row.channels,
        returns=(1, 2),
        clock="internal oscillator, GPS or PTP; us in every packet",
        calibration="DIFOP packets of the recording, or csv of angles",
        verified=row.verified,
    )
    for row in ROWS
)


def read_calibration(path: Path, content: bytes) -> CsvCalibration | None:
    """Parse a csv file of angles; None if it is something else."""
    angles = read_angles(path, content)
    return None if angles is None else CsvCalibration(path, angles)


class DifopCalibration(Calibration):
    """A model with angles from its device packets."""

    is_shared = True

    def __init__(self, row: Model, *, is_named: bool = False) -> None:
        """is_named: the rig names this model."""
        self._row = row
        self._is_named = is_named
        self.model = row.name

    def for_model(self, name: str) -> DifopCalibration | None:
        """The same calibration if the rig names this model; packets may fit two models."""
        return DifopCalibration(self._row, is_named=True) if name == self.model else None

    def match_score(self, evidence: Evidence) -> int:
        """Match score: point packets name this model, or can at least be decoded as it."""
        found = identify_unit(evidence)
        if found is not None and found.model is self._row:
            return _FITS_MODEL
        if found is not None and found.other is self._row and self._is_named:
            return _FITS_MODEL
        points = point_packets(evidence.sample)
        chosen = majority(points, fits(points, self._row.layout))
        if chosen is None:
            return 0
        return NAMED_ONLY if majority(chosen, times_ns(chosen, self._row)[1]) is not None else 0

    def lidar(self, options: Mapping[str, str], evidence: Evidence | None) -> RobosenseLidar:
        """Decoder of the sensor, with the angles of its device packets."""
        check_options(options)
        if evidence is None:
            _refuse_without_packets(f"{VENDOR} {self.model}")
        difop = find_difop(evidence)
        angles = None if difop is None else difop.angles(self._row)
        notes: tuple[str, ...] = ()
        origin = f"DIFOP packets of {difop.serial}" if difop and difop.serial else "DIFOP packets"
        if angles is None and self._row.nominal_deg:
            elevation = np.array(self._row.nominal_deg)
            angles = Angles(elevation, np.zeros_like(elevation))
            origin = "nominal angles"
            notes = (
                f"no DIFOP packet with the angles of this {self.model}: nominal angles assumed; "
                f"record its device port ({_DIFOP_PORT}) as well, or give a csv with --metadata",
            )
        if angles is None:
            found = "no DIFOP packets" if difop is None else "DIFOP packets without angles"
            raise RigError(
                f"{VENDOR} {self.model}: expected the angles of its channels, found {found}; "
                f"record its device port ({_DIFOP_PORT}) as well, or give a csv of "
                "`elevation,azimuth` lines with --metadata"
            )
        lidar = RobosenseLidar(self._row, angles, options, evidence, difop, is_named=self._is_named)
        lidar.calibration = origin
        lidar.notes += notes
        return lidar


class CsvCalibration(Calibration):
    """Csv file with the angles of one unit.

    named: the model named in the rig.
    """

    def __init__(self, path: Path, angles: Angles, named: Model | None = None) -> None:
        self._angles = angles
        self._named = named
        self.path = path
        lines = f"{VENDOR} {len(angles.elevation_deg)}-line"
        self.model = lines if named is None else named.name

    def for_model(self, name: str) -> CsvCalibration | None:
        """The same file for a model of as many channels, named in the rig."""
        count = len(self._angles.elevation_deg)
        rows = [row for row in ROWS if row.name == name and row.channels == count]
        return CsvCalibration(self.path or Path(), self._angles, rows[0]) if rows else None

    def match_score(self, evidence: Evidence) -> int:
        """Match score: point packets name a model of as many channels, or can be decoded as it."""
        if self._named is not None:
            score = DifopCalibration(self._named, is_named=True).match_score(evidence)
            return _FITS_FILE if score == _FITS_MODEL else score
        return _FITS_FILE if self._row(evidence) is not None else 0

    def lidar(self, options: Mapping[str, str], evidence: Evidence | None) -> RobosenseLidar:
        """Decoder of the sensor, of the model named in its packets."""
        check_options(options)
        if evidence is None:
            _refuse_without_packets(f"{self.path}: {self.model}")
        row = self._row(evidence)
        if row is None:
            raise RigError(
                f"{self.path}: expected packets of a {self.model} lidar from {evidence.stream}, "
                f"found {describe(evidence.size, evidence.sample) or 'others'}; give the csv of "
                "its unit"
            )
        refuse_other_beams(self.path, row.name, self._angles.elevation_deg, row.spans_deg)
        difop = find_difop(evidence)
        found = identify_unit(evidence)
        # The number of lines decides as well.
        is_named = self._named is not None or (
            found is not None and found.other is not None and len(self._fitting(found)) == 1
        )
        lidar = RobosenseLidar(row, self._angles, options, evidence, difop, is_named=is_named)
        lidar.calibration = str(self.path)
        return lidar

    def _row(self, evidence: Evidence) -> Model | None:
        if self._named is not None:
            return self._named if DifopCalibration(self._named).match_score(evidence) else None
        identity = identify_unit(evidence)
        return None if identity is None else next(iter(self._fitting(identity)), None)

    def _fitting(self, found: Identity) -> list[Model]:
        """Models that packets may be of, with a channel for each line of the file."""
        lines = len(self._angles.elevation_deg)
        return [row for row in (found.model, found.other) if row and row.channels == lines]


BUILT_IN: tuple[Calibration, ...] = tuple(DifopCalibration(row) for row in ROWS)


class RobosenseLidar(Lidar):
    """Decoder of one sensor.

    Dual mode of 128-line models: three blocks per packet do not divide by two, so each return is a
    separate column (`returns` 1) of unknown return type; the two returns of a shot may be in two
    packets. Columns of equal azimuth have equal timestamps.
    """

    def __init__(
        self,
        row: Model,
        angles: Angles,
        options: Mapping[str, str],
        evidence: Evidence,
        difop: Difop | None,
        *,
        is_named: bool = False,
    ) -> None:
        """is_named: the rig names the model."""
        points = point_packets(evidence.sample)
        points = points[fits(points, row.layout)]
        timed, time_notes = _timed(points, row)
        returned, mode_notes = return_mode(points, timed, difop)
        steps_per_m, unit_notes = units_per_m(points, row, options.get(RANGE_UNIT, ""))
        shape = shape_of(row, returned.returns)
        mirrored = row.mirrors and difop is not None and difop.reversal != 0
        self.vendor = VENDOR
        self.model = row.name
        self.serial = "" if difop is None else difop.serial
        self.mode = ", ".join(
            word for word in (MODE_WORDS[returned.returns], returned.name) if word
        )
        if shape.is_split:
            self.mode += ", a column each"
        self.channels = row.channels
        self.returns = shape.returns
        self.packet_size = evidence.size
        self.columns_per_packet = shape.rows * shape.columns
        self.column_period_ns = float(row.round_ns)
        self._columns_per_round = returned.returns if shape.is_split else 1
        self.records = shape.records
        self.return_types = (returned.type,) * shape.returns
        self.channel = np.arange(row.channels)
        self.firing_ns = firing_ns(points, row, difop)
        self.beams = beam_table(row, angles, mirrored=mirrored)
        self.sequence_modulus = COUNTER_MODULUS if is_counted(points, row) else 0
        self.timestamp_mode = difop.sync if difop is not None and row.has_sync else ""
        self.calibration = ""
        doubtful = notes_on_model(identify_unit(evidence), row, difop, is_named=is_named)
        self.notes = (*time_notes, *mode_notes, *unit_notes, *doubtful)
        self._row = row
        moving = options.get("firing_azimuth") != "off"
        table = header_table(
            timed,
            shape,
            self.packet_size,
            mean_speed(points, timed, shape),
            is_counted=bool(self.sequence_modulus),
            mirrored=mirrored,
            moving=moving,
        )
        self.reader = HeaderReader(table, has_number=bool(self.sequence_modulus))
        self.pixels = pixels(timed, shape, steps_per_m)

    @property
    def columns_per_s(self) -> float:
        """Columns sent per second: one per round, or one for each of its returns."""
        return self._columns_per_round * super().columns_per_s


def _timed(points: U8Array, row: Model) -> tuple[Model, tuple[str, ...]]:
    """The model with the form of times that packets have; and notes."""
    if row.layout is not FIRST_LAYOUT or not len(points):
        return row, ()
    timed = in_time_form(points, row)
    if timed.is_calendar == row.is_calendar:
        return row, ()
    forms = {True: "dates", False: "seconds since 1970"}
    note = (
        f"expected {forms[row.is_calendar]} in the packets of an {row.name}, found "
        f"{forms[timed.is_calendar]}, which are used; check the model"
    )
    return timed, (note,)


def beam_table(row: Model, angles: Angles, *, mirrored: bool) -> BeamTable:
    """Beam vectors in the sensor frame (x forward, y left, z up), metres (section 6).

    The lens rotates with the rotor, without the correction of the channel. Each channel has its own
    origin, since channels fire at different rotor angles. mirrored: azimuths and corrections of the
    unit count in the opposite direction.
    """
    azimuth_rad = angles.azimuth_deg * (-RAD_PER_DEG if mirrored else RAD_PER_DEG)
    direction = spherical(azimuth_rad, angles.elevation_deg * RAD_PER_DEG)
    radius, height = row.lens_m
    lens = np.array([[radius, 0.0, 0.0], [0.0, -radius, 0.0], [0.0, 0.0, height]])
    origin = np.repeat(lens[:, None, :], row.channels, axis=1)
    return BeamTable(direction, origin, np.zeros(1))


def _refuse_without_packets(what: str) -> NoReturn:
    raise RigError(
        f"{what}: expected packets in the first 10 seconds, which define its return mode, found "
        "none; correct its stream, or leave it out of the rig"
    )
