"""ROBOSENSE point (MSOP) packets: layout, timestamps, angles and readings of columns.

Source: docs/sources/robosense.md sections 2, 3, 5 and 6. A packet carries the time of its first
round; a block carries the rotor's angle at the begin of its (first) round.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array, median
from mlbatch.lidar.headers import TimedRows, check_of, checks
from mlbatch.lidar.interface import PixelTable, Records, readings
from mlbatch.sensors.packet_bytes import block_azimuths, has_bytes, majority, number
from mlbatch.sensors.robosense.models import DIFOP, READING, Model
from mlbatch.units import NS_PER_S, NS_PER_US

_CDEG_PER_REVOLUTION = 36000
# An azimuth step above 1 degree is a gap in the field of view.
_GAP_CDEG = 100
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


def header_table(
    model: Model,
    shape: Shape,
    size: int,
    cdeg_per_s: float,
    *,
    is_counted: bool,
    mirrored: bool,
    moving: bool,
) -> TimedRows:
    """Layout of the headers of packets of a size.

    cdeg_per_s: mean rotor speed, used across gaps; is_counted: packets have a counter; mirrored:
    azimuths count backwards; moving: apply rotor motion during a round.
    """
    layout = model.layout
    start_ns = np.arange(shape.columns) * model.round_ns + min(model.firing_ns[0])
    turns = (-1.0 if mirrored else 1.0) / _CDEG_PER_REVOLUTION
    fixed = (check_of(0, layout.magic), check_of(layout.header, layout.block_id))
    return TimedRows(
        packet_bytes=size,
        columns=shape.columns,
        rows=shape.rows,
        first_row=layout.header,
        row_bytes=layout.stride * shape.row_blocks,
        check_count=len(fixed),
        checks=checks(*fixed),
        foreign_count=1,
        foreign=checks(check_of(0, DIFOP)),
        point_at=layout.point_at or -1,
        row_id=int.from_bytes(layout.block_id, "little"),
        row_id_bytes=len(layout.block_id),
        circle=_CDEG_PER_REVOLUTION,
        widest=_GAP_CDEG,
        time_at=layout.time_at,
        is_calendar=model.is_calendar,
        counter_at=model.counter_at if is_counted else -1,
        repeats=shape.is_split,
        row_ns=model.round_ns * shape.columns,
        start_ns=start_ns,
        start_s=start_ns / NS_PER_S,
        known_speed=cdeg_per_s,
        turns=turns,
        following=turns * moving,
    )


def mean_speed(packets: U8Array, model: Model, shape: Shape) -> float:
    """Mean rotor speed of a sample of packets, 0.01 degree/s; 0: unknown."""
    if not len(packets):
        return 0.0
    stamp_ns, _ = times_ns(packets, model)
    azimuth, good = _azimuths(packets, model, shape)
    took_ns = np.diff(stamp_ns)
    rotated = _signed(np.diff(azimuth[:, 0]))
    near = (took_ns > 0) & (took_ns < _NEIGHBOURS_NS) & good[1:, 0] & good[:-1, 0]
    if near.any():
        return float(rotated[near].sum() / took_ns[near].sum() * NS_PER_S)
    step = _signed(np.diff(azimuth, axis=1))
    plain = good[:, 1:] & good[:, :-1] & (np.abs(step) <= _GAP_CDEG)
    plain &= (step != 0) | (not shape.is_split)
    count = plain.sum(axis=1)
    row_ns = model.round_ns * shape.columns
    own = np.where(plain, step, 0).sum(axis=1) * (NS_PER_S / row_ns) / np.maximum(count, 1)
    return median(own)


def pixels(model: Model, shape: Shape, units_per_m: int) -> PixelTable:
    """Pixel layout for compiled decoding."""
    firsts = tuple(
        tuple(
            which * shape.return_step + part * model.layout.stride
            for part in range(model.blocks_per_round)
        )
        for which in range(shape.returns)
    )
    returns = readings(firsts, model.channels, ">u2", model.range_mask)
    return PixelTable(READING, returns, float(np.float32(units_per_m)))


def _azimuths(packets: U8Array, model: Model, shape: Shape) -> tuple[I64Array, BoolArray]:
    """Azimuths of the rows (P, rows), 0.01 degree, and whether the rows are valid."""
    layout = model.layout
    stride = layout.stride * shape.row_blocks
    azimuth = block_azimuths(packets, layout.header, stride, shape.rows, ">")
    # Sensors round the last angles of a revolution up to 360 degrees.
    good = azimuth <= _CDEG_PER_REVOLUTION
    for row in range(shape.rows):
        good[:, row] &= has_bytes(packets, layout.block_id, layout.header + stride * row)
    return azimuth % _CDEG_PER_REVOLUTION, good


def _signed(step: I64Array) -> I64Array:
    """Azimuth steps in the shorter direction, 0.01 degree."""
    half = _CDEG_PER_REVOLUTION // 2
    return (step + half) % _CDEG_PER_REVOLUTION - half
