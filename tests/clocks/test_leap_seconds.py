"""Leap seconds against dates that bulletins and standards name."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone

import pytest

from mlbatch.clocks.timescale import (
    GPS_EPOCH_S,
    LEAPS,
    TAI_GPS_S,
    VALID_UNTIL,
    gps_utc_s,
    tai_utc_s,
)

NS_PER_S = 10**9


def _ns(text: str) -> int:
    return int(datetime.fromisoformat(text).replace(tzinfo=timezone.utc).timestamp()) * NS_PER_S


@pytest.mark.parametrize(
    ("day", "seconds"),
    [
        # IERS Bulletin C 52: from 2017-01-01 UTC - TAI = -37 s; C 49: -36 s from 2015-07-01.
        ("2016-12-31T23:59:59", 36),
        ("2017-01-01", 37),
        ("2015-07-01", 36),
        ("2015-06-30T23:59:59", 35),
        ("2026-06-30", 37),
        # The first leap second of all.
        ("1972-06-30", 10),
        ("1972-07-01", 11),
        # When GPS time began, TAI was 19 s ahead.
        ("1980-01-06", 19),
        ("1970-01-01", 10),
    ],
)
def test_tai_minus_utc(day: str, seconds: int) -> None:
    assert tai_utc_s(_ns(day)) == seconds


def test_gps_time_began_with_utc_and_is_now_18_s_ahead() -> None:
    began = _ns("1980-01-06")
    assert began == GPS_EPOCH_S * NS_PER_S
    assert gps_utc_s(began) == 0
    assert gps_utc_s(_ns("2024-05-01")) == 18
    assert TAI_GPS_S == 19


def test_the_table_grows_by_one_second_at_the_end_of_june_or_december() -> None:
    days = [datetime.fromisoformat(day) for day, _ in LEAPS]
    assert days == sorted(days)
    assert [seconds for _, seconds in LEAPS] == list(range(10, 38))
    assert {(day.month, day.day) for day in days} == {(1, 1), (7, 1)}
    # A list is published for at least half a year.
    assert datetime.fromisoformat(VALID_UNTIL) - days[-1] > timedelta(days=180)
