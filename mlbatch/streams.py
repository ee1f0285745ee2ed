"""Which stream is which sensor: by what the packets say, never by file name.

A *kind* is a stream together with a payload size. At the start the kinds of the first seconds are
matched with calibrations (or the rig's selectors); later kinds join a sensor only if their packets
prove to be its own.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

import numpy as np

from mlbatch.errors import RecordingError, RigError
from mlbatch.frames import GENERIC, namespace, same_namespace
from mlbatch.lidar import Calibration, Evidence, Lidar
from mlbatch.rig import StreamSelector
from mlbatch.types import I64Array, PacketBatch, Stream, StreamTable, U8Array
from mlbatch.units import NS_PER_S

Kind = tuple[int, int]  # (number of the stream, payload size)
SAMPLES_PER_KIND = 16
SAMPLE_EVERY_NS = NS_PER_S // 4


class Role(Enum):
    """What the packets of a kind are."""

    LIDAR = "lidar"
    IMU = "imu"
    BAD_SIZE = "bad_size"
    UNASSIGNED = "unassigned"


@dataclass(slots=True)
class Found:
    """A sensor: its name, how to read it, and the kinds of packets seen of it so far."""

    name: str
    lidar: Lidar
    selector: StreamSelector = field(default_factory=StreamSelector)
    kinds: set[Kind] = field(default_factory=set)


@dataclass(frozen=True, slots=True)
class Route:
    """Where the packets of a kind go: numbers of sensors that may own them."""

    role: Role
    sensors: tuple[int, ...] = ()
    what: str = ""


@dataclass(slots=True)
class Sampler:
    """Collects the first payloads of every kind, and counts them all."""

    table: StreamTable
    samples: dict[Kind, list[bytes]] = field(default_factory=dict)
    sample_host_ns: dict[Kind, list[int]] = field(default_factory=dict)
    packets: dict[Kind, int] = field(default_factory=dict)
    span_ns: dict[Kind, tuple[int, int]] = field(default_factory=dict)

    def add(self, batch: PacketBatch) -> None:
        """Look at a batch."""
        for kind, index in split_by_kind(batch):
            kept = self.samples.setdefault(kind, [])
            hosts_ns = self.sample_host_ns.setdefault(kind, [])
            for at in self._telling(kind, index, batch.host_ns[index]):
                begin = int(batch.start[at])
                kept.append(batch.data[begin : begin + kind[1]].tobytes())
                hosts_ns.append(int(batch.host_ns[at]))
            self.packets[kind] = self.packets.get(kind, 0) + len(index)
            first_ns, last_ns = int(batch.host_ns[index[0]]), int(batch.host_ns[index[-1]])
            self.span_ns[kind] = self.span_ns.get(kind, (first_ns, 0))[0], last_ns

    def _telling(self, kind: Kind, index: I64Array, host_ns: I64Array) -> list[int]:
        """Which packets of a kind to keep: the first ones, then two of every quarter of a second.

        Several sensors may share a kind, and one of them may start later than the others. The
        choice follows arrival times, so that it does not depend on the size of batches.
        """
        first = SAMPLES_PER_KIND - min(SAMPLES_PER_KIND, self.packets.get(kind, 0))
        tick = np.concatenate([[self.span_ns.get(kind, (0, 0))[1]], host_ns]) // SAMPLE_EVERY_NS
        fresh = tick[1:] != tick[:-1]
        fresh[1:] |= fresh[:-1]
        fresh[:first] = True
        chosen: list[int] = index[fresh].tolist()
        return chosen

    def clock_offset_ns(self, sensor: Found) -> int | None:
        """First stamp of a sensor in the samples minus its arrival; None if there is none."""
        firsts = []
        for kind in sensor.kinds:
            packets = as_rows(self.samples[kind], kind[1])[:, : sensor.lidar.packet_size]
            heads = sensor.lidar.heads(packets)
            good = sensor.lidar.owns(packets) & (sensor.lidar.faults(packets) == 0)
            rows = (heads.valid.any(axis=1) & good).nonzero()[0]
            if len(rows):
                row = int(rows[0])
                stamp_ns = int(heads.stamp_ns[row, int(heads.valid[row].argmax())])
                host_ns = self.sample_host_ns[kind][row]
                firsts.append((host_ns, stamp_ns - host_ns))
        return min(firsts)[1] if firsts else None

    def evidence(self, kind: Kind) -> Evidence:
        """What is known of a kind."""
        stream = self.table.streams[kind[0]]
        beside = frozenset(
            (self.table.streams[other].port, size)
            for other, size in self.samples
            if self.table.streams[other].source_ip == stream.source_ip
        )
        return Evidence(stream, kind[1], as_rows(self.samples[kind], kind[1]), beside)


def as_rows(payloads: Sequence[bytes], size: int) -> U8Array:
    """Payloads of one size as (k, size) uint8."""
    return np.frombuffer(b"".join(payloads), np.uint8).reshape(len(payloads), size)


def split_by_kind(batch: PacketBatch) -> list[tuple[Kind, I64Array]]:
    """Packets of a batch by stream and size: ((stream, size), indices in arrival order)."""
    if not len(batch):
        return []
    key = batch.stream << 17 | batch.size
    kinds, inverse = np.unique(key, return_inverse=True)
    order = np.argsort(inverse, kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(inverse, minlength=len(kinds)))[:-1])
    numbers = kinds.tolist()
    return [
        ((number >> 17, number & 0x1FFFF), part)
        for number, part in zip(numbers, parts, strict=True)
    ]


class Router:
    """Tells for every kind which sensors it may come from; remembers the answer.

    early: the kinds from which the sensors were found.
    """

    def __init__(self, table: StreamTable, found: Sequence[Found], early: Collection[Kind]) -> None:
        self._table = table
        self._found = list(found)
        self._early = frozenset(early)
        self._routes: dict[Kind, Route] = {}

    def route(self, kind: Kind, payload: U8Array) -> Route:
        """Route of a kind; payload is one of its packets, looked at only the first time."""
        known = self._routes.get(kind)
        if known is None:
            known = self._routes[kind] = self._decide(kind, payload)
        return known

    def _decide(self, kind: Kind, payload: U8Array) -> Route:
        stream, size = self._table.streams[kind[0]], kind[1]
        owners = tuple(
            number
            for number, sensor in enumerate(self._found)
            if size in (sensor.lidar.packet_size, sensor.lidar.packet_size + 1)
            and self._may_own(sensor, kind, stream, payload)
        )
        if owners:
            self._join(kind, owners)
            return Route(Role.LIDAR, owners)
        imu = self._imu_owner(stream, size)
        if imu is not None:
            return Route(Role.IMU, (imu,))
        for number, sensor in enumerate(self._found):
            if any(stream_number == kind[0] for stream_number, _ in sensor.kinds):
                return Route(Role.BAD_SIZE, (number,))
        return Route(Role.UNASSIGNED)

    def _join(self, kind: Kind, owners: Sequence[int]) -> None:
        """A sensor is known to send a kind: what comes beside it may be its IMU."""
        for number in owners:
            if kind not in self._found[number].kinds:
                self._found[number].kinds.add(kind)
                self._routes = {
                    other: route
                    for other, route in self._routes.items()
                    if route.role is not Role.UNASSIGNED
                }

    def _may_own(self, sensor: Found, kind: Kind, stream: Stream, payload: U8Array) -> bool:
        if kind in sensor.kinds:
            return True
        if not sensor.selector.selects(stream):
            return False
        # A stream that was not there at the start joins only by the serial number it carries,
        # or because the rig says where the sensor sends from.
        if sensor.selector == StreamSelector() and not sensor.lidar.carries_serial:
            return False
        # One packet, which may be damaged, must not speak for all of a stream that begins late:
        # each of its packets is looked at.
        size = sensor.lidar.packet_size
        return kind not in self._early or bool(sensor.lidar.owns(payload[None, :size])[0])

    def _imu_owner(self, stream: Stream, size: int) -> int | None:
        """The sensor whose IMU this is: same source, and, among twins, the port it announces."""
        near = [
            number
            for number, sensor in enumerate(self._found)
            if sensor.lidar.is_imu(size)
            and any(_beside(self._table.streams[other], stream) for other, _ in sensor.kinds)
        ]
        if len(near) > 1 and not stream.topic:
            near = [n for n in near if self._found[n].lidar.imu_port == stream.port]
        return near[0] if len(near) == 1 else None


def _beside(one: Stream, other: Stream) -> bool:
    """Whether two streams may be of one sensor: same source IP, or topics of one namespace."""
    return one.source_ip == other.source_ip and same_namespace(one.topic, other.topic)


def match(
    sampler: Sampler, calibrations: Sequence[Calibration], options: dict[str, str]
) -> tuple[list[Found], list[Kind]]:
    """Sensors of a recording without a rig, and the kinds that no calibration fits.

    Raises RecordingError where the packets do not tell which of several calibrations is theirs.
    """
    usable, lidars = _readable(calibrations, options)
    found: dict[int, Found] = {}
    unknown = []
    for kind in sampler.samples:
        best = _best_fits(sampler.evidence(kind), usable, lidars)
        if not best:
            unknown.append(kind)
        for number in best:
            sensor = found.setdefault(number, Found("", lidars[number]))
            sensor.kinds.add(kind)
    calibrations = usable
    _refuse_shared(sampler.table, found, calibrations)
    sensors = sorted(found.values(), key=lambda sensor: _order(sampler.table, sensor))
    for count, sensor in enumerate(sensors):
        sensor.name = _name(sampler.table, sensor, count)
    return sensors, unknown


def _name(table: StreamTable, sensor: Found, count: int) -> str:
    """After the namespace of its topics if that tells a place, else maker and serial number."""
    topic = min((table.streams[stream].topic for stream, _ in sensor.kinds), default="")
    place = "_".join(part for part in namespace(topic) if part not in GENERIC)
    if place and place[0].isalpha() and place.replace("_", "").isalnum():
        return place
    return f"{sensor.lidar.maker.lower()}_{sensor.lidar.serial or count + 1}"


def _readable(
    calibrations: Sequence[Calibration], options: dict[str, str]
) -> tuple[list[Calibration], list[Lidar]]:
    """The calibrations of lidars that send; one that is switched off sends nothing."""
    usable, lidars = [], []
    for calibration in calibrations:
        try:
            lidars.append(calibration.lidar(options))
        except RigError:
            continue
        usable.append(calibration)
    return usable, lidars


def _best_fits(
    evidence: Evidence, calibrations: Sequence[Calibration], lidars: Sequence[Lidar]
) -> list[int]:
    """Calibrations of the sensors that sent a kind; several when their packets are mixed in it."""
    fits: dict[bytes, list[tuple[int, int]]] = {}
    for number, (calibration, lidar) in enumerate(zip(calibrations, lidars, strict=True)):
        if evidence.size not in (lidar.packet_size, lidar.packet_size + 1):
            continue
        own = lidar.owns(evidence.sample[:, : lidar.packet_size])
        if not own.any():
            continue
        part = Evidence(evidence.stream, evidence.size, evidence.sample[own], evidence.sizes)
        score = calibration.fit(part)
        if score > 0:
            fits.setdefault(own.tobytes(), []).append((score, number))
    best = []
    for group in fits.values():
        top = max(score for score, _ in group)
        first = [number for score, number in group if score == top]
        serials = {calibrations[number].serial for number in first}
        if len(serials) > 1:
            names = ", ".join(str(calibrations[number].path) for number in first)
            raise RecordingError(
                f"packets of {evidence.stream} ({evidence.size} bytes) carry no serial number and "
                f"fit {len(first)} metadata files: {names}; wanted one; name the sensor of each "
                "source with stream.source_ip in a rig file (--rig), or give only its --metadata"
            )
        best.append(first[0])
    return best


def _refuse_shared(
    table: StreamTable, found: dict[int, Found], calibrations: Sequence[Calibration]
) -> None:
    """One unit sends from one place, unless its serial number says that it moved."""
    for number, sensor in found.items():
        streams = sorted({str(table.streams[stream]) for stream, _ in sensor.kinds})
        if len(streams) > 1 and not sensor.lidar.carries_serial:
            raise RecordingError(
                f"metadata {calibrations[number].path} fits the packets of {len(streams)} "
                f"streams ({'; '.join(streams)}), which carry no serial number; wanted a metadata "
                "file each; name them in a rig file (--rig) with stream.source_ip"
            )


def _order(table: StreamTable, sensor: Found) -> tuple[int, int, tuple[tuple[int, int, str], ...]]:
    """By serial number, else source IP and port, else topic."""
    streams = (table.streams[number] for number, _ in sensor.kinds)
    places = tuple(sorted((_ip_number(s.source_ip), s.port, s.topic) for s in streams))
    if sensor.lidar.serial.isdigit():
        return (0, int(sensor.lidar.serial), places)
    return (1, 0, places)


def _ip_number(text: str) -> int:
    return int(ipaddress.ip_address(text)) if text else 0


@dataclass(frozen=True, slots=True)
class Wanted:
    """A sensor of the rig: where it sends from, and the calibrations it may have."""

    name: str
    selector: StreamSelector
    calibrations: Sequence[Calibration]
    decode: dict[str, str]


def match_rig(
    sampler: Sampler, sensors: Sequence[Wanted], origin: Path
) -> tuple[list[Found], list[Kind]]:
    """Sensors of a rig, in its order, and the kinds that it does not mention.

    origin: the rig file. Raises RigError where a sensor has no calibration.
    """
    found = [_find(sampler, wanted, origin) for wanted in sensors]
    taken = {kind for sensor in found for kind in sensor.kinds}
    return found, [kind for kind in sampler.samples if kind not in taken]


def _find(sampler: Sampler, wanted: Wanted, origin: Path) -> Found:
    serial = wanted.selector.serial
    usable = [c for c in wanted.calibrations if not serial or c.serial in ("", serial)]
    if not usable:
        raise RigError(
            f"{origin}: sensor {wanted.name}: no metadata"
            + (f" with serial number {serial}" if serial else "")
            + f" among {_paths(wanted.calibrations)}; give it as `metadata:` of the sensor, or "
            "with --metadata"
        )
    lidars = [calibration.lidar(wanted.decode) for calibration in usable]
    scored: dict[int, tuple[int, set[Kind]]] = {}
    for kind in sampler.samples:
        if not wanted.selector.selects(sampler.table.streams[kind[0]]):
            continue
        evidence = sampler.evidence(kind)
        for number in _best_fits(evidence, usable, lidars):
            before, kinds = scored.setdefault(number, (0, set()))
            scored[number] = (max(before, usable[number].fit(evidence)), kinds | {kind})
    best = max(scored, key=lambda number: scored[number][0], default=None)
    if best is None:
        _refuse_guess(wanted, usable, origin)
        return Found(wanted.name, lidars[0], wanted.selector)
    return Found(wanted.name, lidars[best], wanted.selector, scored[best][1])


def _refuse_guess(wanted: Wanted, usable: Sequence[Calibration], origin: Path) -> None:
    """A sensor that is silent at first needs metadata that are surely its own."""
    if len(usable) > 1:
        raise RigError(
            f"{origin}: sensor {wanted.name}: wanted a packet of it ({wanted.selector}) in the "
            f"first 10 seconds, got none to tell which of {_paths(usable)} is its metadata; "
            "correct its stream, or give `metadata:`"
        )


def _paths(calibrations: Sequence[Calibration]) -> str:
    return ", ".join(str(calibration.path) for calibration in calibrations) or "the files given"
