"""Date and time of HESAI packets.

Source: facts/hesai.md section 4. Six bytes are a calendar date, UTC, or, where the first one is 0,
big-endian seconds since 1970; microseconds follow elsewhere and may be a full second.
"""

from __future__ import annotations

import numpy as np

from mlbatch.sensors.packet_bytes import number
from mlbatch.types import BoolArray, I64Array, U8Array
from mlbatch.units import NS_PER_S, NS_PER_US

_CENTURY = 70  # Years below are of this century, others of the last.
_US_PER_S = 1_000_000
_S_PER_DAY = 86400
# What int64 ns since 1970 can hold, in seconds: beyond, a date is damaged.
_MOST_S = 9_000_000_000


def packet_times(packets: U8Array, date_at: int, us_at: int) -> tuple[I64Array, BoolArray]:
    """(P,) ns since 1970 of packets, and whether their date and time can be."""
    date = packets[:, date_at : date_at + 6].astype(np.int64)
    us = number(packets, us_at, 4)
    calendar_s, is_date = _calendar(date)
    counted_s = number(packets, date_at + 1, 5, ">")
    is_counted = date[:, 0] == 0
    seconds = np.where(is_counted, counted_s, calendar_s)
    valid = np.where(is_counted, counted_s <= _MOST_S, is_date) & (us <= _US_PER_S)
    return np.where(valid, seconds, 0) * NS_PER_S + us * NS_PER_US, valid


def _calendar(date: I64Array) -> tuple[I64Array, BoolArray]:
    """Seconds since 1970 of (P, 6) year, month, day, hour, minute, second; and their validity."""
    year, month, day, hour, minute, second = date.T
    months = (np.where(year < _CENTURY, year + 30, year - _CENTURY)) * 12 + month - 1
    first_day, next_month = _days(months), _days(months + 1)
    valid = (month >= 1) & (month <= 12) & (day >= 1) & (day <= next_month - first_day)
    valid &= (hour < 24) & (minute < 60) & (second < 60)
    days = first_day + day - 1
    return days * _S_PER_DAY + hour * 3600 + minute * 60 + second, valid


def _days(months: I64Array) -> I64Array:
    """Days from 1970 to the first of a month counted from January 1970."""
    days: I64Array = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64)
    return days
