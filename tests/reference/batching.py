"""The paper in plain loops: the oracle of the fast batcher, never optimised.

Source: Faitli et al. (2025), section 2.1. It takes packets in order of receive time, one after the
other, column by column, and shares no code with the fast batcher. Where the paper leaves a choice,
these rules apply (N: newest stamp delivered by a sensor; t0: its first stamp; G: the largest N;
slack: the allowed lateness, 10 ms; max-wait: the idle-source timeout):

1. Intake, per sensor, in its own order of packets: `tests/reference/intake.py`, without jumps. A
   clock reset is a `ClockError`.
2. Invalid columns are dropped as `invalid`; they have no stamp, but count as decoded.
3. Clocks are compared when the first valid column of a sensor is delivered, with every sensor that
   already has one (comparing with the first sensor only would depend on the order). Not with the
   host clock.
4. Sensor s is stalled after a delivery if G - N[s] exceeds max-wait; before its first column, if G
   minus the smallest t0 does.
5. Eq. (1) is evaluated after the first delivery at which every sensor has a column or is stalled,
   over those that have one and are not stalled; else at the end, over all that have one.
6. Slices are windows q = k * slices + j with bounds ceil(q * 1e9 / (rate * slices)).
7. After each delivery the watermark is the smallest N of the sensors that are not stalled, minus
   the slack, if that is larger than before; windows that end at or before it are published. A
   column is `late` if its window ends at or before the newest stamp of its sensor before it minus
   the slack, or at or before the end of what was published before its packet.
8. `complete` is decided at publication: t0 <= start and N >= end for every sensor, and no stall
   overlaps. A stall is a step of a sensor's running maximum from a to b > a + max-wait; it overlaps
   if a < end and b > start.
9. End of input publishes everything else, at the receive time of the last packet.
10. A column is dropped for one reason, the first of: invalid, late, before_start (k < k0 - 1),
   outside_time (start of the whole window outside [start, end)), head (k = k0 - 1), tail (the slice
   of the final G). Keep-partial writes head and tail. `empty` counts slices without a column from
   k0 to the last with a column, inside [start, end). In a window, columns are ordered by stamp,
   sensor, order of delivery.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from fractions import Fraction

from mlbatch.errors import ClockError
from tests.reference.intake import FeedPacket, Intake, StepError

__all__ = ["FeedPacket", "Outcome", "Settings", "Window", "reference_scans"]

SECOND_NS = 10**9
SLACK_NS = 10**7


@dataclass(frozen=True, slots=True)
class Settings:
    """Options of a run; rate in Hz; max_wait_ns None: no idle-source timeout."""

    rate: Fraction
    sensors: int
    slices: int = 1
    max_wait_ns: int | None = SECOND_NS
    keep_partial: bool = False
    start_ns: int | None = None
    end_ns: int | None = None
    host_clock: bool = False


@dataclass(frozen=True, slots=True)
class Window:
    """A written window or slice."""

    index: int
    slice: int
    start_ns: int
    end_ns: int
    complete: bool
    ready_host_ns: int
    columns: list[tuple[int, int, int]]  # (sensor, its accepted packet, column in the packet)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a run; lists over the sensors count packets (rejected) or columns."""

    t_init_ns: int | None
    windows: list[Window]
    rejected: list[dict[str, int]]
    dropped: list[dict[str, int]]
    decoded: list[int]
    written: list[int]
    empty: int
    incomplete: int


@dataclass(slots=True)
class Sensor:
    """State of one sensor after the deliveries so far."""

    packets: int = 0
    first: int | None = None
    newest: int | None = None
    stalls: list[tuple[int, int]] = field(default_factory=list)
    dropped: dict[str, int] = field(default_factory=dict)
    decoded: int = 0
    written: int = 0

    def drop(self, reason: str) -> None:
        """Count one column that is not written."""
        self.dropped[reason] = self.dropped.get(reason, 0) + 1

    def observe(self, stamp: int, max_wait_ns: int | None) -> None:
        """Update N, and record a step of N that is a stall."""
        before = stamp if self.newest is None else self.newest
        if max_wait_ns is not None and stamp - before > max_wait_ns:
            self.stalls.append((before, stamp))
        self.newest = max(before, stamp)


class Session:
    """The main loop of the paper and its state between packets."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.slices_per_ns = settings.rate * settings.slices / SECOND_NS
        self.intakes = [Intake(settings.host_clock) for _ in range(settings.sensors)]
        self.sensors = [Sensor() for _ in range(settings.sensors)]
        self.offsets: dict[int, int] = {}
        self.k0: int | None = None
        self.watermark: int | None = None
        self.published_end: int | None = None
        self.waiting: dict[int, list[tuple[int, int, int, int]]] = {}
        self.filled: set[int] = set()
        self.windows: list[Window] = []

    def bound(self, q: int) -> int:
        """First nanosecond of slice q: rule 6."""
        return math.ceil(q / self.slices_per_ns)

    def slice_of(self, stamp: int) -> int:
        """The q with bound(q) <= stamp < bound(q + 1)."""
        return math.floor(stamp * self.slices_per_ns)

    def deliver(self, packet: FeedPacket, host_ns: int) -> None:
        """Load the columns of an accepted packet, publish the windows that it closes."""
        sensor = self.sensors[packet.sensor]
        number = sensor.packets
        sensor.packets += 1
        for column, stamp in enumerate(packet.stamps):
            sensor.decoded += 1
            if not packet.valid[column]:
                sensor.drop("invalid")
                continue
            if sensor.first is None:
                sensor.first = stamp
                self.compare_clocks(packet.sensor, stamp - packet.host_ns)
            self.load(packet.sensor, stamp, number, column)
        if self.k0 is None:
            self.initialise()
        if self.k0 is not None:
            self.publish(host_ns)

    def compare_clocks(self, number: int, offset: int) -> None:
        """Rule 3."""
        for other, known in self.offsets.items():
            if not self.settings.host_clock and abs(offset - known) > SECOND_NS:
                raise ClockError(
                    f"sensors {other} and {number}: expected comparable clocks, found stamp minus "
                    f"receive time {known} ns and {offset} ns; use --clock host or clock.offset_s"
                )
        self.offsets[number] = offset

    def load(self, number: int, stamp: int, packet: int, column: int) -> None:
        """Put a column into its window, unless it is late: rule 7."""
        sensor = self.sensors[number]
        q = self.slice_of(stamp)
        end = self.bound(q + 1)
        passed = [] if self.published_end is None else [self.published_end]
        passed += [] if sensor.newest is None else [sensor.newest - SLACK_NS]
        if any(end <= limit for limit in passed):
            sensor.drop("late")
        else:
            self.waiting.setdefault(q, []).append((stamp, number, packet, column))
        sensor.observe(stamp, self.settings.max_wait_ns)

    def stalled(self, sensor: Sensor) -> bool:
        """Rule 4."""
        wait = self.settings.max_wait_ns
        newest = [other.newest for other in self.sensors if other.newest is not None]
        if wait is None or not newest:
            return False
        firsts = [other.first for other in self.sensors if other.first is not None]
        return max(newest) - (min(firsts) if sensor.newest is None else sensor.newest) > wait

    def initialise(self) -> None:
        """Eq. (1), if it can be evaluated: rule 5."""
        stalled = [self.stalled(sensor) for sensor in self.sensors]
        begun = [sensor.first is not None for sensor in self.sensors]
        if any(begun) and all(b or s for b, s in zip(begun, stalled, strict=True)):
            self.begin([one for one, s in zip(self.sensors, stalled, strict=True) if not s])

    def begin(self, live: list[Sensor]) -> None:
        """Eq. (1): k0 is the first window that begins after every first stamp."""
        t0max = max(sensor.first for sensor in live if sensor.first is not None)
        self.k0 = math.floor(t0max * self.settings.rate / SECOND_NS) + 1

    def publish(self, host_ns: int) -> None:
        """Advance the watermark, close the windows that it passes: rule 7."""
        live = [sensor for sensor in self.sensors if not self.stalled(sensor)]
        mark = min(sensor.newest for sensor in live if sensor.newest is not None) - SLACK_NS
        self.watermark = mark if self.watermark is None else max(self.watermark, mark)
        while self.waiting and self.bound(min(self.waiting) + 1) <= self.watermark:
            self.close(min(self.waiting), host_ns, tail=None)
        self.published_end = self.bound(self.slice_of(self.watermark))

    def finish(self, host_ns: int) -> None:
        """End of input: rule 9."""
        for intake in self.intakes:
            intake.finish()
        newest = [sensor.newest for sensor in self.sensors if sensor.newest is not None]
        if newest and self.k0 is None:
            self.begin(self.sensors)
        tail = self.slice_of(max(newest, default=0))
        while self.waiting:
            self.close(min(self.waiting), host_ns, tail)

    def close(self, q: int, host_ns: int, tail: int | None) -> None:
        """Write slice q, or drop its columns for one reason."""
        columns = sorted(self.waiting.pop(q))
        self.filled.add(q)
        reason = self.unwanted(q, tail)
        for _, number, _, _ in columns:
            if reason:
                self.sensors[number].drop(reason)
            else:
                self.sensors[number].written += 1
        if reason or self.k0 is None:
            return
        start = self.bound(q)
        end = self.bound(q + 1)
        k, part = divmod(q, self.settings.slices)
        order = [(number, packet, column) for _, number, packet, column in columns]
        complete = self.complete(start, end)
        self.windows.append(Window(k - self.k0, part, start, end, complete, host_ns, order))

    def unwanted(self, q: int, tail: int | None) -> str:
        """Reason not to write slice q, or an empty text: rule 10."""
        k = q // self.settings.slices
        k0 = self.k0
        if k0 is None or k < k0 - 1:
            return "before_start"
        if not self.inside(k):
            return "outside_time"
        if self.settings.keep_partial:
            return ""
        if k == k0 - 1:
            return "head"
        return "tail" if q == tail else ""

    def inside(self, k: int) -> bool:
        """True if window k begins in [start, end)."""
        low = self.settings.start_ns
        high = self.settings.end_ns
        begin = self.bound(k * self.settings.slices)
        return (low is None or begin >= low) and (high is None or begin < high)

    def complete(self, start: int, end: int) -> bool:
        """Rule 8."""
        for sensor in self.sensors:
            if sensor.first is None or sensor.first > start:
                return False
            if sensor.newest is None or sensor.newest < end:
                return False
            if any(before < end and after > start for before, after in sensor.stalls):
                return False
        return True

    def empty(self) -> int:
        """Slices without a column (rule 10), by subtraction: gaps may last for hours."""
        if self.k0 is None or not self.filled:
            return 0
        low = self.settings.start_ns
        high = self.settings.end_ns
        slices = self.settings.slices
        first = self.k0 * slices
        last = max(self.filled)
        # ceil(k * T) >= low is k * T > low - 1, and ceil(k * T) < high is k * T <= high - 1.
        if low is not None:
            first = max(first, (self.slice_of(low - 1) // slices + 1) * slices)
        if high is not None:
            last = min(last, (self.slice_of(high - 1) // slices + 1) * slices - 1)
        return max(0, last - first + 1) - sum(first <= q <= last for q in self.filled)


def reference_scans(feed: Iterable[FeedPacket], settings: Settings) -> Outcome:
    """Batch the packets of a feed, one by one; ClockError for clocks that cannot be used."""
    session = Session(settings)
    host_ns = 0
    for packet in feed:
        host_ns = packet.host_ns
        try:
            accepted = session.intakes[packet.sensor].take(packet)
        except StepError as step:
            raise ClockError(f"sensor {packet.sensor}: {step}") from step
        for one in accepted:
            session.deliver(one, host_ns)
    session.finish(host_ns)
    return Outcome(
        t_init_ns=None if session.k0 is None else session.bound(session.k0 * settings.slices),
        windows=session.windows,
        rejected=[intake.rejected for intake in session.intakes],
        dropped=[sensor.dropped for sensor in session.sensors],
        decoded=[sensor.decoded for sensor in session.sensors],
        written=[sensor.written for sensor in session.sensors],
        empty=session.empty(),
        incomplete=sum(not window.complete for window in session.windows),
    )
