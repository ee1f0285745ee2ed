"""The intake of one sensor by the rules of docs/batching.md, packet by packet in plain integers.

1. A key that occurred in at most 1024 packets of the sensor before (accepted or not) makes a
   `duplicate`; keys below 0 identify nothing. It is renumbered if its first stamp is another.
2. A packet without a valid column is accepted; it neither confirms nor refutes a step.
3. A valid stamp outside [0, 2^31 s), or valid stamps that span more than 1 s: `bad_stamp`.
4. A packet with a valid stamp more than 1 s from the newest accepted one is a step, and is held
   until the next packet Q of the sensor that passes the rules above. If Q is no step, the held
   packet is rejected and Q accepted. If all of Q is within 1 s of the first valid stamp of the
   held packet, the step is confirmed: forward it is a gap, and both are accepted, in order;
   backward it is a clock reset, at the held packet. Otherwise the held packet is rejected and Q is
   held. End of input rejects a held packet.
5. A packet accepted whose largest stamp is more than 1 s after the newest, and more than 1 s longer
   after it than it was received after the last accepted packet, shows that the clock was set: a
   jump, at this packet. Packets of one receive time show nothing.
6. With the host clock, the same rules apply to the stamps of the sensor, except that a reset is
   accepted and nothing is a jump. Then the stamps of an accepted packet become its receive time
   minus their age relative to its largest valid stamp.

A held packet is delivered together with the packet that confirms it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

__all__ = ["DUPLICATE_REACH", "FeedPacket", "Intake", "Numbers", "StepError"]

SECOND_NS = 10**9
DUPLICATE_REACH = 1024


@dataclass(frozen=True, slots=True)
class FeedPacket:
    """A packet in order of receive time: key < 0: no identity; stamps on the sensor's clock, ns."""

    sensor: int
    host_ns: int
    key: int
    stamps: tuple[int, ...]
    valid: tuple[bool, ...]

    def valid_stamps(self) -> list[int]:
        """Stamps of the valid columns, in their order."""
        return [stamp for stamp, valid in zip(self.stamps, self.valid, strict=True) if valid]


class StepError(Exception):
    """A clock was set: stamps before and after, receive time of the first packet after it."""

    def __init__(self, before_ns: int, after_ns: int, host_ns: int) -> None:
        super().__init__(f"expected one clock, found {before_ns} ns and then {after_ns} ns")
        self.before_ns = before_ns
        self.after_ns = after_ns
        self.host_ns = host_ns


class Intake:
    """Filter of the packets of one sensor."""

    def __init__(self, host_clock: bool, *, finds_jumps: bool = False) -> None:
        self.host_clock = host_clock
        self.finds_jumps = finds_jumps
        self.rejected: dict[str, int] = {}
        self.renumbered = 0
        self.packets = 0
        # By key: number and first stamp of the last packet that had it.
        self.last_seen: dict[int, tuple[int, int]] = {}
        self.newest: int | None = None
        self.newest_host_ns = 0
        self.held: FeedPacket | None = None

    def take(self, packet: FeedPacket) -> list[FeedPacket]:
        """Packets that are accepted with this one, in order, stamps on the common clock."""
        if self._is_duplicate(packet):
            self._reject("duplicate")
            return []
        stamps = packet.valid_stamps()
        if not stamps:
            return [packet]
        impossible = min(stamps) < 0 or max(stamps) >= 2**31 * SECOND_NS
        if impossible or max(stamps) - min(stamps) > SECOND_NS:
            self._reject("bad_stamp")
            return []
        return [self._accept(one) for one in self._confirm(packet, stamps)]

    def finish(self) -> None:
        """End of input: reject a held packet."""
        if self.held is not None:
            self._reject("bad_stamp")
            self.held = None

    def _is_duplicate(self, packet: FeedPacket) -> bool:
        self.packets += 1
        if packet.key < 0:
            return False
        number, first_ns = self.last_seen.get(packet.key, (-DUPLICATE_REACH, 0))
        self.last_seen[packet.key] = self.packets, packet.stamps[0]
        if self.packets - number > DUPLICATE_REACH:
            return False
        self.renumbered += first_ns != packet.stamps[0]
        return True

    def _confirm(self, packet: FeedPacket, stamps: list[int]) -> list[FeedPacket]:
        held = self.held
        newest = self.newest
        self.held = None
        if newest is None or all(abs(stamp - newest) <= SECOND_NS for stamp in stamps):
            if held is not None:
                self._reject("bad_stamp")
            return [packet]
        if held is None:
            self.held = packet
            return []
        first = held.valid_stamps()[0]
        if any(abs(stamp - first) > SECOND_NS for stamp in stamps):
            self._reject("bad_stamp")
            self.held = packet
            return []
        if first < newest and self.host_clock:
            self.newest = None
        elif first < newest:
            raise StepError(newest, first, held.host_ns)
        return [held, packet]

    def _accept(self, packet: FeedPacket) -> FeedPacket:
        largest = max(packet.valid_stamps())
        if self.newest is not None and self.finds_jumps and not self.host_clock:
            step = largest - self.newest
            passed = packet.host_ns - self.newest_host_ns
            if step > SECOND_NS and passed > 0 and step - passed > SECOND_NS:
                raise StepError(self.newest, largest, packet.host_ns)
        self.newest = largest if self.newest is None else max(self.newest, largest)
        self.newest_host_ns = packet.host_ns
        if not self.host_clock:
            return packet
        stamps = tuple(packet.host_ns - (largest - stamp) for stamp in packet.stamps)
        return replace(packet, stamps=stamps)

    def _reject(self, reason: str) -> None:
        self.rejected[reason] = self.rejected.get(reason, 0) + 1


class Numbers:
    """Lost and reordered packets by numbers that wrap at `modulus`: docs/sensors.md, Loss.

    A number more than 1024 from the newest one is believed once the next number is near it.
    """

    def __init__(self, modulus: int) -> None:
        self.modulus = modulus
        self.lost = 0
        self.reordered = 0
        self.numbers: list[int] = []
        self.doubtful: int | None = None

    def add(self, number: int) -> None:
        """Count the next accepted packet; negative numbers are ignored."""
        if number < 0:
            return
        if not self.numbers:
            self.numbers = [number]
            return
        step = self._apart(number, self.numbers[-1])
        doubtful = self.doubtful
        self.doubtful = None
        if abs(step) <= 1024:
            if step < 0:
                # One of those that were counted as lost comes late.
                self.reordered += 1
                self.lost = max(self.lost - 1, 0)
            self.lost += max(step - 1, 0)
            self.numbers.append(number if step > 0 else self.numbers[-1])
        elif doubtful is None or abs(self._apart(number, doubtful)) > 1024:
            self.doubtful = number
        else:
            # The first number of all may be a damaged one, and a step back is a restart.
            if step > 0 and len(self.numbers) > 1:
                self.lost += step - 2
            self.numbers.append(number)

    def _apart(self, one: int, other: int) -> int:
        """The shortest way from the other to the one."""
        step = (one - other) % self.modulus
        return step - self.modulus if 2 * step >= self.modulus else step
