"""Encoder of Velodyne packets: what a sensor would send, from ranges or from what it would see.

Source: docs/sources/velodyne.md sections 1-3 and 5-9. A *column* is one firing sequence (all lasers
once); column n is the n-th that is sent, so a blind sector leaves no number out. Returns are in the
order of the wire: last, strongest (HDL-64E: strongest, last).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from typing import ClassVar

import numpy as np

from mlbatch.arrays import F64Array, I64Array, U8Array
from mlbatch.simulate.interface import LidarFiles, LidarModel, LidarSettings, PacketTopic, Sent
from mlbatch.simulate.spinning import SpinningSpec, simulator
from mlbatch.simulate.velodyne.models import MODELS, Table, calibration_yaml
from mlbatch.units import NS_PER_US

DATA_PORT = 2368
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
class VelodyneSpec(SpinningSpec):
    """A sensor to imitate.

    start_us: first firing of column 0, us past the hour number `hour` (since 1970); blind_deg:
    azimuths [from, to) in which it does not measure (from > to: through zero); product: byte 1205,
    if not the model's; sequence_us: time of a sequence, if not the model's; stamps_end: the packet
    is stamped at its end (HDL-32E, section 2).
    """

    topics: ClassVar = {DATA_PORT: PacketTopic("velodyne_packets", "velodyne_msgs/VelodyneScan")}
    device_port = 8308
    # The status bytes of an HDL-64E repeat after 16 packets.
    chunk_packets = 48

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

    @property
    def table(self) -> Table:
        """The unit's beams and packets."""
        return MODELS[self.model]

    def __post_init__(self) -> None:
        table, row = self.table, self.table.row
        # Nothing in packets distinguishes the series of an HDL-64E, or a Puck LITE.
        is_unnamed = row.needs_file or row.reported_as != row.name
        vars(self).update(
            reported_model=row.name,
            rig_model=row.name if is_unnamed else "",
            channels=row.lasers,
            returns=2 if self.mode == "dual" else 1,
            column_ns=(self.sequence_us or table.sequence_us) * NS_PER_US,
            range_unit_m=table.unit_m,
            # Corrections of distances.
            range_offset_m=np.array(table.dist_m),
            # The HDL-64E has no position packets (section 8).
            device_period_ns=0 if row.needs_file else 500_000_000,
            begin_ns=round(self.start_us * NS_PER_US) + self.hour * HOUR_US * NS_PER_US,
        )
        vars(self).update(columns_per_packet=self.rows_per_packet * table.form.columns_per_row)

    @property
    def row_us(self) -> float:
        """From one azimuth to the next, without a blind sector between them."""
        return (self.sequence_us or self.table.sequence_us) * self.table.form.columns_per_row

    @property
    def rows_per_packet(self) -> int:
        """Azimuths of a packet."""
        return 12 // (len(self.table.form.flags) * self.returns)

    @property
    def files(self) -> LidarFiles:
        """The HDL-64E has a calibration of each unit."""
        if not self.table.row.needs_file:
            return LidarFiles()
        return LidarFiles("yaml", calibration_yaml(self.model).encode())

    def encode(self, counts: I64Array, levels: I64Array) -> list[Sent]:
        """Packets of these columns."""
        table, form = self.table, self.table.form
        rows_per_packet = self.rows_per_packet
        rows = len(counts) // form.columns_per_row
        count = rows // rows_per_packet
        if len(counts) != count * self.columns_per_packet:
            raise ValueError(f"expected whole packets of {self.columns_per_packet} columns")
        blocks = len(form.flags) * self.returns
        packets = np.zeros(count, _PACKET)
        row_us = _row_us(self, rows)
        filled = packets["block"][:, : rows_per_packet * blocks]
        filled["flag"] = np.tile(_flags(self), rows_per_packet)
        cdeg = np.rint(_azimuth_deg(self, row_us) * 100).astype(np.int64) % 36000
        filled["azimuth"] = np.repeat(cdeg, blocks).reshape(count, -1)
        filled["reading"]["distance"] = _in_blocks(self, counts).reshape(*filled.shape, 32)
        filled["reading"]["level"] = _in_blocks(self, levels).reshape(*filled.shape, 32)
        packets["stamp_us"] = _stamps_us(self, row_us) % HOUR_US
        packets["factory"] = _factory(self, table.row.product or form.product, count)
        end_ns = _epoch_ns(self, self.start_us + row_us.reshape(count, -1)[:, -1] + self.row_us)
        return [
            Sent(at, DATA_PORT, packet.tobytes())
            for at, packet in zip(end_ns.tolist(), packets, strict=True)
        ]

    def advanced(self, packets: int) -> VelodyneSpec:
        """The sensor as it is so many packets later, without a blind sector."""
        after_us = packets * self.rows_per_packet * self.row_us
        azimuth_deg = float(_azimuth_deg(self, np.array([after_us]))[0]) % 360.0
        return replace(self, start_us=self.start_us + after_us, start_azimuth_deg=azimuth_deg)

    def firing_times_ns(self, columns: int) -> I64Array:
        """(n, lasers) when the lasers fire."""
        return _epoch_ns(self, self.start_us + _firing_us(self, columns))

    def said_times_ns(self, columns: int) -> I64Array:
        """(n, lasers) the same by the stamps of the packets, which are whole us."""
        fires_ns = self.firing_times_ns(columns)
        first_ns = fires_ns[:: self.columns_per_packet].min(axis=1)
        row_us = _row_us(self, columns // self.table.form.columns_per_row)
        stamp_us = self.table.form.stamp_after_us
        said_us = _stamps_us(self, row_us) + self.hour * HOUR_US
        off_ns = said_us * NS_PER_US - round(stamp_us * NS_PER_US) - first_ns
        said_ns: I64Array = fires_ns + np.repeat(off_ns, int(self.columns_per_packet))[:, None]
        return said_ns

    def directions(self, columns: int) -> F64Array:
        """(n, lasers, 3) unit vectors at each laser's own firing."""
        alpha = _alpha_rad(self, columns)
        elevation = np.deg2rad(self.table.elevation_deg)
        flat = np.cos(elevation)
        up = np.broadcast_to(np.sin(elevation), alpha.shape)
        return np.stack((flat * np.cos(alpha), -flat * np.sin(alpha), up), axis=-1)

    def origins(self, columns: int) -> F64Array:
        """(n, lasers, 3) where the rays begin; section 10 with cx = cy = 0."""
        alpha = _alpha_rad(self, columns)
        aside_m = np.array(self.table.horizontal_m)
        up = np.broadcast_to(np.array(self.table.vertical_m), alpha.shape)
        return np.stack((aside_m * np.sin(alpha), aside_m * np.cos(alpha), up), axis=-1)

    def device_packet(
        self, after_ns: int, pps: int = 2, nmea: bool = True, valid: bool = True
    ) -> bytes:
        """A packet of port 8308."""
        payload = bytearray(512)
        past_us = round(self.start_us + after_ns / NS_PER_US)
        payload[198:202] = (past_us % HOUR_US).to_bytes(4, "little")
        payload[202] = pps
        if nmea:
            utc = datetime(1970, 1, 1, tzinfo=timezone.utc) + timedelta(
                hours=self.hour, seconds=past_us // 1_000_000
            )
            payload[NMEA_AT : NMEA_AT + NMEA_SIZE] = gprmc(utc, valid).ljust(NMEA_SIZE, b"\0")
        return bytes(payload)


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


def _stamps_us(spec: VelodyneSpec, row_us: F64Array) -> I64Array:
    """(P,) stamps of packets past the hour of the start."""
    after_us = 542.592 if spec.stamps_end else spec.table.form.stamp_after_us
    stamps: I64Array = np.rint(spec.start_us + row_us[:: spec.rows_per_packet] + after_us).astype(
        np.int64
    )
    return stamps


def _firing_us(spec: VelodyneSpec, columns: int) -> F64Array:
    """(n, lasers), after the first firing of column 0."""
    in_row = spec.table.form.columns_per_row
    row, which = np.divmod(np.arange(columns), in_row)
    column_us: F64Array = _row_us(spec, -(-columns // in_row))[row] + which * (spec.row_us / in_row)
    table = spec.table
    stretch = (spec.sequence_us or table.sequence_us) / table.sequence_us
    firing_us = np.array(table.firing_us) * (stretch if table.form.time_scales else 1.0)
    return np.add(column_us[:, None], firing_us)


def _azimuth_deg(spec: VelodyneSpec, time_us: F64Array) -> F64Array:
    return spec.start_azimuth_deg + spec.rpm * 360.0 / 60e6 * time_us


def _alpha_rad(spec: VelodyneSpec, columns: int) -> F64Array:
    """(n, lasers) azimuth of the beams, clockwise."""
    rotor_deg = _azimuth_deg(spec, _firing_us(spec, columns))
    beams_deg: F64Array = np.add(rotor_deg, np.array(spec.table.azimuth_deg))
    return np.deg2rad(beams_deg)


def _epoch_ns(spec: VelodyneSpec, past_hour_us: F64Array) -> I64Array:
    return np.rint(past_hour_us * 1000).astype(np.int64) + spec.hour * HOUR_US * 1000


def _flags(spec: VelodyneSpec) -> list[int]:
    """Flags of the blocks of a row."""
    flags = list(spec.table.form.flags)
    if spec.table.form.returns_apart:
        return flags * spec.returns
    return [flag for flag in flags for _ in range(spec.returns)]


def _in_blocks(spec: VelodyneSpec, values: I64Array) -> I64Array:
    """(columns, lasers, returns) as (rows, blocks of a row, 32)."""
    rows: I64Array = values.reshape(-1, len(spec.table.form.flags), 32, spec.returns)
    order = (0, 3, 1, 2) if spec.table.form.returns_apart else (0, 1, 3, 2)
    return np.reshape(rows.transpose(order), (len(rows), -1, 32))


def _factory(spec: VelodyneSpec, product: int | None, count: int) -> U8Array:
    """Bytes 1204 and 1205."""
    product = product if spec.product is None else spec.product
    if product is None:
        status = np.frombuffer(_STATUS, np.uint8)[np.arange(count) % len(_STATUS)]
        return np.stack((status, (np.arange(count) * 37 % 251).astype(np.uint8)), axis=1)
    return np.tile(np.array([_MODES[spec.mode], product], np.uint8), (count, 1))


LIDARS = tuple(LidarModel(name, ("strongest", "last", "dual")) for name in MODELS)


def _unit(settings: LidarSettings) -> VelodyneSpec:
    hour, past_ns = divmod(settings.start_ns, HOUR_US * NS_PER_US)
    return VelodyneSpec(
        settings.model,
        settings.mode,
        rpm=settings.rate_hz * 60.0,
        start_azimuth_deg=settings.phase_deg,
        start_us=past_ns / NS_PER_US,
        hour=hour,
    )


simulated = simulator(_unit)
