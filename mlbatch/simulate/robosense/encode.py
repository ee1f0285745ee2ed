"""Encoder of ROBOSENSE packets: packets of a spinning lidar from plain raw values.

Source: docs/sources/robosense.md sections 1 to 7. A rotor of constant speed fires a round of all
channels again and again: round n begins at `start_ns` + n rounds, at azimuth `start_deg` + the
rotation of the rotor meanwhile. Rounds inside the field of view are columns. Nothing here is shared
with a decoder.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone

import numpy as np

from mlbatch.arrays import F64Array, I64Array, U8Array
from mlbatch.simulate.robosense.models import (
    AIRY_MOUNTS,
    DUAL,
    MODELS,
    STRONGEST,
    AngleLayout,
    RobosenseModel,
)

DIFOP_SIZE = 1248
DIFOP_MAGIC = bytes.fromhex("a5ff005a11115555")
START_NS = 1_700_000_000_000_000_000
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_UNWRITTEN = b"\xff\xff\xff"


@dataclass(frozen=True, slots=True)
class RobosenseSpec:
    """A unit to imitate; what is left empty is the model's own.

    model: a name of MODELS; mode: strongest, last, nearest or dual; start_deg: azimuth of round 0;
    view_deg: where it measures, clockwise from the first to the second; is_reversed: the rotor
    rotates the other way (Bpearl: its packets then count 360 - azimuth); mount: of an Airy.
    """

    model: str
    mode: str = STRONGEST
    rpm: int = 600
    start_deg: float = 0.0
    start_ns: int = START_NS
    view_deg: tuple[float, float] = (0.0, 360.0)
    is_calendar: bool | None = None
    unit_m: float = 0.0
    firing_us: tuple[float, ...] = ()
    is_reversed: bool = False
    mount: str = "normal"
    serial: str = "0a1b2c3d4e5f"
    first_counter: int = 0
    latency_ns: int = 200_000

    @property
    def row(self) -> RobosenseModel:
        """The model."""
        return MODELS[self.model]

    @property
    def returns(self) -> int:
        """Of a shot."""
        return 2 if self.mode == DUAL else 1

    @property
    def range_unit_m(self) -> float:
        """Metres of a count of range."""
        return self.unit_m or self.row.unit_m

    @property
    def firing_ns(self) -> I64Array:
        """(channels,) after the begin of the round."""
        own = AIRY_MOUNTS[self.mount][1] if self.model == "Airy 96" else self.row.firing_us
        return np.array([round(time_us * 1000) for time_us in self.firing_us or own])

    @property
    def round_ns(self) -> int:
        """From round to round."""
        return round(self.row.round_us * 1000)

    @property
    def columns_per_packet(self) -> float:
        """Half of a packet's columns may be the rest of a dual one of 128 lines."""
        return self.row.blocks * self.row.slots / (self.row.channels * self.returns)


@dataclass(frozen=True, slots=True)
class Angles:
    """Of each channel, degrees; azimuth_deg is added to the rotor's, clockwise."""

    elevation_deg: F64Array
    azimuth_deg: F64Array


def fan(spec: RobosenseSpec) -> Angles:
    """An uneven fan of whole counts of the DIFOP; RS-16 has no azimuths of its own."""
    row = spec.row
    unit = spec.row.angles.unit_deg
    even = np.linspace(*row.span_deg, row.channels)
    counts = np.rint(even / unit) + np.arange(row.channels) * 5 % 7
    pattern = (np.arange(row.channels) * 3 % 8 - 3.5) * 1.04 if row.angles.azimuth_at else 0.0
    azimuth = np.rint(pattern / unit) * unit * np.ones(row.channels)
    return Angles(np.asarray(counts * unit, np.float64), azimuth)


def rounds(spec: RobosenseSpec, columns: I64Array) -> I64Array:
    """(n,) number of the round that each column is; outside the view nothing is sent."""
    begin, end = spec.view_deg
    width = (end - begin) % 360.0 or 360.0
    if width == 360.0 or not len(columns):
        return columns
    needed = int((columns.max() + 1) * 360.0 / width) + round(2 * 360 / _step_deg(spec))
    number = np.arange(needed)
    azimuth = spec.start_deg + number * _step_deg(spec)
    return number[(azimuth - begin) % 360.0 < width][columns]


def firing_times_ns(spec: RobosenseSpec, columns: I64Array) -> I64Array:
    """(n, channels) of all firings, as in the packets: their time is cut to whole us.

    The second return of a column that two packets share may differ by 1 us.
    """
    own = rounds(spec, columns)
    first = rounds(spec, _first_columns(spec, columns))
    said_ns = (spec.start_ns + first * spec.round_ns) // 1000 * 1000
    begin_ns = said_ns + (own - first) * spec.round_ns
    return begin_ns[:, None] + spec.firing_ns


def azimuths_deg(spec: RobosenseSpec, columns: I64Array) -> F64Array:
    """(n, channels) of the rotor at each firing, clockwise from the x axis, before corrections."""
    turned = rounds(spec, columns)[:, None] + spec.firing_ns / spec.round_ns
    azimuth = spec.start_deg + turned * _step_deg(spec)
    return -azimuth if spec.is_reversed else azimuth


def directions(spec: RobosenseSpec, angles: Angles, columns: I64Array) -> F64Array:
    """(n, channels, 3) unit vectors in the sensor frame, x forward, y left, z up."""
    azimuth = np.radians(azimuths_deg(spec, columns) + angles.azimuth_deg)
    elevation = np.radians(angles.elevation_deg) + np.zeros_like(azimuth)
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), -flat * np.sin(azimuth), np.sin(elevation)], axis=-1)


def origins(spec: RobosenseSpec, columns: I64Array) -> F64Array:
    """(n, channels, 3) places of the lens at each firing, metres, sensor frame."""
    azimuth = np.radians(azimuths_deg(spec, columns))
    radius, height = spec.row.lens_m
    parts = (radius * np.cos(azimuth), -radius * np.sin(azimuth), np.full_like(azimuth, height))
    return np.stack(parts, axis=-1)


def advanced(spec: RobosenseSpec, packets: int) -> RobosenseSpec:
    """Return the unit as it is so many packets later, measuring all around.

    packets: a number that whole columns fill.
    """
    columns = round(packets * spec.columns_per_packet)
    return replace(
        spec,
        start_deg=(spec.start_deg + columns * _step_deg(spec)) % 360.0,
        start_ns=spec.start_ns + columns * spec.round_ns,
        first_counter=(spec.first_counter + packets) % 2**32,
    )


def msop(spec: RobosenseSpec, ranges: I64Array, levels: I64Array) -> list[tuple[int, bytes]]:
    """(receive time in ns, payload) of the packets of these columns, in their order.

    ranges, levels: (columns, channels, returns) raw, as on the wire (Airy: with the flag bits);
    columns have to fill whole packets.
    """
    row = spec.row
    blocks, rest = divmod(ranges.size, row.slots)
    packets = blocks // row.blocks
    if rest or packets * row.blocks != blocks or ranges.shape[2] != spec.returns:
        raise ValueError(f"{ranges.shape} readings are no whole packets of {spec}")
    block = np.zeros((packets, row.blocks), _block(row.slots))
    block["id"] = np.frombuffer(row.block_id.ljust(2, b"\0"), np.uint8)
    if len(row.block_id) == 1:
        block["id"][..., 1] = (np.arange(blocks) % spec.returns + 1).reshape(block.shape)
    block["azimuth"] = _block_azimuths(spec, blocks).reshape(block.shape)
    reading = block["reading"]
    reading["range"] = _as_blocks(ranges).reshape(reading.shape)
    reading["level"] = _as_blocks(levels).reshape(reading.shape)
    payloads = np.zeros((packets, row.size), np.uint8)
    end = row.header + row.blocks * block.itemsize
    payloads[:, row.header : end] = block.view(np.uint8).reshape(packets, -1)
    if len(row.block_id) == 2 and row.blocks == 12:
        payloads[:, -2:] = 0, 0xFF
    return _sent(spec, payloads)


def difop(
    spec: RobosenseSpec,
    angles: Angles,
    *,
    sync: tuple[int, int] = (3, 2),
    time_ns: int | None = None,
    parts: Mapping[int, bytes] | None = None,
) -> bytes:
    """A device packet; sync: mode and state (gPTP, locked by PTP); parts: bytes to put in last."""
    row = spec.row
    layout = spec.row.angles
    view = (round(degrees * 100) % 36001 for degrees in spec.view_deg)
    fields = {
        0: DIFOP_MAGIC,
        8: struct.pack(">H", spec.rpm),
        10: bytes((192, 168, 1, 200, 192, 168, 1, 102)),
        24: struct.pack(">4H", 6699, 6699, 7788, 7788),
        32: struct.pack(">2H", *view),
        40: bytes((0, 6, 23, 1, 8)),
        292: bytes.fromhex(spec.serial),
        300: bytes((row.modes[spec.mode], *sync)),
        303: _time(spec, spec.start_ns if time_ns is None else time_ns),
        layout.elevation_at: _angles(angles.elevation_deg, layout, signed=layout.sign_bytes),
        1246: b"\x0f\xf0",
    }
    if layout.azimuth_at:
        fields[layout.azimuth_at] = _angles(angles.azimuth_deg, layout, signed=True)
    if spec.is_reversed:
        fields[337] = b"\x01"
    if spec.model.startswith("Airy"):
        fields[289] = bytes((AIRY_MOUNTS[spec.mount][0],))
    payload = bytearray(DIFOP_SIZE)
    for at, part in {**fields, **(parts or {})}.items():
        payload[at : at + len(part)] = part
    return bytes(payload)


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


def _first_columns(spec: RobosenseSpec, columns: I64Array) -> I64Array:
    """First column of the packet in which each column begins."""
    row = spec.row
    readings = row.channels * spec.returns
    per_packet = row.slots * row.blocks
    return columns * readings // per_packet * per_packet // readings


def _block_azimuths(spec: RobosenseSpec, blocks: int) -> I64Array:
    """0.01 degrees, where the rotor is when a block's first column begins."""
    column = np.arange(blocks) * spec.row.slots // (spec.row.channels * spec.returns)
    azimuth = spec.start_deg + rounds(spec, column) * _step_deg(spec)
    counts: I64Array = np.rint(azimuth * 100).astype(np.int64)
    return counts % 36000


def _sent(spec: RobosenseSpec, payloads: U8Array) -> list[tuple[int, bytes]]:
    """Add the headers; a packet arrives after the round of its last block."""
    row = spec.row
    sent = []
    numbers = np.arange(len(payloads))
    first_columns = np.floor(numbers * spec.columns_per_packet).astype(np.int64)
    last_columns = np.ceil((numbers + 1) * spec.columns_per_packet).astype(np.int64) - 1
    first_rounds = rounds(spec, first_columns).tolist()
    last_rounds = rounds(spec, last_columns).tolist()
    spans = zip(first_rounds, last_rounds, strict=True)
    for number, (payload, (first_round, last_round)) in enumerate(
        zip(payloads, spans, strict=True)
    ):
        fields = {
            **row.marks,
            row.time_at: _time(spec, spec.start_ns + first_round * spec.round_ns),
        }
        if row.counter_at:
            fields[row.counter_at] = struct.pack(">I", (spec.first_counter + number) % 2**32)
        if row.range_step_at:
            fields[row.range_step_at] = b"\x01" if spec.range_unit_m == 0.0025 else b"\x00"
        if row.wave_modes is not None:
            fields[row.wave_modes[0]] = bytes((row.wave_modes[spec.returns],))
        for at, part in fields.items():
            payload[at : at + len(part)] = np.frombuffer(part, np.uint8)
        end_ns = spec.start_ns + (last_round + 1) * spec.round_ns
        sent.append((end_ns + spec.latency_ns, payload.tobytes()))
    return sent


def _time(spec: RobosenseSpec, time_ns: int) -> bytes:
    """Ten bytes, cut to whole us."""
    second, micro = divmod(time_ns // 1000, 1_000_000)
    if not (spec.row.is_calendar if spec.is_calendar is None else spec.is_calendar):
        return second.to_bytes(6, "big") + struct.pack(">I", micro)
    moment = _EPOCH + timedelta(seconds=second)
    date = (moment.year - 2000, moment.month, moment.day, moment.hour, moment.minute, moment.second)
    return bytes(date) + struct.pack(">2H", *divmod(micro, 1000))


def _angles(angles_deg: F64Array, layout: AngleLayout, *, signed: bool) -> bytes:
    """Three bytes per channel: sign and size, or size alone; FF where a slot has no channel."""
    counts = np.rint(angles_deg / layout.unit_deg).astype(np.int64).tolist()
    if signed:
        written = [bytes((count < 0,)) + struct.pack(">H", abs(count)) for count in counts]
    else:
        written = [abs(count).to_bytes(3, "big") for count in counts]
    return b"".join(written + [_UNWRITTEN] * (layout.slots - len(written)))
