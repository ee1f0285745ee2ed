"""Timescales of stamps (docs/sources/ouster.md, section 7); leap seconds."""

from __future__ import annotations

import pytest

from mlbatch.clocks.timescale import common_timescale, timescale

NS_PER_S = 10**9
NOON_NS = 1_777_896_000 * NS_PER_S


@pytest.mark.parametrize(
    ("ahead_s", "name"),
    [
        (0.0, "utc"),
        (-0.004, "utc"),
        (1.999, "utc"),
        (-1.999, "utc"),
        (2.0, "unknown"),
        # A standard PTP grandmaster serves TAI, 37 s ahead of UTC since 2017.
        (37.0, "tai"),
        (35.001, "tai"),
        (38.999, "tai"),
        (39.0, "unknown"),
        (18.0, "unknown"),
        (540.79, "unknown"),
        (-37.0, "unknown"),
    ],
)
def test_a_date_is_compared_with_the_capture_host(ahead_s: float, name: str) -> None:
    assert timescale(NOON_NS + round(ahead_s * NS_PER_S), NOON_NS) == name


@pytest.mark.parametrize(("date_s", "ahead_s"), [(1_388_534_400, 35), (1_230_768_000, 34)])
def test_older_recordings_have_their_own_leap_seconds(date_s: int, ahead_s: int) -> None:
    """New Year of 2014 and of 2009 (IERS)."""
    host_ns = date_s * NS_PER_S
    assert timescale(host_ns + ahead_s * NS_PER_S, host_ns) == "tai"
    assert timescale(host_ns + 37 * NS_PER_S, host_ns) == "unknown"


@pytest.mark.parametrize("seconds", [0, 866, 16011, 999_999_999])
def test_small_stamps_count_from_power_on(seconds: int) -> None:
    """Also where PTP was asked for and never locked: 866 s and 1089 s were seen."""
    assert timescale(seconds * NS_PER_S, NOON_NS) == "uptime"


def test_the_first_date_there_is() -> None:
    at = 10**9 * NS_PER_S
    assert timescale(at - 1, at) == "uptime"
    assert timescale(at, at) == "utc"


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
