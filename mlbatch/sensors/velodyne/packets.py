"""Velodyne data packets: timestamps, angles, readings and points of columns.

Source: docs/sources/velodyne.md sections 1 to 4 and 10. A column is one firing sequence; a
packet has one timestamp and an azimuth for each block, from which those of all columns follow.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.lidar.geometry import CorrectedRanges
from mlbatch.lidar.headers import HeaderReader, PacedBlocks
from mlbatch.lidar.interface import Lidar, PixelTable, readings
from mlbatch.sensors.packet_bytes import block_azimuths
from mlbatch.sensors.velodyne.calibration import VelodyneFile
from mlbatch.sensors.velodyne.clock import HOUR_NS
from mlbatch.sensors.velodyne.models import (
    CIRCLE_CDEG,
    DUAL,
    MODE_AT,
    MODES,
    PACKET_SIZE,
    STAMP_AT,
    STRIDE,
    Layout,
    Model,
    beam_table,
    expected_flags,
    layout,
    ranks,
)
from mlbatch.units import NS_PER_S

VENDOR = "Velodyne"
_RETURN_TYPES = {"strongest return": (1,), "last return": (2,), DUAL: (0, 0)}
# Section 4: an azimuth step wider than others by this factor is a blind sector.
_GAP_FACTOR = 3
_GAP_CDEG = 100
# Manuals: 300 rpm and more. Below, angles give no usable times.
_SLOWEST = 4 * CIRCLE_CDEG / NS_PER_S
_SPEED_TOLERANCE = 0.05
# By number of returns: values of the mode byte that do not contradict it.
_MAY_BE_MODE = {
    returns: np.array([(MODES.get(code, mode) == DUAL) == (returns == 2) for code in range(256)])
    for returns, mode in ((1, ""), (2, DUAL))
}


@dataclass(frozen=True, slots=True)
class Measured:
    """Properties measured from the first packets.

    mode: of returns.
    sequence_ns: length of a firing sequence.
    clock_offset_ns: true time minus receive time.
    speed: of the rotor, 0.01 degree/ns, 0 if unknown.
    """

    mode: str
    sequence_ns: float
    clock_offset_ns: int = 0
    speed: float = 0.0
    timestamp_mode: str = ""


# Values of --decode for Velodyne, where none is given.
DEFAULTS: Mapping[str, str] = {
    "firing_azimuth": "on",
    "vertical_offset": "on",
    "packet_stamp": "start",
}


class VelodyneLidar(Lidar):
    """Decoder of one sensor."""

    def __init__(
        self,
        model: Model,
        file: VelodyneFile | None,
        measured: Measured,
        options: Mapping[str, str],
        notes: tuple[str, ...],
    ) -> None:
        returns = 2 if measured.mode == DUAL else 1
        self._model = model
        self._is_raised = options["vertical_offset"] == "on"
        self._file = file
        where = layout(model, returns)
        self.vendor = VENDOR
        self.model = model.name
        self.mode = measured.mode
        self.channels = model.lasers
        self.returns = returns
        self.packet_size = PACKET_SIZE
        self.columns_per_packet = where.columns
        self.column_period_ns = measured.sequence_ns
        self.records = where.records
        dark = np.zeros(0, np.int64) if file is None else (~file.enabled).nonzero()[0]
        self.pixels = PixelTable(
            3,
            readings(where.first_byte, model.lasers, "<u2"),
            model.units_per_m,
            dark=tuple(dark.tolist()),
        )
        self.return_types = _RETURN_TYPES.get(measured.mode, (0,))
        self.firing_ns = model.firing_ns(measured.sequence_ns)
        self.firing_ns[:, dark] = -1
        self.beams = beam_table(model, file, raised=self._is_raised)
        elevation = np.array(model.elevation_deg) if file is None else file.elevation_rad
        self.channel = ranks(elevation)
        self.calibration = "built in" if file is None else str(file.path)
        self.timestamp_mode = measured.timestamp_mode
        self.clock_period_ns = HOUR_NS
        self.notes = notes
        table = header_table(model, where, measured, options, self.firing_ns)
        self.reader = HeaderReader(table, has_number=False)

    def projection(self, body_from_sensor: F64Array) -> CorrectedRanges | None:
        """Projection of the HDL-64E, whose corrections depend on the range; else None."""
        if not self._model.needs_file or self._file is None:
            return None
        file = self._file
        if not self._is_raised:
            file = replace(file, vert_offset_m=np.zeros_like(file.vert_offset_m))
        return hdl64_projection(file, body_from_sensor)


def header_table(
    model: Model, where: Layout, measured: Measured, options: Mapping[str, str], firing_ns: I64Array
) -> PacedBlocks:
    """Layout of the headers; firing_ns: as of the `Lidar`."""
    returns = 2 if measured.mode == DUAL else 1
    flags = expected_flags(model.banks, returns)
    sequence_ns = measured.sequence_ns
    # First firing of each column, after the packet's stamp and after its block's azimuth.
    number = np.arange(where.columns)
    start_ns = np.rint(number * sequence_ns).astype(np.int64) + model.stamp_ns
    if options["packet_stamp"] == "end" and model.stamp_may_end:
        start_ns -= start_ns[-1] + firing_ns.max()
    ahead_ns: F64Array = (number % model.halves).astype(np.float64) * sequence_ns
    return PacedBlocks(
        packet_bytes=PACKET_SIZE,
        columns=where.columns,
        groups=where.sequences,
        blocks_per_group=where.blocks,
        block_count=len(flags),
        block_bytes=STRIDE,
        flags=flags.astype(np.int64),
        circle=CIRCLE_CDEG,
        widest=_GAP_CDEG,
        gap_factor=_GAP_FACTOR,
        stamp_at=STAMP_AT,
        period_ns=HOUR_NS,
        clock_offset_ns=measured.clock_offset_ns,
        # Other models differ by flags; the HDL-64E has its status there.
        mode_at=MODE_AT,
        modes=_MAY_BE_MODE[returns].astype(np.uint8) if model.banks == 1 else None,
        start_ns=start_ns,
        ahead_ns=ahead_ns,
        group_ns=sequence_ns * model.halves,
        known_speed=measured.speed,
        slowest=_SLOWEST,
        tolerance=_SPEED_TOLERANCE,
        follows_rotor=options["firing_azimuth"] == "on",
    )


def first_azimuths(packets: U8Array, where: Layout) -> I64Array:
    """(P, sequences) azimuths of the first block of every firing sequence.

    0.01 degree, from 0 to 35999: packets may have 36000 for 0.
    """
    return block_azimuths(packets, 0, STRIDE * where.blocks, where.sequences, "<") % CIRCLE_CDEG


def steps(azimuth: I64Array) -> tuple[I64Array, BoolArray]:
    """Azimuth steps within packets, and whether they span a blind sector.

    A jittering or resting rotor may step back by less than a degree.
    """
    step = (azimuth[:, 1:] - azimuth[:, :-1] + _GAP_CDEG) % CIRCLE_CDEG - _GAP_CDEG
    is_wide = step > _GAP_CDEG
    if not is_wide.any():
        return step, is_wide
    middle = np.sort(step, axis=1)[:, (step.shape[1] - 1) // 2, None]
    return step, (step > _GAP_FACTOR * middle) & is_wide


def mean_step(step: I64Array, gap: BoolArray) -> F64Array:
    """(P,) mean of the steps that are no gap; the median step never is one."""
    if not gap.any():
        return np.asarray(step.sum(axis=1) / step.shape[1], np.float64)
    total = np.where(gap, 0, step).sum(axis=1)
    return np.asarray(total / (~gap).sum(axis=1), np.float64)


# Source: section 10, the first variant (velodyne_decoder). A laser of an HDL-64E is calibrated at
# 25.04 m, and again at 2.40 m to the side (x) and 1.93 m ahead (y). Below 25.04 m its correction is
# interpolated linearly between the two, for each axis separately; height uses the mean of both.
_FAR_M = 25.04
_NEAR_RIGHT_M = 2.40
_NEAR_FORWARD_M = 1.93


def hdl64_projection(file: VelodyneFile, body_from_sensor: F64Array) -> CorrectedRanges:
    """Ranges as measured to points of a sensor at `body_from_sensor` (4, 4), m."""
    # Lasers without near values keep the far one: slope 0.
    two_points = (file.dist_correction_x_m != 0) & (file.dist_correction_y_m != 0)
    planes = (
        np.cos(file.azimuth_rad),
        np.sin(file.azimuth_rad),
        np.cos(file.elevation_rad),
        np.sin(file.elevation_rad),
        file.horiz_offset_m,
        file.vert_offset_m,
        file.dist_correction_m,
        *_line(file.dist_correction_x_m, file, two_points, _NEAR_RIGHT_M),
        *_line(file.dist_correction_y_m, file, two_points, _NEAR_FORWARD_M),
    )
    return CorrectedRanges(
        np.stack(planes).astype(np.float32), body_from_sensor[:3].astype(np.float32)
    )


def _line(
    near: F64Array, file: VelodyneFile, two_points: BoolArray, near_m: float
) -> tuple[F64Array, F64Array]:
    """Correction at 0 m and its slope, from the values at `near_m` and at 25.04 m."""
    far = file.dist_correction_m
    slope = np.where(two_points, (far - near) / (_FAR_M - near_m), 0.0)
    start = np.where(two_points, near - slope * near_m, far)
    return start, slope
