"""What of a sensor's packets is let in: no duplicates, no wild stamps, clock resets named.

CONTRACT.md section 1, `bad_stamp`; section 4, `duplicate`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mlbatch.arrays import BoolArray, I64Array
from mlbatch.batching.loss import PacketLoss
from mlbatch.errors import ClockJump
from mlbatch.types import Heads
from mlbatch.units import NS_PER_S

STEP_NS = NS_PER_S
STAMP_LIMIT_NS = 2**31 * NS_PER_S
# A packet is a duplicate of one that came at most this many packets of the sensor before: captures
# of bridged ports repeat within milliseconds, while a 16-bit frame id comes back after hours.
DUPLICATE_REACH = 1024
NEVER = -(2**62)
FOREVER = 2**62
# Keys are kept in so many pieces at most.
_MOST_PIECES = 32
_NONE = np.empty(0, np.int64)


@dataclass(slots=True)
class Arrival:
    """Packets of one sensor in one batch, in order of arrival.

    position: (P,) int64, place in the batch; host_ns: (P,) int64; key: (P,) int64, equal for
    duplicates, negative for packets without identity; heads: their columns, sensor clock; place:
    (P,) int64, where the packet's first column lies in the ring.
    """

    position: I64Array
    host_ns: I64Array
    key: I64Array
    heads: Heads
    place: I64Array

    def take(self, index: BoolArray | I64Array) -> Arrival:
        """The packets at `index`."""
        heads = self.heads
        return Arrival(
            self.position[index],
            self.host_ns[index],
            self.key[index],
            Heads(heads.stamp_ns[index], heads.encoder[index], heads.valid[index]),
            self.place[index],
        )


@dataclass(slots=True)
class Accepted:
    """Accepted packets of one sensor on the common clock, in order of delivery.

    newest_ns: (A,) int64, largest valid stamp of each, NEVER where none is valid.
    """

    packets: Arrival
    newest_ns: I64Array


def extremes(heads: Heads) -> tuple[I64Array, I64Array]:
    """Smallest and largest valid stamp of each packet; FOREVER and NEVER where none is valid."""
    stamp, valid = heads.stamp_ns, heads.valid
    if valid.size and valid.all():
        return stamp.min(axis=1), stamp.max(axis=1)
    low = np.where(valid, stamp, FOREVER).min(axis=1, initial=FOREVER)
    high = np.where(valid, stamp, NEVER).max(axis=1, initial=NEVER)
    return low, high


class Intake:
    """The door of one sensor; `rejected` counts what stays outside."""

    def __init__(
        self,
        name: str,
        *,
        host_clock: bool = False,
        offset_ns: int = 0,
        modulus: int = 0,
        packet_ns: float = 0.0,
    ) -> None:
        """modulus, packet_ns: as in PacketLoss."""
        self.name = name
        self.loss = PacketLoss(modulus, packet_ns)
        self.rejected: dict[str, int] = {}
        self._host_clock = host_clock
        self._offset_ns = offset_ns
        self._newest = NEVER
        self._held: Arrival | None = None
        # Keys of the newest packets, DUPLICATE_REACH or more where there were so many.
        self._recent: list[I64Array] = []
        self._largest_key = -1

    def accept(self, arrival: Arrival) -> Accepted:
        """Let in the packets of a batch, as far as they are good."""
        fresh = self._distinct(arrival.key)
        if fresh is not None:
            arrival = arrival.take(fresh)
        heads = arrival.heads
        if self._offset_ns:
            heads.stamp_ns = heads.stamp_ns + self._offset_ns
        low, high = extremes(heads)
        if self._held is None and len(high) and self._is_calm(int(low.min()), int(high.max())):
            self._newest = max(self._newest, int(high.max()))
        else:
            arrival, low, high = self._sift(arrival, low, high)
        self.loss.add(arrival.key, arrival.heads, arrival.host_ns)
        if self._host_clock and len(high):
            stamp, known = arrival.heads.stamp_ns, high > NEVER
            arrival.heads.stamp_ns = arrival.host_ns[:, None] - (high[:, None] - stamp)
            high = np.where(known, arrival.host_ns, NEVER)
        return Accepted(arrival, high)

    def _is_calm(self, lowest: int, highest: int) -> bool:
        """Whether stamps between these limits are sane, and no packet of them can be a step."""
        return (
            lowest >= 0
            and highest < STAMP_LIMIT_NS
            and max(highest, self._newest) - lowest <= STEP_NS
            and (self._newest == NEVER or highest - self._newest <= STEP_NS)
        )

    def _sift(
        self, arrival: Arrival, low: I64Array, high: I64Array
    ) -> tuple[Arrival, I64Array, I64Array]:
        """The packets whose stamps are sane and whose steps are confirmed; their extremes."""
        # Where nothing was measured, low lies far above and high far below: such packets pass.
        sane = (low >= 0) & (high < STAMP_LIMIT_NS) & (high - low <= STEP_NS)
        if not sane.all():
            self._reject("bad_stamp", len(sane) - int(np.count_nonzero(sane)))
            arrival, low, high = arrival.take(sane), low[sane], high[sane]
        if self._held is not None or self._steps(low, high).any():
            arrival = self._judge(arrival)
            return arrival, *extremes(arrival.heads)
        self._newest = max(self._newest, int(high.max(initial=NEVER)))
        return arrival, low, high

    def finish(self) -> None:
        """End of input: a packet that is still held was never confirmed."""
        if self._held is not None:
            self._reject("bad_stamp", 1)
            self._held = None

    def _reject(self, reason: str, count: int) -> None:
        if count:
            self.rejected[reason] = self.rejected.get(reason, 0) + count

    def _distinct(self, key: I64Array) -> BoolArray | None:
        """Which packets are not a repetition of one of the last DUPLICATE_REACH; None: all."""
        rises = len(key) > 0 and int(key[0]) > self._largest_key
        if rises and (len(key) == 1 or bool((key[1:] > key[:-1]).all())):
            # As nearly always: every number is larger than all before it.
            self._remember(key)
            self._largest_key = int(key[-1])
            return None
        recent = np.concatenate([*self._recent, _NONE])[-DUPLICATE_REACH:]
        if len(key) == 1:
            # Numbers without an order that come one by one: a look at all is cheaper than a sort.
            fresh = np.array([key[0] < 0 or not (recent == key).any()])
        else:
            fresh = _first_of_kind(recent, key)
        self._largest_key = max(int(recent.max(initial=-1)), int(key.max(initial=-1)))
        self._recent = [recent]
        self._remember(key)
        again = len(key) - int(np.count_nonzero(fresh))
        self._reject("duplicate", again)
        return fresh if again else None

    def _remember(self, key: I64Array) -> None:
        self._recent.append(key)
        if len(self._recent) > _MOST_PIECES:
            self._recent = [np.concatenate(self._recent)[-DUPLICATE_REACH:]]

    def _steps(self, low: I64Array, high: I64Array) -> BoolArray:
        """Which packets step more than 1 s from the newest stamp before them, if none were held."""
        newest = np.empty_like(high)
        newest[:1], newest[1:] = self._newest, high[:-1]
        np.maximum.accumulate(newest, out=newest)
        # The first packet of all has nothing to step from.
        known, measured = newest > NEVER, high > NEVER
        return known & measured & ((high > newest + STEP_NS) | (low < newest - STEP_NS))

    def _judge(self, arrival: Arrival) -> Arrival:
        """Hold packets that step until the next one: packet by packet, since it is rare."""
        rows = arrival if self._held is None else _joined(self._held, arrival)
        low, high = extremes(rows.heads)
        position = rows.position.copy()
        held = None if self._held is None else 0
        newest, accepted = self._newest, []
        for row in range(0 if held is None else 1, len(high)):
            lowest, highest = int(low[row]), int(high[row])
            if highest > NEVER:
                steps = newest > NEVER and (highest > newest + STEP_NS or lowest < newest - STEP_NS)
                if held is not None:
                    first = self._first_stamp(rows, held)
                    near = first - STEP_NS <= lowest and highest <= first + STEP_NS
                    if steps and near:
                        if first < newest:
                            if not self._host_clock:
                                raise self._reset(newest, first, int(rows.host_ns[held]))
                            newest = NEVER  # Stamps only tell ages within a packet.
                        accepted.append(held)
                        # It is let in together with the packet that confirms it.
                        position[held] = position[row]
                        newest, held = max(newest, int(high[held])), None
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
        self._held = None if held is None else _copied(rows, held)
        rows.position = position
        return rows.take(np.array(accepted, np.int64))

    @staticmethod
    def _first_stamp(rows: Arrival, row: int) -> int:
        heads = rows.heads
        return int(heads.stamp_ns[row][heads.valid[row]][0])

    def _reset(self, newest: int, back: int, host_ns: int) -> ClockJump:
        return ClockJump(
            f"sensor {self.name}: clock reset within the recording: stamps went back from "
            f"{newest / NS_PER_S:.6f} s to {back / NS_PER_S:.6f} s; wanted one running clock; "
            "use --on-jump split, or --clock host",
            host_ns,
        )

    @property
    def held_host_ns(self) -> int | None:
        """Arrival of the packet that is held, if any."""
        return None if self._held is None else int(self._held.host_ns[0])

    @property
    def held_place(self) -> int | None:
        """Ring place of the packet that is held, if any; its pixels must not be overwritten."""
        return None if self._held is None else int(self._held.place[0])


def _first_of_kind(recent: I64Array, key: I64Array) -> BoolArray:
    """Which keys (n,) repeat none of the DUPLICATE_REACH before them; recent: those before all."""
    keys = np.concatenate([recent, key])
    order = keys.argsort(kind="stable")
    ordered = keys[order]
    again = (ordered[1:] == ordered[:-1]) & (ordered[1:] >= 0)
    again &= order[1:] - order[:-1] <= DUPLICATE_REACH
    fresh = np.ones(len(keys), bool)
    fresh[order[1:][again]] = False
    return fresh[len(recent) :]


def _copied(rows: Arrival, row: int) -> Arrival:
    return rows.take(np.array([row]))


def _joined(first: Arrival, second: Arrival) -> Arrival:
    one, two = first.heads, second.heads
    heads = Heads(
        np.concatenate([one.stamp_ns, two.stamp_ns]),
        np.concatenate([one.encoder, two.encoder]),
        np.concatenate([one.valid, two.valid]),
    )
    return Arrival(
        np.concatenate([first.position, second.position]),
        np.concatenate([first.host_ns, second.host_ns]),
        np.concatenate([first.key, second.key]),
        heads,
        np.concatenate([first.place, second.place]),
    )


# Clocks that jump forward: a gap in the stamps that the recorder's clock did not see.
#
# A sensor that was silent goes on where its clock is by then, and as much time has passed at the
# recorder. Where stamps step by more than a second and arrivals do not, the clock was set: by
# PTP or GPS that locked, or by a restart. Backward steps are told by `intake.py`.


class Watch(Protocol):
    """What wants to know the stamps and arrivals of all accepted packets."""

    def add(self, stamp_ns: I64Array, host_ns: I64Array) -> None:
        """Take in packets (P,), in order of delivery."""
        ...


class JumpGuard:
    """Looks at the accepted packets of one sensor; `check` raises ClockJump.

    watch: told of all packets; None where arrivals are not known well enough. has_clock: False
    where stamps are arrivals, which tell nothing of a clock.
    """

    def __init__(self, name: str, watch: Watch | None = None, *, has_clock: bool = True) -> None:
        self.name = name
        self._watch = watch
        self._has_clock = has_clock
        self._newest_ns = NEVER
        self._host_ns = 0

    def check(self, delivery: Accepted) -> None:
        """Look at the next packets, in order of delivery."""
        if not self._has_clock:
            return
        stamp_ns, host_ns = delivery.newest_ns, delivery.packets.host_ns
        if len(stamp_ns) and int(stamp_ns.min()) <= NEVER:
            measured = stamp_ns > NEVER
            stamp_ns, host_ns = stamp_ns[measured], host_ns[measured]
        if not len(stamp_ns):
            return
        if self._newest_ns == NEVER:
            self._newest_ns, self._host_ns = int(stamp_ns[0]), int(host_ns[0])
        newest_ns = max(self._newest_ns, int(stamp_ns.max()))
        if newest_ns - self._newest_ns > STEP_NS:
            self._refuse_jump(stamp_ns, host_ns)
        self._newest_ns, self._host_ns = newest_ns, int(host_ns[-1])
        if self._watch is not None:
            self._watch.add(stamp_ns, host_ns)

    def _refuse_jump(self, stamp_ns: I64Array, host_ns: I64Array) -> None:
        """Look for a step of more than a second in the stamps that arrivals do not show."""
        newest = np.maximum.accumulate(np.concatenate([[self._newest_ns], stamp_ns]))
        hosts = np.concatenate([[self._host_ns], host_ns])
        steps, passed = newest[1:] - newest[:-1], hosts[1:] - hosts[:-1]
        # Recorders without times of their own say nothing.
        jumps = (steps > STEP_NS) & (passed > 0) & (steps - passed > STEP_NS)
        if jumps.any():
            raise self._jump(newest, hosts, int(np.argmax(jumps)))

    def _jump(self, newest: I64Array, hosts: I64Array, at: int) -> ClockJump:
        before, after = int(newest[at]), int(newest[at + 1])
        passed = int(hosts[at + 1] - hosts[at])
        return ClockJump(
            f"sensor {self.name}: clock jump within the recording: stamps went forward from "
            f"{before / NS_PER_S:.6f} s to {after / NS_PER_S:.6f} s while only "
            f"{passed / NS_PER_S:.6f} s passed at the recorder; wanted one running clock; use "
            "--on-jump split, or --clock host",
            int(hosts[at + 1]),
        )
