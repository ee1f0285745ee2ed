"""Encoder of Velodyne packets: what a sensor would send, from ranges or from what it would see.

Source: docs/sources/velodyne.md sections 1-3 and 5-9, and nothing of the decoder. A *column* is one
firing sequence (all lasers once); column n is the n-th that is sent, so a blind sector leaves no
number out. Returns are in the order of the wire: last, strongest (HDL-64E: strongest, last).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone

import numpy as np

from mlbatch.arrays import F64Array, I64Array, U8Array
from mlbatch.simulate.velodyne.models import MODELS, Table

HOUR_US = 3_600_000_000
NMEA_AT = 206
NMEA_SIZE = 128
_MODES = {"strongest": 0x37, "last": 0x38, "dual": 0x39}
_READING = np.dtype([("distance", "<u2"), ("level", "u1")])
_BLOCK = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("reading", _READING, 32)])
_PACKET = np.dtype([("block", _BLOCK, 12), ("stamp_us", "<u4"), ("factory", "u1", 2)])
# Characters of the HDL-64E's status, docs/sources/velodyne.md section 9.
_STATUS = b"HMSDNYGTV1234567"


@dataclass(frozen=True)
class VelodyneSpec:
    """A sensor to imitate; model is a key of MODELS (HDL-64E: "HDL-64E S2" or "HDL-64E S3").

    start_us: first firing of column 0, us past the hour number `hour` (since 1970); blind_deg:
    azimuths [from, to) in which it does not measure (from > to: through zero); product: byte 1205,
    if not the model's; sequence_us: time of a sequence, if not the model's; stamps_end: the packet
    is stamped at its end (HDL-32E, section 2); host_ahead_ns: host clock minus sensor clock.
    """

    model: str
    mode: str = "strongest"
    rpm: float = 600.0
    start_azimuth_deg: float = 0.0
    start_us: float = 1_000_000.0
    hour: int = 472_222
    blind_deg: tuple[float, float] | None = None
    product: int | None = None
    sequence_us: float | None = None
    stamps_end: bool = False
    host_ahead_ns: int = 0

    @property
    def table(self) -> Table:
        """The row of the model in the data sheet."""
        return MODELS[self.model]

    @property
    def returns(self) -> int:
        """Returns of a column."""
        return 2 if self.mode == "dual" else 1

    @property
    def row_us(self) -> float:
        """From one azimuth to the next, without a blind sector between them."""
        return (self.sequence_us or self.table.sequence_us) * self.table.columns_per_row

    @property
    def rows_per_packet(self) -> int:
        """Azimuths of a packet."""
        return 12 // (len(self.table.flags) * self.returns)

    @property
    def columns_per_packet(self) -> int:
        """Firing sequences of a packet."""
        return self.rows_per_packet * self.table.columns_per_row

    @property
    def firing_us(self) -> F64Array:
        """(lasers,) when each fires, after the first of its sequence."""
        table = self.table
        stretch = (self.sequence_us or table.sequence_us) / table.sequence_us
        return np.array(table.firing_us) * (stretch if table.time_scales else 1.0)


@dataclass(frozen=True)
class Sent:
    """Payloads (P, size) and their receive times (P,), ns."""

    payloads: U8Array
    host_ns: I64Array


def encode(spec: VelodyneSpec, distance: I64Array, level: I64Array) -> Sent:
    """Packets with these counts of distance and levels, each (columns, lasers, returns)."""
    table = spec.table
    rows_per_packet = spec.rows_per_packet
    rows = len(distance) // table.columns_per_row
    count = rows // rows_per_packet
    if len(distance) != count * spec.columns_per_packet:
        raise ValueError(f"expected whole packets of {spec.columns_per_packet} columns")
    blocks = len(table.flags) * spec.returns
    packets = np.zeros(count, _PACKET)
    row_us = _row_us(spec, rows)
    filled = packets["block"][:, : rows_per_packet * blocks]
    filled["flag"] = np.tile(_flags(spec), rows_per_packet)
    cdeg = np.rint(_azimuth_deg(spec, row_us) * 100).astype(np.int64) % 36000
    filled["azimuth"] = np.repeat(cdeg, blocks).reshape(count, -1)
    filled["reading"]["distance"] = _in_blocks(spec, distance).reshape(*filled.shape, 32)
    filled["reading"]["level"] = _in_blocks(spec, level).reshape(*filled.shape, 32)
    first_us = row_us.reshape(count, rows_per_packet)[:, 0]
    after_us = 542.592 if spec.stamps_end else table.stamp_after_us
    stamp_us = np.rint(spec.start_us + first_us + after_us).astype(np.int64)
    packets["stamp_us"] = stamp_us % HOUR_US
    packets["factory"] = _factory(spec, count)
    payloads = packets.view(np.uint8).reshape(count, _PACKET.itemsize)
    return Sent(payloads, _receive_ns(spec, row_us.reshape(count, -1)[:, -1] + spec.row_us))


def advanced(spec: VelodyneSpec, packets: int) -> VelodyneSpec:
    """Return the sensor as it is so many packets later, without a blind sector."""
    after_us = packets * spec.rows_per_packet * spec.row_us
    azimuth_deg = float(_azimuth_deg(spec, np.array([after_us]))[0]) % 360.0
    return replace(spec, start_us=spec.start_us + after_us, start_azimuth_deg=azimuth_deg)


def firing_times_ns(spec: VelodyneSpec, columns: I64Array) -> I64Array:
    """(n, lasers) when the lasers fire, by the sensor's clock, ns since 1970."""
    return _epoch_ns(spec, spec.start_us + _firing_us(spec, columns))


def directions(spec: VelodyneSpec, columns: I64Array) -> F64Array:
    """(n, lasers, 3) unit vectors at each laser's own firing, sensor frame."""
    alpha = _alpha_rad(spec, columns)
    elevation = np.deg2rad(spec.table.elevation_deg)
    flat = np.cos(elevation)
    up = np.broadcast_to(np.sin(elevation), alpha.shape)
    return np.stack((flat * np.cos(alpha), -flat * np.sin(alpha), up), axis=-1)


def origins(spec: VelodyneSpec, columns: I64Array) -> F64Array:
    """(n, lasers, 3) where the rays begin, m, sensor frame; section 10 with cx = cy = 0."""
    alpha = _alpha_rad(spec, columns)
    aside_m = np.array(spec.table.horizontal_m)
    up = np.broadcast_to(np.array(spec.table.vertical_m), alpha.shape)
    return np.stack((aside_m * np.sin(alpha), aside_m * np.cos(alpha), up), axis=-1)


def position_packets(
    spec: VelodyneSpec, times_us: F64Array, pps: int = 2, nmea: bool = True, valid: bool = True
) -> Sent:
    """Packets of port 8308, sent so long after the sensor's start."""
    payloads = np.zeros((len(times_us), 512), np.uint8)
    for payload, time_us in zip(payloads, times_us.tolist(), strict=True):
        past_us = round(spec.start_us + time_us)
        payload[198:202] = np.frombuffer((past_us % HOUR_US).to_bytes(4, "little"), np.uint8)
        payload[202] = pps
        if nmea:
            utc = datetime(1970, 1, 1, tzinfo=timezone.utc) + timedelta(
                hours=spec.hour, seconds=past_us // 1_000_000
            )
            sentence = gprmc(utc, valid).ljust(NMEA_SIZE, b"\0")
            payload[NMEA_AT : NMEA_AT + NMEA_SIZE] = np.frombuffer(sentence, np.uint8)
    return Sent(payloads, _receive_ns(spec, np.asarray(times_us, np.float64)))


def gprmc(utc: datetime, valid: bool = True) -> bytes:
    """A GPRMC sentence of this second, with its checksum."""
    status = "A" if valid else "V"
    place = "4807.038,N,01131.000,E,022.4,084.4"
    body = f"GPRMC,{utc:%H%M%S},{status},{place},{utc:%d%m%y},003.1,W"
    checksum = functools.reduce(lambda total, byte: total ^ byte, body.encode())
    return f"${body}*{checksum:02X}\r\n".encode()


def _row_us(spec: VelodyneSpec, rows: int) -> F64Array:
    """First firing of the rows that are sent, after that of the first of all."""
    numbers: I64Array = np.arange(rows)
    while spec.blind_deg is not None:
        start, end = spec.blind_deg
        azimuth = _azimuth_deg(spec, np.multiply(numbers, spec.row_us, dtype=np.float64))
        seen = numbers[(azimuth - start) % 360 >= (end - start) % 360]
        if len(seen) >= rows:
            numbers = seen[:rows]
            break
        numbers = np.arange(2 * len(numbers))
    return np.multiply(numbers, spec.row_us, dtype=np.float64)


def _firing_us(spec: VelodyneSpec, columns: I64Array) -> F64Array:
    """(n, lasers), after the first firing of column 0."""
    in_row = spec.table.columns_per_row
    row_us = _row_us(spec, int(columns.max(initial=0)) // in_row + 1)
    column_us: F64Array = row_us[columns // in_row] + columns % in_row * (spec.row_us / in_row)
    return np.add(column_us[:, None], spec.firing_us)


def _azimuth_deg(spec: VelodyneSpec, time_us: F64Array) -> F64Array:
    return spec.start_azimuth_deg + spec.rpm * 360.0 / 60e6 * time_us


def _alpha_rad(spec: VelodyneSpec, columns: I64Array) -> F64Array:
    """(n, lasers) azimuth of the beams, clockwise."""
    rotor_deg = _azimuth_deg(spec, _firing_us(spec, columns))
    beams_deg: F64Array = np.add(rotor_deg, np.array(spec.table.azimuth_deg))
    return np.deg2rad(beams_deg)


def _epoch_ns(spec: VelodyneSpec, past_hour_us: F64Array) -> I64Array:
    return np.rint(past_hour_us * 1000).astype(np.int64) + spec.hour * HOUR_US * 1000


def _receive_ns(spec: VelodyneSpec, after_start_us: F64Array) -> I64Array:
    """Receive times of packets sent so long after the start: 0.1 ms of transport."""
    return _epoch_ns(spec, spec.start_us + after_start_us) + 100_000 + spec.host_ahead_ns


def _flags(spec: VelodyneSpec) -> list[int]:
    """Flags of the blocks of a row."""
    flags = list(spec.table.flags)
    if spec.table.returns_apart:
        return flags * spec.returns
    return [flag for flag in flags for _ in range(spec.returns)]


def _in_blocks(spec: VelodyneSpec, values: I64Array) -> I64Array:
    """(columns, lasers, returns) as (rows, blocks of a row, 32)."""
    rows: I64Array = values.reshape(-1, len(spec.table.flags), 32, spec.returns)
    order = (0, 3, 1, 2) if spec.table.returns_apart else (0, 1, 3, 2)
    return np.reshape(rows.transpose(order), (len(rows), -1, 32))


def _factory(spec: VelodyneSpec, count: int) -> U8Array:
    """Bytes 1204 and 1205."""
    product = spec.table.product if spec.product is None else spec.product
    if product is None:
        status = np.frombuffer(_STATUS, np.uint8)[np.arange(count) % len(_STATUS)]
        return np.stack((status, (np.arange(count) * 37 % 251).astype(np.uint8)), axis=1)
    return np.tile(np.array([_MODES[spec.mode], product], np.uint8), (count, 1))
