"""Do the recordings of a session belong together: receive times of the lidars in each.

A window can contain the columns of two lidars only if they were recorded at the same time.
Recordings with a lidar in common may follow each other, as the parts of a split recording do, but
not at any distance. Where they overlap, they are copies: a lidar measures one thing at an instant.
"""

from __future__ import annotations

import contextlib
import datetime
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mlbatch import sensors
from mlbatch.arrays import I64Array, U8Array
from mlbatch.batching.intake import NEVER, extremes
from mlbatch.discovery.first_seconds import FIRST_NS
from mlbatch.discovery.router import Role
from mlbatch.discovery.sampler import SAMPLES_PER_KIND, KindFilter, split_by_kind
from mlbatch.discovery.types import DetectedSensor, PacketKind
from mlbatch.errors import MlbatchError, RecordingError
from mlbatch.lidar.headers import content_keys
from mlbatch.lidar.interface import Lidar
from mlbatch.readers import open_recording
from mlbatch.readers.byte_records import records
from mlbatch.types import PacketBatch, Recording, Stream, StreamTable
from mlbatch.units import NS_PER_MS, NS_PER_S

if TYPE_CHECKING:
    from mlbatch.discovery.discover import Discovery

# Largest time between recordings with a lidar in common: a break in a day of work, but not a day.
MAX_BREAK_NS = 24 * 3600 * NS_PER_S
# Packets of a kind that are described.
_CHECKED = 16
# The packets that contain a multiple of this are compared between recordings.
_INSTANT_NS = 50 * NS_PER_MS
# Largest receive time between packets that are compared.
_NEAR_NS = NS_PER_S
# Of each recording, bytes of a lidar that are looked at before another recording overlaps it.
_FIRST_BYTES = 8 << 20
# Instants of a lidar that are kept of each recording.
_MOST_INSTANTS = 4096
# Recordings contradict each other from this number of shared instants with other packets on, and
# this share of all shared instants: a packet may be damaged. After `_SETTLED` shared instants that
# mostly agree, the recordings are copies.
_MIN_OTHERS = 3
_OTHERS = 0.5
_SETTLED = 200


@dataclass(slots=True)
class LidarSpan:
    """The lidars of one recording, and when their packets were received, ns.

    first_ns: None before the first; is_whole: no later packet can come.
    """

    path: Path
    lidars: set[str] = field(default_factory=set)
    first_ns: int | None = None
    last_ns: int = 0
    is_whole: bool = False

    def add(self, lidar: str, first_ns: int, last_ns: int) -> None:
        """Add packets of a lidar."""
        self.lidars.add(lidar)
        self.first_ns = first_ns if self.first_ns is None else min(self.first_ns, first_ns)
        self.last_ns = max(self.last_ns, last_ns)


@dataclass(slots=True)
class _Group:
    """Recordings that share lidars, by first receive time."""

    spans: list[LidarSpan]

    @property
    def lidars(self) -> set[str]:
        return {lidar for span in self.spans for lidar in span.lidars}

    @property
    def first_ns(self) -> int:
        return self.spans[0].first_ns or 0

    @property
    def last_ns(self) -> int:
        return max(span.last_ns for span in self.spans)

    @property
    def is_whole(self) -> bool:
        return all(span.is_whole for span in self.spans)

    def __str__(self) -> str:
        # Of a long series the names would fill pages.
        more = f" and {len(self.spans) - 1} more" if len(self.spans) > 1 else ""
        return f"{self.spans[0].path}{more} ({iso(self.first_ns)} to {iso(self.last_ns)})"


def problem(
    spans: Sequence[LidarSpan], optional: Iterable[str] = (), *, are_all_known: bool = True
) -> tuple[str, bool]:
    """Why recordings are no session, or "", and True if only optional lidars are concerned.

    optional: lidars that may be absent; are_all_known: False while more lidars may be found in the
    recordings.
    """
    groups = _groups(spans)
    for group in groups:
        text = _long_break(group.spans)
        if text:
            return text, False
    found = ""
    for number, late in enumerate(groups if are_all_known else ()):
        for early in groups[:number]:
            if not early.is_whole or early.last_ns >= late.first_ns:
                continue
            text = (
                f"{early}, {late}: expected recordings of different lidars that overlap in receive "
                "time, found none that do, so that no scan has all lidars; convert each alone, or "
                "correct the receive times (editcap -t SECONDS) (no_overlap)"
            )
            if not (early.lidars <= set(optional) or late.lidars <= set(optional)):
                return text, False
            found = text
    return found, bool(found)


def _groups(spans: Sequence[LidarSpan]) -> list[_Group]:
    """Recordings in groups that share no lidar, by first receive time."""
    groups: list[_Group] = []
    for span in spans:
        if span.first_ns is None:
            continue
        shared = [group for group in groups if group.lidars & span.lidars]
        groups = [group for group in groups if group not in shared]
        groups.append(_Group([span, *(one for group in shared for one in group.spans)]))
    for group in groups:
        group.spans.sort(key=lambda span: span.first_ns or 0)
    return sorted(groups, key=lambda group: group.first_ns)


def _long_break(spans: Sequence[LidarSpan]) -> str:
    """Error text if recordings of one lidar are too far apart, else ""."""
    before = spans[0]
    for span in spans[1:]:
        if before.is_whole and (span.first_ns or 0) - before.last_ns > MAX_BREAK_NS:
            return (
                f"{_Group([before])}, {_Group([span])}: expected recordings of one session at most "
                "a day apart, found more; convert each alone, or correct the receive times "
                "(editcap -t SECONDS) (no_overlap)"
            )
        if span.last_ns >= before.last_ns or not span.is_whole:
            before = span
    return ""


def iso(host_ns: int) -> str:
    """Receive time as ISO 8601 in UTC, to the millisecond; in seconds where no date has it."""
    try:
        moment = datetime.datetime.fromtimestamp(host_ns // NS_PER_S, datetime.timezone.utc)
    except (OverflowError, ValueError, OSError):
        return f"{host_ns / NS_PER_S:.3f} s"
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{host_ns % NS_PER_S // 10**6:03d}Z"


# -- packets of one lidar in several recordings ---------------------------------------------------


@dataclass(slots=True)
class _Copies:
    """Instants that two recordings share of a lidar; others: instants whose packets differ."""

    instants: int = 0
    others: int = 0


class SharedLidars:
    """Compares the packets of lidars that several recordings have at the same receive times."""

    def __init__(self) -> None:
        # By sensor and recording: newest receive time, bytes, and by instant the packets' contents.
        self._last_ns: dict[str, dict[Path, int]] = {}
        self._bytes: Counter[tuple[str, Path]] = Counter()
        self._contents: dict[tuple[str, Path], dict[int, set[int]]] = {}
        self._copies: dict[tuple[str, Path, Path], _Copies] = {}

    def add(
        self, recording: Recording, sensor: DetectedSensor, batch: PacketBatch, index: I64Array
    ) -> None:
        """Add packets that may be of a sensor; RecordingError if another recording has others."""
        path = recording.path
        host_ns = batch.host_ns[index]
        last_ns = self._last_ns.setdefault(sensor.name, {})
        last_ns[path] = max(last_ns.get(path, 0), int(host_ns.max()))
        near = [
            other
            for other, other_ns in last_ns.items()
            if other != path
            and other_ns + _NEAR_NS >= int(host_ns.min())
            and self._compared(sensor, path, other).instants < _SETTLED
        ]
        self._bytes[sensor.name, path] += sensor.lidar.packet_size * len(index)
        if not near and self._bytes[sensor.name, path] > _FIRST_BYTES:
            return
        kept = self._contents.setdefault((sensor.name, path), {})
        for instant, content in _instants(sensor.lidar, batch, index, host_ns):
            if instant in kept:
                kept[instant].add(content)
                continue
            kept[instant] = {content}
            if len(kept) > _MOST_INSTANTS:
                del kept[next(iter(kept))]
            for other in near:
                self._compare(sensor, instant, content, path, other)

    def _compared(self, sensor: DetectedSensor, one: Path, other: Path) -> _Copies:
        key = (sensor.name, min(one, other), max(one, other))
        return self._copies.setdefault(key, _Copies())

    def _compare(
        self, sensor: DetectedSensor, instant: int, content: int, path: Path, other: Path
    ) -> None:
        contents = self._contents.get((sensor.name, other), {}).get(instant)
        if contents is None:
            return
        copies = self._compared(sensor, path, other)
        copies.instants += 1
        copies.others += content not in contents
        if copies.others >= _MIN_OTHERS and copies.others > _OTHERS * copies.instants:
            raise RecordingError(
                f"{min(path, other)}, {max(path, other)}: expected packets of {sensor.name} of "
                f"different times, or copies, found others in {copies.others} of "
                f"{copies.instants} instants that both have (the last at "
                f"{instant * _INSTANT_NS / NS_PER_S:.2f} s of its clock): recordings of two "
                "drives; convert each alone"
            )


def _instants(
    lidar: Lidar, batch: PacketBatch, index: I64Array, host_ns: I64Array
) -> Iterator[tuple[int, int]]:
    """Multiples of `_INSTANT_NS` within intact packets of a lidar, and the packets' contents."""
    layout = np.dtype([("byte", "u1", lidar.packet_size)])
    packets = records(batch.data, layout, batch.start[index])["byte"]
    good = lidar.sent_by_me(packets) & (lidar.faults(packets) == 0)
    packets = packets[good]
    low, high = extremes(lidar.column_headers(packets, host_ns[good]))
    instant = high // _INSTANT_NS
    rows = np.flatnonzero((high > NEVER) & (instant * _INSTANT_NS >= low))
    yield from zip(instant[rows].tolist(), content_keys(packets[rows]).tolist(), strict=True)


# -- captures -------------------------------------------------------------------------------------


def spans_of_captures(
    recordings: Sequence[Recording], is_wanted: Callable[[Stream, str], bool]
) -> list[LidarSpan]:
    """Lidars of captures, by their first and last packets; nothing between is read.

    Empty if one of the recordings does not show its end: then the run finds out. is_wanted: by
    stream and description.
    """
    spans = []
    for recording in recordings:
        try:
            span = _span(recording, is_wanted)
        except MlbatchError:
            # Its damage is an error of the run.
            span = None
        if span is None:
            return []
        spans.append(span)
    return spans


def _span(recording: Recording, is_wanted: Callable[[Stream, str], bool]) -> LidarSpan | None:
    table = StreamTable()
    last = recording.last_packets(table)
    if last is None or not len(last):
        return None
    span = LidarSpan(recording.path, is_whole=True)
    with contextlib.closing(open_recording(recording.path, table).packets()) as packets:
        first = next(packets, None)
        if first is None or not len(first):
            return None
        # Lidars may begin after other packets, and end before them.
        first_ns = int(first.host_ns.min())
        last_ns = int(last.host_ns.max())
        for batch in (first, last):
            for lidar in _lidars(batch, table, is_wanted):
                span.add(lidar, first_ns, last_ns)
    return span


def _lidars(
    batch: PacketBatch, table: StreamTable, is_wanted: Callable[[Stream, str], bool]
) -> Iterator[str]:
    """Lidars whose packets are in a batch."""
    for kind, index in KindFilter().followed(batch, split_by_kind(batch)):
        stream = table.streams[kind.stream]
        packets = batch.data[batch.start[index[:_CHECKED], None] + np.arange(kind.size)]
        description = sensors.describe(kind.size, packets)
        if description is not None and "lidar" in description and is_wanted(stream, description):
            yield lidar_name(stream, description)


def lidar_name(stream: Stream, what: str) -> str:
    """Name of a lidar without a sensor: its serial number, which may move, else its stream."""
    serial = re.search(r"serial \w+", what)
    return serial[0] if serial else str(stream)


# -- packets of a run -----------------------------------------------------------------------------


class RunOverlap:
    """Follows the packets of several recordings; an error as soon as they are no session."""

    def __init__(self, recordings: Sequence[Recording], setup: Discovery) -> None:
        self._setup = setup
        self._spans = {id(one): LidarSpan(one.path) for one in recordings}
        self._shared = SharedLidars()
        self._kind_filters = {id(one): KindFilter() for one in recordings}
        # By recording and kind, as lidars of several recordings may have one address.
        self._lidars: dict[tuple[int, PacketKind], list[str]] = {}
        self._begun_ns: int | None = None
        self._is_settled = False

    def add(self, recording: Recording, batch: PacketBatch | None) -> None:
        """Add the next packets of a recording; None: it has no more."""
        span = self._spans[id(recording)]
        if batch is None:
            span.is_whole = True
            return
        is_new = span.first_ns is None
        parts = split_by_kind(batch)
        for kind, index in self._kind_filters[id(recording)].followed(batch, parts):
            key = id(recording), kind
            names = self._lidars.get(key)
            if names is None:
                first = batch.start[index[:SAMPLES_PER_KIND], None] + np.arange(kind.size)
                names = list(self._names(kind, batch.data[first]))
                self._lidars[key] = names
            host_ns = batch.host_ns[index]
            for name in names:
                span.add(name, int(host_ns.min()), int(host_ns.max()))
            for sensor in self._setup.sensors:
                if sensor.name in names:
                    self._shared.add(recording, sensor, batch, index)
        newest_ns = int(batch.host_ns[-1])
        if is_new and span.first_ns is not None:
            self._begun_ns = newest_ns
            self._is_settled = False
            self._refuse(are_all_known=False)
        elif (
            not self._is_settled
            and self._begun_ns is not None
            and newest_ns - self._begun_ns > FIRST_NS
            and all(one.first_ns is not None or one.is_whole for one in self._spans.values())
        ):
            self._is_settled = True
            self._refuse()

    def finish(self) -> str:
        """Check all that was read, at the end; gives a warning about optional sensors, or ""."""
        for span in self._spans.values():
            span.is_whole = True
        return self._refuse()

    def _refuse(self, *, are_all_known: bool = True) -> str:
        """Raise RecordingError if recordings are no session; gives a warning, or ""."""
        optional = [
            one.name for one in self._setup.sensors if one.rig is not None and one.rig.optional
        ]
        text, is_optional = problem(
            list(self._spans.values()), optional, are_all_known=are_all_known
        )
        if text and not is_optional:
            raise RecordingError(text)
        return text

    def _names(self, kind: PacketKind, packets: U8Array) -> Iterator[str]:
        """Lidars that sent packets (k, size) of a kind, but for those that the user left out."""
        setup = self._setup
        stream = setup.sampler.table.streams[kind.stream]
        route = setup.router.route(kind, packets[0])
        if route.role in (Role.IMU, Role.BAD_SIZE):
            return
        owned = np.zeros(len(packets), np.bool_)
        for number in route.sensors:
            sensor = setup.sensors[number]
            own = sensor.lidar.sent_by_me(packets[:, : sensor.lidar.packet_size])
            owned |= own
            if own.any():
                yield sensor.name
        others = packets[~owned]
        if setup.rig is not None or setup.ignored.all_others or not len(others):
            return
        others = others[~setup.ignored.packets(stream, kind, others)]
        what = sensors.describe(kind.size, others[:1]) if len(others) else None
        if what is not None and "lidar" in what:
            yield lidar_name(stream, what)
