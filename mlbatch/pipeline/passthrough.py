"""IMU samples and recorded messages: not batched, written with the scan of their time.

Recorded Imu messages are written only if scans are on an epoch clock within 1 s of theirs, at their
own timestamps; messages of other topics byte for byte at their log time. Topics that `--pass` names
are refused where their clock and that of the scans are more than 1 s apart. IMU samples of lidars
keep the clock of their lidar.

Where no scan follows for long (before the first lidar packet, in a gap of all lidars), messages
wait in a temporary file: memory does not depend on how many there are.
"""

from __future__ import annotations

import contextlib
import heapq
import math
import struct
import tempfile
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from mlbatch.arrays import BoolArray, I64Array
from mlbatch.batching.intake import STAMP_LIMIT_NS
from mlbatch.clocks.timescale import format_difference
from mlbatch.errors import ClockError, ExportError, UsageError
from mlbatch.reports.ledger import DecodedCounts
from mlbatch.types import ImuSamples, Message, Recording, Topic
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    import sqlite3

IMU_TYPE = "sensor_msgs/Imu"
PASS_REASONS = ("no_place", "bad_stamp", "outside_time", "other_clock")
# Never forward a recorded /tf_static: the writers publish their own.
OWN_TOPIC = "/tf_static"
NEAR_NS = NS_PER_S
# Bytes of messages in memory before later ones go to a temporary file, and how much later than the
# last scan these are: more than windows wait for usually.
_MEMORY_BYTES = 4 << 20
_FAR_NS = 4 * NS_PER_S
# Memory of a message in addition to its bytes.
MESSAGE_BYTES = 400
# Parts of IMU samples that are kept before they are joined.
_MOST_PARTS = 256
# Two words of the timestamp in a message's header, by encoding (docs/sources/messages.md, section
# 1): after 4 bytes of CDR encapsulation, or after the sequence number of ROS 1.
_STAMP = {"cdr": struct.Struct("<4xiI"), "ros1": struct.Struct("<4xII")}

# By timestamp, topic, and order in the recordings: the order in the output.
Key: TypeAlias = tuple[int, str, int]
Entry: TypeAlias = tuple[Key, Message]

# The data may be lost with the process: no journal, and one transaction that never ends.
_BEGIN = """
PRAGMA journal_mode = OFF;
PRAGMA synchronous = OFF;
CREATE TABLE message(
    stamp_ns INTEGER, topic TEXT, added INTEGER, host_ns INTEGER, number INTEGER, data BLOB);
CREATE INDEX by_key ON message(stamp_ns, topic, added);
BEGIN;
"""
_IN_ORDER = "SELECT rowid, * FROM message ORDER BY stamp_ns, topic, added"
# Messages that are read at once.
_READ_BYTES = 1 << 16

# Lower and upper end of --start/--end, ns; None: no limit.
TimeLimits = tuple[int | None, int | None]


class ImuQueue:
    """IMU samples of all lidars that wait, sorted by timestamp when they are asked for.

    counts: counters of each sensor; offsets_ns: added to the timestamps of each sensor; has_place:
    False if the output has no place for samples; then none is kept.
    """

    def __init__(
        self, counts: Sequence[DecodedCounts], offsets_ns: Sequence[int], *, has_place: bool
    ) -> None:
        self._counts = list(counts)
        self._offsets_ns = list(offsets_ns)
        self._has_place = has_place
        none = np.zeros((0, 3))
        self._sorted = [
            ImuSamples(sensor, np.zeros(0, np.int64), none, none) for sensor in range(len(counts))
        ]
        # In the order in which they came.
        self._new: list[list[ImuSamples]] = [[] for _ in counts]

    @property
    def is_waiting(self) -> bool:
        """True if there are samples in the queue."""
        return any(self._new) or any(len(samples.stamp_ns) for samples in self._sorted)

    def add(self, samples: ImuSamples) -> None:
        """Add samples of one sensor."""
        counts = self._counts[samples.sensor]
        counts.decoded += len(samples.stamp_ns)
        if not self._has_place:
            counts.drop("no_place", len(samples.stamp_ns))
            return
        stamp_ns = samples.stamp_ns + self._offsets_ns[samples.sensor]
        samples.stamp_ns = stamp_ns
        sane = (stamp_ns >= 0) & (stamp_ns < STAMP_LIMIT_NS)
        if not sane.all():
            counts.drop("bad_stamp", int(np.count_nonzero(~sane)))
            samples = _part(samples, sane)
        if len(samples.stamp_ns):
            self._new[samples.sensor].append(samples)
        if len(self._new[samples.sensor]) > _MOST_PARTS:
            self._sort(samples.sensor)

    def drop_before(self, low_ns: int) -> None:
        """Drop samples before the first limit."""
        for sensor, counts in enumerate(self._counts):
            counts.drop("outside_time", len(self._take(sensor, low_ns).stamp_ns))

    def drain_until(self, end_ns: int | None, limits_ns: TimeLimits) -> list[ImuSamples]:
        """Samples before `end_ns` (None: all) and inside the limits, by timestamp."""
        low_ns, high_ns = limits_ns
        if low_ns is not None:
            self.drop_before(low_ns if end_ns is None else min(low_ns, end_ns))
        taken = []
        for sensor, counts in enumerate(self._counts):
            samples = self._take(sensor, end_ns)
            if high_ns is not None:
                count = int(samples.stamp_ns.searchsorted(high_ns))
                counts.drop("outside_time", len(samples.stamp_ns) - count)
                samples = _part(samples, slice(0, count))
            if len(samples.stamp_ns):
                counts.written += len(samples.stamp_ns)
                taken.append(samples)
        return sorted(taken, key=lambda samples: (int(samples.stamp_ns[0]), samples.sensor))

    def _take(self, sensor: int, end_ns: int | None) -> ImuSamples:
        """Take the samples of a sensor before a time (None: all)."""
        if self._new[sensor]:
            self._sort(sensor)
        waiting = self._sorted[sensor]
        stamp_ns = waiting.stamp_ns
        end = len(stamp_ns) if end_ns is None else int(stamp_ns.searchsorted(end_ns))
        self._sorted[sensor] = _part(waiting, slice(end, None))
        return _part(waiting, slice(0, end))

    def _sort(self, sensor: int) -> None:
        """Sort what waits by timestamp: packets may be reordered."""
        parts = [self._sorted[sensor], *self._new[sensor]]
        samples = ImuSamples(
            sensor,
            np.concatenate([part.stamp_ns for part in parts]),
            np.concatenate([part.acceleration for part in parts]),
            np.concatenate([part.angular_velocity for part in parts]),
        )
        if not bool((np.diff(samples.stamp_ns) >= 0).all()):
            samples = _part(samples, np.argsort(samples.stamp_ns, kind="stable"))
        self._sorted[sensor] = samples
        self._new[sensor] = []


def _part(samples: ImuSamples, which: BoolArray | I64Array | slice) -> ImuSamples:
    return ImuSamples(
        samples.sensor,
        samples.stamp_ns[which],
        samples.acceleration[which],
        samples.angular_velocity[which],
    )


@dataclass(slots=True)
class MessageCounts:
    """Messages of one topic: read = written + sum(dropped); reasons as in PASS_REASONS."""

    read: int = 0
    written: int = 0
    dropped: dict[str, int] = field(default_factory=dict)

    def drop(self, reason: str) -> None:
        """Count a message that is not written."""
        self.dropped[reason] = self.dropped.get(reason, 0) + 1


def selected(topics: Iterable[Topic], patterns: Sequence[str]) -> frozenset[str]:
    """Names of the topics to forward: all Imu topics, and topics that match a pattern."""
    return frozenset(
        topic.name
        for topic in topics
        if topic.type == IMU_TYPE or any(fnmatchcase(topic.name, p) for p in patterns)
    ) - {OWN_TOPIC}


class MessageQueue:
    """Holds recorded messages until the scan of their time is written; `counts` by topic."""

    def __init__(
        self, patterns: Sequence[str], encodings: frozenset[str], begin_ns: int | None = None
    ) -> None:
        """encodings: those that the output can store; begin_ns: start of a segment (receive time).

        Of what was received before the segment only latched messages are taken, as by a subscriber
        that joins late.
        """
        self.counts: dict[str, MessageCounts] = {}
        self._patterns = list(patterns)
        self._encodings = encodings
        self._begin_ns = begin_ns
        # A heap; later messages are in `_far` once there are many.
        self._near: list[Entry] = []
        self._near_bytes = 0
        self._most_bytes = _MEMORY_BYTES
        self._far = MessageSpill()
        self._added = 0
        # Clock of the scans minus that of the capture host, and remedies for a difference.
        self._scan_offset_ns = 0
        self._remedies = ""
        # Up to where messages were taken.
        self._taken_ns: int | None = None

    @property
    def waiting(self) -> int:
        """Number of messages in the queue."""
        return len(self._near) + len(self._far)

    @property
    def has_place(self) -> bool:
        """True if the output can store messages at all."""
        return bool(self._encodings)

    def subscribe(self, recordings: Iterable[Recording]) -> None:
        """Ask the recordings for the selected topics."""
        for recording in recordings:
            recording.keep = selected(recording.topics, self._patterns)

    def is_asked(self, recordings: Iterable[Recording]) -> bool:
        """True if the output can store messages of a topic that is to be forwarded."""
        return any(
            topic.encoding in self._encodings and selected([topic], self._patterns)
            for recording in recordings
            for topic in recording.topics
        )

    def refuse_unknown(self, recordings: Sequence[Recording]) -> None:
        """Raise UsageError for a pattern that matches no topic of the recordings."""
        names = [topic.name for recording in recordings for topic in recording.topics]
        for pattern in self._patterns:
            if not any(fnmatchcase(name, pattern) for name in names):
                raise UsageError(
                    f"--pass {pattern}: expected a topic of the recording, found none that "
                    "matches; see `mlbatch inspect`"
                )

    def check_clock(
        self, recordings: Sequence[Recording], scan_offset_ns: int, remedies: str
    ) -> None:
        """Raise ClockError where `--pass` would mix times of clocks more than NEAR_NS apart.

        Messages are written at their log time, IMU messages at that of their header, which is
        checked when they are written. scan_offset_ns: clock of the scans minus receive time;
        remedies: what brings both together.
        """
        self._scan_offset_ns = scan_offset_ns
        self._remedies = remedies
        if abs(scan_offset_ns) <= NEAR_NS:
            return
        for recording in recordings:
            for topic in recording.topics:
                is_written = topic.encoding in self._encodings and topic.name != OWN_TOPIC
                if is_written and topic.type != IMU_TYPE and self.is_asked_for(topic):
                    raise _other_clock(topic, "the capture host's clock", scan_offset_ns, remedies)

    def is_asked_for(self, topic: Topic) -> bool:
        """True if `--pass` names the topic."""
        return any(fnmatchcase(topic.name, pattern) for pattern in self._patterns)

    def add(self, messages: Iterable[Message]) -> None:
        """Add messages, in file order."""
        for message in messages:
            if self._is_of_earlier_segment(message):
                continue
            counts = self.counts.setdefault(message.topic.name, MessageCounts())
            counts.read += 1
            if message.topic.encoding not in self._encodings:
                counts.drop("no_place")
                continue
            stamp_ns = message.host_ns
            if message.topic.type == IMU_TYPE:
                own_ns = header_stamp_ns(message)
                if own_ns is None:
                    counts.drop("bad_stamp")
                    continue
                stamp_ns = own_ns
            heapq.heappush(self._near, ((stamp_ns, message.topic.name, self._added), message))
            self._near_bytes += len(message.data) + MESSAGE_BYTES
            self._added += 1
            if self._near_bytes > self._most_bytes:
                self._spill()

    def _spill(self) -> None:
        """Move the messages that no scan follows soon to the file."""
        far_ns = None if self._taken_ns is None else self._taken_ns + _FAR_NS
        far = [entry for entry in self._near if far_ns is None or entry[0][0] >= far_ns]
        if far:
            far.sort()
            self._far.add(far)
            self._near = [entry for entry in self._near if far_ns and entry[0][0] < far_ns]
            heapq.heapify(self._near)
            self._near_bytes = sum(len(one.data) + MESSAGE_BYTES for _, one in self._near)
        # Not again for every further message.
        self._most_bytes = self._near_bytes + _MEMORY_BYTES

    @property
    def _first_ns(self) -> int | None:
        """Timestamp of the first message in the queue."""
        firsts = [self._near[0][0][0]] if self._near else []
        if self._far.first is not None:
            firsts.append(self._far.first[0])
        return min(firsts, default=None)

    def _pop(self) -> tuple[int, Message]:
        """Take the first message, with its timestamp."""
        far = self._far.first
        if far is not None and (not self._near or far < self._near[0][0]):
            key, message = self._far.pop()
        else:
            key, message = heapq.heappop(self._near)
            self._near_bytes -= len(message.data) + MESSAGE_BYTES
        return key[0], message

    def _is_of_earlier_segment(self, message: Message) -> bool:
        """True for a message read for its metadata that is output of an earlier segment."""
        begin_ns = self._begin_ns
        return begin_ns is not None and message.host_ns < begin_ns and not message.topic.latched

    def drop_before(self, low_ns: int) -> None:
        """Drop messages before the first limit."""
        while (first_ns := self._first_ns) is not None and first_ns < low_ns:
            _, message = self._pop()
            self.counts[message.topic.name].drop("outside_time")

    def drain_until(
        self,
        end_ns: int | None,
        limits_ns: TimeLimits,
        clock_offset_ns: int | None,
        most_bytes: float = math.inf,
    ) -> list[Message]:
        """Messages before `end_ns` (None: all), at the times they are written at.

        clock_offset_ns: scan clock minus receive time, None where scans are on no epoch clock;
        most_bytes: the rest is left for the next call once messages have this many bytes.
        """
        low_ns, high_ns = limits_ns
        if low_ns is not None:
            self.drop_before(low_ns if end_ns is None else min(low_ns, end_ns))
        taken: list[Message] = []
        size = 0
        while (first_ns := self._first_ns) is not None and size < most_bytes:
            if end_ns is not None and first_ns >= end_ns:
                break
            stamp_ns, message = self._pop()
            counts = self.counts[message.topic.name]
            if high_ns is not None and stamp_ns >= high_ns:
                counts.drop("outside_time")
            elif message.topic.type == IMU_TYPE and not self._is_near(
                stamp_ns, message, clock_offset_ns
            ):
                counts.drop("other_clock")
            else:
                counts.written += 1
                size += len(message.data) + MESSAGE_BYTES
                taken.append(message._replace(host_ns=stamp_ns))
        if end_ns is not None:
            self._taken_ns = end_ns
        self._most_bytes = max(_MEMORY_BYTES, self._near_bytes)
        return taken

    def _is_near(self, stamp_ns: int, message: Message, clock_offset_ns: int | None) -> bool:
        """True if an IMU's clock is that of the scans, both relative to the capture host's.

        ClockError if `--pass` names the topic and not even its first message is near.
        """
        ahead_ns = stamp_ns - message.host_ns
        if not self.is_asked_for(message.topic):
            return clock_offset_ns is not None and abs(ahead_ns - clock_offset_ns) <= NEAR_NS
        apart_ns = self._scan_offset_ns - ahead_ns
        if abs(apart_ns) <= NEAR_NS:
            return True
        counts = self.counts[message.topic.name]
        if not counts.written and "other_clock" not in counts.dropped:
            raise _other_clock(message.topic, "the clock of its header", apart_ns, self._remedies)
        return False


def _other_clock(topic: Topic, clock: str, apart_ns: int, remedies: str) -> ClockError:
    return ClockError(
        f"--pass {topic.name}: expected {clock} and that of the scans within 1 s of each other, "
        f"since both are written at their own times, found the scans "
        f"{format_difference(apart_ns)} from it; {remedies}, or leave the topic out"
    )


def header_stamp_ns(message: Message) -> int | None:
    """Timestamp of a message that begins with a Header, ns; None if it is not a plausible one."""
    words = _STAMP.get(message.topic.encoding)
    if words is None or len(message.data) < words.size:
        return None
    seconds, nanoseconds = words.unpack_from(message.data)
    if not (0 < seconds < 2**31 and nanoseconds < NS_PER_S):
        return None
    return int(seconds) * NS_PER_S + int(nanoseconds)


# -- messages in a file ---------------------------------------------------------------------------


class MessageSpill:
    """Messages in a file without a name, which the system removes; `len`: how many."""

    def __init__(self) -> None:
        self._base: sqlite3.Connection | None = None
        self._topics: list[Topic] = []
        self._count = 0
        # The first messages, already read; some, as long as there are any.
        self._ready: deque[Entry] = deque()

    def __len__(self) -> int:
        return self._count

    @property
    def first(self) -> Key | None:
        """Key of the first message; None without any."""
        return self._ready[0][0] if self._ready else None

    def add(self, entries: Sequence[Entry]) -> None:
        """Add entries."""
        if not entries:
            return
        self._count += len(entries)
        with _disk_errors():
            if self._base is None:
                self._base = _open()
            # Among those that were read there may be a place for the new ones.
            for added in (entries, self._ready):
                rows = [
                    (*key, one.host_ns, self._number(one.topic), one.data) for key, one in added
                ]
                self._base.executemany("INSERT INTO message VALUES (?, ?, ?, ?, ?, ?)", rows)
            self._ready.clear()
            self._read(self._base)

    def pop(self) -> Entry:
        """Take the first message."""
        entry = self._ready.popleft()
        self._count -= 1
        if self._base is not None and not self._ready:
            with _disk_errors():
                self._read(self._base)
            if not self._count:
                self._base.close()
                self._base = None
        return entry

    def _read(self, base: sqlite3.Connection) -> None:
        """Move the first messages from the file to memory."""
        rows = []
        size = 0
        for row, stamp_ns, name, added, host_ns, topic, data in base.execute(_IN_ORDER):
            message = Message(self._topics[topic], host_ns, data)
            self._ready.append(((stamp_ns, name, added), message))
            rows.append((row,))
            size += len(data)
            if size >= _READ_BYTES:
                break
        base.executemany("DELETE FROM message WHERE rowid = ?", rows)

    def _number(self, topic: Topic) -> int:
        if topic not in self._topics:
            self._topics.append(topic)
        return self._topics.index(topic)


def _open() -> sqlite3.Connection:
    import sqlite3

    # It opens the file at the first statement; after that the file needs no name.
    with tempfile.NamedTemporaryFile(prefix="mlbatch-") as file:
        base = sqlite3.connect(file.name, isolation_level=None, check_same_thread=False)
        base.executescript(_BEGIN)
    return base


@contextlib.contextmanager
def _disk_errors() -> Iterator[None]:
    import sqlite3

    try:
        yield
    except (OSError, sqlite3.Error) as err:
        raise ExportError(
            f"{tempfile.gettempdir()}: expected room for messages that wait for their scan, found "
            f"{getattr(err, 'strerror', None) or str(err)!r}; free space there, or set TMPDIR to "
            "another folder"
        ) from err
