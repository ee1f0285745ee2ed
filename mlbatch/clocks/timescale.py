"""Timescale of a sensor's stamps: UTC, TAI, GPS time, time since power-on; leap seconds.

The timescale follows from the values of the stamps and the receive times of their packets, never
from a mode field: a sensor in PTP mode counts from power-on until PTP locks
(docs/sources/ouster.md section 7, velodyne.md section 7, hesai.md section 4).
"""

from __future__ import annotations

from bisect import bisect_right
from datetime import datetime, timezone

from mlbatch.units import NS_PER_MS, NS_PER_S

UTC = "utc"
TAI = "tai"
GPS = "gps"
TOP_OF_HOUR = "top_of_hour"
UPTIME = "uptime"
WRONG_YEAR = "wrong_year"
UNKNOWN = "unknown"
# Domains of clocks that follow civil time.
EPOCHS = (UTC, TAI, GPS)
DESCRIPTION = {
    UTC: "UTC",
    TAI: "TAI",
    GPS: "GPS time",
    TOP_OF_HOUR: "past an hour, not synchronised",
    UPTIME: "since power-on",
    WRONG_YEAR: "a wrong date",
    UNKNOWN: "unknown",
}

# -- leap seconds ---------------------------------------------------------------------------------

# Source: leap-seconds.list of the IERS (hpiers.obspm.fr/iers/bul/bulc/ntp/leap-seconds.list, in
# the form of RFC 8633 section 3.7), updated 2026-07-06; Bulletin C announces every half year
# whether a leap second follows. GPS time: IS-GPS-200, section 3.3.4: equal to UTC on 1980-01-06,
# no leap seconds.

# The table is complete until this day.
VALID_UNTIL = "2027-06-28"
TAI_GPS_S = 19
# 1980-01-06 in seconds since 1970.
GPS_EPOCH_S = 315_964_800
# TAI - UTC in seconds from this day (UTC) on.
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


# -- timescale of a stamp -------------------------------------------------------------------------

# Stamps below 1e9 s (2001) are no current date: the sensor counts from power-on.
EPOCH_NS = 10**9 * NS_PER_S
# Tolerance for the clock of the capture host.
NEAR_NS = 2 * NS_PER_S
HOUR_NS = 3600 * NS_PER_S
DAY_NS = 24 * HOUR_NS
# No sensor runs for three years without a break; dates from 1973 to 2001 are a calendar that was
# never set.
LONGEST_UPTIME_NS = 10**8 * NS_PER_S
_HALF_A_YEAR_NS = 182 * DAY_NS


def timescale(stamp_ns: int, host_ns: int) -> str:
    """`utc`, `tai`, `uptime` or `unknown`, for a stamp and the receive time of its packet (UTC)."""
    if stamp_ns < EPOCH_NS:
        return UPTIME
    for name, offset_ns in ((UTC, 0), (TAI, tai_utc_s(host_ns) * NS_PER_S)):
        if abs(stamp_ns - host_ns - offset_ns) < NEAR_NS:
            return name
    return UNKNOWN


def describe_time(stamp_ns: int, name: str) -> str:
    """A time as text: date and timescale `name`, or seconds of a clock without a date."""
    if stamp_ns < EPOCH_NS:
        since = "since power-on" if name == UPTIME else "of a clock without a date"
        return f"{stamp_ns / NS_PER_S:.3f} s {since}"
    moment = datetime.fromtimestamp(stamp_ns // NS_PER_S, timezone.utc)
    text = f"{moment:%Y-%m-%dT%H:%M:%S}.{stamp_ns % NS_PER_S // NS_PER_MS:03d}"
    if name == UTC:
        return f"{text}Z"
    return f"{text} TAI" if name == TAI else f"{text} by the sensors' clock, timescale unknown"


def common_timescale(names: list[str]) -> str:
    """Timescale of scans of several sensors: theirs if they agree, else unknown."""
    return names[0] if len(set(names)) == 1 else UNKNOWN


def domain_of(stamp_ns: int, offset_ns: int, period_ns: int) -> str:
    """Domain of a clock that shows `stamp_ns` and is `offset_ns` ahead of the capture host (UTC).

    Finer than `timescale`. period_ns: range of the sensor's counter if the decoder completes it
    from receive times (an hour), else 0.
    """
    if period_ns:
        return UTC if abs(offset_ns) < NEAR_NS else TOP_OF_HOUR
    host_ns = stamp_ns - offset_ns
    if host_ns >= EPOCH_NS:
        for name, ahead_ns in _ahead_of_utc(host_ns):
            if abs(offset_ns - ahead_ns) < NEAR_NS:
                return name
    if stamp_ns < LONGEST_UPTIME_NS:
        return UPTIME
    if stamp_ns < EPOCH_NS or (host_ns >= EPOCH_NS and abs(offset_ns) >= _HALF_A_YEAR_NS):
        return WRONG_YEAR
    return UNKNOWN


def _ahead_of_utc(utc_ns: int) -> tuple[tuple[str, int], ...]:
    """Difference to UTC of each epoch domain, ns; GPS time also as counted from 1980."""
    tai_s = tai_utc_s(utc_ns)
    gps_s = gps_utc_s(utc_ns)
    ahead = ((UTC, 0), (TAI, tai_s), (GPS, gps_s), (GPS, gps_s - GPS_EPOCH_S))
    return tuple((name, seconds * NS_PER_S) for name, seconds in ahead)


# -- differences of clocks ------------------------------------------------------------------------

_LARGEST_ZONE_H = 14


def known_difference(difference_ns: int, utc_ns: int, error_ns: int) -> tuple[int, str] | None:
    """The known difference of two timescales within `error_ns` of a value, and its name; or None.

    Known are differences of UTC, TAI and GPS time at `utc_ns`, and whole days, hours and seconds.
    """
    if abs(difference_ns) <= error_ns:
        return None
    sign = 1 if difference_ns > 0 else -1
    tai_s = tai_utc_s(utc_ns)
    gps_s = gps_utc_s(utc_ns)
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
            whole_ns = sign * count * unit_ns
            if abs(difference_ns - whole_ns) <= error_ns:
                return whole_ns, f"{count} whole {unit}"
    return None


def format_difference(value_ns: int) -> str:
    """A difference as text: in ms below a second, else in s."""
    if abs(value_ns) < NS_PER_S:
        return f"{value_ns / NS_PER_MS:+.3f} ms"
    return f"{value_ns / NS_PER_S:+.6f} s"


# -- kinds of jumps -------------------------------------------------------------------------------

# Jumps that are not of the sensor's clock: the capture host's clock stepped; the transport delay of
# one sensor changed.
HOST = "host"
DELAY = "delay"
# The clock that stepped between two packets: of stamps (`sensor`) or receive times (HOST).
SENSOR = "sensor"
# A sensor sends within seconds of power-on, when its clock starts.
_STARTED_NS = 600 * NS_PER_S
# Ranges of counters: 32 bits of us and ns, the hour, the day.
_WRAPS_NS = (2**32 * 1000, 2**32, HOUR_NS, DAY_NS)
_WRAP_ERROR_NS = 20 * NS_PER_MS


def kind_of_jump(before_ns: int, after_ns: int, size_ns: int, period_ns: int) -> str:
    """`forward`, `backward`, `restart` or `wrap`: how a sensor's clock moved between two stamps."""
    # Counters wrap backward only; an hour that the decoder corrects may also move forward.
    wraps_ns = {period_ns} if size_ns > 0 else {period_ns, *_WRAPS_NS}
    if any(abs(abs(size_ns) - wrap_ns) < _WRAP_ERROR_NS for wrap_ns in wraps_ns - {0}):
        return "wrap"
    if after_ns < before_ns and after_ns < _STARTED_NS:
        return "restart"
    return "forward" if size_ns > 0 else "backward"
