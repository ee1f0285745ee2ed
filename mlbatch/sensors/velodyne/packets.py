"""Velodyne data packets: timestamps, angles and readings of columns.

Source: docs/sources/velodyne.md sections 1 to 4. A column is one firing sequence; a packet has one
timestamp and an azimuth for each block, from which those of all columns follow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.lidar.headers import HeaderReader, PacedBlocks
from mlbatch.lidar.pixel_table import PixelTable, readings
from mlbatch.lidar.projections import CorrectedRanges
from mlbatch.sensors.base import BaseLidar
from mlbatch.sensors.velodyne.calibration import VelodyneFile
from mlbatch.sensors.velodyne.clock import HOUR_NS, top_of_hour_ns
from mlbatch.sensors.velodyne.hdl64 import hdl64_projection
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
_AZIMUTH_AT = 2
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


@dataclass(frozen=True, slots=True)
class Options:
    """Values of --decode for Velodyne."""

    firing_azimuth: bool = True
    vertical_offset: bool = True
    stamp_is_end: bool = False


class VelodyneLidar(BaseLidar):
    """Decoder of one sensor; implements `Lidar`."""

    def __init__(
        self,
        model: Model,
        file: VelodyneFile | None,
        measured: Measured,
        options: Options,
        notes: tuple[str, ...],
    ) -> None:
        returns = 2 if measured.mode == DUAL else 1
        self._model = model
        self._measured = measured
        self._options = options
        self._file = file
        self._layout = layout(model, returns)
        self.vendor = VENDOR
        self.model = model.name
        self.mode = measured.mode
        self.channels = model.lasers
        self.returns = returns
        self.packet_size = PACKET_SIZE
        self.columns_per_packet = self._layout.columns
        self.column_period_ns = measured.sequence_ns
        self.records = self._layout.records
        self._dark = np.zeros(0, np.int64) if file is None else (~file.enabled).nonzero()[0]
        self.pixels = PixelTable(
            3,
            readings(self._layout.first_byte, model.lasers, "<u2"),
            model.units_per_m,
            dark=tuple(self._dark.tolist()),
        )
        self.return_types = _RETURN_TYPES.get(measured.mode, (0,))
        self.firing_ns = model.firing_ns(measured.sequence_ns)
        self.firing_ns[:, self._dark] = -1
        self.beams = beam_table(model, file, raised=options.vertical_offset)
        elevation = np.array(model.elevation_deg) if file is None else file.elevation_rad
        self.channel = ranks(elevation)
        self.calibration = "built in" if file is None else str(file.path)
        self.timestamp_mode = measured.timestamp_mode
        self.clock_period_ns = HOUR_NS
        self.notes = notes
        self.reader = HeaderReader(self._header_table(), has_number=False)

    def projection(self, body_from_sensor: F64Array) -> CorrectedRanges | None:
        """Projection of the HDL-64E, whose corrections depend on the range; else None."""
        if not self._model.needs_file or self._file is None:
            return None
        file = self._file
        if not self._options.vertical_offset:
            file = replace(file, vert_offset_m=np.zeros_like(file.vert_offset_m))
        return hdl64_projection(file, body_from_sensor)

    def _header_table(self) -> PacedBlocks:
        """Layout of the headers."""
        model = self._model
        measured = self._measured
        start_ns, ahead_ns = self._timetable()
        flags = expected_flags(model.banks, self.returns)
        modes = _MAY_BE_MODE[self.returns].astype(np.uint8)
        return PacedBlocks(
            packet_bytes=PACKET_SIZE,
            columns=self._layout.columns,
            groups=self._layout.sequences,
            blocks_per_group=self._layout.blocks,
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
            modes=modes if model.banks == 1 else None,
            start_ns=start_ns,
            ahead_ns=ahead_ns,
            group_ns=measured.sequence_ns * model.halves,
            known_speed=measured.speed,
            slowest=_SLOWEST,
            tolerance=_SPEED_TOLERANCE,
            follows_rotor=self._options.firing_azimuth,
        )

    def _timetable(self) -> tuple[I64Array, F64Array]:
        """First firing of each column, after the packet's stamp and after its block's azimuth."""
        model = self._model
        sequence_ns = self._measured.sequence_ns
        number = np.arange(self._layout.columns)
        start_ns = np.rint(number * sequence_ns).astype(np.int64) + model.stamp_ns
        if self._options.stamp_is_end and model.stamp_may_end:
            start_ns -= start_ns[-1] + self.firing_ns.max()
        ahead_ns: F64Array = (number % model.halves).astype(np.float64) * sequence_ns
        return start_ns, ahead_ns


def are_good(packets: U8Array, model: Model, returns: int) -> BoolArray:
    """(P,) whether packets are a model's, with so many returns: flags, limits, return mode."""
    flags = expected_flags(model.banks, returns)
    used = len(flags)
    blocks = _block_words(packets, 0, used) == flags
    blocks &= _block_words(packets, _AZIMUTH_AT, used) <= CIRCLE_CDEG
    good = blocks.all(axis=1)
    good &= top_of_hour_ns(packets) < HOUR_NS
    if model.banks == 1:  # Other models differ by flags; the HDL-64E has its status there.
        good &= _MAY_BE_MODE[returns][packets[:, MODE_AT]]
    return np.asarray(good)


def first_azimuths(packets: U8Array, where: Layout) -> I64Array:
    """(P, sequences) azimuths of the first block of every firing sequence.

    0.01 degree, from 0 to 35999: packets may have 36000 for 0.
    """
    azimuth = _block_words(packets, _AZIMUTH_AT, where.sequences, where.blocks)
    azimuth[azimuth == CIRCLE_CDEG] = 0
    return azimuth


def _block_words(packets: U8Array, at: int, count: int, every: int = 1) -> I64Array:
    """(P, count) two-byte numbers at byte `at` of every n-th block."""
    step = STRIDE * every
    blocks = packets[:, at : at + step * count].reshape(len(packets), count, step)
    return np.asarray(blocks[:, :, :2].view("<u2")[..., 0], np.int64)


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
