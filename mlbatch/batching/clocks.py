"""Clocks that can be merged: CONTRACT.md section 1, "Comparable clocks"."""

from __future__ import annotations

from mlbatch.errors import ClockError
from mlbatch.units import NS_PER_S

COMPARABLE_NS = NS_PER_S


def refuse_incomparable(offsets_ns: list[tuple[str, int | None]], number: int) -> None:
    """Compare sensor `number` with all others that have a packet; ClockError beyond 1 s.

    offsets_ns: name of each sensor and its first stamp minus the arrival of its packet.
    """
    name, mine_ns = offsets_ns[number]
    for other, theirs_ns in offsets_ns[:number] + offsets_ns[number + 1 :]:
        if mine_ns is None or theirs_ns is None or abs(mine_ns - theirs_ns) <= COMPARABLE_NS:
            continue
        raise ClockError(
            f"clocks of the sensors cannot be compared: stamp minus arrival is "
            f"{theirs_ns / NS_PER_S:+.3f} s for {other} and {mine_ns / NS_PER_S:+.3f} s for "
            f"{name}, {abs(mine_ns - theirs_ns) / NS_PER_S:.3f} s apart; wanted at most 1 s; "
            "use --clock host, or give clock.offset_s in the rig"
        )
