"""`mlbatch inspect`: the result of discovery as a table, as JSON and as a rig file."""

from __future__ import annotations

import contextlib
import html
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.clocks.compare import SYNCHRONISED, Comparison, compare
from mlbatch.clocks.host_offset import HostOffset, describe_off
from mlbatch.clocks.timescale import format_difference, timescale
from mlbatch.clocks.watch import ClockEstimate
from mlbatch.discovery.discover import (
    Discovery,
    SensorSelection,
    discover,
    lacks_decoder,
    name_kind,
    packet_types,
)
from mlbatch.discovery.first_seconds import is_without_packets
from mlbatch.discovery.interleaved import shared_address
from mlbatch.discovery.match import describe, describe_each
from mlbatch.discovery.overlap import SharedLidars, iso
from mlbatch.discovery.router import Role
from mlbatch.discovery.sampler import MOST_KINDS, split_by_kind
from mlbatch.discovery.types import DetectedSensor, PacketKind
from mlbatch.errors import MlbatchError, RecordingError, RigError
from mlbatch.native.arena import PacketArena
from mlbatch.outputs.inputs import open_inputs
from mlbatch.pipeline.cloud_times import CloudTimes, TimeFinding
from mlbatch.pipeline.contents import (
    RecordingReport,
    TopicCounter,
    TopicReport,
    recording_report,
)
from mlbatch.pipeline.ingest import Ingest
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.sensor import sensors_of
from mlbatch.readers.bag.clouds import CloudRecording
from mlbatch.reports.json_records import to_json
from mlbatch.reports.poses import PoseFigures
from mlbatch.rig.rig import (
    DEFAULT_BODY_FRAME,
    Rig,
    RigSensor,
    StreamSelector,
    UnknownExtrinsics,
)
from mlbatch.rig.write import write_rig
from mlbatch.types import PacketBatch, Recording, StreamTable
from mlbatch.units import NS_PER_MS, NS_PER_S

# Called with the bytes read so far, and with those of all recordings.
Progress = Callable[[int, int], object]
# Fewer pairs of clocks are described in words, not by a matrix.
_FEWEST_PAIRS = 3
# Windows from which poses are checked.
_MOST_WINDOWS = 32
MS_PER_S = NS_PER_S // NS_PER_MS
HEAD = (
    "stream",
    "what",
    "sensor",
    "packets",
    "Hz",
    "lost",
    "seconds",
    "clock",
    "calibration",
    "extrinsics",
    "missing",
)
_MEASURE = (
    "extrinsics not known: replace `unknown` by {translation_m: [x, y, z], "
    "rotation_rpy_deg: [r, p, y]}; a guess within 1 m and 20 degrees is refined by mlbatch "
    "calibrate"
)
# Warnings that concern a conversion; the table shows missing metadata and decoders.
_CONVERSION_ONLY = frozenset({"no_decoder", "no_metadata", "not_seen_yet", "identity_extrinsics"})


@dataclass(frozen=True, slots=True)
class StreamReport:
    """One packet kind: origin, description, counts; times are receive times."""

    stream: str
    what: str = ""
    sensor: str = ""
    model: str = ""
    mode: str = ""
    serial: str = ""
    bytes: int = 0
    packets: int = 0
    rate_hz: float = 0.0
    lost: int | None = None
    first_host_ns: int = 0
    last_host_ns: int = 0
    timescale: str = ""
    offset_ms: float | None = None  # clock minus the capture host's
    calibration: str = ""
    extrinsics: str = ""  # their source, or ""
    missing: str = ""

    def row(self) -> list[str]:
        """Cells of the table, as HEAD."""
        clock = self.timescale
        if self.offset_ms is not None:
            is_near = abs(self.offset_ms) < MS_PER_S
            offset = (
                f"{self.offset_ms:+.3f} ms" if is_near else f"{self.offset_ms / MS_PER_S:+.3f} s"
            )
            clock += f" {offset}"
        return [
            self.stream,
            self.what,
            self.sensor,
            str(self.packets),
            f"{self.rate_hz:.1f}",
            "" if self.lost is None else str(self.lost),
            f"{(self.last_host_ns - self.first_host_ns) / NS_PER_S:.3f}",
            clock,
            self.calibration,
            self.extrinsics,
            self.missing,
        ]


TOPIC_HEAD = ("other topic", "type", "messages", "Hz")
RECORDING_HEAD = ("recording", "container", "MB", "start", "seconds")
_BYTES_PER_MB = 1_000_000


@dataclass(frozen=True, slots=True, repr=False)
class Inspection:
    """All streams of the first 10 seconds of a session, or of all of it."""

    streams: tuple[StreamReport, ...]  # one for each packet kind
    sensors: tuple[DetectedSensor, ...]
    body_frame: str = DEFAULT_BODY_FRAME
    # Metadata of sensors that are files, by name of the sensor.
    files: dict[str, Path] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    clocks: Comparison | None = None  # None without timestamps
    whole: bool = False  # counts, loss and clocks are those of whole recordings
    recordings: tuple[RecordingReport, ...] = ()
    topics: tuple[TopicReport, ...] = ()  # without packets
    point_times: tuple[TimeFinding, ...] = ()  # of decoded clouds
    poses: PoseFigures | None = None  # None: one lidar

    def __repr__(self) -> str:
        """The lidars, in a line."""
        names = ", ".join(f"{one.name} {one.lidar.model}" for one in self.sensors)
        return f"<Inspection of {len(self.streams)} streams: {names or 'no lidar'}>"

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>"
            for row in (HEAD, *(one.row() for one in self.streams))
        )
        return f"<table>{rows}</table>"

    @property
    def first_host_ns(self) -> int | None:
        """Earliest receive time of a packet or log time of a message."""
        firsts = [one.first_host_ns for one in self.streams]
        firsts += [one.first_host_ns for one in self.topics if one.messages]
        return min(firsts, default=None)

    @property
    def last_host_ns(self) -> int | None:
        """Newest receive or log time; None where only `whole` shows it."""
        lasts = [one.last_host_ns for one in self.streams]
        lasts += [one.last_host_ns for one in self.topics if one.messages]
        ends = [one.last_host_ns for one in self.recordings]
        known = [end for end in ends if end is not None]
        if not self.whole and len(known) < len(ends):
            return None
        # The last packets of a file may be fragments, which only reading joins.
        return max([*lasts, *known], default=None)

    @property
    def duration_s(self) -> float | None:
        """Time from the first to the last packet or message, by the capture host."""
        if self.first_host_ns is None or self.last_host_ns is None:
            return None
        return (self.last_host_ns - self.first_host_ns) / NS_PER_S

    def recording_rows(self) -> list[list[str]]:
        """The recordings, head first; start and duration of all together are in the first row."""
        rows = [
            [one.path, one.container, f"{one.bytes / _BYTES_PER_MB:.1f}", "", ""]
            for one in self.recordings
        ]
        if rows and self.first_host_ns is not None:
            duration_s = self.duration_s
            rows[0][3] = iso(self.first_host_ns)
            rows[0][4] = "see --whole" if duration_s is None else f"{duration_s:.3f}"
        return [list(RECORDING_HEAD), *rows]

    def topic_rows(self) -> list[list[str]]:
        """Topics without packets, head first."""
        return [
            list(TOPIC_HEAD),
            *(
                [one.topic, one.type, str(one.messages), f"{one.rate_hz:.1f}"]
                for one in self.topics
            ),
        ]

    def rows(self) -> list[list[str]]:
        """The table, head first."""
        return [list(HEAD), *(stream.row() for stream in self.streams)]

    def as_json(self) -> dict[str, object]:
        """The JSON document of `--json`."""
        return {
            "schema": "mlbatch.inspect/1",
            "whole": self.whole,
            "recordings": [asdict(one) for one in self.recordings],
            "start": None if self.first_host_ns is None else iso(self.first_host_ns),
            "duration_s": self.duration_s,
            "streams": [asdict(stream) for stream in self.streams],
            "topics": [asdict(topic) for topic in self.topics],
            "notes": list(self.notes),
            "point_times": [asdict(one) for one in self.point_times],
            "clocks": {} if self.clocks is None else _clocks_as_json(self.clocks),
            **({} if self.poses is None else {"poses": to_json(self.poses)}),
        }

    def pose_lines(self) -> list[str]:
        """How the surfaces that lidars see fit, as text."""
        if self.poses is None:
            return []
        known = [pair for pair in self.poses.pairs if pair.is_known]
        return [f"poses: {pair.describe()}" for pair in known] or [self.poses.describe()]

    def clock_lines(self) -> list[str]:
        """Verdicts on the clocks, as text; of many pairs only the ones that need attention."""
        if self.clocks is None:
            return []
        lines = self.clocks.describe()
        pairs = self.clocks.pairs
        if len(pairs) < _FEWEST_PAIRS:
            return lines
        reference = self.clocks.reference
        shown = [
            pair.describe()
            for pair in pairs
            if pair.verdict != SYNCHRONISED and reference in (pair.one, pair.two)
        ]
        return [*lines[: len(lines) - len(pairs)], *shown]

    def clock_matrix(self) -> list[list[str]]:
        """Differences of the clocks, row minus column, head first; empty for one pair."""
        if self.clocks is None or len(self.clocks.pairs) < _FEWEST_PAIRS:
            return []
        names = [name for name, _ in self.clocks.estimates]
        apart = self._apart_ns()
        head = ["clock minus clock", *(str(number) for number, _ in enumerate(names, 1))]
        rows = [
            [f"{number} {name}", *(format_difference(apart[name, other]) for other in names)]
            for number, name in enumerate(names, 1)
        ]
        return [head, *rows]

    def clocks_to_reference(self) -> list[list[str]]:
        """The first column of the matrix, from which the others follow; row 0 is the head."""
        if self.clocks is None:
            return []
        reference = self.clocks.reference
        apart = self._apart_ns()
        rows = [
            [name, format_difference(apart[name, reference])] for name, _ in self.clocks.estimates
        ]
        return [["clock", f"minus clock of {reference}"], *rows]

    def _apart_ns(self) -> dict[tuple[str, str], int]:
        """How far the first clock of each pair is ahead of the second, both ways."""
        apart = {}
        for name, _ in () if self.clocks is None else self.clocks.estimates:
            apart[name, name] = 0
        for pair in () if self.clocks is None else self.clocks.pairs:
            middle_ns = (pair.low_ns + pair.high_ns) // 2
            apart[pair.two, pair.one] = middle_ns
            apart[pair.one, pair.two] = -middle_ns
        return apart

    def rig_text(self, folder: Path) -> str:
        """A rig file for these sensors; extrinsics without a source are `unknown`."""
        if not self.sensors:
            raise RigError(
                "--write-rig: expected at least one lidar with its metadata, found none; "
                "give --metadata FILE"
            )
        sensors = []
        comments = {}
        for sensor in self.sensors:
            extrinsics: F64Array | UnknownExtrinsics = UnknownExtrinsics()
            comments[sensor.name] = _MEASURE
            if sensor.pose.is_known:
                extrinsics = sensor.pose.body_from_sensor
                comments[sensor.name] = f"extrinsics of {sensor.pose.describe()}"
            sensors.append(
                RigSensor(
                    name=sensor.name,
                    stream=sensor.selector,
                    metadata=self.files.get(sensor.name),
                    extrinsics=extrinsics,
                    points=None if sensor.rig is None else sensor.rig.points,
                    sweeps=None if sensor.rig is None else sensor.rig.sweeps,
                )
            )
        # A rig refuses a body frame with the name of a sensor.
        names = {sensor.name for sensor in self.sensors}
        body_frame = DEFAULT_BODY_FRAME if self.body_frame in names else self.body_frame
        return write_rig(Rig(tuple(sensors), body_frame), folder, comments)


def inspect(
    recordings: Sequence[Path],
    metadata: Sequence[Path],
    *,
    rig: Path | None = None,
    whole: bool = False,
    progress: Progress | None = None,
) -> Inspection:
    """Inspect the first 10 s of recordings, with the metadata given or in their directories.

    rig: its sensors and names; whole: count packets and measure loss and clocks on the whole
    recordings; progress: called with the bytes read so far, and those of all recordings.
    """
    table = StreamTable()
    discovery = discover(
        open_inputs(recordings, table, rig),
        table,
        SensorSelection(rig=rig, metadata=tuple(metadata), identity_extrinsics=True),
        to_convert=False,
    )
    early = frozenset(discovery.sampler.kinds)
    topics = TopicCounter(discovery.recordings, (one.topic for one in table.streams))
    cloud_times = CloudTimes(discovery)
    measured = _measure(discovery, topics, cloud_times, progress, whole=whole)
    types = packet_types(discovery.recordings)
    for recording in () if discovery.sampler.kinds or types else discovery.recordings:
        # Damage is all that it contains.
        if not recording.topics and recording.notes:
            raise RecordingError(
                f"{recording.path}: expected packets or messages, found none "
                f"({'; '.join(recording.notes)}); record or copy it again"
            )
    streams = tuple(
        _stream_report(discovery, kind, measured, types) for kind in discovery.sampler.kinds
    )
    for sensor in discovery.sensors:
        sensor.selector = _selector(table, sensor)
    known = measured.estimates()
    files = {str(path): path for path in discovery.examined}
    return Inspection(
        streams=streams,
        sensors=tuple(discovery.sensors),
        body_frame=discovery.frame_id,
        files={
            sensor.name: files[sensor.lidar.calibration]
            for sensor in discovery.sensors
            if sensor.lidar.calibration in files
        },
        notes=(
            *_notes(discovery),
            *_late_notes(discovery, early),
            *measured.other_lidars(),
            # One by one: they may not be comparable.
            *filter(None, (describe_off([HostOffset.measured(*one)]) for one in known)),
            *([] if rig is not None else _dataset_notes(discovery)),
        ),
        clocks=compare(known) if known else None,
        whole=whole,
        recordings=tuple(map(recording_report, discovery.recordings)),
        topics=tuple(topics.reports()),
        point_times=tuple(cloud_times.findings()),
        poses=_poses(discovery, Job(tuple(recordings), SensorSelection(rig, tuple(metadata)))),
    )


def _poses(discovery: Discovery, job: Job) -> PoseFigures | None:
    """The check of the poses by the first windows; None for one lidar."""
    if len(discovery.sensors) < 2:
        return None
    unknown = [sensor.name for sensor in discovery.sensors if not sensor.pose.is_known]
    if unknown:
        return PoseFigures(f"the pose of {', '.join(unknown)} is not known")
    # Not loaded where poses are not known.
    from mlbatch.pipeline.conversion import Conversion

    try:
        run = Conversion(job)
        check = run.pose_check
        if check is None:
            return None
        with contextlib.closing(run.windows()) as windows:
            for window in windows:
                check.add(window)
                if check.is_over or window.index >= _MOST_WINDOWS:
                    break
        return check.figures()
    except MlbatchError:
        # What is wrong, `convert` says.
        return PoseFigures("the recording cannot be converted as it is")


def _late_notes(discovery: Discovery, early: Collection[PacketKind]) -> Iterator[str]:
    """Lidars that began after the first 10 s, in which sensors are detected; early: kinds then."""
    sampler = discovery.sampler
    owned = {kind for sensor in discovery.sensors for kind in sensor.kinds}
    for kind in sampler.kinds:
        what = "" if kind in early or kind in owned else describe(sampler, kind) or ""
        if "lidar" in what:
            yield (
                f"{sampler.table.streams[kind.stream]}: {what}; it started after the first 10 s, "
                "in which sensors are detected; name the sensor in a rig file (--rig)"
            )


def _dataset_notes(discovery: Discovery) -> Iterator[str]:
    """The public dataset that recordings may be of."""
    topics = {topic.name for recording in discovery.recordings for topic in recording.topics}
    if topics:
        from mlbatch.rig.recipes import by_topics, proposal

        yield from filter(None, [proposal(by_topics(topics))])


def _selector(table: StreamTable, sensor: DetectedSensor) -> StreamSelector:
    """How a rig identifies the packets of a sensor."""
    if sensor.lidar.carries_serial:
        return StreamSelector(serial=sensor.lidar.serial)
    stream = table.streams[min(sensor.kinds).stream]
    return StreamSelector(
        stream.source_ip,
        stream.port,
        stream.topic,
        frame_id=stream.frame_id,
        lidar_id=stream.lidar_id,
    )


def _notes(discovery: Discovery) -> Iterator[str]:
    """Notes on damage, times of clouds, calibrations, contradictions, shared addresses, lidars."""
    texts = [(recording, text) for recording in discovery.recordings for text in recording.notes]
    clouds = [one for one in discovery.recordings if isinstance(one, CloudRecording)]
    texts += [(recording, text) for recording in clouds for text in recording.verdicts]
    for recording, text in texts:
        yield f"{recording.path.name}: {text}"
    yield from discovery.unusable
    for note in discovery.notes:
        if note.code not in _CONVERSION_ONLY:
            yield note.message
    for sensor in discovery.sensors:
        if sensor.lidar.unproven:
            yield f"{sensor.name}: {Path(sensor.lidar.calibration).name}: {sensor.lidar.unproven}"
        problem = shared_address(discovery.sampler, sensor)
        if problem:
            yield problem
    unfollowed = discovery.sampler.kind_filter
    if unfollowed.packets:
        yield (
            f"{unfollowed.packets} packets of at least {unfollowed.kinds} other streams or sizes "
            f"are not listed: only the first {MOST_KINDS} are, and those that a vendor recognises"
        )
    if not discovery.sampler.kinds:
        yield "no UDP packet in the first 10 seconds"
    elif not discovery.sensors:
        names = ", ".join(path.name for path in discovery.examined) or "none"
        yield f"no lidar with its metadata; files examined: {names}"


# -- loss and clocks ------------------------------------------------------------------------------


class _Measured:
    """Packets as a run accepts them: their loss and clocks by sensor, and packets of no sensor.

    firsts: of each sensor, its first timestamp and its receive time, ns; sent: kinds with a packet
    of it; one that begins late may be of another.
    """

    def __init__(self, discovery: Discovery) -> None:
        self._discovery = discovery
        self._arena = PacketArena()
        self._sensors = sensors_of(discovery, Job(()), self._arena)
        self.firsts: list[tuple[int, int] | None] = [None for _ in self._sensors]
        self.sent: list[set[PacketKind]] = [set() for _ in self._sensors]
        # Steps of a clock are shown, not refused: loss is counted as with `--clock host`, and
        # clocks are watched before anything is rejected, as for `--align-clocks`.
        self.intakes = [sensor.intake(host_clock=True) for sensor in self._sensors]
        self._losses = Ingest(discovery.router, self._sensors, self.intakes)
        shown = [sensor.unread(self._arena) for sensor in self._sensors]
        self._ingest = Ingest(discovery.router, shown, [sensor.clock_intake() for sensor in shown])

    def add(self, batch: PacketBatch) -> None:
        """Add all packets of a batch."""
        self._arena.keep_from(None)
        self._losses.columns(batch)
        for number, accepted in enumerate(self._ingest.columns(batch).accepted):
            if accepted is None or not len(accepted.host_ns):
                continue
            kinds = split_by_kind(batch.take(accepted.position))
            self.sent[number].update(kind for kind, _ in kinds)
            valid = accepted.columns.valid
            if self.firsts[number] is None and valid.any():
                row, column = np.argwhere(valid)[0]
                stamp_ns = int(accepted.columns.stamp_ns[row, column])
                self.firsts[number] = stamp_ns, int(accepted.host_ns[row])

    def estimates(self) -> list[tuple[str, ClockEstimate]]:
        """Name and clock of each sensor whose packets have receive times."""
        found = ((sensor.name, sensor.clock.watch.estimate()) for sensor in self._sensors)
        return [(name, estimate) for name, estimate in found if estimate is not None]

    def offset_ns(self, number: int) -> int | None:
        """Clock minus the capture host's; by the log time of a message where that is all."""
        estimate = self._sensors[number].clock.watch.estimate()
        if estimate is not None:
            return estimate.offset_ns
        first = self.firsts[number]
        return None if first is None else first[0] - first[1]

    def other_lidars(self) -> Iterator[str]:
        """Lidars that share the address of a sensor."""
        kinds = {kind for sensor in self._discovery.sensors for kind in sensor.kinds}
        for (kind, _), packets in sorted(self._ingest.unassigned.items(), key=lambda one: one[0]):
            what = describe_each(kind.size, packets.sample) if kind in kinds else None
            if what is not None and "lidar" in what:
                stream = self._discovery.sampler.table.streams[kind.stream]
                yield (
                    f"{stream}: {what} as well; {packets.packets} packets are of no sensor; "
                    "give its --metadata"
                )


def _measure(
    discovery: Discovery,
    topics: TopicCounter,
    cloud_times: CloudTimes,
    progress: Progress | None,
    *,
    whole: bool,
) -> _Measured:
    """Loss and clock of each sensor, in the first seconds or the whole session.

    topics: gets the messages of the others; cloud_times: the decoded clouds; whole: packets of all
    kinds are counted again, with those that begin later.
    """
    sampler = discovery.sampler
    if whole:
        sampler.restart_counts()
    late: set[PacketKind] = set()
    measured = _Measured(discovery)
    recordings = discovery.recordings
    size_bytes = sum(recording.size_bytes for recording in recordings)
    shared = SharedLidars()

    def compare(recording: Recording, batch: PacketBatch | None) -> None:
        if batch is None:
            return
        for kind, index in split_by_kind(batch):
            for sensor in discovery.sensors:
                if kind in sensor.kinds:
                    shared.add(recording, sensor, batch, index)

    read = discovery.first.whole if whole else discovery.first.again
    for batch in read(is_without_packets, compare):
        topics.add(batch.messages)
        if progress is not None:
            progress(sum(recording.position_bytes for recording in recordings), size_bytes)
        if whole:
            for kind, index in sampler.kind_filter.followed(batch, split_by_kind(batch)):
                if sampler.count(kind, index, batch):
                    late.add(kind)
        measured.add(batch)
        cloud_times.add(batch)
    for sensor, sent in zip(discovery.sensors, measured.sent, strict=True):
        sensor.kinds -= late - sent
    return measured


def _clocks_as_json(clocks: Comparison) -> dict[str, object]:
    """Clocks in the JSON document; times in ms, receive times in ns."""
    return {
        "verdict": clocks.verdict,
        "bound_ms": None if clocks.bound_ns is None else clocks.bound_ns / NS_PER_MS,
        "lines": clocks.describe(),
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
            for name, finding in clocks.estimates
        ],
    }


# -- streams --------------------------------------------------------------------------------------


def _stream_report(
    discovery: Discovery,
    kind: PacketKind,
    measured: _Measured,
    types: Mapping[str, str],
) -> StreamReport:
    """Report of one kind; types: message types by topic."""
    sampler = discovery.sampler
    samples = sampler.kinds[kind]
    # Routing first: it may add a kind to its sensor.
    route = discovery.router.route(kind, samples.arrays()[0][0])
    span_ns = samples.last_host_ns - samples.first_host_ns
    report = StreamReport(
        stream=str(sampler.table.streams[kind.stream]),
        bytes=kind.size,
        packets=samples.packets,
        rate_hz=(samples.packets - 1) * NS_PER_S / span_ns if span_ns > 0 else 0.0,
        first_host_ns=samples.first_host_ns,
        last_host_ns=samples.last_host_ns,
    )
    owners = (number for number, one in enumerate(discovery.sensors) if kind in one.kinds)
    number = next(owners, None)
    if number is None:
        what = describe(sampler, kind) or ""
        missing = "decoder" if lacks_decoder(what) else "metadata" if "lidar" in what else ""
        is_owned = route.role in (Role.IMU, Role.BAD_SIZE)
        return replace(
            report,
            what=name_kind(sampler, kind, types),
            sensor=discovery.sensors[route.sensors[0]].name if is_owned else "",
            missing=missing,
        )
    sensor = discovery.sensors[number]
    lidar = sensor.lidar
    first = measured.firsts[number]
    offset_ns = measured.offset_ns(number)
    return replace(
        report,
        what=f"{lidar.model} {lidar.mode}",
        sensor=sensor.name,
        model=lidar.model,
        mode=lidar.mode,
        serial=lidar.serial,
        lost=measured.intakes[number].loss.lost,
        timescale="" if first is None else timescale(*first),
        offset_ms=None if offset_ns is None else offset_ns / NS_PER_MS,
        calibration=Path(lidar.calibration).name,
        extrinsics=sensor.pose.describe() if sensor.pose.is_known else "",
    )
