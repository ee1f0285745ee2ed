"""Encoder of ROBOSENSE packets: packets of a spinning lidar from plain raw values.

Source: docs/sources/robosense.md sections 1 to 7. A rotor of constant speed fires a round of all
channels again and again: round n begins at `start_ns` + n rounds, at azimuth `start_deg` + the
rotation of the rotor meanwhile. Rounds inside the field of view are columns.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from typing import ClassVar

import numpy as np

from mlbatch.arrays import F64Array, I64Array, U8Array
from mlbatch.simulate.interface import LidarModel, LidarSettings, PacketTopic, Sent
from mlbatch.simulate.robosense.models import (
    AIRY_MOUNTS,
    DUAL,
    EARLY,
    MODELS,
    STRONGEST,
    RobosenseModel,
)
from mlbatch.simulate.spinning import SpinningSpec, simulator
from mlbatch.units import NS_PER_S

MSOP_PORT = 6699
DIFOP_PORT = 7788
DIFOP_SIZE = 1248
DIFOP_MAGIC = bytes.fromhex("a5ff005a11115555")
START_NS = 1_700_000_000_000_000_000
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_UNWRITTEN = b"\xff\xff\xff"
_TYPE = "rslidar_msg/RslidarPacket"
# Airy: two bits of a range are flags (section 4), one of which is set.
_AIRY_FLAG = 0x4000


@dataclass(frozen=True, slots=True)
class Angles:
    """Of each channel, degrees; azimuth_deg is added to the rotor's, clockwise."""

    elevation_deg: F64Array
    azimuth_deg: F64Array


@dataclass(frozen=True)
class RobosenseSpec(SpinningSpec):
    """A unit to imitate.

    model: a name of MODELS; mode: strongest, last, nearest or dual; start_deg: azimuth of round 0;
    view_deg: where it measures, clockwise from the first to the second; is_reversed: the rotor
    rotates the other way (Bpearl: its packets then count 360 - azimuth); mount: of an Airy.
    """

    topics: ClassVar = {
        MSOP_PORT: PacketTopic("rslidar_packets", _TYPE),
        DIFOP_PORT: PacketTopic("rslidar_packets", _TYPE, of_device=True),
    }
    device_port = DIFOP_PORT

    model: str
    mode: str = STRONGEST
    rpm: int = 600
    start_deg: float = 0.0
    start_ns: int = START_NS
    view_deg: tuple[float, float] = (0.0, 360.0)
    is_reversed: bool = False
    mount: str = "normal"
    serial: str = "0a1b2c3d4e5f"
    first_counter: int = 0

    @property
    def row(self) -> RobosenseModel:
        """The layout of its packets."""
        return MODELS[self.model]

    @property
    def is_airy(self) -> bool:
        """Whether ranges have flags, and firing times depend on the mount."""
        return self.model.startswith("Airy")

    def __post_init__(self) -> None:
        row, layout = self.row.row, self.row.layout
        returns = 2 if self.mode == DUAL else 1
        vars(self).update(
            reported_model=row.name,
            channels=row.channels,
            returns=returns,
            # Half of a packet's columns may be the rest of a dual one of 128 lines.
            columns_per_packet=layout.blocks * layout.per_block / (row.channels * returns),
            column_ns=row.round_ns,
            range_unit_m=1 / row.units_per_m,
            # 14 bits of an Airy.
            largest=row.range_mask,
            device_period_ns=NS_PER_S // 10,
            begin_ns=self.start_ns,
        )

    @property
    def firing_ns(self) -> I64Array:
        """(channels,) after the begin of the round."""
        tables = self.row.row.firing_ns
        mount = AIRY_MOUNTS.index(self.mount)
        return np.array(tables[mount if self.is_airy and len(tables) > 1 else self.row.firing])

    @property
    def round_ns(self) -> int:
        """From round to round."""
        return self.row.row.round_ns

    @property
    def angles(self) -> Angles:
        """Of a made-up unit: an uneven fan of whole counts of the DIFOP.

        RS-16 has no azimuths of its own.
        """
        offsets = self.row.row.angles
        unit = offsets.unit_deg
        number = np.arange(self.channels)
        even = np.linspace(*self.row.span_deg, self.channels)
        counts = np.rint(even / unit) + number * 5 % 7
        pattern = (number * 3 % 8 - 3.5) * 1.04 if offsets.azimuth_at else 0.0
        azimuth = np.rint(pattern / unit) * unit * np.ones(self.channels)
        return Angles(np.asarray(counts * unit, np.float64), azimuth)

    def advanced(self, packets: int) -> RobosenseSpec:
        """The unit as it is so many packets later, measuring all around."""
        columns = round(packets * self.columns_per_packet)
        return replace(
            self,
            start_deg=(self.start_deg + columns * _step_deg(self)) % 360.0,
            start_ns=self.start_ns + columns * self.round_ns,
            first_counter=(self.first_counter + packets) % 2**32,
        )

    def firing_times_ns(self, columns: int) -> I64Array:
        """(n, channels) of all firings, as in the packets: their time is cut to whole us.

        The second return of a column that two packets share may differ by 1 us.
        """
        own = _rounds(self, np.arange(columns))
        first = _rounds(self, _first_columns(self, columns))
        said_ns = (self.start_ns + first * self.round_ns) // 1000 * 1000
        begin_ns = said_ns + (own - first) * self.round_ns
        return begin_ns[:, None] + self.firing_ns

    def directions(self, columns: int) -> F64Array:
        """(n, channels, 3) unit vectors, x forward, y left, z up."""
        angles = self.angles
        # A unit that turns the other way takes its corrections backwards, too.
        sense = -1 if self.is_reversed else 1
        azimuth = np.radians(_azimuths_deg(self, columns) + sense * angles.azimuth_deg)
        elevation = np.radians(angles.elevation_deg) + np.zeros_like(azimuth)
        flat = np.cos(elevation)
        return np.stack(
            [flat * np.cos(azimuth), -flat * np.sin(azimuth), np.sin(elevation)], axis=-1
        )

    def origins(self, columns: int) -> F64Array:
        """(n, channels, 3) places of the lens at each firing."""
        azimuth = np.radians(_azimuths_deg(self, columns))
        radius, height = self.row.row.lens_m
        parts = (radius * np.cos(azimuth), -radius * np.sin(azimuth), np.full_like(azimuth, height))
        return np.stack(parts, axis=-1)

    def encode(self, counts: I64Array, levels: I64Array) -> list[Sent]:
        """Packets of these columns, in their order."""
        layout = self.row.layout
        blocks, rest = divmod(counts.size, layout.per_block)
        packets = blocks // layout.blocks
        if rest or packets * layout.blocks != blocks or counts.shape[2] != self.returns:
            raise ValueError(f"{counts.shape} readings are no whole packets of {self}")
        block = np.zeros((packets, layout.blocks), _block(layout.per_block))
        block["id"] = np.frombuffer(layout.block_id.ljust(2, b"\0"), np.uint8)
        if len(layout.block_id) == 1:
            block["id"][..., 1] = (np.arange(blocks) % self.returns + 1).reshape(block.shape)
        block["azimuth"] = _block_azimuths(self, blocks).reshape(block.shape)
        reading = block["reading"]
        flag = _AIRY_FLAG if self.is_airy else 0
        reading["range"] = _as_blocks(counts + flag).reshape(reading.shape)
        reading["level"] = _as_blocks(levels).reshape(reading.shape)
        payloads = np.zeros((packets, self.row.size), np.uint8)
        payloads[:, layout.header : layout.end] = block.view(np.uint8).reshape(packets, -1)
        if len(layout.block_id) == 2 and layout.blocks == 12:
            payloads[:, -2:] = 0, 0xFF
        return _sent(self, payloads)

    def device_packet(
        self,
        after_ns: int = 0,
        angles: Angles | None = None,
        parts: Mapping[int, bytes] | None = None,
    ) -> bytes:
        """A DIFOP packet; angles: of another unit; parts: bytes to put in last."""
        row = self.row
        offsets = row.row.angles
        own = angles or self.angles
        view = (round(degrees * 100) % 36001 for degrees in self.view_deg)
        fields = {
            0: DIFOP_MAGIC,
            8: struct.pack(">H", self.rpm),
            10: bytes((192, 168, 1, 200, 192, 168, 1, 102)),
            24: struct.pack(">4H", 6699, 6699, 7788, 7788),
            32: struct.pack(">2H", *view),
            40: bytes((0, 6, 23, 1, 8)),
            292: bytes.fromhex(self.serial),
            # gPTP, locked by PTP.
            300: bytes((row.modes[self.mode], 3, 2)),
            303: _time(self, self.start_ns + after_ns),
            offsets.elevation_at: _angles(row, own.elevation_deg, signed=offsets.signed),
            1246: b"\x0f\xf0",
        }
        if offsets.azimuth_at:
            fields[offsets.azimuth_at] = _angles(row, own.azimuth_deg, signed=True)
        if self.is_reversed:
            fields[337] = b"\x01"
        if self.is_airy:
            fields[289] = bytes((AIRY_MOUNTS.index(self.mount),))
        payload = bytearray(DIFOP_SIZE)
        for at, part in {**fields, **(parts or {})}.items():
            payload[at : at + len(part)] = part
        return bytes(payload)


def _rounds(spec: RobosenseSpec, columns: I64Array) -> I64Array:
    """(n,) number of the round that each column is; outside the view nothing is sent."""
    begin, end = spec.view_deg
    width = (end - begin) % 360.0 or 360.0
    if width == 360.0 or not len(columns):
        return columns
    needed = int((columns.max() + 1) * 360.0 / width) + round(2 * 360 / _step_deg(spec))
    number = np.arange(needed)
    azimuth = spec.start_deg + number * _step_deg(spec)
    return number[(azimuth - begin) % 360.0 < width][columns]


def _azimuths_deg(spec: RobosenseSpec, columns: int) -> F64Array:
    """(n, channels) of the rotor at each firing, clockwise from the x axis, before corrections."""
    turned = _rounds(spec, np.arange(columns))[:, None] + spec.firing_ns / spec.round_ns
    azimuth = spec.start_deg + turned * _step_deg(spec)
    return -azimuth if spec.is_reversed else azimuth


def angles_csv(angles: Angles) -> str:
    """The vendor's file of angles: one line per channel, elevation and azimuth in degrees."""
    pairs = np.stack([angles.elevation_deg, angles.azimuth_deg], axis=1).tolist()
    return "".join(f"{up:.4f},{aside:.4f}\n" for up, aside in pairs)


def _step_deg(spec: RobosenseSpec) -> float:
    """Rotation in a round; a minute has 6e10 ns."""
    return spec.rpm * 360.0 * spec.round_ns / 6e10


def _block(slots: int) -> np.dtype[np.void]:
    reading = np.dtype([("range", ">u2"), ("level", "u1")])
    return np.dtype([("id", "u1", 2), ("azimuth", ">u2"), ("reading", reading, slots)])


def _as_blocks(values: I64Array) -> I64Array:
    """Readings in the order of the wire.

    All channels of the first return, then of the second, column by column: cut every `slots`
    readings, that is right for whole, half and double columns in a block.
    """
    return np.ascontiguousarray(values.transpose(0, 2, 1))


def _first_columns(spec: RobosenseSpec, columns: int) -> I64Array:
    """First column of the packet in which each column begins."""
    readings = spec.channels * spec.returns
    per_packet = spec.row.layout.per_block * spec.row.layout.blocks
    return np.arange(columns) * readings // per_packet * per_packet // readings


def _block_azimuths(spec: RobosenseSpec, blocks: int) -> I64Array:
    """0.01 degrees, where the rotor is when a block's first column begins."""
    column = np.arange(blocks) * spec.row.layout.per_block // (spec.channels * spec.returns)
    azimuth = spec.start_deg + _rounds(spec, column) * _step_deg(spec)
    counts: I64Array = np.rint(azimuth * 100).astype(np.int64)
    return counts % 36000


def _sent(spec: RobosenseSpec, payloads: U8Array) -> list[Sent]:
    """Add the headers; a packet is complete after the round of its last block."""
    row = spec.row
    sent = []
    numbers = np.arange(len(payloads))
    first_columns = np.floor(numbers * spec.columns_per_packet).astype(np.int64)
    last_columns = np.ceil((numbers + 1) * spec.columns_per_packet).astype(np.int64) - 1
    first_rounds = _rounds(spec, first_columns).tolist()
    last_rounds = _rounds(spec, last_columns).tolist()
    spans = zip(first_rounds, last_rounds, strict=True)
    for number, (payload, (first_round, last_round)) in enumerate(
        zip(payloads, spans, strict=True)
    ):
        fields = {
            **row.marks,
            row.layout.time_at: _time(spec, spec.start_ns + first_round * spec.round_ns),
        }
        if row.counter_at:
            fields[row.counter_at] = struct.pack(">I", (spec.first_counter + number) % 2**32)
        if row.range_step_at:
            fields[row.range_step_at] = b"\x01" if spec.range_unit_m == 0.0025 else b"\x00"
        if row.layout.modes is not None:
            codes = {returns: code for code, returns in row.layout.modes.items()}
            fields[row.layout.mode_at] = bytes((codes.get(spec.returns, 0),))
        for at, part in fields.items():
            payload[at : at + len(part)] = np.frombuffer(part, np.uint8)
        end_ns = spec.start_ns + (last_round + 1) * spec.round_ns
        sent.append(Sent(end_ns, MSOP_PORT, payload.tobytes()))
    return sent


def _time(spec: RobosenseSpec, time_ns: int) -> bytes:
    """Ten bytes, cut to whole us."""
    second, micro = divmod(time_ns // 1000, 1_000_000)
    if not spec.row.row.is_calendar:
        return second.to_bytes(6, "big") + struct.pack(">I", micro)
    moment = _EPOCH + timedelta(seconds=second)
    date = (moment.year - 2000, moment.month, moment.day, moment.hour, moment.minute, moment.second)
    return bytes(date) + struct.pack(">2H", *divmod(micro, 1000))


def _angles(row: RobosenseModel, angles_deg: F64Array, *, signed: bool) -> bytes:
    """Three bytes per channel: sign and size, or size alone; FF where a slot has no channel."""
    counts = np.rint(angles_deg / row.row.angles.unit_deg).astype(np.int64).tolist()
    if signed:
        written = [bytes((count < 0,)) + struct.pack(">H", abs(count)) for count in counts]
    else:
        written = [abs(count).to_bytes(3, "big") for count in counts]
    return b"".join(written + [_UNWRITTEN] * (row.angle_slots - len(written)))


LIDARS = tuple(
    LidarModel(name, tuple(row.modes), (10, 5, 20))
    for name, row in MODELS.items()
    if not name.endswith(EARLY)
)


def _unit(settings: LidarSettings) -> RobosenseSpec:
    return RobosenseSpec(
        settings.model,
        settings.mode,
        rpm=settings.rate_hz * 60,
        start_deg=settings.phase_deg,
        start_ns=settings.start_ns,
        serial=f"{settings.serial:012d}"[-12:],
    )


simulated = simulator(_unit)
