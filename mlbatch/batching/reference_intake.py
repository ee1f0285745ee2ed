"""Which packets the oracle lets in: rule 1 of `reference.py`, packet by packet.

Source: CONTRACT.md section 1, `bad_stamp`, and section 4, `duplicate`, made exact. Each sensor is
judged in its own order:

- A key that the sensor sent at most 1024 of its packets ago (let in or not) is a `duplicate`; keys
  below 0 identify nothing.
- A packet without a valid column is accepted; it neither confirms nor rejects anything.
- A valid stamp outside [0, 2^31 s), or valid stamps that span more than 1 s: `bad_stamp` at once.
- A packet with a valid stamp more than 1 s from the newest accepted one steps, and is held. The
  sensor's next packet Q that gets this far judges it. Q does not step from the newest: the held one
  is rejected, Q accepted. All of Q lies within 1 s of the held one's first valid stamp: confirmed;
  forward it is a gap, both are accepted in order; backward it is a reset, a `ClockError`. Else the
  held one is rejected and Q is held. End of input rejects what is held.
- With the host clock the same is judged on the sensor's stamps, but that a reset is accepted; then
  the stamps of an accepted packet become its host time minus their age against its largest valid
  stamp.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from mlbatch.errors import ClockError

SECOND_NS = 10**9
DUPLICATE_REACH = 1024


@dataclass(frozen=True, slots=True)
class FeedPacket:
    """One packet as it arrives: key < 0 has no identity; stamps on the sensor's clock, ns."""

    sensor: int
    host_ns: int
    key: int
    stamps: tuple[int, ...]
    valid: tuple[bool, ...]

    def valid_stamps(self) -> list[int]:
        """Stamps of the columns that were measured, in their order."""
        return [stamp for stamp, valid in zip(self.stamps, self.valid, strict=True) if valid]


class Intake:
    """The door of one sensor: rule 1."""

    def __init__(self, sensor: int, host_clock: bool) -> None:
        self.sensor = sensor
        self.host_clock = host_clock
        self.rejected: dict[str, int] = {}
        self.packets = 0
        self.last_seen: dict[int, int] = {}
        self.newest: int | None = None
        self.held: FeedPacket | None = None

    def take(self, packet: FeedPacket) -> list[FeedPacket]:
        """Packets that are let in when this one arrives, in order, stamps on the common clock."""
        if self._is_duplicate(packet.key):
            self._reject("duplicate")
            return []
        stamps = packet.valid_stamps()
        if not stamps:
            return [packet]
        impossible = min(stamps) < 0 or max(stamps) >= 2**31 * SECOND_NS
        if impossible or max(stamps) - min(stamps) > SECOND_NS:
            self._reject("bad_stamp")
            return []
        return [self._let_in(one) for one in self._judge(packet, stamps)]

    def finish(self) -> None:
        """End of input: nothing can confirm a held packet any more."""
        if self.held is not None:
            self._reject("bad_stamp")
            self.held = None

    def _is_duplicate(self, key: int) -> bool:
        self.packets += 1
        if key < 0:
            return False
        before = self.last_seen.get(key)
        self.last_seen[key] = self.packets
        return before is not None and self.packets - before <= DUPLICATE_REACH

    def _judge(self, packet: FeedPacket, stamps: list[int]) -> list[FeedPacket]:
        held, self.held = self.held, None
        newest = self.newest
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
            raise ClockError(
                f"sensor {self.sensor}: wanted a clock that runs on, got a reset from "
                f"{newest} ns back to {first} ns; cut the recording there or use --clock host"
            )
        return [held, packet]

    def _let_in(self, packet: FeedPacket) -> FeedPacket:
        largest = max(packet.valid_stamps())
        self.newest = largest if self.newest is None else max(self.newest, largest)
        if not self.host_clock:
            return packet
        stamps = tuple(packet.host_ns - (largest - stamp) for stamp in packet.stamps)
        return replace(packet, stamps=stamps)

    def _reject(self, reason: str) -> None:
        self.rejected[reason] = self.rejected.get(reason, 0) + 1
