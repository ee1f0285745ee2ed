"""Encoder of HESAI packets and angle files: what a lidar would send, from plain values.

Source: docs/sources/hesai.md sections 2 (layout), 3 (tails), 4 (dates), 5 (times), 6 (angles and
the files with them), 7 (checksums), 8 (JT16); rows of the models: `models.py`. Column k is the k-th
group of blocks that share an azimuth; the rotor has constant speed.
"""

from __future__ import annotations

import functools
import hashlib
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import ClassVar

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.sensors.hesai.firing import NEVER
from mlbatch.simulate.hesai.models import (
    EPOCH,
    HIGH,
    IMU,
    MODELS,
    OPERATIONS,
    SAFETY,
    SEQUENCE,
    SIGNATURE,
    SINCE_1900,
    HesaiModel,
)
from mlbatch.simulate.interface import LidarFiles, LidarModel, LidarSettings, PacketTopic, Sent
from mlbatch.simulate.spinning import SpinningSpec, simulator
from mlbatch.units import RAD_PER_DEG

DATA_PORT = 2368
# Byte of the return mode, and returns.
MODES = {
    "first": (0x33, 1),
    "strongest": (0x37, 1),
    "last": (0x38, 1),
    "dual": (0x39, 2),
    "first and last": (0x3B, 2),
    "first and strongest": (0x3C, 2),
    "triple": (0x3D, 3),
}
_MIRROR_STARTS_DEG = (20.0, 140.0, 260.0)
# Azimuths in which an AT128 measures, from the middle of a mirror's field.
_HALF_VIEW_DEG = 60.0
_SIGNATURE = bytes(range(32))
_REVERSED_BITS = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


@dataclass(frozen=True)
class Angles:
    """Beams of a turning lidar, deg, (channels,)."""

    elevation_deg: Sequence[float]
    azimuth_deg: Sequence[float]

    def aim(self, rotor_deg: F64Array) -> tuple[F64Array, F64Array]:
        """The rotor's angle is added to the azimuths."""
        elevation = np.asarray(self.elevation_deg, np.float64)
        return rotor_deg + np.asarray(self.azimuth_deg), np.broadcast_to(elevation, rotor_deg.shape)


@dataclass(frozen=True)
class MirrorAngles:
    """Beams of an AT128, deg: starts of the three fields, which have no gaps; (128,) angles."""

    start_deg: tuple[float, float, float]
    elevation_deg: Sequence[float]
    azimuth_deg: Sequence[float]

    def aim(self, rotor_deg: F64Array) -> tuple[F64Array, F64Array]:
        """Twice the angle since the start of the mirror; no adjustments."""
        past = np.stack([(rotor_deg - start) % 360 for start in self.start_deg]).min(axis=0)
        elevation = np.asarray(self.elevation_deg, np.float64)
        return 2 * past - np.asarray(self.azimuth_deg), np.broadcast_to(elevation, past.shape)

    def dat(self) -> bytes:
        """The correction file of the unit, in steps of 1/25600 deg."""
        starts = [round(deg * 25600) for deg in self.start_deg]
        body = bytes.fromhex("eeff0105800303") + bytes(8) + bytes([1])
        body += struct.pack("<6I", *starts, *starts[1:], starts[0])
        for angles in (self.azimuth_deg, self.elevation_deg):
            body += struct.pack("<128i", *(round(deg * 25600) for deg in angles))
        body += bytes(2 * 128 * 180)
        return body + hashlib.sha256(body).digest()


# Highest and lowest beam by the data sheets, deg; of other models as of a PandarXT-16.
_SPAN_DEG = (14.9, -15.1)
_WIDE_DEG = (14.9, -24.9)
_SPANS_DEG = {
    "Pandar20A": (7.9, -24.9),
    "Pandar20B": (2.9, -18.9),
    "Pandar40P": _WIDE_DEG,
    "Pandar40M": _WIDE_DEG,
    "Pandar64": _WIDE_DEG,
    "Pandar64-7": _WIDE_DEG,
    "PandarQT64": (52.1, -52.1),
    "QT128C2X": (52.6, -52.6),
    "XT32M2X": (19.5, -20.8),
    "Pandar128E3X": _WIDE_DEG,
    "OT128": _WIDE_DEG,
}


def fan(model: str, channels: int) -> tuple[list[float], list[float]]:
    """Elevations and azimuths of a made-up unit, deg: evenly spread."""
    elevation = np.linspace(*_SPANS_DEG.get(model, _SPAN_DEG), channels)
    return elevation.round(3).tolist(), np.linspace(-4.0, 4.0, channels).round(3).tolist()


def angles_csv(elevation_deg: Sequence[float], azimuth_deg: Sequence[float]) -> bytes:
    """The angle file of a unit."""
    rows = enumerate(zip(elevation_deg, azimuth_deg, strict=True), 1)
    lines = [f"{channel},{elevation},{azimuth}\n" for channel, (elevation, azimuth) in rows]
    return "".join(["Laser id,Elevation,Azimuth\n", *lines]).encode()


@dataclass(frozen=True)
class HesaiSpec(SpinningSpec):
    """A lidar to imitate.

    start_deg: rotor angle of the first column; start_ns: time of the first packet; flags: optional
    parts, None for all that the model has; operation: of models with protocol 1.4; sequence: of the
    first packet.
    """

    topics: ClassVar = {DATA_PORT: PacketTopic("hesai_packets", "hesai_ros_driver/UdpFrame")}

    model: str
    mode: str = "strongest"
    rpm: int = 600
    start_deg: float = 0.0
    start_ns: int = 1_700_000_000_000_000_000
    sequence: int = 0
    flags: int | None = None
    operation: str = HIGH

    @property
    def row(self) -> HesaiModel:
        """The model's layout, with what the spec chooses."""
        return _row(self.model, self.operation, self.flags)

    def __post_init__(self) -> None:
        vars(self).update(
            reported_model=self.row.row.name,
            channels=self.row.row.channels,
            returns=MODES[self.mode][1],
            columns_per_packet=self.groups,
            column_ns=float(self.row.step_ns),
            range_unit_m=self.row.unit_mm / 1000.0,
            begin_ns=self.start_ns,
        )

    @property
    def groups(self) -> int:
        """Groups of blocks of a packet, with an azimuth each."""
        return self.row.blocks // MODES[self.mode][1]

    @property
    def beams(self) -> Angles | MirrorAngles:
        """Angles of a made-up unit."""
        elevation, azimuth = fan(self.model, self.channels)
        if self.model == "AT128":
            return MirrorAngles(_MIRROR_STARTS_DEG, elevation, azimuth)
        return Angles(elevation, azimuth)

    @property
    def files(self) -> LidarFiles:
        """The file of these angles."""
        beams = self.beams
        if isinstance(beams, MirrorAngles):
            return LidarFiles("dat", beams.dat())
        return LidarFiles("csv", angles_csv(*fan(self.model, self.channels)))

    def has(self, flag: int) -> bool:
        """Whether the packets have this optional part."""
        return bool(self.row.flags & flag)

    def advanced(self, packets: int) -> HesaiSpec:
        """The lidar as it is so many packets later; ValueError if that is no whole ns."""
        row = self.row
        after_ns = row.step_ns * packets * self.groups
        if after_ns.denominator != 1:
            raise ValueError(f"{packets} packets last {after_ns} ns, no whole number")
        turned_deg = float(after_ns * self.rpm * 6 % (360 * 10**9)) * 1e-9
        return replace(
            self,
            start_deg=(self.start_deg + turned_deg) % 360.0,
            start_ns=self.start_ns + int(after_ns),
            sequence=(self.sequence + packets) % 2**32,
        )

    def azimuths_deg(self, columns: int) -> F64Array:
        """(n,) rotor angles as in the packets."""
        step_deg = float(self.row.step_ns) * self.rpm * 6e-9
        units = np.rint((self.start_deg + np.arange(columns) * step_deg) * self.row.units_per_deg)
        wrapped: F64Array = units % (360 * self.row.units_per_deg) / self.row.units_per_deg
        return wrapped

    def fires(self, columns: int) -> BoolArray:
        """(n, channels) which beams fire in a column."""
        # Tables that count back never contain -1 ns.
        return np.asarray(_offsets_ns(self, columns) != NEVER)

    def firing_times_ns(self, columns: int) -> I64Array:
        """(n, channels) when each beam fires; the block's time where it does not."""
        times: I64Array = _block_times_ns(self, columns)[:, None] + _fired_ns(self, columns)
        return times

    def directions(self, columns: int) -> F64Array:
        """(n, channels, 3) unit vectors at each beam's firing; x right, y forward."""
        rotor = np.repeat(self.azimuths_deg(columns)[:, None], self.channels, axis=1)
        lag_ns = self.row.row.timing.azimuth_ns
        rotor += (_fired_ns(self, columns) - lag_ns) * (self.rpm * 6e-9)
        azimuth, elevation = (np.radians(angle) for angle in self.beams.aim(rotor))
        flat = np.cos(elevation)
        return np.stack(
            [flat * np.sin(azimuth), flat * np.cos(azimuth), np.sin(elevation)], axis=-1
        )

    def in_view(self, directions: F64Array) -> BoolArray:
        """The middle of the field of an AT128 is at twice 60 degrees of the mirror."""
        if self.model != "AT128":
            return super().in_view(directions)
        azimuth = np.arctan2(directions[..., 0], directions[..., 1]) / RAD_PER_DEG % 360.0
        return np.asarray(np.abs(azimuth - 120.0) <= _HALF_VIEW_DEG)

    def encode(self, counts: I64Array, levels: I64Array) -> list[Sent]:
        """Packets of these columns; what a silent beam is given is left out."""
        row = self.row
        lead, azimuth_at = row.row.lead, row.row.azimuth_at
        columns = len(counts)
        packets = columns // self.groups
        if counts.shape != self.shape(packets):
            raise ValueError(f"{counts.shape}: no whole packets of {self.groups}")
        blocks = np.zeros((columns, self.returns, row.stride), np.uint8)
        units = np.rint(self.azimuths_deg(columns) * row.units_per_deg).astype(np.int64)
        # The AT128's finer azimuth: two bytes of 1/100 deg, then one of 1/25600.
        coarse, fine = np.divmod(units, row.units_per_deg // 100)
        # Before the azimuth is the flag of a block.
        blocks[..., :azimuth_at] = np.frombuffer(b"\xff\xee"[:azimuth_at], np.uint8)
        blocks[..., azimuth_at : azimuth_at + 2] = _bytes_of(coarse, "<u2")[:, None]
        if lead == 3:
            blocks[..., 2] = fine[:, None]
        fired = self.fires(columns)[:, :, None]
        body = blocks[..., lead:].reshape(columns, self.returns, self.channels, row.unit)
        body[..., :2] = _bytes_of(np.where(fired, counts, 0).transpose(0, 2, 1), "<u2")
        body[..., 2] = np.where(fired, levels, 0).transpose(0, 2, 1)
        blocks[..., lead:] = body.reshape(columns, self.returns, -1)
        bodies = blocks.reshape(packets, -1)
        assemble = _jt16 if self.model == "JT16" else _assembled
        said_ns = _packet_times_ns(self, packets)
        last_ns = self.firing_times_ns(columns).reshape(packets, -1).max(axis=1)
        times = zip(said_ns.tolist(), np.maximum(last_ns, said_ns).tolist(), strict=True)
        return [
            Sent(ready_ns, DATA_PORT, assemble(self, at, time_ns, bodies[at].tobytes()))
            for at, (time_ns, ready_ns) in enumerate(times)
        ]


@functools.lru_cache(maxsize=64)
def _row(model: str, operation: str, flags: int | None) -> HesaiModel:
    """Return the layout of a model with what a spec chooses."""
    row = MODELS[model]
    number = OPERATIONS[operation][0] if row.operations else 0
    return replace(row, flags=row.flags if flags is None else flags, operation=number)


def _packet_times_ns(spec: HesaiSpec, packets: int) -> I64Array:
    """(P,) what the packets say: whole microseconds."""
    step_ns = spec.row.step_ns * spec.groups
    after_ns = np.arange(packets) * step_ns.numerator // step_ns.denominator
    times: I64Array = (spec.start_ns + after_ns) // 1000 * 1000
    return times


def _block_times_ns(spec: HesaiSpec, columns: int) -> I64Array:
    """(n,) packet time and offset of the block, by section 5."""
    timing, step_ns = spec.row.row.timing, spec.row.step_ns
    groups = spec.groups
    packet, group = np.divmod(np.arange(columns), groups)
    if timing.counts_back:
        # (last block - b) // returns; the blocks of a group give the same.
        offsets = [-int(step_ns * (groups - 1 - one)) for one in range(groups)]
    else:
        offsets = [int(step_ns * one) for one in range(groups)]
    times = _packet_times_ns(spec, -(-columns // groups))
    block_ns: I64Array = times[packet] + timing.base_ns + np.array(offsets)[group]
    return block_ns


def _offsets_ns(spec: HesaiSpec, columns: int) -> I64Array:
    """(n, channels) firing of each beam after its block's time; NEVER where it does not fire."""
    row = spec.row.row
    # Column 0 of a QT128 is of loop 1; a packet says 1 for loop 1 first.
    tables = np.arange(len(row.firing_ns))
    if spec.row.operations:
        mode, states = OPERATIONS[spec.operation]
        tables = row.tables[mode, :states]
    return row.firing_ns[tables[np.arange(columns) % len(tables)]]


def _fired_ns(spec: HesaiSpec, columns: int) -> I64Array:
    """(n, channels) the same; 0 where a beam does not fire."""
    offsets = _offsets_ns(spec, columns)
    return np.where(offsets == NEVER, 0, offsets)


def crc32_mpeg2(message: bytes) -> int:
    """CRC-32/MPEG-2: the usual CRC-32 of the message with all bits mirrored, not inverted."""
    usual = zlib.crc32(message.translate(_REVERSED_BITS)) ^ 0xFFFFFFFF
    return int(f"{usual:032b}"[::-1], 2)


def _assembled(spec: HesaiSpec, number: int, time_ns: int, body: bytes) -> bytes:
    """Header, blocks, checks, tail and what follows."""
    row = spec.row
    head = bytearray.fromhex(row.head)
    if len(head) == 12:
        head[8:10] = bytes([spec.returns > 1, row.unit_mm])
        head[11] = row.flags
    elif head:
        head[4:6] = bytes([spec.returns > 1, row.unit_mm])
    parts = [bytes(head), body]
    if row.row.has_checks:
        parts.append(_crc(body))
        if spec.has(SAFETY):
            safety = bytes([0x20, 0, *bytes(10)])
            parts += [b"\1", safety, _crc(safety)]
    end = _tail(spec, number, time_ns)
    if spec.has(SEQUENCE):
        end += struct.pack("<I", (spec.sequence + number) % 2**32)
    if spec.has(IMU):
        end += bytes(22)
    parts += [end, _crc(end) if row.row.has_checks else b""]
    return b"".join([*parts, _SIGNATURE if spec.has(SIGNATURE) else b""])


def _tail(spec: HesaiSpec, number: int, time_ns: int) -> bytes:
    place = spec.row.row.tail
    tail = bytearray(place.size)
    first = number * spec.groups
    states = OPERATIONS[spec.operation][1]
    each = [(first + block // spec.returns) % states for block in range(spec.row.blocks)]
    state = sum(one << 14 >> 2 * block for block, one in enumerate(each))
    # The factory byte follows the time, and a mode that is there.
    factory_at = place.us_at + 4 + (place.mode_at == place.us_at + 4)
    for at, form, value in (
        (place.mode_at, "B", MODES[spec.mode][0]),
        (factory_at, "B", 0x42),
        (place.rpm_at, "<h", round(spec.rpm / place.rpm_step)),
        (place.date_at, "6s", date_field(time_ns, spec.row.date)),
        (place.us_at, "<I", time_ns // 1000 % 1_000_000),
        (place.loop_at, "B", (first + 1) % 2),
        (place.operation_at, "B", spec.row.operation),
        (place.states_at, "<H", state),
    ):
        if at is not None:
            struct.pack_into(form, tail, at, value)
    return bytes(tail)


def date_field(time_ns: int, form: str) -> bytes:
    """The six bytes of a date, in UTC."""
    seconds = time_ns // 10**9
    if form == EPOCH:
        return b"\0" + seconds.to_bytes(5, "big")
    date = datetime(1970, 1, 1) + timedelta(seconds=seconds)
    year = date.year - (1900 if form == SINCE_1900 else 2000)
    # The reader takes 70 and more as after 1900.
    if not (70 <= year < 256 if form == SINCE_1900 else 0 < year < 70):
        raise ValueError(f"expected a year that {form} can encode, found {date.year}")
    return bytes([year, date.month, date.day, date.hour, date.minute, date.second])


def _jt16(spec: HesaiSpec, number: int, time_ns: int, body: bytes) -> bytes:
    """Section 8: no tail, no return mode; the body is azimuth and channels."""
    parts = [bytes.fromhex("eeff01080000"), date_field(time_ns, spec.row.date)]
    parts += [struct.pack("<I", time_ns // 1000 % 1_000_000), body, bytes(8)]
    packet = b"".join([*parts, struct.pack("<H", (spec.sequence + number) % 2**16)])
    return packet + _crc(packet)


def _crc(message: bytes) -> bytes:
    return struct.pack("<I", crc32_mpeg2(message))


def _bytes_of(values: I64Array, kind: str) -> U8Array:
    """(..., bytes) of whole numbers (...)."""
    raw = np.ascontiguousarray(values.astype(kind))
    return raw.view(np.uint8).reshape(*values.shape, raw.itemsize)


def _modes(name: str) -> tuple[str, ...]:
    """Return the return modes; JT16 has one, and seven blocks cannot have pairs of returns."""
    if name == "JT16":
        return ("strongest",)
    return ("strongest", "last") if MODELS[name].blocks % 2 else ("strongest", "last", "dual")


LIDARS = tuple(
    LidarModel(name, _modes(name), (10,) if name == "AT128" else (10, 5, 20)) for name in MODELS
)


def _unit(settings: LidarSettings) -> HesaiSpec:
    return HesaiSpec(
        settings.model,
        settings.mode,
        rpm=settings.rate_hz * 60,
        start_deg=settings.phase_deg,
        start_ns=settings.start_ns,
    )


simulated = simulator(_unit)
