"""`mlbatch extract`: raw packets of chosen lidars and times, unchanged, into another container.

One pass. Payloads and receive times stay as they are; every packet that is read is written, or
counted under a reason. Metadata go along: as messages where the container stores those of the
recording, else as files next to it, with a rig.
"""

from __future__ import annotations

import contextlib
import os
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from mlbatch.arrays import BoolArray, I64Array
from mlbatch.batching.windows import Limit
from mlbatch.discovery.calibrations import is_metadata
from mlbatch.discovery.discover import Discovery, SensorSelection, discover
from mlbatch.discovery.first_seconds import is_without_packets
from mlbatch.errors import UsageError
from mlbatch.frames.tree import some
from mlbatch.native import require_library
from mlbatch.pipeline.extract_places import Assigned, ChosenLidar, Place, Places, side_files
from mlbatch.pipeline.passthrough import MessageQueue
from mlbatch.pipeline.time_limits import refuse_outside, text_of_range
from mlbatch.readers import has_packets, open_recordings
from mlbatch.readers.byte_records import SLACK
from mlbatch.ros.packet_writing import Stamped
from mlbatch.types import Message, PacketBatch, Recording, StreamTable, Topic
from mlbatch.units import NS_PER_S
from mlbatch.writers.atomic import Output, check_name, discard, export_errors, prepare
from mlbatch.writers.recordings import (
    ENCODINGS,
    MOST_HOST_NS,
    MOST_UDP_BYTES,
    PCAP,
    Bag,
    PcapFile,
    frame_head,
    new_bag,
)

# Why packets are left out: of no chosen lidar; received before --start or from --end on; the
# container has no message for them, or no room for their size or time.
REASONS = ("not_chosen", "outside_time", "no_place")
# Reading ends so much after the end: the receive times of bags and of several queues step back.
_AFTER_END_NS = 10 * NS_PER_S
_KIND_BITS = 17


@dataclass(frozen=True, slots=True)
class Extraction:
    """A request of `extract`; start, end: receive times, `from_t_init` after the first packet.

    duration_ns: instead of an end; passed: patterns of topics to copy.
    """

    recordings: tuple[Path, ...]
    output: Path
    selection: SensorSelection = field(default_factory=SensorSelection)
    start: Limit | None = None
    end: Limit | None = None
    duration_ns: int | None = None
    passed: tuple[str, ...] = ()
    overwrite: bool = False


@dataclass(slots=True)
class Extracted:
    """Result: read = written + sum(left_out), packets by REASONS.

    files: the recording first; messages: copied, without packets; first_ns, last_ns: receive times
    of what was written; frames: those without a packet, by reason; is_short: the recording has
    more, which was not read; notes: warnings.
    """

    lidars: Sequence[ChosenLidar]
    files: tuple[Path, ...]
    read: int = 0
    left_out: dict[str, int] = field(default_factory=lambda: dict.fromkeys(REASONS, 0))
    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    frames: Counter[str] = field(default_factory=Counter)
    is_short: bool = False
    notes: list[str] = field(default_factory=list)

    @property
    def written(self) -> int:
        """Packets that were written."""
        return sum(lidar.written for lidar in self.lidars)

    def rows(self) -> list[tuple[str, ...]]:
        """A table of the lidars, head first."""
        head = ("lidar", "model", "to", "packets", "written")
        return [
            head,
            *(
                (one.name, one.model, one.place, str(one.read), str(one.written))
                for one in self.lidars
            ),
        ]

    def lines(self) -> list[str]:
        """The ledger and the files, in words."""
        parts = [f"{self.written} written", *(f"{n} {why}" for why, n in self.left_out.items())]
        seconds = (self.last_ns - self.first_ns) / NS_PER_S
        found = [
            f"read {self.read} packets: {', '.join(parts)}",
            f"received within {seconds:.3f} s",
        ]
        if self.messages:
            found[-1] += f"; {self.messages} messages copied"
        if self.frames:
            reasons = ", ".join(f"{count} {why}" for why, count in sorted(self.frames.items()))
            found.append(f"frames without a packet: {reasons}")
        if self.is_short:
            found.append("what was recorded later was not read")
        return [*found, f"wrote {', '.join(path.name for path in self.files)}"]


def extract(request: Extraction, progress: Callable[[int, int], object] | None = None) -> Extracted:
    """Extract packets; nothing has its final name before all is complete.

    progress: called with the bytes read so far, and with those of all recordings.
    """
    target = request.output
    _check_target(request)
    require_library()
    selection = replace(request.selection, identity_extrinsics=True)
    table = StreamTable()
    opened = open_recordings(request.recordings, table, selection.rig)
    setup = discover(opened, table, selection, to_convert=False)
    if not setup.sensors and not setup.noted:
        # For its reasons.
        discover(opened, table, selection)
    encodings = ENCODINGS[target.suffix]
    topics = _forwarded(setup.recordings, request, encodings)
    places = Places(setup, encodings)
    _refuse_without_place(places, target)
    selects = bool(selection.only or selection.ignore)
    texts = side_files(places, target, topics, selects=selects)
    outputs: list[Output] = []
    try:
        paths = [target, *texts]
        outputs.extend(prepare(path, request.overwrite, folder=False) for path in paths)
        with export_errors(target):
            for output in outputs[1:]:
                output.partial.write_bytes(texts[output.target])
            run = _Run(setup, places, request, topics, outputs[0].partial, tuple(paths))
            run.write(progress)
        # The recording last: with it the others are complete.
        for output in (*outputs[1:], outputs[0]):
            output.publish()
    except BaseException:
        for output in outputs:
            discard(output.target)
        raise
    return run.found


def _check_target(request: Extraction) -> None:
    target = request.output
    if target.suffix not in ENCODINGS:
        raise UsageError(
            f"-o: expected a name that ends with {', '.join(ENCODINGS)}, found {target.name}; "
            "choose one of these"
        )
    if request.passed and not ENCODINGS[target.suffix]:
        raise UsageError(
            f"--pass: expected a bag, which stores messages, found {target.name}; leave it out, or "
            "write a .mcap"
        )
    check_name(target)
    for path in request.recordings:
        if path.exists() and target.exists() and os.path.samefile(path, target):
            raise UsageError(
                f"-o: expected another file than the recordings, found {target}; choose another"
            )


def _refuse_without_place(places: Places, target: Path) -> None:
    """Raise UsageError for a lidar with packets that the container cannot store."""
    for number, lidar in enumerate(places.lidars):
        place = places.main_place(number)
        if place is None or place.to is not None:
            continue
        source = places.setup.sampler.table.streams[place.stream]
        remedy = f"write a .pcap, or --ignore {lidar.name}"
        what = "packets that ROS drivers publish"
        if source.topic:
            remedy = f"--ignore {lidar.name}"
            what = "raw packets"
        raise UsageError(
            f"{target.name}: {lidar.name}: expected {what}, found those of {lidar.model} on "
            f"{source}, which have no place in it; {remedy}"
        )


def _forwarded(
    recordings: Sequence[Recording], request: Extraction, encodings: tuple[str, ...]
) -> frozenset[Topic]:
    """Topics to copy: calibrations and transforms, and those of `--pass`."""
    MessageQueue(request.passed, frozenset()).refuse_unknown(recordings)
    found = set()
    for topic in (topic for recording in recordings for topic in recording.topics):
        is_asked = any(fnmatchcase(topic.name, pattern) for pattern in request.passed)
        if has_packets(topic) or not (is_asked or is_metadata(topic)):
            continue
        if topic.encoding in encodings:
            found.add(topic)
        elif is_asked:
            raise UsageError(
                f"--pass {topic.name}: expected messages encoded as {' or '.join(encodings)} for "
                f"{request.output.name}, found {topic.encoding!r}; do not pass it"
            )
    return frozenset(found)


# -- packets ----------------------------------------------------------------------------------


class _Run:
    """Writes the recording; found: counts so far, complete once it is written."""

    def __init__(
        self,
        setup: Discovery,
        places: Places,
        request: Extraction,
        topics: frozenset[Topic],
        path: Path,
        files: tuple[Path, ...],
    ) -> None:
        self.found = Extracted(places.lidars, files)
        self._setup = setup
        self._places = places
        self._topics = topics
        self._begin_ns, self._end_ns = _limits(request, setup, places.lidars)
        suffix = request.output.suffix
        self._pcap = PcapFile(path) if suffix == PCAP else None
        self._bag: Bag | None = None if suffix == PCAP else new_bag(path, suffix)
        # Of REASONS the last, by stream and size.
        self._without_place = Counter[tuple[int, int]]()
        # Received, by the recording; written.
        self._received_ns: tuple[int, int] | None = None
        self._written_ns: tuple[int, int] | None = None
        # Messages up to the next packets, by log time; latched ones that were written.
        self._waiting: deque[Message] = deque()
        self._latched: set[int] = set()
        # The newest of a device from before the start, by place and size.
        self._early: dict[tuple[int, int], tuple[int, Stamped]] = {}

    def write(self, progress: Callable[[int, int], object] | None) -> None:
        """Read all packets up to the end, and write those that are chosen."""
        recordings = self._setup.recordings
        names = frozenset(topic.name for topic in self._topics)
        for recording in recordings:
            recording.keep = names
        try:
            self._read_all(recordings, progress)
            if self._bag is not None:
                for place in self._places.places:
                    last_ns = self._written_ns[1] if self._written_ns else 0
                    for message in place.messages.rest(last_ns) if place.messages else ():
                        self._bag.forward(message)
                self._forward_until(None)
        except BaseException:
            # Completing a file may fail as well, perhaps on the disk that is full.
            with contextlib.suppress(Exception):
                self._close()
            raise
        self._close()
        self._refuse_nothing()
        self._complete()

    def _close(self) -> None:
        for file in (self._pcap, self._bag):
            if file is not None:
                file.close()

    def _read_all(
        self, recordings: Sequence[Recording], progress: Callable[[int, int], object] | None
    ) -> None:
        with contextlib.closing(self._setup.first.whole(is_without_packets)) as batches:
            for batch in batches:
                if self._is_beyond(batch):
                    self.found.is_short = True
                    return
                self._add_messages(batch.messages)
                self._add(batch)
                if progress is not None:
                    done = sum(recording.position_bytes for recording in recordings)
                    progress(done, sum(recording.size_bytes for recording in recordings))

    def _is_beyond(self, batch: PacketBatch) -> bool:
        if self._end_ns is None or not len(batch):
            return False
        return int(batch.host_ns.min()) >= self._end_ns + _AFTER_END_NS

    def _add(self, batch: PacketBatch) -> None:
        if not len(batch):
            self._forward_until(None)
            return
        self.found.read += len(batch)
        first_ns, last_ns = self._received_ns or (int(batch.host_ns.min()), 0)
        self._received_ns = first_ns, max(last_ns, int(batch.host_ns.max()))
        assigned = self._places.assign(batch)
        is_chosen = assigned.place >= 0
        for number, count in enumerate(np.bincount(assigned.lidar[is_chosen]).tolist()):
            self._places.lidars[number].read += count
        left_out = self.found.left_out
        left_out["not_chosen"] += len(batch) - int(is_chosen.sum())
        is_inside = np.ones(len(batch), np.bool_)
        if self._begin_ns is not None:
            is_inside &= batch.host_ns >= self._begin_ns
        if self._end_ns is not None:
            is_inside &= batch.host_ns < self._end_ns
        outside = np.flatnonzero(is_chosen & ~is_inside)
        left_out["outside_time"] += len(outside)
        self._keep_early(batch, assigned, outside)
        rows = np.flatnonzero(is_chosen & is_inside)
        if len(rows):
            self._put_early()
            self._put(batch.take(rows), assigned.lidar[rows], assigned.place[rows])
        self._forward_until(None)

    # -- what a lidar said of itself before the start ---------------------------------------------

    def _keep_early(self, batch: PacketBatch, assigned: Assigned, rows: I64Array) -> None:
        """Keep the newest packets of devices from before the start, which calibrate lidars."""
        if self._begin_ns is None or self._written_ns is not None:
            return
        for row in rows[assigned.is_device[rows]].tolist():
            if batch.host_ns[row] < self._begin_ns:
                begin, size = int(batch.start[row]), int(batch.size[row])
                payload = batch.data[begin : begin + size].tobytes()
                packet = Stamped(int(batch.host_ns[row]), payload)
                self._early[int(assigned.place[row]), size] = int(assigned.lidar[row]), packet

    def _put_early(self) -> None:
        """Write what was kept, before the first packets."""
        if not self._early:
            return
        found = sorted(self._early.items(), key=lambda item: item[1][1].host_ns)
        self._early = {}
        self.found.left_out["outside_time"] -= len(found)
        size = np.array([key[1] for key, _ in found])
        data = b"".join(packet.payload for _, (_, packet) in found) + bytes(SLACK)
        place = np.array([key[0] for key, _ in found])
        batch = PacketBatch(
            np.frombuffer(data, np.uint8),
            np.cumsum(size) - size,
            size,
            np.array([self._places.places[one].stream for one in place.tolist()]),
            np.array([packet.host_ns for _, (_, packet) in found]),
        )
        self._put(batch, np.array([lidar for _, (lidar, _) in found]), place)

    # -- writing ------------------------------------------------------------------------------

    def _put(self, batch: PacketBatch, lidar: I64Array, place: I64Array) -> None:
        """Write packets; lidar, place: (n,) of each."""
        if self._pcap is not None:
            is_written = self._put_frames(self._pcap, batch, place)
        else:
            is_written = np.array(list(self._put_messages(batch, place)), np.bool_)
        for row in np.flatnonzero(~is_written).tolist():
            self._without_place[int(batch.stream[row]), int(batch.size[row])] += 1
        self.found.left_out["no_place"] += len(batch) - int(is_written.sum())
        if not is_written.any():
            return
        for number, count in enumerate(np.bincount(lidar[is_written]).tolist()):
            self._places.lidars[number].written += count
        host_ns = batch.host_ns[is_written]
        first_ns, last_ns = self._written_ns or (int(host_ns.min()), 0)
        self._written_ns = min(first_ns, int(host_ns.min())), max(last_ns, int(host_ns.max()))

    def _put_frames(self, pcap: PcapFile, batch: PacketBatch, place: I64Array) -> BoolArray:
        fits: BoolArray = (batch.size <= MOST_UDP_BYTES) & (batch.host_ns >= 0)
        fits &= batch.host_ns < MOST_HOST_NS
        for number in np.unique(place).tolist():
            if self._places.places[number].to is None:
                fits &= place != number
        keys, head = np.unique(place[fits] << _KIND_BITS | batch.size[fits], return_inverse=True)
        heads = []
        for key in keys.tolist():
            to = self._places.places[key >> _KIND_BITS].to
            if to is not None:
                heads.append(frame_head(to.source_ip, to.port, key & ((1 << _KIND_BITS) - 1)))
        pcap.packets(batch.take(np.flatnonzero(fits)), heads, head)
        return fits

    def _put_messages(self, batch: PacketBatch, place: I64Array) -> Iterator[bool]:
        """Write packets in messages; yield for each whether it has a place."""
        data = batch.data.data
        untimed = self._setup.sampler.table.untimed
        rows = zip(
            place.tolist(),
            batch.start.tolist(),
            batch.size.tolist(),
            batch.host_ns.tolist(),
            strict=True,
        )
        for number, begin, size, host_ns in rows:
            to: Place = self._places.places[number]
            packet = Stamped(host_ns, bytes(data[begin : begin + size]))
            if self._bag is None or to.messages is None or not to.messages.fits(packet):
                yield False
                continue
            self._forward_until(host_ns)
            for message in to.messages.add(packet, is_timed=to.stream not in untimed):
                self._bag.forward(message)
            yield True

    # -- messages -----------------------------------------------------------------------------

    def _add_messages(self, messages: Sequence[Message]) -> None:
        """Take messages in the time limits, and what describes sensors from before."""
        found = []
        for message in messages:
            if message.topic not in self._topics:
                continue
            if self._end_ns is not None and message.host_ns >= self._end_ns:
                continue
            if self._begin_ns is None or message.host_ns >= self._begin_ns:
                found.append(message)
            elif is_metadata(message.topic) and not message.topic.name.endswith("/tf"):
                # At the start, so that players do not wait; once, if it is published again.
                key = hash((message.topic.name, bytes(message.data)))
                if key not in self._latched:
                    self._latched.add(key)
                    found.append(message._replace(host_ns=self._begin_ns))
        self._waiting.extend(sorted(found, key=lambda message: message.host_ns))

    def _forward_until(self, host_ns: int | None) -> None:
        """Write the messages up to a time; None: all."""
        while self._waiting and (host_ns is None or self._waiting[0].host_ns <= host_ns):
            message = self._waiting.popleft()
            if self._bag is not None:
                self._bag.forward(message)
                self.found.messages += 1

    # -- result -------------------------------------------------------------------------------

    def _refuse_nothing(self) -> None:
        if self._written_ns is not None:
            return
        if self._received_ns is None:
            raise UsageError("expected packets in the recordings, found none; check the files")
        raise UsageError(
            "expected packets of the chosen lidars in the time limits, found none; packets were "
            f"received {text_of_range(*self._received_ns)}"
        )

    def _complete(self) -> None:
        """Complete the counts, and add notes."""
        found, table, is_capture = self.found, self._setup.sampler.table, self._pcap is not None
        for recording in self._setup.recordings:
            found.notes += [f"{recording.path.name}: {note}" for note in recording.notes]
            found.frames.update(recording.counts.skipped)
        why = "" if is_capture else ": no message of drivers contains them"
        for (stream, size), count in self._without_place.items():
            found.notes.append(
                f"{table.streams[stream]}: {found.files[0].name} has no place for {count} packets "
                f"of {size} bytes{why}"
            )
        streams = {place.stream for place in self._places.places} if is_capture else set()
        for stream in sorted(streams & table.untimed):
            found.notes.append(
                f"{table.streams[stream]}: expected the receive time of each packet, found only "
                "that of whole messages, which all their packets got; do not convert with --clock "
                "host"
            )
        bare = [lidar.name for lidar in found.lidars if lidar.sensor is None and lidar.written]
        if bare:
            names = some(bare, len(bare))
            found.notes.append(f"no calibration of {names} was found: add it to convert")
        found.first_ns, found.last_ns = self._written_ns or (0, 0)
        found.left_out = {reason: count for reason, count in found.left_out.items() if count}
        for number, lidar in enumerate(found.lidars):
            main = self._places.main_place(number)
            lidar.place = "" if main is None else str(main.to)


def _limits(
    request: Extraction, setup: Discovery, lidars: Sequence[ChosenLidar]
) -> tuple[int | None, int | None]:
    """Receive times in [begin, end), ns; None: no limit."""
    sampled = setup.sampler.kinds
    firsts = [
        sampled[kind].first_host_ns for one in lidars for kind in one.kinds if kind in sampled
    ]
    first_ns = min(firsts, default=0)
    refuse_outside(request.start, request.end, first_ns, "the first packet")
    begin_ns = None if request.start is None else request.start.at(first_ns)
    end_ns = None if request.end is None else request.end.at(first_ns)
    if request.duration_ns is not None:
        end_ns = (first_ns if begin_ns is None else begin_ns) + request.duration_ns
    return begin_ns, end_ns
