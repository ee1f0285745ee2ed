"""Sessions with very many packet kinds: port scans, file transfers, video among the lidars.

The first kinds are followed one by one. A later kind is only counted, until it has sent some
packets and a vendor recognises one of them: memory and time do not grow with streams that no sensor
sends, and a lidar that starts last is found.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from mlbatch import sensors
from mlbatch.arrays import I64Array
from mlbatch.discovery.types import PacketKind
from mlbatch.types import PacketBatch

# Kinds that are followed whatever they are; vehicles with ten lidars send a few dozen.
MOST_KINDS = 256
# Later kinds are examined at this packet, and then each time their number has doubled.
EXAMINED_AT = 16
# Kinds that are counted one by one; then all of them begin anew.
_MOST_COUNTED = 1 << 16


@dataclass(slots=True)
class Crowd:
    """Decides which packet kinds are followed.

    packets: those that were not, so far; kinds: how many kinds they are of, at least.
    """

    packets: int = 0
    kinds: int = 0
    _followed: set[PacketKind] = field(default_factory=set)
    _counted: dict[PacketKind, int] = field(default_factory=dict)

    def followed(
        self, batch: PacketBatch, parts: list[tuple[PacketKind, I64Array]]
    ) -> list[tuple[PacketKind, I64Array]]:
        """The kinds to follow among those of a batch, and the rows from which on.

        parts: kinds with their rows, as by `split_by_kind`. All other packets are counted. The
        result does not depend on the size of batches.
        """
        if len(self._followed) + len(parts) > MOST_KINDS:
            parts = sorted(parts, key=lambda part: int(part[1][0]))
        chosen = []
        for kind, index in parts:
            begin = self._first_row(batch, kind, index)
            self.packets += begin
            if begin < len(index):
                chosen.append((kind, index[begin:] if begin else index))
        return chosen

    def _first_row(self, batch: PacketBatch, kind: PacketKind, index: I64Array) -> int:
        """Number of packets of a kind in a batch before it is followed."""
        if kind in self._followed:
            return 0
        if len(self._followed) < MOST_KINDS:
            self._followed.add(kind)
            return 0
        before = self._counted.get(kind, 0)
        if not before:
            self.kinds += 1
            if len(self._counted) >= _MOST_COUNTED:
                self._counted.clear()
        examined = EXAMINED_AT
        while examined <= before + len(index):
            row = examined - before - 1
            if row >= 0 and _is_recognised(batch, kind, int(index[row])):
                self._counted.pop(kind, None)
                self._followed.add(kind)
                return row
            examined *= 2
        self._counted[kind] = before + len(index)
        return len(index)


def _is_recognised(batch: PacketBatch, kind: PacketKind, row: int) -> bool:
    begin = int(batch.start[row])
    payload = batch.data[begin : begin + kind.size]
    return sensors.describe(kind.size, payload[None]) is not None
