"""Packets lost and reordered on the way: by the sensor's own count, else by the pace of stamps."""

from __future__ import annotations

from mlbatch.batching.pace import PaceLoss
from mlbatch.types import Heads, I64Array

# A longer step is believed only if the next packet goes on from there: one flipped bit in a frame
# number must not count as a million lost packets.
BELIEVED_STEP = 1024


class PacketLoss:
    """What one sensor's packets tell of others that did not come, or came late.

    By their numbers where they bear a count, else by the pace of their stamps; a sensor of which
    neither is known loses nothing that we know of.
    """

    def __init__(self, modulus: int, packet_ns: float = 0.0) -> None:
        """modulus: where the count wraps, 0 none; packet_ns: time of a packet, 0 unknown."""
        self._numbers = Loss(modulus)
        self._pace = PaceLoss(packet_ns) if packet_ns and not modulus else None

    @property
    def lost(self) -> int:
        """Packets missing between those that came."""
        return self._numbers.lost if self._pace is None else self._pace.lost

    @property
    def reordered(self) -> int:
        """Packets that came after a later one."""
        return self._numbers.reordered if self._pace is None else self._pace.reordered

    def add(self, sequence: I64Array, heads: Heads, host_ns: I64Array) -> None:
        """Count accepted packets (P,), in order of arrival, by the sensor's own clock."""
        if self._pace is None:
            self._numbers.add(sequence)
        elif len(host_ns):
            self._pace.add(heads, host_ns)


class Loss:
    """Counts gaps and backward steps in sequence numbers that wrap at `modulus` (0: none)."""

    def __init__(self, modulus: int) -> None:
        self.lost = 0
        self.reordered = 0
        self._modulus = modulus
        self._newest: int | None = None
        self._doubtful: int | None = None
        # One packet alone proves nothing: the first of all may be the damaged one.
        self._is_sure = False

    def add(self, sequence: I64Array) -> None:
        """Count accepted packets (n,), in order of arrival; negative: outside the count."""
        if not self._modulus or not len(sequence):
            return
        if self._is_sure and self._doubtful is None and self._goes_on(sequence):
            self._newest = int(sequence[-1])
            return
        for number in sequence[sequence >= 0].tolist():
            if self._newest is None:
                self._newest = number
            else:
                self._step(number)

    def _goes_on(self, sequence: I64Array) -> bool:
        """Whether every number is one more than that before, as nearly always."""
        if self._newest is None or int(sequence[0]) != (self._newest + 1) % self._modulus:
            return False
        return len(sequence) == 1 or bool(
            (sequence[1:] == (sequence[:-1] + 1) % self._modulus).all()
        )

    def _step(self, number: int) -> None:
        step = self._signed(number - (self._newest or 0))
        if abs(step) > BELIEVED_STEP:
            if self._doubtful is None or abs(self._signed(number - self._doubtful)) > BELIEVED_STEP:
                self._doubtful = number
                return
            # A restart counts anew; a long gap is a gap.
            if step > 0 and self._is_sure:
                self.lost += step - 2
            self._newest, self._doubtful, self._is_sure = number, None, True
            return
        self._doubtful, self._is_sure = None, True
        if step > 0:
            self.lost += step - 1
            self._newest = number
        elif step < 0:
            self.reordered += 1
            self.lost = max(0, self.lost - 1)

    def _signed(self, step: int) -> int:
        half = self._modulus // 2
        return (step + half) % self._modulus - half
