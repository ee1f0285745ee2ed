"""Leap seconds: how far TAI and GPS time are ahead of UTC.

Source: leap-seconds.list of the IERS (hpiers.obspm.fr/iers/bul/bulc/ntp/leap-seconds.list, in the
form of RFC 8633 section 3.7), updated 2026-07-06; Bulletin C says every half year whether a leap
second follows. GPS time: IS-GPS-200, section 3.3.4: equal to UTC on 1980-01-06, no leap seconds.
"""

from __future__ import annotations

from bisect import bisect_right
from datetime import datetime, timezone

from mlbatch.units import NS_PER_S

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
