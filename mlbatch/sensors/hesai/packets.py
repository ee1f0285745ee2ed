"""HESAI packets to timestamps, rotor positions and ranges, for all models.

Source: docs/sources/hesai.md sections 2 to 5 (dates: 4) and 7. A column is a firing group: one
block for each return, all of one azimuth. Time of a block is that of firing offset 0, and so is its
azimuth, but for XT models (`Timing.azimuth_ns`); some models count offsets back from there, so
timestamp and angle of a column are those of its earliest firing.
"""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.lidar.geometry import rotor_words
from mlbatch.lidar.interface import FAULTS, Records
from mlbatch.lidar.pixel_table import PixelTable, readings
from mlbatch.sensors.crc import crc32
from mlbatch.sensors.hesai.firing import NEVER
from mlbatch.sensors.hesai.layout import CRC_SIZE, RETURN_MODES, SAFETY, SAFETY_SIZE, Layout
from mlbatch.sensors.hesai.models import OPERATIONS
from mlbatch.sensors.packet_bytes import number
from mlbatch.types import ColumnHeaders
from mlbatch.units import MM_PER_M, NS_PER_S, NS_PER_US

_CENTURY = 70  # Years below are in this century, others in the last.
_US_PER_S = 1_000_000
_S_PER_DAY = 86400
# Range of int64 ns since 1970, in seconds; later dates are damaged.
_MOST_S = 9_000_000_000


def packet_times(packets: U8Array, date_at: int, us_at: int) -> tuple[I64Array, BoolArray]:
    """(P,) ns since 1970 of packets, and whether their date and time are valid."""
    date = packets[:, date_at : date_at + 6].astype(np.int64)
    us = number(packets, us_at, 4)
    calendar_s, is_date = _calendar(date)
    counted_s = number(packets, date_at + 1, 5, ">")
    is_counted = date[:, 0] == 0
    seconds = np.where(is_counted, counted_s, calendar_s)
    valid = np.where(is_counted, counted_s <= _MOST_S, is_date) & (us <= _US_PER_S)
    return np.where(valid, seconds, 0) * NS_PER_S + us * NS_PER_US, valid


def _calendar(date: I64Array) -> tuple[I64Array, BoolArray]:
    """Seconds since 1970 of (P, 6) year, month, day, hour, minute, second; and their validity."""
    year, month, day, hour, minute, second = date.T
    months = (np.where(year < _CENTURY, year + 30, year - _CENTURY)) * 12 + month - 1
    first_day = _days(months)
    next_month = _days(months + 1)
    valid = (month >= 1) & (month <= 12) & (day >= 1) & (day <= next_month - first_day)
    valid &= (hour < 24) & (minute < 60) & (second < 60)
    days = first_day + day - 1
    return days * _S_PER_DAY + hour * 3600 + minute * 60 + second, valid


def _days(months: I64Array) -> I64Array:
    """Days from 1970 to the first of a month, which counts from January 1970."""
    days: I64Array = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64)
    return days


_BAD_HEADER = np.uint8(FAULTS.index("bad_header"))
_BAD_CRC = np.uint8(FAULTS.index("bad_crc"))
_BLOCK_FLAG = (0xFF, 0xEE)
_S_PER_MINUTE = 60
_S_PER_NS = 1e-9


class PacketReader:
    """Decoder of packets of one layout.

    sense: 1 for a clockwise rotor, else -1.
    follows_rotor: apply rotor motion during a firing.
    checks_crc: check all parts that have a CRC.
    """

    def __init__(
        self, layout: Layout, *, follows_rotor: bool = True, checks_crc: bool = False
    ) -> None:
        model = layout.model
        self.layout = layout
        self.records = Records(
            start=layout.prefix + model.header,
            stride=layout.stride * layout.mode.returns,
            size=layout.stride * layout.mode.returns,
        )
        fires = model.firing_ns != NEVER
        huge = np.iinfo(np.int64).max
        self._first_ns = np.where(fires, model.firing_ns, huge).min(axis=1)
        self.firing_ns: I64Array = np.where(fires, model.firing_ns - self._first_ns[:, None], NEVER)
        self.sense = 1
        self._follows_rotor = follows_rotor
        self._checks_crc = checks_crc
        self._record = _record_dtype(layout)

    def column_headers(self, packets: U8Array) -> ColumnHeaders:
        """Timestamps, rotor words and validity of all columns."""
        layout = self.layout
        timing = self.layout.model.timing
        body = packets[:, layout.prefix :]
        packet_ns, _ = self._times(body)
        operation = self._operation(body)
        group = np.arange(layout.columns)
        if timing.counts_back:
            group -= layout.columns - 1
        step_ns = timing.step_ns * np.array(timing.slower, np.int64)[operation]
        table = self._tables(body, operation)
        first_ns = self._first_ns[table]
        offset_ns = timing.base_ns + step_ns[:, None] * group // timing.divisor
        revolutions = self._azimuths(body)[:, :: layout.mode.returns] / layout.model.ticks
        speed = np.broadcast_to(self._revolutions_per_s(body)[:, None], revolutions.shape)
        revolutions += speed * ((first_ns - timing.azimuth_ns) * _S_PER_NS)
        return ColumnHeaders(
            packet_ns[:, None] + offset_ns + first_ns,
            rotor_words(revolutions, speed, table),
            np.ones(revolutions.shape, np.bool_),
        )

    def faults(self, packets: U8Array) -> U8Array:
        """(P,) index into FAULTS."""
        layout = self.layout
        body = packets[:, layout.prefix :]
        good = np.ones(len(body), np.bool_)
        for at, value in layout.fixed.items():
            good &= body[:, at] == value
        if not layout.fixed:
            for at, value in enumerate(_BLOCK_FLAG):
                good &= (self._each_block(body, at) == value).all(axis=1)
        good &= self._has_mode(body)
        good &= self._times(body)[1]
        azimuth = self._azimuths(body)
        good &= (azimuth <= layout.model.ticks).all(axis=1)
        groups = azimuth.reshape(len(body), layout.columns, layout.mode.returns)
        good &= (groups == groups[:, :, :1]).all(axis=(1, 2))
        verdict: U8Array = np.where(good, np.uint8(0), _BAD_HEADER)
        if self._checks_crc:
            verdict[good & ~self._crc_agrees(body)] = _BAD_CRC
        return verdict

    def sequence(self, packets: U8Array) -> I64Array | None:
        """(P,) sequence number, None if packets carry none."""
        at = self.layout.sequence_at
        if at is None:
            return None
        width = self.layout.model.tail.sequence_bytes
        return number(packets, self.layout.prefix + at, width)

    def pixels(self) -> PixelTable:
        """Pixel layout for compiled decoding."""
        layout = self.layout
        unit_mm = self.layout.unit_mm
        firsts = tuple(
            (which * layout.stride + layout.model.lead,) for which in range(layout.mode.returns)
        )
        is_whole = MM_PER_M % unit_mm == 0
        return PixelTable(
            layout.unit,
            readings(firsts, layout.model.channels, "<u2"),
            MM_PER_M // unit_mm if is_whole else MM_PER_M,
            1 if is_whole else unit_mm,
            layout.model.silent,
        )

    def azimuth_revolutions(self, packets: U8Array) -> F64Array:
        """(P,) azimuth of the first block, in revolutions."""
        azimuth = self._azimuths(packets[:, self.layout.prefix :])[:, 0]
        return np.asarray(azimuth / self.layout.model.ticks, np.float64)

    def _each_block(self, body: U8Array, at: int) -> U8Array:
        """(P, blocks) byte `at` of every block."""
        layout = self.layout
        return body[:, layout.model.header + at : layout.body_end : layout.stride]

    def _azimuths(self, body: U8Array) -> I64Array:
        """(P, blocks) azimuths, in ticks."""
        model = self.layout.model
        low, high = (self._each_block(body, model.azimuth_at + at) for at in (0, 1))
        azimuth = low.astype(np.int64) | high.astype(np.int64) << 8
        if model.ticks > 1 << 16:
            azimuth = azimuth << 8 | self._each_block(body, model.azimuth_at + 2)
        return azimuth

    def _times(self, body: U8Array) -> tuple[I64Array, BoolArray]:
        tail = self.layout.model.tail
        at = self.layout.tail_at
        return packet_times(body, at + tail.date_at, at + tail.us_at)

    def _revolutions_per_s(self, body: U8Array) -> F64Array:
        """(P,) rotor speed stated in the packets; 0 without a field, or if it is not applied."""
        tail = self.layout.model.tail
        if tail.rpm_at is None or not self._follows_rotor:
            return np.zeros(len(body))
        steps = number(body, self.layout.tail_at + tail.rpm_at, 2)
        if tail.rpm_is_signed:
            steps = np.abs(steps.astype(np.int16).astype(np.int64))
        return np.asarray(steps * (tail.rpm_step * self.sense / _S_PER_MINUTE), np.float64)

    def _operation(self, body: U8Array) -> I64Array:
        at = self.layout.model.tail.operation_at
        if at is None:
            return np.zeros(len(body), np.int64)
        return number(body, self.layout.tail_at + at, 1) % OPERATIONS

    def _tables(self, body: U8Array, operation: I64Array) -> I64Array:
        """(P, columns) firing table of every column."""
        layout = self.layout
        tail = self.layout.model.tail
        group = np.arange(layout.columns)
        if tail.loop_at is not None:
            flag = number(body, layout.tail_at + tail.loop_at, 1)
            return np.asarray((flag[:, None] + group + 1) % 2)
        if tail.states_at is None:
            return np.zeros((len(body), layout.columns), np.int64)
        states = number(body, layout.tail_at + tail.states_at, 2)[:, None]
        state = states >> (14 - 2 * layout.mode.returns * group) & 3
        return np.asarray(layout.model.tables[operation[:, None], state])

    def _has_mode(self, body: U8Array) -> BoolArray:
        """(P,) whether packets have the number and types of returns of the first packets."""
        at = self.layout.model.tail.mode_at
        if at is None:
            return np.ones(len(body), np.bool_)
        mode = self.layout.mode
        same = [
            code
            for code, one in RETURN_MODES.items()
            if (one.returns, one.types) == (mode.returns, mode.types)
        ]
        return np.isin(body[:, self.layout.tail_at + at], same)

    def _crc_agrees(self, body: U8Array) -> BoolArray:
        """(P,) whether all checksums are correct."""
        layout = self.layout
        agrees = np.ones(len(body), np.bool_)
        parts = []
        if layout.model.has_checks:
            parts.append((layout.model.header, layout.body_end))
            if layout.flags & SAFETY:
                safety_at = layout.body_end + CRC_SIZE
                # Without the version byte and the checksum.
                parts.append((safety_at + 1, safety_at + SAFETY_SIZE - CRC_SIZE))
        if layout.crc_at is not None:
            parts.append((layout.tail_at, layout.crc_at))
        for begin, end in parts:
            agrees &= crc32(body[:, begin:end]) == number(body, end, CRC_SIZE)
        return agrees


def _record_dtype(layout: Layout) -> np.dtype[np.void]:
    """Record of a column: a block for every return."""
    reading = np.dtype(
        {
            "names": ["distance", "reflectivity"],
            "formats": ["<u2", "u1"],
            "offsets": [0, 2],
            "itemsize": layout.unit,
        }
    )
    block = np.dtype(
        {
            "names": ["reading"],
            "formats": [(reading, layout.model.channels)],
            "offsets": [layout.model.lead],
            "itemsize": layout.stride,
        }
    )
    return np.dtype([("block", block, (layout.mode.returns,))])
