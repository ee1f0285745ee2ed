"""Packet, column and point accounting: everything read is written or counted under a reason."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

from mlbatch.types import CaptureCounts

# Closed lists, described in docs/report.md.
# `fragment`: a frame whose content is in the datagram that its last fragment completed.
CAPTURE_REASONS = ("not_ip", "not_udp", "truncated", "fragment", "fragment_lost", "no_stream")
PACKET_REASONS = ("bad_size", "bad_header", "bad_crc", "bad_stamp", "duplicate")
# `incomplete`: of windows left out by --drop-incomplete. Of frame-level fusion: `part_sweep`: of
# sweeps that the recording contains in part; `no_set`: of sweeps that no set contains.
# `no_pose`: of windows that --deskew left out.
COLUMN_REASONS = (
    "before_start",
    "late",
    "tail",
    "head",
    "invalid",
    "outside_time",
    "incomplete",
    "part_sweep",
    "no_set",
    "no_pose",
)
# `no_place`: the output format cannot store them.
IMU_REASONS = ("bad_stamp", "duplicate", "outside_time", "no_place")
# Outcomes of a slot of a written column.
POINT_OUTCOMES = ("no_return", "range", "box", "repeated", "written")
# Counters of the points of a sensor: `clipped` ones are among those written.
POINT_COUNTERS = (*POINT_OUTCOMES, "clipped")


@dataclass(slots=True)
class PacketCounts:
    """Lidar packets of a sensor: read = accepted + sum(rejected)."""

    read: int = 0
    accepted: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    lost: int = 0  # gaps in the sequence
    reordered: int = 0  # packets received after a later one

    def reject(self, reason: str, count: int = 1) -> None:
        """Count rejected packets."""
        _add(self.rejected, reason, count)


@dataclass(slots=True)
class DecodedCounts:
    """Columns or IMU samples of a sensor: decoded + reused = written + sum(dropped)."""

    decoded: int = 0
    written: int = 0
    reused: int = 0  # columns written again, in a further set of frame-level fusion
    dropped: dict[str, int] = field(default_factory=dict)

    def drop(self, reason: str, count: int = 1) -> None:
        """Count what is not written."""
        _add(self.dropped, reason, count)


@dataclass(slots=True)
class PointCounts:
    """Slots of the written columns: slots = no_return + range + box + repeated + written."""

    slots: int = 0
    no_return: int = 0
    range: int = 0
    box: int = 0
    repeated: int = 0
    written: int = 0
    clipped: int = 0  # written points whose intensity exceeds the 8 bits of the layout

    @property
    def outcomes(self) -> list[int]:
        """Slots by outcome, in the order of POINT_OUTCOMES."""
        return [self.no_return, self.range, self.box, self.repeated, self.written]

    @property
    def counters(self) -> list[int]:
        """All but `slots`, in the order of POINT_COUNTERS."""
        return [*self.outcomes, self.clipped]

    def add(self, counts: Sequence[int]) -> None:
        """Count slots by outcome, and the clipped ones, in the order of POINT_COUNTERS."""
        self.slots += sum(counts[: len(POINT_OUTCOMES)])
        for name, count in zip(POINT_COUNTERS, counts, strict=True):
            setattr(self, name, getattr(self, name) + count)


@dataclass(slots=True)
class SensorLedger:
    """All counters of one sensor."""

    packets: PacketCounts = field(default_factory=PacketCounts)
    columns: DecodedCounts = field(default_factory=DecodedCounts)
    points: PointCounts = field(default_factory=PointCounts)
    imu_packets: int = 0
    imu_samples: DecodedCounts = field(default_factory=DecodedCounts)

    def check(self) -> list[str]:
        """One line for each counter that does not balance; empty if all do."""
        packets = self.packets
        columns = self.columns
        points = self.points
        samples = self.imu_samples
        return [
            *_balance("packets", packets.read, (packets.accepted, *packets.rejected.values())),
            *_balance(
                "columns",
                columns.decoded + columns.reused,
                (columns.written, *columns.dropped.values()),
            ),
            *_balance("points", points.slots, tuple(points.outcomes)),
            *_balance("IMU samples", samples.decoded, (samples.written, *samples.dropped.values())),
            *_unknown("packets", packets.rejected, PACKET_REASONS),
            *_unknown("columns", columns.dropped, COLUMN_REASONS),
            *_unknown("IMU samples", samples.dropped, IMU_REASONS),
        ]


def check_capture(counts: CaptureCounts) -> list[str]:
    """One line for each counter of a reader that does not balance."""
    parts = (counts.datagrams, *counts.skipped.values())
    return [
        *_balance("frames", counts.frames, parts),
        *_unknown("frames", counts.skipped, CAPTURE_REASONS),
    ]


def check_datagrams(datagrams: int, sensors: Sequence[SensorLedger], unassigned: int) -> list[str]:
    """Imbalance between recordings and sensors, as a line."""
    parts = [(one.packets.read, one.imu_packets) for one in sensors]
    return _balance("datagrams", datagrams, (*itertools.chain(*parts), unassigned))


def check_messages(topic: str, read: int, written: int, dropped: dict[str, int]) -> list[str]:
    """Imbalance among the recorded messages of a topic, as a line."""
    return _balance(f"messages of {topic}", read, (written, *dropped.values()))


def ordered(counts: dict[str, int], reasons: tuple[str, ...]) -> dict[str, int]:
    """The counted reasons, in the order of their closed list."""
    listed = {reason: counts[reason] for reason in reasons if counts.get(reason)}
    return listed | {reason: count for reason, count in sorted(counts.items()) if count}


def _add(counts: dict[str, int], reason: str, count: int) -> None:
    if count:
        counts[reason] = counts.get(reason, 0) + count


def _balance(what: str, total: int, parts: tuple[int, ...]) -> list[str]:
    if total == sum(parts):
        return []
    return [f"{what}: expected {total} accounted for, found {' + '.join(map(str, parts))}"]


def _unknown(what: str, counts: dict[str, int], reasons: tuple[str, ...]) -> list[str]:
    return [f"{what}: unknown reason {reason!r}" for reason in counts if reason not in reasons]
