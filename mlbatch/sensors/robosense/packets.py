"""ROBOSENSE point (MSOP) packets: layout, timestamps, angles and readings of columns.

Source: docs/sources/robosense.md sections 2, 3, 5 and 6. A packet carries the time of its first
round; a block carries the rotor's angle at the begin of its (first) round.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array, median
from mlbatch.lidar.geometry import rotor_words
from mlbatch.lidar.interface import FAULTS, Records
from mlbatch.lidar.pixel_table import PixelTable, readings
from mlbatch.sensors.packet_bytes import has_bytes, majority, number
from mlbatch.sensors.robosense.models import READING, Layout, Model
from mlbatch.types import ColumnHeaders
from mlbatch.units import NS_PER_S, NS_PER_US

_CDEG_PER_REVOLUTION = 36000
# An azimuth step above 1 degree is a gap in the field of view.
_GAP_CDEG = 100
_BAD_HEADER = FAULTS.index("bad_header")
_YEAR_2000_MONTHS = 30 * 12
# Lengths of months are not checked: days 29 to 31 may run into the next month.
_CALENDAR_LIMITS = ((1, 12), (1, 31), (0, 23), (0, 59), (0, 60))
# Times beyond 2^33 s are damaged.
_MOST_SECONDS = 1 << 33
# Packets nearer than this are within one revolution, even at 1200 rpm.
_NEIGHBOURS_NS = 5_000_000


@dataclass(frozen=True, slots=True)
class Shape:
    """Columns of a packet in one return mode.

    rows: groups of blocks with an azimuth.
    row_blocks: blocks of a row.
    columns: of a row.
    records: their offsets.
    return_step: bytes from return to return within a record.
    is_split: each return is a separate column.
    """

    rows: int
    row_blocks: int
    columns: int
    records: Records
    returns: int
    return_step: int
    is_split: bool


def shape_of(model: Model, returns: int) -> Shape:
    """Columns of a packet of a model.

    Blocks of 16-line models have two rounds, or one round of two returns. A 96-line round has two
    blocks. Other models have one block per return; three blocks of 128 lines do not divide by two,
    so each return is a separate column, and a shot may span two packets.
    """
    layout = model.layout
    column = READING * model.channels
    start = layout.header + 4
    if model.rounds_per_block > 1:
        single = Records(start, layout.stride, column, model.rounds_per_block, column)
        records = single if returns == 1 else Records(start, layout.stride, returns * column)
        return Shape(
            layout.blocks, 1, single.per_row // returns, records, returns, column, is_split=False
        )
    one = model.blocks_per_round
    is_split = layout.blocks % (one * returns) != 0
    kept = 1 if is_split else returns
    stride = one * kept * layout.stride
    records = Records(start, stride, stride - 4)
    step = one * layout.stride
    return Shape(layout.blocks // (one * kept), one * kept, 1, records, kept, step, is_split)


def times_ns(packets: U8Array, model: Model) -> tuple[I64Array, BoolArray]:
    """(P,) timestamps of packets, and whether they are valid; calendar times are UTC."""
    at = model.layout.time_at
    if not model.is_calendar:
        second = number(packets, at, 6, ">")
        micro = number(packets, at + 6, 4, ">")
        good = (second < _MOST_SECONDS) & (micro < 1_000_000)
        return second % _MOST_SECONDS * NS_PER_S + micro * NS_PER_US, good
    fields = packets[:, at : at + 6].astype(np.int64)
    milli = number(packets, at + 6, 2, ">")
    micro = number(packets, at + 8, 2, ">")
    good = (milli < 1000) & (micro < 1000)
    for field, (least, most) in zip(fields[:, 1:].T, _CALENDAR_LIMITS, strict=True):
        good &= (field >= least) & (field <= most)
    year, month, day, hour, minute, second = fields.T
    months = (_YEAR_2000_MONTHS + 12 * year + month - 1).astype("datetime64[M]")
    days = months.astype("datetime64[D]").astype(np.int64) + day - 1
    seconds = ((days * 24 + hour) * 60 + minute) * 60 + second
    return seconds * NS_PER_S + (milli * 1000 + micro) * NS_PER_US, good


def in_time_form(packets: U8Array, model: Model) -> Model:
    """The model with times in the form that most packets (k, size) have: calendar or seconds.

    A time is seldom valid in both forms: seconds up to 2106 begin with two bytes 0, where calendar
    times have the month.
    """
    other = replace(model, is_calendar=not model.is_calendar)
    own_form, other_form = (
        majority(packets, times_ns(packets, one)[1]) is not None for one in (model, other)
    )
    return other if other_form and not own_form else model


class PacketReader:
    """Decoder of point packets of one model in one return mode; see `Lidar`."""

    def __init__(
        self, model: Model, shape: Shape, units_per_m: int, *, mirrored: bool, moving: bool
    ) -> None:
        """mirrored: azimuths count backwards; moving: apply rotor motion during a round."""
        self._model = model
        self._shape = shape
        self._units_per_m = np.float32(units_per_m)
        self._sense = -1.0 if mirrored else 1.0
        self._moving = moving
        self._row_ns = model.round_ns * shape.columns
        self._cdeg_per_s = 0.0

    def learn_speed(self, packets: U8Array) -> None:
        """Measure the mean rotor speed from a sample of packets; used across gaps."""
        stamp_ns, _ = times_ns(packets, self._model)
        azimuth, good = self._azimuths(packets)
        took_ns = np.diff(stamp_ns)
        rotated = _signed(np.diff(azimuth[:, 0]))
        near = (took_ns > 0) & (took_ns < _NEIGHBOURS_NS) & good[1:, 0] & good[:-1, 0]
        if near.any():
            self._cdeg_per_s = float(rotated[near].sum() / took_ns[near].sum() * NS_PER_S)
        else:
            self._cdeg_per_s = median(self._steps(azimuth, good)[0])

    def faults(self, packets: U8Array) -> U8Array:
        """(P,) index into FAULTS."""
        layout = self._model.layout
        good = has_bytes(packets, layout.magic) & has_bytes(packets, layout.block_id, layout.header)
        good &= times_ns(packets, self._model)[1]
        return np.where(good, 0, _BAD_HEADER).astype(np.uint8)

    def column_headers(self, packets: U8Array) -> ColumnHeaders:
        """Timestamps, rotor words and validity of all columns."""
        model = self._model
        shape = self._shape
        stamp_ns, _ = times_ns(packets, model)
        azimuth, good = self._azimuths(packets)
        speed, row_ns = self._steps(azimuth, good)
        round_ns = np.arange(shape.columns) * model.round_ns + min(model.firing_ns[0])
        # Written out, since -1 cannot be inferred without packets.
        flat = len(packets), row_ns.shape[1] * shape.columns
        after_ns = (row_ns[:, :, None] + round_ns).reshape(flat)
        at_round = azimuth[:, :, None] + speed[:, None, None] * (round_ns / NS_PER_S)
        revolutions = self._sense / _CDEG_PER_REVOLUTION * at_round.reshape(flat)
        revolutions_per_s = (self._sense / _CDEG_PER_REVOLUTION * self._moving) * speed
        words = rotor_words(revolutions, revolutions_per_s[:, None])
        valid = np.repeat(good, shape.columns, axis=1)
        return ColumnHeaders(stamp_ns[:, None] + after_ns, words, valid)

    def pixels(self) -> PixelTable:
        """Pixel layout for compiled decoding."""
        model = self._model
        shape = self._shape
        firsts = tuple(
            tuple(
                which * shape.return_step + part * model.layout.stride
                for part in range(model.blocks_per_round)
            )
            for which in range(shape.returns)
        )
        returns = readings(firsts, model.channels, ">u2", model.range_mask)
        return PixelTable(READING, returns, float(self._units_per_m))

    def _azimuths(self, packets: U8Array) -> tuple[I64Array, BoolArray]:
        """Azimuths of the rows (P, rows), 0.01 degree, and whether the rows are valid."""
        layout = self._model.layout
        shape = self._shape
        at = layout.header + layout.stride * shape.row_blocks * np.arange(shape.rows)
        azimuth = packets[:, at + 2].astype(np.int64) << 8 | packets[:, at + 3]
        # Sensors round the last angles of a revolution up to 360 degrees.
        good = (azimuth <= _CDEG_PER_REVOLUTION) & _has_ids(packets, at, layout)
        return azimuth % _CDEG_PER_REVOLUTION, good

    def _steps(self, azimuth: I64Array, good: BoolArray) -> tuple[F64Array, I64Array]:
        """Speed (P,) of the rotor, 0.01 degree/s, and begin (P, rows) of the rows, ns.

        The speed of a packet follows from its steps from row to row. The duration of a gap in the
        field of view follows from its angle; a packet has at most one, else an azimuth is damaged.
        """
        step = _signed(np.diff(azimuth, axis=1))
        sure = good[:, 1:] & good[:, :-1]
        again = sure & (step == 0) if self._shape.is_split else np.zeros_like(sure)
        gap = sure & (np.abs(step) > _GAP_CDEG)
        plain = sure & ~gap & ~again
        count = plain.sum(axis=1)
        rotated = np.where(plain, step, 0).sum(axis=1)
        own = rotated * (NS_PER_S / self._row_ns) / np.maximum(count, 1)
        wait_ns = np.where(again, 0, self._row_ns)
        if gap.any() and self._cdeg_per_s:
            gap &= gap.sum(axis=1, keepdims=True) == 1
            forward = np.where(self._cdeg_per_s > 0, step, -step) % _CDEG_PER_REVOLUTION
            bridge_ns = np.rint(forward * (NS_PER_S / abs(self._cdeg_per_s))).astype(np.int64)
            wait_ns = np.where(gap, bridge_ns, wait_ns)
        begin_ns = np.zeros(azimuth.shape, np.int64)
        np.cumsum(wait_ns, axis=1, out=begin_ns[:, 1:])
        return np.where(count > 0, own, self._cdeg_per_s), begin_ns


def _has_ids(packets: U8Array, at: I64Array, layout: Layout) -> BoolArray:
    """(P, rows) whether the rows at these bytes begin with the id of a block."""
    good = np.ones((len(packets), len(at)), np.bool_)
    for place, byte in enumerate(layout.block_id):
        good &= packets[:, at + place] == byte
    return good


def _signed(step: I64Array) -> I64Array:
    """Azimuth steps in the shorter direction, 0.01 degree."""
    half = _CDEG_PER_REVOLUTION // 2
    return (step + half) % _CDEG_PER_REVOLUTION - half
