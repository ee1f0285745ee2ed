"""What a sensor's stamps count: decided by their value and by the recorder's clock.

facts/ouster.md section 7: the mode a sensor was set to does not prove what it does; its values do.
"""

from __future__ import annotations

from mlbatch.leap_seconds import tai_utc_s
from mlbatch.units import NS_PER_S

# Stamps below 1e9 s (2001) cannot be today's time: the sensor counts from power-on.
EPOCH_NS = 10**9 * NS_PER_S
# How far the recorder's clock may be off for a timescale to be told.
NEAR_NS = 2 * NS_PER_S


def timescale(stamp_ns: int, host_ns: int) -> str:
    """`utc`, `tai`, `uptime` or `unknown`, for a stamp and the arrival of its packet (UTC)."""
    if stamp_ns < EPOCH_NS:
        return "uptime"
    for name, offset_ns in (("utc", 0), ("tai", tai_utc_s(host_ns) * NS_PER_S)):
        if abs(stamp_ns - host_ns - offset_ns) < NEAR_NS:
            return name
    return "unknown"


def common_timescale(names: list[str]) -> str:
    """The timescale of a scan made of several sensors: theirs if they agree, else unknown."""
    return names[0] if len(set(names)) == 1 else "unknown"
