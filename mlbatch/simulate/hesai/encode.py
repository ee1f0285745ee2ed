"""Encoder of HESAI packets and angle files: what a lidar would send, from plain values.

Source: docs/sources/hesai.md sections 2 (layout), 3 (tails), 4 (dates), 5 (times), 7 (checksums), 8
(JT16); rows of the models: `models.py`, angles: `angles.py`. Column k is the k-th group of blocks
that share an azimuth; the rotor has constant speed.
"""

from __future__ import annotations

import functools
import struct
import zlib
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.simulate.hesai.angles import Angles as Angles
from mlbatch.simulate.hesai.angles import Beams
from mlbatch.simulate.hesai.angles import MirrorAngles as MirrorAngles
from mlbatch.simulate.hesai.angles import angles_csv as angles_csv
from mlbatch.simulate.hesai.models import (
    EPOCH,
    HIGH,
    IMU,
    MODELS,
    NEVER,
    OPERATIONS,
    SAFETY,
    SEQUENCE,
    SIGNATURE,
    SINCE_1900,
    STATES,
    TABLES,
    UNIT_FLAGS,
    HesaiModel,
)

SINGLE = 0x37
DUAL = 0x39
TRIPLE = 0x3D
_RETURNS = {0x33: 1, 0x34: 1, 0x37: 1, 0x38: 1, 0x3D: 3}
_SIGNATURE = bytes(range(32))
_REVERSED_BITS = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
# From the last shot to the receive time of the packet.
_TRAVEL_NS = 40_000


@dataclass(frozen=True)
class HesaiSpec:
    """A lidar to imitate.

    start_deg: rotor angle of the first column; start_ns: time of the first packet; date: form of
    the date field; flags: optional parts, None for all that the model has; operation: of models
    with protocol 1.4; sequence: of the first packet.
    """

    model: str
    mode: int = SINGLE
    rpm: int = 600
    start_deg: float = 0.0
    start_ns: int = 1_700_000_000_000_000_000
    date: str = ""
    unit_mm: int = 0
    sequence: int = 0
    flags: int | None = None
    operation: str = HIGH

    @property
    def row(self) -> HesaiModel:
        """The model's layout, with what the spec chooses."""
        return _row(self.model, self.operation, self.flags, self.date, self.unit_mm)

    @property
    def returns(self) -> int:
        """Blocks of a group."""
        return _RETURNS.get(self.mode, 2)

    @property
    def groups(self) -> int:
        """Columns of a packet."""
        return self.row.blocks // self.returns

    def has(self, flag: int) -> bool:
        """Whether the packets have this optional part."""
        return bool(self.row.flags & flag)


@functools.lru_cache(maxsize=64)
def _row(model: str, operation: str, flags: int | None, date: str, unit_mm: int) -> HesaiModel:
    """Return the layout of a model with what a spec chooses."""
    row = MODELS[model]
    slower = model in STATES and operation != HIGH
    own_flags = row.flags if flags is None else flags
    return replace(
        row,
        step_ns=row.step_ns * (2 if slower else 1),
        flags=own_flags,
        unit=row.unit + (row.grows and (own_flags & UNIT_FLAGS).bit_count()),
        date=date or row.date,
        unit_mm=unit_mm or row.unit_mm,
    )


def advanced(spec: HesaiSpec, packets: int) -> HesaiSpec:
    """Return the lidar as it is so many packets later; ValueError if that is no whole ns.

    packets: a multiple of those after which the firing tables repeat.
    """
    row = spec.row
    columns = packets * spec.groups
    after_ns = row.step_ns * columns
    if after_ns.denominator != 1:
        raise ValueError(f"{packets} packets last {after_ns} ns, no whole number")
    turned_deg = float(after_ns * spec.rpm * 6 % (360 * 10**9)) * 1e-9
    return replace(
        spec,
        start_deg=(spec.start_deg + turned_deg) % 360.0,
        start_ns=spec.start_ns + int(after_ns),
        sequence=(spec.sequence + packets) % 2**32,
    )


def packet_times_ns(spec: HesaiSpec, packets: int) -> I64Array:
    """(P,) what the packets say: whole microseconds."""
    step_ns = spec.row.step_ns * spec.groups
    after_ns = np.arange(packets) * step_ns.numerator // step_ns.denominator
    times: I64Array = (spec.start_ns + after_ns) // 1000 * 1000
    return times


def block_times_ns(spec: HesaiSpec, columns: int) -> I64Array:
    """(n,) packet time and offset of the block, by section 5."""
    row = spec.row
    groups = spec.groups
    packet, group = np.divmod(np.arange(columns), groups)
    if row.counts_back:
        # (last block - b) // returns; the blocks of a group give the same.
        offsets = [-int(row.step_ns * (groups - 1 - one)) for one in range(groups)]
    else:
        offsets = [int(row.step_ns * one) for one in range(groups)]
    times = packet_times_ns(spec, -(-columns // groups))
    block_ns: I64Array = times[packet] + row.first_ns + np.array(offsets)[group]
    return block_ns


def azimuths_deg(spec: HesaiSpec, columns: int) -> F64Array:
    """(n,) rotor angles as in the packets."""
    step_deg = float(spec.row.step_ns) * spec.rpm * 6e-9
    units = np.rint((spec.start_deg + np.arange(columns) * step_deg) * spec.row.units_per_deg)
    wrapped: F64Array = units % (360 * spec.row.units_per_deg) / spec.row.units_per_deg
    return wrapped


def offsets_ns(spec: HesaiSpec, columns: int) -> I64Array:
    """(n, channels) firing of each beam after its block's time; NEVER where it does not fire."""
    number: I64Array = np.arange(columns)
    if spec.model == "QT128C2X":
        # Column 0 is of loop 1; a packet says 1 for loop 1 first.
        return TABLES["QT128C2X"][number % 2]
    if spec.model in STATES:
        tables = [STATES[spec.model][spec.operation, state] for state in range(_states(spec))]
        return np.stack(tables)[number % len(tables)]
    return np.broadcast_to(TABLES[spec.model], (columns, spec.row.channels))


def fires(spec: HesaiSpec, columns: int) -> BoolArray:
    """(n, channels) which beams fire in a column."""
    offsets = offsets_ns(spec, columns)
    # Tables that count back never contain -1 ns.
    return np.asarray(offsets != NEVER)


def firing_times_ns(spec: HesaiSpec, columns: int) -> I64Array:
    """(n, channels) when each beam fires; the block's time where it does not."""
    offsets = np.where(fires(spec, columns), offsets_ns(spec, columns), 0)
    times: I64Array = block_times_ns(spec, columns)[:, None] + offsets
    return times


def host_times_ns(spec: HesaiSpec, packets: int) -> I64Array:
    """(P,) receive times, ns: after the packet's last shot and its time."""
    last = firing_times_ns(spec, packets * spec.groups).reshape(packets, -1).max(axis=1)
    receive_ns: I64Array = np.maximum(last, packet_times_ns(spec, packets)) + _TRAVEL_NS
    return receive_ns


def directions(spec: HesaiSpec, beams: Beams, columns: int, *, turning: bool = True) -> F64Array:
    """(n, channels, 3) unit vectors at each beam's firing, in HESAI's frame: x right, y forward.

    turning: the rotor moves while the beams of a column fire.
    """
    rotor = np.repeat(azimuths_deg(spec, columns)[:, None], spec.row.channels, axis=1)
    if turning:
        offsets = np.where(fires(spec, columns), offsets_ns(spec, columns), 0)
        rotor += (offsets + spec.row.azimuth_lag_ns) * (spec.rpm * 6e-9)
    azimuth, elevation = (np.radians(angle) for angle in beams.aim(rotor))
    flat = np.cos(elevation)
    return np.stack([flat * np.sin(azimuth), flat * np.cos(azimuth), np.sin(elevation)], axis=-1)


def encode_packets(
    spec: HesaiSpec, ranges: I64Array, levels: I64Array | None = None
) -> list[bytes]:
    """Packets of n columns, whole packets of them.

    ranges: (n, channels, returns) in the spec's unit, 0 no return; levels: the same shape, 0..255.
    What a silent beam is given is left out.
    """
    row = spec.row
    columns = len(ranges)
    packets = columns // spec.groups
    if packets * spec.groups != columns or ranges.shape[1:] != (row.channels, spec.returns):
        raise ValueError(f"{ranges.shape}: no whole packets of {spec.groups} columns")
    blocks = np.zeros((columns, spec.returns, row.stride), np.uint8)
    units = np.rint(azimuths_deg(spec, columns) * row.units_per_deg).astype(np.int64)
    # The AT128's finer azimuth: two bytes of 1/100 deg, then one of 1/25600.
    coarse, fine = np.divmod(units, row.units_per_deg // 100)
    blocks[..., :2] = np.frombuffer(row.block_flag or bytes(2), np.uint8)
    blocks[..., row.azimuth_at : row.azimuth_at + 2] = _bytes_of(coarse, "<u2")[:, None]
    if row.lead == 3:
        blocks[..., 2] = fine[:, None]
    fired = fires(spec, columns)[:, :, None]
    body = blocks[..., row.lead :].reshape(columns, spec.returns, row.channels, row.unit)
    body[..., :2] = _bytes_of(np.where(fired, ranges, 0).transpose(0, 2, 1), "<u2")
    if levels is not None:
        body[..., 2] = np.where(fired, levels, 0).transpose(0, 2, 1)
    blocks[..., row.lead :] = body.reshape(columns, spec.returns, -1)
    bodies = blocks.reshape(packets, -1)
    assemble = _jt16 if spec.model == "JT16" else _assembled
    times = packet_times_ns(spec, packets).tolist()
    return [assemble(spec, at, times[at], bodies[at].tobytes()) for at in range(packets)]


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
    if row.checked:
        parts.append(_crc(body))
        if spec.has(SAFETY):
            safety = bytes([0x20, 0, *bytes(10)])
            parts += [b"\1", safety, _crc(safety)]
    end = _tail(spec, number, time_ns)
    if spec.has(SEQUENCE):
        end += struct.pack("<I", (spec.sequence + number) % 2**32)
    if spec.has(IMU):
        end += bytes(22)
    parts += [end, _crc(end) if row.checked else b""]
    return b"".join([*parts, _SIGNATURE if spec.has(SIGNATURE) else b""])


def _tail(spec: HesaiSpec, number: int, time_ns: int) -> bytes:
    place = spec.row.tail
    tail = bytearray(spec.row.tail.size)
    tail[place.mode] = spec.mode
    tail[place.factory] = 0x42
    # JT128 counts in 0.1 rpm.
    struct.pack_into("<h", tail, place.speed, spec.rpm * spec.row.speed_units_per_rpm)
    if place.date:
        tail[place.date : place.date + 6] = date_field(time_ns, spec.row.date)
    struct.pack_into("<I", tail, place.micros, time_ns // 1000 % 1_000_000)
    if place.loop:
        tail[place.loop] = (number * spec.groups + 1) % 2
    if place.operation:
        tail[place.operation] = OPERATIONS[spec.operation]
    if spec.model in STATES:
        first = number * spec.groups
        states = _states(spec)
        fields = [(first + block // spec.returns) % states for block in range(spec.row.blocks)]
        state = sum(one << (14 - 2 * block) for block, one in enumerate(fields))
        struct.pack_into("<H", tail, place.state, state)
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


def _states(spec: HesaiSpec) -> int:
    return sum(mode == spec.operation for mode, _ in STATES[spec.model])


def _bytes_of(values: I64Array, kind: str) -> U8Array:
    """(..., bytes) of whole numbers (...)."""
    raw = np.ascontiguousarray(values.astype(kind))
    return raw.view(np.uint8).reshape(*values.shape, raw.itemsize)
