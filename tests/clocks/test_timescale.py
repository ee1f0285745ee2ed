"""Timescales of stamps (docs/sources/ouster.md, section 7); leap seconds."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone

import pytest

from mlbatch.clocks.timescale import (
    GPS_EPOCH_S,
    LEAPS,
    TAI_GPS_S,
    VALID_UNTIL,
    common_timescale,
    gps_utc_s,
    known_difference,
    tai_utc_s,
    timescale,
)

NS_PER_S = 10**9


NOON_S = 1_777_896_000
# New Year of 2014 and of 2009 had leap seconds of their own (IERS).
YEAR_2014_S, YEAR_2009_S = 1_388_534_400, 1_230_768_000
FIRST_S = 10**9


@pytest.mark.parametrize(
    ("ahead_s", "host_s", "name"),
    [
        (0, NOON_S, "utc"),
        (-0.004, NOON_S, "utc"),
        (1.999, NOON_S, "utc"),
        (-1.999, NOON_S, "utc"),
        (2, NOON_S, "unknown"),
        # A standard PTP grandmaster serves TAI, 37 s ahead of UTC since 2017.
        (37, NOON_S, "tai"),
        (35.001, NOON_S, "tai"),
        (38.999, NOON_S, "tai"),
        (39, NOON_S, "unknown"),
        (18, NOON_S, "unknown"),
        (540.79, NOON_S, "unknown"),
        (-37, NOON_S, "unknown"),
        (35, YEAR_2014_S, "tai"),
        (37, YEAR_2014_S, "unknown"),
        (34, YEAR_2009_S, "tai"),
        (37, YEAR_2009_S, "unknown"),
        # Small stamps count from power-on, also where PTP was asked for and never locked: 866 s
        # and 1089 s were seen.
        *((seconds - NOON_S, NOON_S, "uptime") for seconds in (0, 866, 16011, 999_999_999)),
        # The first date there is.
        (-1e-9, FIRST_S, "uptime"),
        (0, FIRST_S, "utc"),
    ],
)
def test_a_stamp_is_compared_with_the_capture_host(ahead_s: float, host_s: int, name: str) -> None:
    host_ns = host_s * NS_PER_S
    assert timescale(host_ns + round(ahead_s * NS_PER_S), host_ns) == name


@pytest.mark.parametrize(
    ("names", "shared"),
    [
        (["utc", "utc"], "utc"),
        (["uptime"], "uptime"),
        (["utc", "tai"], "unknown"),
        (["utc", "unknown"], "unknown"),
        ([], "unknown"),
    ],
)
def test_a_scan_has_the_timescale_of_all_its_sensors(names: list[str], shared: str) -> None:
    assert common_timescale(names) == shared


# -- leap seconds, against dates of bulletins and standards ---------------------------------------


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


# In 2026: TAI - UTC is 37 s; GPS time counts from 3657 days after 1970, and is 18 s ahead of UTC.
@pytest.mark.parametrize(
    ("seconds", "name"),
    [
        (37, "37 s: TAI - UTC"),
        (18, "18 s: GPS - UTC"),
        (19, "19 s: TAI - GPS"),
        (3657 * 86_400, "from 1970 to 1980: GPS time without its epoch"),
        (3657 * 86_400 - 18, "UTC against GPS time from 1980"),
        (3657 * 86_400 + 18, "315964818 whole second(s)"),
        (2 * 86_400, "2 whole day(s)"),
    ],
)
def test_differences_of_timescales_are_named(seconds: int, name: str) -> None:
    for sign in (1, -1):
        difference_ns = sign * seconds * NS_PER_S
        found = known_difference(difference_ns + 400, NOON_S * NS_PER_S, 1000)
        assert found == (difference_ns, name)


def test_the_table_grows_by_one_second_at_the_end_of_june_or_december() -> None:
    days = [datetime.fromisoformat(day) for day, _ in LEAPS]
    assert days == sorted(days)
    assert [seconds for _, seconds in LEAPS] == list(range(10, 38))
    assert {(day.month, day.day) for day in days} == {(1, 1), (7, 1)}
    # A list is published for at least half a year.
    assert datetime.fromisoformat(VALID_UNTIL) - days[-1] > timedelta(days=180)
