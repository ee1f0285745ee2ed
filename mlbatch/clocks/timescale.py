"""What a sensor's stamps count: decided by their value and by the recorder's clock.

facts/ouster.md section 7: the mode a sensor was set to does not prove what it does; its values do.
"""

from __future__ import annotations

from bisect import bisect_right
from datetime import datetime, timezone

from mlbatch.units import NS_PER_MS, NS_PER_S

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


# Leap seconds: how far TAI and GPS time are ahead of UTC.
#
# Source: leap-seconds.list of the IERS (hpiers.obspm.fr/iers/bul/bulc/ntp/leap-seconds.list, in
# the form of RFC 8633 section 3.7), updated 2026-07-06; Bulletin C says every half year whether
# a leap second follows. GPS time: IS-GPS-200, section 3.3.4: equal to UTC on 1980-01-06, no leap
# seconds.

# Until then no leap second can have been added that the table lacks.
VALID_UNTIL = "2027-06-28"
TAI_GPS_S = 19
# 1980-01-06 in seconds since 1970.
GPS_EPOCH_S = 315_964_800
# From this day (UTC) on, TAI - UTC is so many seconds.
LEAPS: tuple[tuple[str, int], ...] = (
    ("1972-01-01", 10),
    ("1972-07-01", 11),
    ("1973-01-01", 12),
    ("1974-01-01", 13),
    ("1975-01-01", 14),
    ("1976-01-01", 15),
    ("1977-01-01", 16),
    ("1978-01-01", 17),
    ("1979-01-01", 18),
    ("1980-01-01", 19),
    ("1981-07-01", 20),
    ("1982-07-01", 21),
    ("1983-07-01", 22),
    ("1985-07-01", 23),
    ("1988-01-01", 24),
    ("1990-01-01", 25),
    ("1991-01-01", 26),
    ("1992-07-01", 27),
    ("1993-07-01", 28),
    ("1994-07-01", 29),
    ("1996-01-01", 30),
    ("1997-07-01", 31),
    ("1999-01-01", 32),
    ("2006-01-01", 33),
    ("2009-01-01", 34),
    ("2012-07-01", 35),
    ("2015-07-01", 36),
    ("2017-01-01", 37),
)
_STARTS_S = [
    int(datetime.fromisoformat(day).replace(tzinfo=timezone.utc).timestamp()) for day, _ in LEAPS
]


def tai_utc_s(utc_ns: int) -> int:
    """TAI - UTC in whole seconds at a time in ns since 1970 (UTC); 10 before 1972."""
    return LEAPS[max(bisect_right(_STARTS_S, utc_ns // NS_PER_S) - 1, 0)][1]


def gps_utc_s(utc_ns: int) -> int:
    """GPS time - UTC in whole seconds at a time in ns since 1970 (UTC); negative before 1980."""
    return tai_utc_s(utc_ns) - TAI_GPS_S


# Names for what clocks count and for the differences between them.
#
# facts/ouster.md section 7, facts/velodyne.md section 7, facts/hesai.md section 4: the mode a
# sensor was set to does not prove what its clock does; the values do.

UTC, TAI, GPS = "utc", "tai", "gps"
TOP_OF_HOUR, UPTIME, WRONG_YEAR, UNKNOWN = "top_of_hour", "uptime", "wrong_year", "unknown"
# Kinds of jumps that the sensor's clock has no part in; what stepped between two packets.
HOST, DELAY, SENSOR = "host", "delay", "sensor"
# Domains whose clocks follow the world's time.
EPOCHS = (UTC, TAI, GPS)
IN_WORDS = {
    UTC: "UTC",
    TAI: "TAI",
    GPS: "GPS time",
    TOP_OF_HOUR: "past an hour, not synchronised",
    UPTIME: "since power-on",
    WRONG_YEAR: "a wrong date",
    UNKNOWN: "unknown",
}
HOUR_NS = 3600 * NS_PER_S
DAY_NS = 24 * HOUR_NS
# No sensor runs for three years on end; 1973 to 2001 is a calendar that was never set.
LONGEST_UPTIME_NS = 10**8 * NS_PER_S
_HALF_A_YEAR_NS = 182 * DAY_NS
# Sensors send within seconds of power-on, their clocks begin there.
_STARTED_NS = 600 * NS_PER_S
_LARGEST_ZONE_H = 14
# Counters that wrap: of 32 bits in us and ns, and past the hour.
_WRAPS_NS = (2**32 * 1000, 2**32, HOUR_NS, DAY_NS)
_WRAP_ERROR_NS = 20 * NS_PER_MS


def shifts_ns(utc_ns: int) -> tuple[tuple[str, int], ...]:
    """How far clocks of each epoch domain are ahead of UTC; GPS also as counted from 1980."""
    tai_s, gps_s = tai_utc_s(utc_ns), gps_utc_s(utc_ns)
    shifts = ((UTC, 0), (TAI, tai_s), (GPS, gps_s), (GPS, gps_s - GPS_EPOCH_S))
    return tuple((name, seconds * NS_PER_S) for name, seconds in shifts)


def domain_of(stamp_ns: int, offset_ns: int, period_ns: int) -> str:
    """What a stamp counts that is `offset_ns` ahead of the recorder's clock (UTC).

    period_ns: what the sensor leaves out and the recorder's clock gave (the hour), 0: nothing.
    """
    if period_ns:
        return UTC if abs(offset_ns) < NEAR_NS else TOP_OF_HOUR
    host_ns = stamp_ns - offset_ns
    if host_ns >= EPOCH_NS:
        for name, shift_ns in shifts_ns(host_ns):
            if abs(offset_ns - shift_ns) < NEAR_NS:
                return name
    if stamp_ns < LONGEST_UPTIME_NS:
        return UPTIME
    if stamp_ns < EPOCH_NS or (host_ns >= EPOCH_NS and abs(offset_ns) >= _HALF_A_YEAR_NS):
        return WRONG_YEAR
    return UNKNOWN


def whole_ns(difference_ns: int, utc_ns: int, error_ns: int) -> tuple[int, str] | None:
    """The known difference that is met within `error_ns`, and its name; None if there is none."""
    if abs(difference_ns) <= error_ns:
        return None
    sign = 1 if difference_ns > 0 else -1
    tai_s, gps_s = tai_utc_s(utc_ns), gps_utc_s(utc_ns)
    known = (
        (tai_s, f"{tai_s} s: TAI - UTC"),
        (gps_s, f"{gps_s} s: GPS - UTC"),
        (TAI_GPS_S, f"{TAI_GPS_S} s: TAI - GPS"),
        (GPS_EPOCH_S, "from 1970 to 1980: GPS time without its epoch"),
        (GPS_EPOCH_S - gps_s, "UTC against GPS time from 1980"),
    )
    for seconds, name in known:
        if abs(abs(difference_ns) - seconds * NS_PER_S) <= error_ns:
            return sign * seconds * NS_PER_S, name
    for unit_ns, most, unit in (
        (DAY_NS, None, "day(s)"),
        (HOUR_NS, _LARGEST_ZONE_H, "hour(s): a time zone, or the wrong hour"),
        (NS_PER_S, None, "second(s)"),
    ):
        count = round(abs(difference_ns) / unit_ns)
        if count and (most is None or count <= most):
            whole = sign * count * unit_ns
            if abs(difference_ns - whole) <= error_ns:
                return whole, f"{count} whole {unit}"
    return None


def kind_of_jump(before_ns: int, after_ns: int, size_ns: int, period_ns: int) -> str:
    """`forward`, `backward`, `restart` or `wrap`: what a sensor's clock did between two stamps."""
    # An hour that was found anew may also go up; counters only fall back.
    wraps_ns = {period_ns} if size_ns > 0 else {period_ns, *_WRAPS_NS}
    if any(abs(abs(size_ns) - wrap_ns) < _WRAP_ERROR_NS for wrap_ns in wraps_ns - {0}):
        return "wrap"
    if after_ns < before_ns and after_ns < _STARTED_NS:
        return "restart"
    return "forward" if size_ns > 0 else "backward"


def in_seconds(value_ns: int) -> str:
    """A difference for people: ms below a second, else s."""
    if abs(value_ns) < NS_PER_S:
        return f"{value_ns / NS_PER_MS:+.3f} ms"
    return f"{value_ns / NS_PER_S:+.6f} s"
