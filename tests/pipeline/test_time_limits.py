"""`--start` and `--end` that are no times of the recording."""

from __future__ import annotations

from pathlib import Path

import pytest

from mlbatch.batching.windows import Limit
from mlbatch.errors import UsageError
from mlbatch.pipeline.time_limits import refuse_outside
from tests.builders.sessions import NS_PER_MS, NS_PER_S, Shell, Unit, names, write_session

# 2027-01-15 08:00:00 UTC is 1800000000; the first stamp of a unit is 20 ms later.
BEGIN_S = 1_800_000_000
DAY_S = 86_400


def _unit(begin_s: int, turns: int = 10) -> Unit:
    """A lidar whose packets are received at 1800000000 s, whatever it counts."""
    begin_ns = begin_s * NS_PER_S + 20 * NS_PER_MS
    return Unit(begin_ns=begin_ns, host_ns=(BEGIN_S - begin_s) * NS_PER_S, turns=turns)


@pytest.mark.parametrize("option", ["--start", "--end"])
@pytest.mark.parametrize("jobs", ["1", "3"])
def test_a_number_meant_as_relative_is_refused(
    shell: Shell, tmp_path: Path, option: str, jobs: str
) -> None:
    write_session(tmp_path, _unit(BEGIN_S))
    outcome = shell(f"convert drive.pcap -o out {option} 10 --jobs {jobs}")
    assert outcome.code == 2
    assert outcome.err == (
        f"mlbatch: error: {option}: expected a time of the recording, which begins at "
        "1800000000.02 s (2027-01-15T08:00:00.020), found 10 s; "
        f"write {option} +10 for 10 s after the start of scan 0\n"
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["111.json", "drive.pcap"]


def test_it_is_refused_on_a_clock_since_power_on(shell: Shell, tmp_path: Path) -> None:
    write_session(tmp_path, _unit(866))
    outcome = shell("convert drive.pcap -o out --start 10")
    assert outcome.code == 2
    assert "begins at 866.02 s, found 10 s; write --start +10" in outcome.err


def test_small_numbers_are_times_of_a_clock_since_power_on(shell: Shell, tmp_path: Path) -> None:
    write_session(tmp_path, _unit(866))
    # Windows from 866.1 s on; the last revolution ends at 867.02 s, in a partial window.
    assert shell("convert drive.pcap -o some --start 866.5 --end 866.8").code == 0
    assert names("some") == ["000004.npz", "000005.npz", "000006.npz"]
    assert shell("convert drive.pcap -o all --start 863").code == 0
    assert len(names("all")) == 9


@pytest.mark.parametrize(
    "words",
    [
        # The minute, the hour and the day in which the recording begins.
        "--start 2027-01-15T08:00",
        f"--start {BEGIN_S - 3600}",
        "--start 2027-01-15",
        f"--start {BEGIN_S} --end {BEGIN_S + DAY_S}",
    ],
)
def test_a_start_somewhat_earlier_is_legal(shell: Shell, tmp_path: Path, words: str) -> None:
    write_session(tmp_path, _unit(BEGIN_S))
    assert shell(f"convert drive.pcap -o out {words}").code == 0
    assert len(names("out")) == 9


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("--start 2026-01-15", "1768435200 s (2026-01-15T00:00:00.000); correct it"),
        ("--end 2027-01-15T07:59", "1799999940 s (2027-01-15T07:59:00.000); correct it"),
    ],
)
def test_dates_before_the_recording_are_refused(
    shell: Shell, tmp_path: Path, words: str, found: str
) -> None:
    write_session(tmp_path, _unit(BEGIN_S))
    outcome = shell(f"convert drive.pcap -o out {words}")
    assert (outcome.code, found in outcome.err) == (2, True), outcome.err


@pytest.mark.parametrize("start", [f"{BEGIN_S + 7}", "+7", "2027-01-15T08:00:07"])
def test_a_start_after_the_recording_shows_its_range(
    shell: Shell, tmp_path: Path, start: str
) -> None:
    write_session(tmp_path, _unit(BEGIN_S))
    outcome = shell(f"convert drive.pcap -o out --start {start}")
    assert outcome.code == 1
    assert (
        "no scan: expected --start in the recording, from 1800000000.02 s "
        "(2027-01-15T08:00:00.020) to 1800000001.0" in outcome.err
    )


def test_later_segments_need_not_contain_the_limits(shell: Shell, tmp_path: Path) -> None:
    """The clock goes back by 800 s: what is after the step would be long after `--start`."""
    write_session(tmp_path, _unit(866, turns=40))
    words = "--fault jump:ouster_111:500s@2s --on-jump split --start 866.5"
    outcome = shell(f"convert drive.pcap -o out {words}")
    assert outcome.code == 0, outcome.err
    assert len(names("out.seg1")) >= 10
    assert len(names("out.seg2")) >= 10


@pytest.mark.parametrize(
    ("first_s", "start_s", "is_legal"),
    [
        (BEGIN_S, BEGIN_S - DAY_S, True),
        (BEGIN_S, BEGIN_S - DAY_S - 1, False),
        (500, 496, True),
        (500, 495, False),
        (30, 10, False),
        (3, 0, True),
        (500, 10_000, True),
    ],
)
def test_how_early_a_start_may_be(first_s: int, start_s: int, is_legal: bool) -> None:
    limit = Limit(start_s * NS_PER_S)
    if is_legal:
        refuse_outside(limit, None, first_s * NS_PER_S)
        return
    with pytest.raises(UsageError, match="--start: expected a time of the recording"):
        refuse_outside(limit, None, first_s * NS_PER_S)


def test_relative_limits_are_never_outside() -> None:
    limit = Limit(0, from_t_init=True)
    refuse_outside(limit, limit, BEGIN_S * NS_PER_S)
