"""What `inspect` tells: every stream of a session, what it is, and what is missing."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np

from mlbatch.batching.intake import NEVER, extremes
from mlbatch.batching.loss import PacketLoss
from mlbatch.clocks.compare import Comparison, compare
from mlbatch.clocks.timescale import timescale
from mlbatch.clocks.watch import ClockWatch
from mlbatch.clouds import CloudRecording
from mlbatch.decode.packet_ring import PacketRing
from mlbatch.discovery.discover import describe, lacks_decoder, named, packet_types
from mlbatch.discovery.extrinsics import Mounted, in_words, mount
from mlbatch.discovery.match import match, shared_by
from mlbatch.discovery.probe import calibrations_for, first_seconds, look, with_clouds
from mlbatch.discovery.router import Role, Router
from mlbatch.discovery.sampler import (
    Found,
    Kind,
    Sampler,
    clock_watch,
    has_receive_times,
    split_by_kind,
)
from mlbatch.errors import RigError
from mlbatch.frames.transforms import from_rpy_deg
from mlbatch.lidar.interface import Lidar
from mlbatch.readers import merge, open_recording
from mlbatch.rig.rig import DEFAULT_BODY_FRAME, Rig, RigSensor, StreamSelector
from mlbatch.rig.write import write_rig
from mlbatch.types import Recording, StreamTable
from mlbatch.units import NS_PER_MS, NS_PER_S

MS_PER_S = NS_PER_S // NS_PER_MS
Value: TypeAlias = str | int | float | None
HEAD = (
    *("stream", "what", "sensor", "packets", "Hz", "lost", "seconds"),
    *("clock", "calibration", "extrinsics", "missing"),
)


@dataclass(frozen=True, slots=True)
class StreamReport:
    """One kind of packets: where from, what, how many; times by the recorder's clock.

    offset_ms: first stamp minus its arrival; extrinsics: where they come from, or "".
    """

    stream: str
    what: str
    sensor: str
    model: str
    mode: str
    serial: str
    bytes: int
    packets: int
    rate_hz: float
    lost: int | None
    first_host_ns: int
    last_host_ns: int
    timescale: str
    offset_ms: float | None
    calibration: str
    extrinsics: str
    missing: str

    def row(self) -> list[str]:
        """Cells for people, as HEAD."""
        clock = self.timescale
        if self.offset_ms is not None:
            near = abs(self.offset_ms) < MS_PER_S
            offset = f"{self.offset_ms:+.3f} ms" if near else f"{self.offset_ms / MS_PER_S:+.3f} s"
            clock += f" {offset}"
        return [
            *(self.stream, self.what, self.sensor, str(self.packets), f"{self.rate_hz:.1f}"),
            "" if self.lost is None else str(self.lost),
            f"{(self.last_host_ns - self.first_host_ns) / NS_PER_S:.3f}",
            *(clock, self.calibration, self.extrinsics, self.missing),
        ]


@dataclass(slots=True)
class _Count:
    """What a pass over the first seconds shows of one sensor."""

    ring: PacketRing
    loss: PacketLoss
    watch: ClockWatch
    first: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class Survey:
    """All streams of the first 10 seconds of a session.

    files: metadata by sensor, where they lie in a file and not in the recording itself.
    """

    streams: tuple[StreamReport, ...]
    sensors: tuple[Mounted, ...]
    body_frame: str = DEFAULT_BODY_FRAME
    files: dict[str, Path] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    clocks: Comparison | None = None

    def rows(self) -> list[list[str]]:
        """The table, head first."""
        return [list(HEAD), *(stream.row() for stream in self.streams)]

    def as_json(self) -> dict[str, object]:
        """For programs."""
        return {
            "schema": "mlbatch.inspect/1",
            "streams": [asdict(stream) for stream in self.streams],
            "notes": list(self.notes),
            "clocks": {} if self.clocks is None else _as_json(self.clocks),
        }

    def clock_lines(self) -> list[str]:
        """What the clock doctor says, for people."""
        return [] if self.clocks is None else self.clocks.in_words()

    def rig_text(self, folder: Path) -> str:
        """A rig file for these sensors; identity extrinsics are marked as to be measured."""
        if not self.sensors:
            raise RigError(
                "--write-rig: wanted at least one lidar with its metadata, got none; "
                "give --metadata FILE"
            )
        sensors = tuple(
            RigSensor(
                name=sensor.name,
                stream=_selector(sensor.found),
                metadata=self.files.get(sensor.name),
                extrinsics=sensor.body_from_sensor
                if _is_placed(sensor)
                # As angles, which are easier to fill in than a matrix.
                else from_rpy_deg((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
            )
            for sensor in self.sensors
        )
        notes = {
            sensor.name: f"extrinsics of {sensor.origin}"
            if _is_placed(sensor)
            else "extrinsics unknown: measure them"
            for sensor in self.sensors
        }
        return write_rig(Rig(sensors, self._body_frame()), folder, notes)

    def _body_frame(self) -> str:
        """The body frame, unless it has the name of a sensor, which a rig refuses."""
        names = {sensor.name for sensor in self.sensors}
        return DEFAULT_BODY_FRAME if self.body_frame in names else self.body_frame


def _selector(sensor: Found) -> StreamSelector:
    if sensor.lidar.carries_serial:
        return StreamSelector(serial=sensor.lidar.serial)
    return sensor.selector


def _is_placed(sensor: Mounted) -> bool:
    return sensor.extrinsics_source != "identity"


def survey(recordings: Sequence[Path], metadata: Sequence[Path], *, whole: bool = False) -> Survey:
    """Look at the first 10 s of recordings, with the metadata given or found beside them.

    whole: loss and clocks are those of the whole recordings.
    """
    table = StreamTable()
    opened = with_clouds([open_recording(path, table) for path in recordings], table, ())
    sampler, learner = look(opened, table)
    calibrations, looked = calibrations_for(recordings, metadata)
    files = {str(one.path): one.path for one in calibrations if one.path is not None}
    calibrations += learner.calibrations()
    matched = match(sampler, calibrations, {})
    found = matched.sensors
    mounted, mounting = mount(
        table,
        found,
        [None] * len(found),
        None,
        learner.knowledge,
        metadata_topics=learner.metadata_topics,
        identity_extrinsics=True,
    )
    for sensor in found:
        streams = [table.streams[stream] for stream, _ in sensor.kinds]
        sensor.selector = StreamSelector(streams[0].source_ip, streams[0].port, streams[0].topic)
    counts = _count(opened, found, table.untimed, whole=whole)
    router = Router(table, found, sampler.samples)
    types = packet_types(opened)
    reports = tuple(
        _report(sampler, kind, mounted, counts, _owner(sampler, kind, found, router), types)
        for kind in sampler.samples
    )
    notes = [f"{recording.path.name}: {text}" for recording in opened for text in recording.notes]
    notes += [
        f"{recording.path.name}: {text}"
        for recording in opened
        if isinstance(recording, CloudRecording)
        for text in recording.verdicts
    ]
    notes += [*learner.faults, *map(in_words, mounting.findings)]
    notes += filter(None, (shared_by(sampler, sensor) for sensor in found))
    if not sampler.samples:
        notes.append("no UDP packet in the first 10 seconds")
    elif not found:
        names = ", ".join(path.name for path in looked) or "none"
        notes.append(f"no lidar with its metadata; files looked at: {names}")
    used = {
        sensor.name: files[sensor.lidar.calibration]
        for sensor in found
        if sensor.lidar.calibration in files
    }
    named = [(one.name, count.watch.finding()) for one, count in zip(found, counts, strict=True)]
    findings = [(name, finding) for name, finding in named if finding is not None]
    clocks = compare(findings) if findings else None
    return Survey(reports, tuple(mounted), mounting.body_frame, used, tuple(notes), clocks)


def _count(
    recordings: Sequence[Recording],
    found: Sequence[Found],
    untimed: Collection[int],
    *,
    whole: bool,
) -> list[_Count]:
    counts = [_counting(sensor.lidar) for sensor in found]
    for batch in merge(recordings) if whole else first_seconds(recordings):
        for kind, index in split_by_kind(batch):
            for sensor, count in zip(found, counts, strict=True):
                if kind not in sensor.kinds:
                    continue
                packets, _ = count.ring.store(batch.data, batch.start[index], None)
                good = sensor.lidar.owns(packets) & (sensor.lidar.faults(packets) == 0)
                hosts_ns = batch.host_ns[index[good]]
                heads = sensor.lidar.heads(packets[good], hosts_ns)
                count.loss.add(sensor.lidar.sequence(packets[good]), heads, hosts_ns)
                _, newest_ns = extremes(heads)
                if has_receive_times(untimed, sensor):
                    count.watch.add(newest_ns[newest_ns > NEVER], hosts_ns[newest_ns > NEVER])
                if count.first is None and heads.valid.any():
                    row, column = np.argwhere(heads.valid)[0]
                    host_ns = int(batch.host_ns[index[good]][row])
                    count.first = int(heads.stamp_ns[row, column]), host_ns
    return counts


def _as_json(clocks: Comparison) -> dict[str, object]:
    """The clock doctor's findings for programs; times in ms, arrivals in ns."""
    return {
        "verdict": clocks.verdict,
        "bound_ms": None if clocks.bound_ns is None else clocks.bound_ns / NS_PER_MS,
        "lines": clocks.in_words(),
        "sensors": [
            {
                "name": name,
                "domain": finding.domain,
                "offset_ms": finding.offset_ns / NS_PER_MS,
                "uncertainty_ms": finding.uncertainty_ns / NS_PER_MS,
                "drift_ppm": finding.drift_ppm,
                "jumps": [
                    {"host_ns": one.host_ns, "size_ms": one.size_ns / NS_PER_MS, "kind": one.kind}
                    for one in finding.jumps
                ],
            }
            for name, finding in clocks.findings
        ],
    }


def _counting(lidar: Lidar) -> _Count:
    """Nothing counted yet."""
    packet_ns = lidar.columns_per_packet * lidar.column_period_ns
    ring = PacketRing(lidar.packet_size, lidar.records)
    return _Count(ring, PacketLoss(lidar.sequence_modulus, packet_ns), clock_watch(lidar))


def _owner(sampler: Sampler, kind: Kind, found: Sequence[Found], router: Router) -> str:
    """Name of the sensor that sends a kind of packets beside its lidar packets; empty if none."""
    route = router.route(kind, np.frombuffer(sampler.samples[kind][0], np.uint8))
    return found[route.sensors[0]].name if route.role in (Role.IMU, Role.BAD_SIZE) else ""


def _report(
    sampler: Sampler,
    kind: Kind,
    mounted: Sequence[Mounted],
    counts: Sequence[_Count],
    owner: str,
    types: Mapping[str, str],
) -> StreamReport:
    first_ns, last_ns = sampler.span_ns[kind]
    packets = sampler.packets[kind]
    at = next((n for n, sensor in enumerate(mounted) if kind in sensor.found.kinds), None)
    lidar = None if at is None else mounted[at].found.lidar
    first = None if at is None else counts[at].first
    what = "" if lidar is not None else describe(sampler, kind) or ""
    missing = "decoder" if lacks_decoder(what) else "metadata" if "lidar" in what else ""
    return StreamReport(
        stream=str(sampler.table.streams[kind[0]]),
        what=named(sampler, kind, types) if lidar is None else f"{lidar.model} {lidar.mode}",
        sensor=owner if at is None else mounted[at].name,
        model="" if lidar is None else lidar.model,
        mode="" if lidar is None else lidar.mode,
        serial="" if lidar is None else lidar.serial,
        bytes=kind[1],
        packets=packets,
        rate_hz=(packets - 1) * NS_PER_S / (last_ns - first_ns) if last_ns > first_ns else 0.0,
        lost=None if at is None else counts[at].loss.lost,
        first_host_ns=first_ns,
        last_host_ns=last_ns,
        timescale="" if first is None else timescale(*first),
        offset_ms=None if first is None else (first[0] - first[1]) / NS_PER_MS,
        calibration="" if lidar is None else Path(lidar.calibration).name,
        extrinsics=mounted[at].origin if at is not None and _is_placed(mounted[at]) else "",
        missing=missing,
    )
