"""Clocks that can be merged: CONTRACT.md section 1, "Comparable clocks"."""

from __future__ import annotations

from mlbatch.doctor import whole_ns
from mlbatch.errors import ClockError
from mlbatch.units import NS_PER_MS, NS_PER_S

COMPARABLE_NS = NS_PER_S
# As near a difference must lie to one that has a name, such as TAI - UTC; and the time for which
# it is named, since no leap second has been added for years.
WHOLE_WITHIN_NS = 50 * NS_PER_MS
TODAY_NS = 1_700_000_000 * NS_PER_S


def refuse_incomparable(offsets_ns: list[tuple[str, int | None]], number: int) -> None:
    """Compare sensor `number` with all others that have a packet; ClockError beyond 1 s.

    offsets_ns: name of each sensor and its first stamp minus the arrival of its packet.
    """
    name, mine_ns = offsets_ns[number]
    for other, theirs_ns in offsets_ns[:number] + offsets_ns[number + 1 :]:
        if mine_ns is None or theirs_ns is None or abs(mine_ns - theirs_ns) <= COMPARABLE_NS:
            continue
        apart_ns = abs(mine_ns - theirs_ns)
        known = whole_ns(apart_ns, TODAY_NS, WHOLE_WITHIN_NS)
        named = f" ({known[1]})" if known is not None and "second" not in known[1] else ""
        raise ClockError(
            f"clocks of the sensors cannot be compared: stamp minus arrival is "
            f"{theirs_ns / NS_PER_S:+.3f} s for {other} and {mine_ns / NS_PER_S:+.3f} s for "
            f"{name}, {apart_ns / NS_PER_S:.3f} s apart{named}; wanted at most 1 s; use "
            "--align-clocks or --clock host, or give clock.offset_s or clock.epoch in the rig"
        )
