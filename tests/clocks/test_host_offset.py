"""Clocks that are off from the capture host's: causes, remedies, and what is no fault."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.clocks.host_offset import HostOffset, describe_off
from mlbatch.clocks.timescale import describe_time
from mlbatch.clocks.watch import ClockWatch
from tests.builders.clocks import (
    BEGIN_NS,
    GPS_1980_NS,
    GPS_NS,
    HOUR_NS,
    NS_PER_MS,
    NS_PER_S,
    TAI_NS,
    TRUE,
    Clock,
    Way,
    hear,
)

WAY = Way(least_us=100, mean_us=50)
UPTIME = Clock(1000 * NS_PER_S - BEGIN_NS)
PTP = "TIME_FROM_PTP_1588"


def measured(clock: Clock, source: str = "", host: Clock = TRUE, name: str = "left") -> HostOffset:
    heard = hear(np.random.default_rng(1), clock, seconds=10, rate_hz=200, way=WAY, host=host)
    watch = ClockWatch(period_ns=HOUR_NS if clock.past_hour else 0, mode=source)
    watch.add(heard.stamp_ns, heard.host_ns)
    estimate = watch.estimate()
    assert estimate is not None
    return HostOffset.measured(name, estimate)


ZONE = "(8 whole hour(s): a time zone, or the wrong hour)"
NONE_KNOWN = "no known difference of timescales"


@pytest.mark.parametrize(
    ("clock", "found", "line", "cause"),
    [
        (Clock(TAI_NS), "+36.99", "{epoch: tai}", "(37 s: TAI - UTC)"),
        (Clock(GPS_NS), "+17.99", "{epoch: gps}", "(18 s: GPS - UTC)"),
        # Seconds since 1980 are no offset of an epoch: 315964800 - 18 s.
        (Clock(GPS_1980_NS), "-315964782.0", "{offset_s: 315964782.000}", ""),
        (Clock(540_793 * NS_PER_MS), "+540.79", "{offset_s: -540.793}", NONE_KNOWN),
        (
            Clock(-7 * 366 * 24 * HOUR_NS),
            "-221356800.0",
            "{offset_s: 221356800.000}",
            "a date that was never set",
        ),
        (
            Clock(-1431 * NS_PER_S, past_hour=True),
            "-1431.0",
            "{offset_s: 1431.000}",
            "a counter without GPS time",
        ),
        (Clock(1_500 * NS_PER_MS), "+1.49", "{offset_s: -1.500}", NONE_KNOWN),
        (Clock(8 * HOUR_NS), "+28799.99", "{offset_s: -28800.000}", ZONE),
    ],
)
def test_an_epoch_clock_that_is_off(clock: Clock, found: str, line: str, cause: str) -> None:
    text = describe_off([measured(clock)])
    assert text.startswith(
        f"left: expected a clock within 1 s of the capture host's, found {found}"
    )
    assert f"use --clock host or --align-clocks, or `clock: {line}` in the rig" in text
    assert cause in text


@pytest.mark.parametrize(
    "offset",
    [
        measured(TRUE),
        measured(Clock(950 * NS_PER_MS)),
        measured(Clock(-950 * NS_PER_MS)),
        # Meant to count from power-on.
        measured(UPTIME),
        measured(UPTIME, "TIME_FROM_INTERNAL_OSC"),
        measured(TRUE, PTP),
        # The capture host has no date: nothing is known about the sensor.
        measured(TRUE, host=Clock(-BEGIN_NS + 100 * NS_PER_S)),
        # Not for certain.
        HostOffset("left", "utc", 1_004 * NS_PER_MS, 5 * NS_PER_MS, BEGIN_NS),
    ],
)
def test_clocks_that_need_no_warning(offset: HostOffset) -> None:
    assert describe_off([offset]) == ""


@pytest.mark.parametrize("source", [PTP, "gPTP or PTP", "PTP", "GPS", "NTP"])
def test_a_time_source_that_never_locked(source: str) -> None:
    text = describe_off([measured(UPTIME, source)])
    assert f"it counts from power-on: the time source never locked; time source {source}" in text


def test_sensors_that_agree_with_each_other_get_one_correction() -> None:
    """Two sensors on TAI, of which one has a delay of 3 ms more."""
    one = measured(Clock(540_000 * NS_PER_MS))
    two = measured(Clock(539_997 * NS_PER_MS), name="right")
    text = describe_off([one, two])
    assert text.startswith("left, right: expected a clock within 1 s")
    assert "or for every sensor `clock: {offset_s: -540.000}` in the rig" in text


def test_a_correction_in_the_rig_is_part_of_the_new_one() -> None:
    # The rig adds 2 s, which leaves 38 s: altogether 36 s are to be taken away.
    left = measured(TRUE)._replace(domain="unknown", offset_ns=38 * NS_PER_S)
    assert "`clock: {offset_s: -36.000}`" in describe_off([left], 2 * NS_PER_S)


def test_without_receive_times_only_the_rig_helps() -> None:
    offset = HostOffset.of_message("left", BEGIN_NS + 37 * NS_PER_S, BEGIN_NS, 0, "")
    text = describe_off([offset], timed=False)
    assert text.endswith("use `clock: {epoch: tai}` in the rig")
    # The message may be logged a second after its first packet.
    late = HostOffset.of_message("left", BEGIN_NS - 1_900 * NS_PER_MS, BEGIN_NS, 0, "")
    assert describe_off([late], timed=False) == ""


@pytest.mark.parametrize(
    ("stamp_ns", "name", "text"),
    [
        (1_777_881_600_100_000_000, "utc", "2026-05-04T08:00:00.100Z"),
        (1_777_881_637_100_999_999, "tai", "2026-05-04T08:00:37.100 TAI"),
        (866_100_000_000, "uptime", "866.100 s since power-on"),
        (866_100_000_000, "unknown", "866.100 s of a clock without a date"),
        (
            1_777_881_600_000_000_000,
            "unknown",
            "2026-05-04T08:00:00.000 by the sensors' clock, timescale unknown",
        ),
    ],
)
def test_times_as_text(stamp_ns: int, name: str, text: str) -> None:
    assert describe_time(stamp_ns, name) == text
