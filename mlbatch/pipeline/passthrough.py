"""IMU samples on their way past the batching: kept until the scan of their time is out."""

from __future__ import annotations

import heapq
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase

import numpy as np

from mlbatch.arrays import BoolArray
from mlbatch.batching.intake import STAMP_LIMIT_NS
from mlbatch.errors import UsageError
from mlbatch.report.ledger import DecodedCounts
from mlbatch.types import ImuSamples, Message, Recording, Topic
from mlbatch.units import NS_PER_S


class ImuQueue:
    """Samples of all sensors, counted in `counts`; nothing is kept for an output without a place.

    offsets_ns: added to the stamps of each sensor, as to those of its columns.
    """

    def __init__(
        self, counts: Sequence[DecodedCounts], offsets_ns: Sequence[int], *, wanted: bool
    ) -> None:
        self._counts = list(counts)
        self._offsets_ns = list(offsets_ns)
        self._wanted = wanted
        self._waiting: list[ImuSamples] = []

    def add(self, samples: ImuSamples) -> None:
        """Take in samples of one sensor."""
        counts = self._counts[samples.sensor]
        counts.decoded += len(samples.stamp_ns)
        if not self._wanted:
            counts.drop("no_place", len(samples.stamp_ns))
            return
        samples.stamp_ns = samples.stamp_ns + self._offsets_ns[samples.sensor]
        sane = (samples.stamp_ns >= 0) & (samples.stamp_ns < STAMP_LIMIT_NS)
        samples = self._kept(samples, sane, "bad_stamp")
        if len(samples.stamp_ns):
            self._waiting.append(samples)

    def drop_before(self, low_ns: int) -> None:
        """Drop what lies before the first limit, so that it need not wait for a scan."""
        kept = [self._kept(one, one.stamp_ns >= low_ns, "outside_time") for one in self._waiting]
        self._waiting = [samples for samples in kept if len(samples.stamp_ns)]

    def take(
        self, until_ns: int | None, limits_ns: tuple[int | None, int | None]
    ) -> list[ImuSamples]:
        """Samples before `until_ns` (None: all) and inside the limits, by stamp."""
        low, high = limits_ns
        taken, later = [], []
        for number in sorted({samples.sensor for samples in self._waiting}):
            samples = _in_order([one for one in self._waiting if one.sensor == number])
            upto = len(samples.stamp_ns)
            if until_ns is not None:
                upto = int(np.searchsorted(samples.stamp_ns, until_ns))
                later.append(_part(samples, slice(upto, None)))
            samples = _part(samples, slice(0, upto))
            inside = np.ones(upto, bool)
            if low is not None:
                inside &= samples.stamp_ns >= low
            if high is not None:
                inside &= samples.stamp_ns < high
            samples = self._kept(samples, inside, "outside_time")
            if len(samples.stamp_ns):
                self._counts[number].written += len(samples.stamp_ns)
                taken.append(samples)
        self._waiting = [samples for samples in later if len(samples.stamp_ns)]
        return sorted(taken, key=lambda samples: (int(samples.stamp_ns[0]), samples.sensor))

    def _kept(self, samples: ImuSamples, keep: BoolArray, reason: str) -> ImuSamples:
        if keep.all():
            return samples
        self._counts[samples.sensor].drop(reason, int(np.count_nonzero(~keep)))
        return _part(samples, keep)


def _in_order(parts: Sequence[ImuSamples]) -> ImuSamples:
    """Samples of one sensor as one, by stamp: packets may have overtaken each other."""
    stamp_ns = np.concatenate([part.stamp_ns for part in parts])
    order = np.argsort(stamp_ns, kind="stable")
    return ImuSamples(
        parts[0].sensor,
        stamp_ns[order],
        np.concatenate([part.acceleration for part in parts])[order],
        np.concatenate([part.angular_velocity for part in parts])[order],
    )


def _part(samples: ImuSamples, which: BoolArray | slice) -> ImuSamples:
    return ImuSamples(
        samples.sensor,
        samples.stamp_ns[which],
        samples.acceleration[which],
        samples.angular_velocity[which],
    )


# Messages of a recording that go to the output as they are: IMU topics, and those of `--pass`.
#
# CONTRACT.md section 3: recorded Imu topics only if scans are on an epoch clock within 1 s of
# them, all at their own stamps; other topics byte for byte at their log time.

IMU_TYPE = "sensor_msgs/Imu"
PASS_REASONS = ("no_place", "bad_stamp", "outside_time", "other_clock")
# Ours says where the sensors are; a second one could contradict it.
OWN_TOPIC = "/tf_static"
NEAR_NS = NS_PER_S
# Where the stamp of a message's header begins, and its two words, by encoding (facts/messages.md
# section 1): CDR has 4 bytes of its own before it, ROS 1 a sequence number.
_STAMP = {"cdr": struct.Struct("<4xiI"), "ros1": struct.Struct("<4xII")}


@dataclass(slots=True)
class PassCounts:
    """Messages of one topic: read = written + sum(dropped); reasons as in PASS_REASONS."""

    read: int = 0
    written: int = 0
    dropped: dict[str, int] = field(default_factory=dict)

    def drop(self, reason: str) -> None:
        """Count a message that is not written."""
        self.dropped[reason] = self.dropped.get(reason, 0) + 1


def selected(topics: Iterable[Topic], patterns: Sequence[str]) -> frozenset[str]:
    """Names of topics to hand over: all Imu topics, and those that a pattern names."""
    return frozenset(
        topic.name
        for topic in topics
        if topic.type == IMU_TYPE or any(fnmatchcase(topic.name, p) for p in patterns)
    ) - {OWN_TOPIC}


class PassQueue:
    """Holds messages until the scan of their time is out; `counts` by topic."""

    def __init__(
        self, patterns: Sequence[str], encodings: frozenset[str], begin_ns: int | None = None
    ) -> None:
        """encodings: those that the output has a place for; begin_ns: arrival where a part begins.

        Of what came before the part only latched messages are taken, as by a late subscriber.
        """
        self.counts: dict[str, PassCounts] = {}
        self._patterns = list(patterns)
        self._encodings = encodings
        self._begin_ns = begin_ns
        # A heap by stamp, then arrival: recordings hold messages in any order.
        self._waiting: list[tuple[int, int, Message]] = []
        self._arrived = 0

    @property
    def waiting(self) -> int:
        """Messages whose time has not come."""
        return len(self._waiting)

    @property
    def has_room(self) -> bool:
        """Whether the output takes messages at all."""
        return bool(self._encodings)

    def keep(self, recordings: Iterable[Recording]) -> None:
        """Have recordings hand over what is selected."""
        for recording in recordings:
            recording.keep = selected(recording.topics, self._patterns)

    def refuse_unknown(self, recordings: Sequence[Recording]) -> None:
        """Refuse a pattern that no topic of the recordings matches."""
        names = [topic.name for recording in recordings for topic in recording.topics]
        for pattern in self._patterns:
            if not any(fnmatchcase(name, pattern) for name in names):
                raise UsageError(
                    f"--pass {pattern}: wanted a topic of the recording, got none that matches; "
                    "see `mlbatch inspect`"
                )

    def add(self, messages: Iterable[Message]) -> None:
        """Take in messages, in file order."""
        for message in messages:
            if self._is_of_earlier_part(message):
                continue
            counts = self.counts.setdefault(message.topic.name, PassCounts())
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
            heapq.heappush(self._waiting, (stamp_ns, self._arrived, message))
            self._arrived += 1

    def _is_of_earlier_part(self, message: Message) -> bool:
        """Whether a message that came to teach belongs to the output of an earlier part."""
        begin_ns = self._begin_ns
        return begin_ns is not None and message.host_ns < begin_ns and not message.topic.latched

    def drop_before(self, low_ns: int) -> None:
        """Drop what lies before the first limit, so that it need not wait for a scan."""
        while self._waiting and self._waiting[0][0] < low_ns:
            _, _, message = heapq.heappop(self._waiting)
            self.counts[message.topic.name].drop("outside_time")

    def take(
        self, until_ns: int | None, limits_ns: tuple[int | None, int | None], offset_ns: int | None
    ) -> list[Message]:
        """Messages before `until_ns` (None: all), at the times they are written at.

        offset_ns: scan clock minus arrival, None where scans are not on an epoch clock.
        """
        low, high = limits_ns
        if low is not None:
            self.drop_before(low if until_ns is None else min(low, until_ns))
        taken = []
        while self._waiting and (until_ns is None or self._waiting[0][0] < until_ns):
            stamp_ns, _, message = heapq.heappop(self._waiting)
            counts = self.counts[message.topic.name]
            if high is not None and stamp_ns >= high:
                counts.drop("outside_time")
            elif message.topic.type == IMU_TYPE and not _is_near(stamp_ns, message, offset_ns):
                counts.drop("other_clock")
            else:
                counts.written += 1
                taken.append(replace(message, host_ns=stamp_ns))
        return sorted(taken, key=lambda message: (message.host_ns, message.topic.name))


def header_stamp_ns(message: Message) -> int | None:
    """Stamp of a message that begins with a Header, ns; None if it has none that makes sense."""
    words = _STAMP.get(message.topic.encoding)
    if words is None or len(message.data) < words.size:
        return None
    seconds, nanoseconds = words.unpack_from(message.data)
    if not (0 < seconds < 2**31 and nanoseconds < NS_PER_S):
        return None
    return int(seconds) * NS_PER_S + int(nanoseconds)


def _is_near(stamp_ns: int, message: Message, offset_ns: int | None) -> bool:
    """Whether an IMU's clock is that of the scans, both seen from the recorder's."""
    return offset_ns is not None and abs(stamp_ns - message.host_ns - offset_ns) <= NEAR_NS
