"""Per-sensor intake: rejects duplicates and implausible stamps, detects clocks that jump.

`Intake` filters packets (`duplicate`, `bad_stamp`) and reports clock resets. `JumpGuard` checks the
accepted ones for forward jumps of the clock. Both raise ClockJump.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from mlbatch.arrays import BoolArray, I64Array
from mlbatch.batching.loss import PacketLoss
from mlbatch.errors import ClockJump
from mlbatch.types import ColumnHeaders
from mlbatch.units import NS_PER_S

# A packet whose stamps differ more than this from the newest one needs confirmation.
STEP_NS = NS_PER_S
STAMP_LIMIT_NS = 2**31 * NS_PER_S
# Duplicates are searched among this many packets of the sensor: captures of bridged ports repeat
# packets within milliseconds, while a 16-bit frame id repeats after hours.
DUPLICATE_REACH = 1024
# Stamps of no packet: before and after all others.
NEVER = -(2**62)
FOREVER = 2**62
# Arrays in which recent keys are kept before they are joined.
_MAX_PIECES = 32
_NONE = np.empty(0, np.int64)


@dataclass(slots=True)
class Arrival:
    """Packets of one sensor in one batch, in order of receive time."""

    position: I64Array  # (P,) int64, index in the batch
    host_ns: I64Array  # (P,) int64, receive time
    key: I64Array  # (P,) int64, equal for duplicates, negative for packets without identity
    headers: ColumnHeaders  # their columns, sensor clock
    ring_index: I64Array  # (P,) int64, ring index of the packet's first column
    # (C,) int64, ring indexes of a packet's columns relative to the first; None: they count up.
    column_offsets: I64Array | None = None
    # All columns are valid, and no stamp is smaller than the one before it. False: unknown.
    is_rising: bool = False

    def take(self, index: BoolArray | I64Array) -> Arrival:
        """The packets at `index`."""
        headers = self.headers
        return Arrival(
            self.position[index],
            self.host_ns[index],
            self.key[index],
            ColumnHeaders(headers.stamp_ns[index], headers.encoder[index], headers.valid[index]),
            self.ring_index[index],
            self.column_offsets,
            self.is_rising,
        )


class Accepted(NamedTuple):
    """Accepted packets of one sensor on the common clock, in order of delivery."""

    packets: Arrival
    newest_ns: I64Array  # (A,) int64, largest valid stamp of each packet, NEVER where none is valid


def rises(headers: ColumnHeaders) -> bool:
    """Whether all columns are valid, and no stamp is smaller than the one before it."""
    stamp = headers.stamp_ns.reshape(-1)
    is_whole = stamp.size > 0 and bool(headers.valid.all())
    return is_whole and bool((stamp[1:] >= stamp[:-1]).all())


def extremes(headers: ColumnHeaders) -> tuple[I64Array, I64Array]:
    """Smallest and largest valid stamp of each packet; FOREVER and NEVER where none is valid."""
    stamp = headers.stamp_ns
    valid = headers.valid
    if valid.size and valid.all():
        return stamp.min(axis=1), stamp.max(axis=1)
    low = np.where(valid, stamp, FOREVER).min(axis=1, initial=FOREVER)
    high = np.where(valid, stamp, NEVER).max(axis=1, initial=NEVER)
    return low, high


def _extent(low: I64Array, high: I64Array, *, is_rising: bool) -> tuple[int, int]:
    """Smallest of `low`, largest of `high`, both (n,); is_rising: both rise."""
    if is_rising and len(low):
        return int(low[0]), int(high[-1])
    return int(low.min(initial=FOREVER)), int(high.max(initial=NEVER))


class Intake:
    """Filter of the packets of one sensor; `rejected` counts rejected packets by reason.

    renumbered: duplicates by their number whose timestamps are others.
    """

    def __init__(
        self,
        name: str,
        *,
        host_clock: bool = False,
        offset_ns: int = 0,
        modulus: int = 0,
        packet_ns: float = 0.0,
        has_receive_times: bool = True,
    ) -> None:
        """Arguments of one sensor.

        host_clock: replace stamps by receive times; offset_ns: added to stamps; modulus,
        packet_ns: as in PacketLoss; has_receive_times: False where `--clock host` is refused.
        """
        self.name = name
        self.has_receive_times = has_receive_times
        self.loss = PacketLoss(modulus, packet_ns)
        self.rejected: dict[str, int] = {}
        self.renumbered = 0
        self._host_clock = host_clock
        self._offset_ns = offset_ns
        self._newest = NEVER
        # A packet that steps, until the next packet confirms or refutes the step.
        self._held: Arrival | None = None
        # Keys of the newest packets: DUPLICATE_REACH of them or more, once there are so many.
        self._recent: list[I64Array] = []
        # First timestamp of each.
        self._recent_ns: list[I64Array] = []
        self._largest_key = -1

    def accept(self, arrival: Arrival) -> Accepted:
        """Accept the good packets of a batch; ClockJump where the clock was reset."""
        fresh = self._distinct(arrival.key, arrival.headers.stamp_ns[:, 0])
        if fresh is not None:
            arrival = arrival.take(fresh)
        headers = arrival.headers
        if self._offset_ns:
            headers.stamp_ns = headers.stamp_ns + self._offset_ns
        if arrival.is_rising:
            # Copies, since some are kept.
            low = headers.stamp_ns[:, 0].copy()
            high = headers.stamp_ns[:, -1].copy()
        else:
            low, high = extremes(headers)
        lowest, highest = _extent(low, high, is_rising=arrival.is_rising)
        if self._held is None and len(high) and self._has_no_step(lowest, highest):
            self._newest = max(self._newest, highest)
        else:
            arrival, low, high = self._check_stamps(arrival, low, high)
        self.loss.add(arrival.key, arrival.headers, arrival.host_ns)
        if self._host_clock and len(high):
            stamp = arrival.headers.stamp_ns
            measured = high > NEVER
            arrival.headers.stamp_ns = arrival.host_ns[:, None] - (high[:, None] - stamp)
            arrival.is_rising = False
            high = np.where(measured, arrival.host_ns, NEVER)
        return Accepted(arrival, high)

    def finish(self) -> None:
        """End of input: reject the packet that is still held, since nothing can confirm it."""
        if self._held is not None:
            self._reject("bad_stamp", 1)
            self._held = None

    @property
    def held_host_ns(self) -> int | None:
        """Receive time of the packet that is held, if any."""
        return None if self._held is None else int(self._held.host_ns[0])

    @property
    def held_ring_index(self) -> int | None:
        """Ring index of the packet that is held, if any; its pixels must not be overwritten."""
        return None if self._held is None else int(self._held.ring_index[0])

    def _reject(self, reason: str, count: int) -> None:
        if count:
            self.rejected[reason] = self.rejected.get(reason, 0) + count

    # -- duplicates ---------------------------------------------------------------------------

    def _distinct(self, key: I64Array, first_ns: I64Array) -> BoolArray | None:
        """Mask of packets that repeat none of the last DUPLICATE_REACH; None: all are new."""
        rises = len(key) > 0 and int(key[0]) > self._largest_key
        if rises and (len(key) == 1 or bool((key[1:] > key[:-1]).all())):
            # The usual case: every key is larger than all before it.
            self._remember(key, first_ns)
            self._largest_key = int(key[-1])
            return None
        recent = np.concatenate([*self._recent, _NONE])[-DUPLICATE_REACH:]
        recent_ns = np.concatenate([*self._recent_ns, _NONE])[-DUPLICATE_REACH:]
        if len(key) == 1:
            # One key without an order: a linear search is cheaper than a sort.
            fresh = np.array([key[0] < 0 or not (recent == key).any()])
        elif _all_differ(recent, key):
            fresh = np.ones(len(key), np.bool_)
        else:
            fresh = _first_of_kind(recent, key)
        self._largest_key = max(int(recent.max(initial=-1)), int(key.max(initial=-1)))
        self._recent = [recent]
        self._recent_ns = [recent_ns]
        self._remember(key, first_ns)
        repeated = len(key) - int(np.count_nonzero(fresh))
        self._reject("duplicate", repeated)
        if not repeated:
            return None
        known = len(recent)
        keys = np.concatenate([recent, key])
        self.renumbered += _count_renumbered(keys, np.concatenate([recent_ns, first_ns]), known)
        return fresh

    def _remember(self, key: I64Array, first_ns: I64Array) -> None:
        self._recent.append(key)
        self._recent_ns.append(first_ns.copy())
        if len(self._recent) > _MAX_PIECES:
            self._recent = [np.concatenate(self._recent)[-DUPLICATE_REACH:]]
            self._recent_ns = [np.concatenate(self._recent_ns)[-DUPLICATE_REACH:]]

    # -- stamps -------------------------------------------------------------------------------

    def _has_no_step(self, lowest: int, highest: int) -> bool:
        """True if no stamp between these limits can be out of range or part of a step."""
        return (
            lowest >= 0
            and highest < STAMP_LIMIT_NS
            and max(highest, self._newest) - lowest <= STEP_NS
            and (self._newest == NEVER or highest - self._newest <= STEP_NS)
        )

    def _check_stamps(
        self, arrival: Arrival, low: I64Array, high: I64Array
    ) -> tuple[Arrival, I64Array, I64Array]:
        """Packets with stamps in range and without unconfirmed steps; their extremes."""
        # A packet without a valid column has low = FOREVER and high = NEVER, and is accepted.
        sane = (low >= 0) & (high < STAMP_LIMIT_NS) & (high - low <= STEP_NS)
        if not sane.all():
            self._reject("bad_stamp", len(sane) - int(np.count_nonzero(sane)))
            arrival = arrival.take(sane)
            low = low[sane]
            high = high[sane]
        if self._held is not None or self._steps(low, high).any():
            arrival = self._confirm_steps(arrival)
            return arrival, *extremes(arrival.headers)
        self._newest = max(self._newest, int(high.max(initial=NEVER)))
        return arrival, low, high

    def _steps(self, low: I64Array, high: I64Array) -> BoolArray:
        """Mask of packets more than STEP_NS from the newest stamp before them, if none is held."""
        newest = np.empty_like(high)
        newest[:1] = self._newest
        newest[1:] = high[:-1]
        np.maximum.accumulate(newest, out=newest)
        # The first packet of all has no stamp before it.
        has_newest = newest > NEVER
        measured = high > NEVER
        return has_newest & measured & ((high > newest + STEP_NS) | (low < newest - STEP_NS))

    def _confirm_steps(self, arrival: Arrival) -> Arrival:
        """Hold each packet that steps until the next one; packet by packet, since steps are rare.

        The next packet confirms the step if all of it is within STEP_NS of the held packet.
        """
        rows = arrival if self._held is None else _joined(self._held, arrival)
        low, high = extremes(rows.headers)
        position = rows.position.copy()
        held = None if self._held is None else 0
        newest = self._newest
        accepted = []
        for row in range(0 if held is None else 1, len(high)):
            lowest = int(low[row])
            highest = int(high[row])
            if highest > NEVER:
                steps = newest > NEVER and (highest > newest + STEP_NS or lowest < newest - STEP_NS)
                if held is not None:
                    first = self._first_stamp(rows, held)
                    near = first - STEP_NS <= lowest and highest <= first + STEP_NS
                    if steps and near:
                        if first < newest:
                            if not self._host_clock:
                                raise self._reset(newest, first, int(rows.host_ns[held]))
                            # With --clock host, stamps are only used for ages within a packet.
                            newest = NEVER
                        accepted.append(held)
                        # It is delivered together with the packet that confirms it.
                        position[held] = position[row]
                        newest = max(newest, int(high[held]))
                        held = None
                        steps = False
                    else:
                        self._reject("bad_stamp", 1)
                        held = None
                if steps:
                    held = row
                    continue
                newest = max(newest, highest)
            accepted.append(row)
        self._newest = newest
        self._held = None if held is None else rows.take(np.array([held]))
        rows.position = position
        return rows.take(np.array(accepted, np.int64))

    @staticmethod
    def _first_stamp(rows: Arrival, row: int) -> int:
        headers = rows.headers
        return int(headers.stamp_ns[row][headers.valid[row]][0])

    def _reset(self, newest: int, back: int, host_ns: int) -> ClockJump:
        return ClockJump(
            f"sensor {self.name}: clock reset within the recording: expected stamps of one "
            f"continuous clock, found a step back from {newest / NS_PER_S:.6f} s to "
            f"{back / NS_PER_S:.6f} s; {remedies(self.has_receive_times)}",
            host_ns,
        )


def _all_differ(recent: I64Array, key: I64Array) -> bool:
    """Whether no two keys are equal, the usual case; a sort of values is faster than of indices."""
    keys = np.concatenate([recent, key])
    keys.sort()
    return not bool((keys[1:] == keys[:-1]).any())


def _first_of_kind(recent: I64Array, key: I64Array) -> BoolArray:
    """Mask of keys (n,) that repeat none of the DUPLICATE_REACH keys before them.

    recent: keys of earlier batches, oldest first.
    """
    keys = np.concatenate([recent, key])
    order = keys.argsort(kind="stable")
    ordered = keys[order]
    again = (ordered[1:] == ordered[:-1]) & (ordered[1:] >= 0)
    again &= order[1:] - order[:-1] <= DUPLICATE_REACH
    fresh = np.ones(len(keys), bool)
    fresh[order[1:][again]] = False
    return fresh[len(recent) :]


def _count_renumbered(key: I64Array, first_ns: I64Array, known: int) -> int:
    """Number of packets whose number an earlier one with another timestamp had.

    known: packets that were counted before.
    """
    order = key.argsort(kind="stable")
    ordered = key[order]
    again = (ordered[1:] == ordered[:-1]) & (ordered[1:] >= 0) & (order[1:] >= known)
    return int(np.count_nonzero(again & (np.diff(first_ns[order]) != 0)))


def _joined(first: Arrival, second: Arrival) -> Arrival:
    headers = ColumnHeaders(
        np.concatenate([first.headers.stamp_ns, second.headers.stamp_ns]),
        np.concatenate([first.headers.encoder, second.headers.encoder]),
        np.concatenate([first.headers.valid, second.headers.valid]),
    )
    return Arrival(
        np.concatenate([first.position, second.position]),
        np.concatenate([first.host_ns, second.host_ns]),
        np.concatenate([first.key, second.key]),
        headers,
        np.concatenate([first.ring_index, second.ring_index]),
        first.column_offsets,
    )


def remedies(has_receive_times: bool) -> str:
    """What to do about a clock that jumps; has_receive_times: as in `Intake`."""
    return "use --on-jump split" + (", or --clock host" if has_receive_times else "")


class Watch(Protocol):
    """Observer of the stamps and receive times of accepted packets (`clocks.watch.ClockWatch`)."""

    def add(self, stamp_ns: I64Array, host_ns: I64Array) -> None:
        """Add packets (P,), in order of delivery."""
        ...


class JumpGuard:
    """Detects forward jumps of a sensor's clock: steps in the stamps but not in receive times.

    After a silence both have advanced by the same time, which is a gap and no jump. If stamps
    advance by more than STEP_NS longer than receive times, the clock was set: PTP or GPS lock, or a
    restart. Backward jumps are detected by `Intake`.
    """

    def __init__(self, name: str, watch: Watch | None = None, *, has_clock: bool = True) -> None:
        """Arguments of one sensor.

        watch: observer of all packets, None where receive times are too inexact; has_clock: False
        where stamps are receive times, which show nothing of a sensor's clock.
        """
        self.name = name
        self._watch = watch
        self._has_clock = has_clock
        self._newest_ns = NEVER
        self._host_ns = 0

    def check(self, accepted: Accepted) -> None:
        """Check the next packets, in order of delivery; ClockJump at the first jump."""
        if not self._has_clock:
            return
        stamp_ns = accepted.newest_ns
        host_ns = accepted.packets.host_ns
        is_rising = accepted.packets.is_rising
        lowest_ns, highest_ns = _extent(stamp_ns, stamp_ns, is_rising=is_rising)
        if len(stamp_ns) and lowest_ns <= NEVER:
            measured = stamp_ns > NEVER
            stamp_ns = stamp_ns[measured]
            host_ns = host_ns[measured]
        if not len(stamp_ns):
            return
        if self._newest_ns == NEVER:
            self._newest_ns = int(stamp_ns[0])
            self._host_ns = int(host_ns[0])
        newest_ns = max(self._newest_ns, highest_ns)
        if newest_ns - self._newest_ns > STEP_NS:
            self._refuse_jump(stamp_ns, host_ns)
        self._newest_ns = newest_ns
        self._host_ns = int(host_ns[-1])
        if self._watch is not None:
            self._watch.add(stamp_ns, host_ns)

    def _refuse_jump(self, stamp_ns: I64Array, host_ns: I64Array) -> None:
        newest = np.maximum.accumulate(np.concatenate([[self._newest_ns], stamp_ns]))
        hosts = np.concatenate([[self._host_ns], host_ns])
        steps = newest[1:] - newest[:-1]
        passed = hosts[1:] - hosts[:-1]
        # No time passed between packets that share the receive time of a message.
        jumps = (steps > STEP_NS) & (passed > 0) & (steps - passed > STEP_NS)
        if jumps.any():
            raise self._jump(newest, hosts, int(np.argmax(jumps)))

    def _jump(self, newest: I64Array, hosts: I64Array, at: int) -> ClockJump:
        before = int(newest[at])
        after = int(newest[at + 1])
        passed = int(hosts[at + 1] - hosts[at])
        return ClockJump(
            f"sensor {self.name}: clock jump within the recording: expected stamps of one "
            f"continuous clock, found a step forward from {before / NS_PER_S:.6f} s to "
            f"{after / NS_PER_S:.6f} s within {passed / NS_PER_S:.6f} s at the capture host; "
            f"{remedies(self._watch is not None)}",
            int(hosts[at + 1]),
        )
