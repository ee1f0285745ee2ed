"""Contents of recordings besides packets: time and size, and messages of other topics."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from mlbatch.errors import MlbatchError
from mlbatch.readers import has_packets
from mlbatch.types import Message, Recording, StreamTable
from mlbatch.units import NS_PER_S


@dataclass(frozen=True, slots=True)
class TopicReport:
    """Messages of a topic without packets; times are log times."""

    topic: str
    type: str
    messages: int
    rate_hz: float
    first_host_ns: int
    last_host_ns: int


@dataclass(frozen=True, slots=True)
class RecordingReport:
    """A recording; last_host_ns: newest receive or log time, None where only `--whole` shows it."""

    path: str
    container: str
    bytes: int
    last_host_ns: int | None


class TopicCounter:
    """Counts the messages of topics without packets."""

    def __init__(self, recordings: Sequence[Recording], streams: Iterable[str]) -> None:
        """Subscribe to all topics of recordings but `streams`, which are counted as packets."""
        left_out = frozenset(streams)
        # Messages, first and last log time.
        self._counts: dict[tuple[str, str], tuple[int, int, int]] = {}
        for recording in recordings:
            others = [
                one for one in recording.topics if one.name not in left_out and not has_packets(one)
            ]
            recording.keep = frozenset(topic.name for topic in others)
            for topic in others:
                self._counts[topic.name, topic.type] = (0, 0, 0)

    def add(self, messages: Iterable[Message]) -> None:
        """Count messages."""
        for message in messages:
            key = (message.topic.name, message.topic.type)
            count, first_ns, last_ns = self._counts.get(key, (0, 0, 0))
            at_ns = message.host_ns
            if not count:
                first_ns = last_ns = at_ns
            self._counts[key] = (count + 1, min(first_ns, at_ns), max(last_ns, at_ns))

    def reports(self) -> Iterator[TopicReport]:
        """The topics by name; those without a message, too."""
        for (name, type_), (count, first_ns, last_ns) in sorted(self._counts.items()):
            span_ns = last_ns - first_ns
            rate_hz = (count - 1) * NS_PER_S / span_ns if span_ns > 0 else 0.0
            yield TopicReport(name, type_, count, rate_hz, first_ns, last_ns)


def recording_report(recording: Recording) -> RecordingReport:
    """Name, container, size and end of a recording, without reading it."""
    last_ns = recording.last_ns
    # Damage at the end is noted when the recording is read.
    with contextlib.suppress(MlbatchError):
        last = recording.last_packets(StreamTable()) if last_ns is None else None
        if last is not None and len(last):
            last_ns = int(last.host_ns.max())
    return RecordingReport(str(recording.path), recording.container, recording.size_bytes, last_ns)
