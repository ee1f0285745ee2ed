"""Batching worked by hand (docs/batching.md): the reference, and equal to it the fast batcher."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import pytest
from hypothesis import given, settings

from mlbatch.errors import ClockError
from tests.builders.fast import run_fast
from tests.builders.feeds import Case, feeds
from tests.builders.hand import MS, TEN_HZ, by_host, packet
from tests.reference.batching import FeedPacket, Outcome, Settings, reference_scans

TWO = replace(TEN_HZ, sensors=2)
Seen = Mapping[str, object]


def feed_of(text: str) -> list[FeedPacket]:
    """Packets `SENSOR:STAMP,STAMP`, ms; `!`: an invalid column; `~`: receive time; `#`: key.

    `SENSOR:BEGIN..END/STEP` are packets of a column each, every 50 ms if no step is given; with
    them the feed is sorted by receive time.
    """
    feed = []
    for word in text.split():
        sensor, _, rest = word.partition(":")
        rest, _, key = rest.partition("#")
        rest, _, host = rest.partition("~")
        begin, _, end = rest.partition("..")
        if end:
            until, _, step = end.partition("/")
            times = range(int(begin), int(until), int(step or 50))
            feed += [packet(int(sensor), stamp) for stamp in times]
            continue
        columns = rest.split(",")
        stamps = [float(one.strip("!")) for one in columns]
        one = packet(
            int(sensor), *stamps, host_ms=float(host) if host else None, key=int(key or -1)
        )
        feed.append(replace(one, valid=tuple("!" not in column for column in columns)))
    return by_host(feed) if ".." in text else feed


def batched(feed: Sequence[FeedPacket], options: Settings) -> Outcome:
    """Outcome of a feed: of the reference, and of the fast batcher in batches of any size."""
    outcome = reference_scans(feed, options)
    groupings = [[1] * len(feed)]
    # Packets of one batch must have the same number of columns.
    if len({len(one.stamps) for one in feed}) == 1:
        groupings += [[len(feed)], [3] * (len(feed) // 3) + [len(feed) % 3]]
    for sizes in groupings:
        assert run_fast(feed, options, sizes) == outcome
    return outcome


def seen_of(outcome: Outcome) -> Seen:
    """What rows name of an outcome, ms; wN: columns of window N, as SENSOR.PACKET.COLUMN."""
    windows = outcome.windows
    seen: dict[str, object] = {
        "t": None if outcome.t_init_ns is None else outcome.t_init_ns / MS,
        "windows": [one.index for one in windows],
        "spans": [(one.index, one.start_ns / MS, one.end_ns / MS) for one in windows],
        "sizes": [len(one.columns) for one in windows],
        "complete": [one.index for one in windows if one.complete],
        "ready": [one.ready_host_ns / MS for one in windows],
        **{name: getattr(outcome, name) for name in ("rejected", "dropped", "decoded", "empty")},
        **{f"written{sensor}": count for sensor, count in enumerate(outcome.written)},
        **{f"dropped{sensor}": counts for sensor, counts in enumerate(outcome.dropped)},
        **{reason: outcome.dropped[0].get(reason, 0) for reason in ("late", "invalid")},
    }
    for one in windows:
        seen[f"w{one.index}"] = " ".join(".".join(map(str, column)) for column in one.columns)
        seen.setdefault(f"ready{one.index}", one.ready_host_ns / MS)
    return seen


def at(rate: str) -> Settings:
    return replace(TEN_HZ, rate=Fraction(rate))


def duplicate(between: int, sensor: int = 0) -> str:
    return " ".join(f"{sensor}:50#{100 + n}" for n in range(between)) + f" {sensor}:50#9"


ENDS = {"head": 2, "tail": 1}
LATE = {"head": 1, "late": 1, "tail": 1}
GAP = "0:50..3000 1:50..300 1:1800..3000"
# A feed, and what it gives; a text: why it is refused.
CASES: list[tuple[str, Settings, Seen | str]] = [
    # -- grid --
    # 1e9 / 15 = 66 666 666.67: bounds 1, 2, 3 are rounded up each from the exact product.
    (
        "0:0 0:66.666667 0:133.333333 0:133.333334 0:199.999999 0:200",
        at("15"),
        {"spans": [(0, 66.666667, 133.333334), (1, 133.333334, 200)], "sizes": [2, 2]},
    ),
    # 1e9 / 29.97 = 33 366 700.03 and its multiples 66 733 400.07, 100 100 100.1.
    (
        "0:0 0:33.366701 0:66.7334 0:66.733401 0:100.1001 0:100.100101",
        at("29.97"),
        {"spans": [(0, 33.366701, 66.733401), (1, 66.733401, 100.100101)], "sizes": [2, 2]},
    ),
    (
        "0:0 0:300 0:599.999999 0:600 0:899.999999 0:900",
        at("10/3"),
        {"spans": [(0, 300, 600), (1, 600, 900)], "sizes": [2, 2]},
    ),
    # The first window begins after the first stamp: 20 and 70 are in the head, 320 in the tail.
    (
        "0:20..350",
        TEN_HZ,
        {"spans": [(0, 100, 200), (1, 200, 300)], "dropped": [ENDS], "written0": 4},
    ),
    # "Larger than" in eq. (1): t0 = 100 is itself a bound, so scans begin at 200.
    ("0:100..450", TEN_HZ, {"t": 200, "dropped": [ENDS]}),
    ("0:99.999999~0 0:100..350", TEN_HZ, {"t": 100}),
    # The latest first stamp counts: 10, 60, ... 160 are before the head [200, 300), 210, 260 in it.
    (
        "0:10..600 1:230..600",
        TWO,
        {"t": 300, "dropped": [{"before_start": 4, "head": 2, "tail": 2}, {"head": 2, "tail": 2}]},
    ),
    # Windows are half open.
    ("0:50 0:199.999999,200~0 0:310", TEN_HZ, {"w0": "0.1.0", "w1": "0.1.1"}),
    # By stamp, sensor, delivery: 130 of sensor 0 comes twice, that of sensor 1 after both.
    (
        "0:50,!50 1:50,!50 1:120,130 0:110,130 0:130,140 1:250,!250 0:250,!250 0:350,!350 "
        "1:350,!350",
        TWO,
        {"w0": "0.1.0 1.1.0 0.1.1 0.2.0 1.1.1 0.2.1"},
    ),
    # -- late and slack --
    # 209.999999 is less than 10 ms past the end of [100, 200).
    ("0:50 0:150 0:209.999999 0:120 0:310", TEN_HZ, {"w0": "0.3.0 0.1.0"}),
    ("0:50 0:150 0:210 0:199 0:310", TEN_HZ, {"w0": "0.1.0", "dropped": [LATE]}),
    # By an earlier column of its own packet; never by another sensor.
    ("0:50 0:210,199 0:310", TEN_HZ, {"dropped": [LATE]}),
    ("0:50 1:50 1:950 0:150 0:960", TWO, {"w0": "0.1.0", "late": 0}),
    # Sensor 1 is missing, so nothing is published; still 150 comes after 210.
    ("0:50 0:210 0:150 1:220 0:350", TWO, {"late": 1}),
    # Published when the last sensor passes end plus slack; at the end without slack.
    ("0:50 1:50 0:150 0:230 1:209.999999~231 1:210~232", TWO, {"windows": [0], "ready": [232]}),
    ("0:50 0:150 0:200", TEN_HZ, {"spans": [(0, 100, 200)], "ready": [200], "complete": [0]}),
    # -- intake --
    (
        "0:50 0:9000 0:150 0:250",
        TEN_HZ,
        {"rejected": [{"bad_stamp": 1}], "w0": "0.1.0", "empty": 0},
    ),
    # A step of exactly one second is not held; what is held at the end is rejected.
    ("0:50 0:1050", TEN_HZ, {"rejected": [{}], "decoded": [2]}),
    ("0:50 0:1051", TEN_HZ, {"rejected": [{"bad_stamp": 1}], "decoded": [1]}),
    # The next packet confirms a gap and closes [100, 200); [200, 300) to [4900, 5000) are empty.
    (
        "0:50 0:150 0:5020 0:5040 0:5150",
        TEN_HZ,
        {"rejected": [{}], "ready0": 5040, "w49": "0.2.0 0.3.0", "empty": 48},
    ),
    # Confirmation reaches one second; beyond, the first is rejected, the second held to the end.
    ("0:50 0:9000 0:10000", TEN_HZ, {"rejected": [{}]}),
    ("0:50 0:9000 0:10001", TEN_HZ, {"rejected": [{"bad_stamp": 2}]}),
    # Without a valid column it is accepted at once, before the packet that is held: number 1.
    (
        "0:50 0:9000 0:!200 0:9050 0:9250",
        TEN_HZ,
        {"rejected": [{}], "w89": "0.2.0 0.3.0", "invalid": 1},
    ),
    ("0:90000 0:20 0:40", TEN_HZ, "90000000000 ns and then 20000000 ns"),
    # Impossible stamps and spans are rejected at once, and do not affect a held packet.
    *(
        (f"0:{wild} 0:50 0:60", TEN_HZ, {"rejected": [{"bad_stamp": 1}], "decoded": [2]})
        for wild in ("-1", f"{2**31 * 1000}", "100,1100.000001")
    ),
    ("0:50 0:9000 0:-1 0:9050", TEN_HZ, {"decoded": [3]}),
    # Duplicates reach 1024 packets back, each renews the reach, and each sensor has its own.
    (f"0:50#9 {duplicate(1023)}", TEN_HZ, {"rejected": [{"duplicate": 1}]}),
    (f"0:50#9 {duplicate(1024)}", TEN_HZ, {"rejected": [{}]}),
    (f"0:50#9 1:50#9 0:50#9 {duplicate(1023)}", TWO, {"rejected": [{"duplicate": 2}, {}]}),
    # Invalid columns have no stamp: the first would move t0, the last close the window and be wild.
    (
        "0:!0,150,!90000~150 0:250 0:350",
        TEN_HZ,
        {"t": 200, "decoded": [5], "dropped": [{"invalid": 2, "head": 1, "tail": 1}]},
    ),
    # Receive time minus age: 50, 60 | 195, 205 | 310.
    (
        "0:7000,7010~60 0:7090,7100~205 0:7300~310",
        replace(TEN_HZ, host_clock=True),
        {"t": 100, "w0": "0.1.0", "w1": "0.1.1"},
    ),
    # Clocks more than a second apart, also of sensors that are each within 1 s of sensor 0.
    ("0:50 1:1060~60", TWO, {"decoded": [1, 1]}),
    ("0:50 1:1060.000001~60", TWO, "sensors 0 and 1"),
    ("0:50 1:1060.000001~60", replace(TWO, host_clock=True), {"decoded": [1, 1]}),
    *(
        (text, replace(TEN_HZ, sensors=3), "expected comparable clocks")
        for text in (
            "0:5000 1:5900~5000 2:4100~5000",
            "1:5900~5000 0:5000 2:4100~5000",
            "2:4100~5000 1:5900~5000 0:5000",
        )
    ),
    # -- stalls, late starts, early ends --
    # Windows 1 to 3 and four from 36 000 000 on have columns; those between are not visited.
    ("0:50..400 0:3600000000..3600000400", TEN_HZ, {"empty": 36_000_000 - 4}),
    # 1100 - 50 > 1000: at that packet sensor 1 is given up and all to 1000 comes out.
    (
        "1:50 0:50..1601 1:150~1601 1:1000~1602",
        TWO,
        {"ready0": 1100, "dropped1": {"head": 1, "late": 2}, "complete": []},
    ),
    # A gap of 1550 is held, then confirmed; windows it overlaps are incomplete: [100, 200) is
    # before the stall from 250, [1800, 1900) begins where it ends. 100 to 250, 1800 to 2850.
    (GAP, TWO, {"complete": [0, *range(17, 28)], "rejected": [{}, {}], "written1": 4 + 22}),
    (GAP, replace(TWO, max_wait_ns=None), {"complete": [*range(28)], "windows": [*range(28)]}),
    # Sensor 1 is given up at 1100 = 50 + 1000 + 50; [1800, 1900) begins after its first stamp.
    ("0:50..3000 1:1730..3000", TWO, {"t": 100, "complete": [*range(17, 28)]}),
    ("0:50..500", TWO, {"t": 100, "windows": [0, 1, 2], "complete": []}),
    # Its last stamp is 400: the end of [300, 400).
    ("0:50..800 1:50..450", TWO, {"windows": [*range(6)], "complete": [0, 1, 2]}),
    ("0:10 0:20", TEN_HZ, {"windows": [], "dropped": [{"head": 2}]}),
    ("", TEN_HZ, {"t": None}),
    # -- what is written --
    (
        "0:50..350",
        replace(TEN_HZ, keep_partial=True),
        {"windows": [-1, 0, 1, 2], "complete": [0, 1], "dropped": [{}]},
    ),
    # Slices of 50 from 100: 110, 140 | 160 | none | 260, 290 is the tail.
    (
        "0:50 0:110 0:140 0:160 0:260 0:290",
        replace(TEN_HZ, slices=2),
        {
            "spans": [(0, 100, 150), (0, 150, 200)],
            "sizes": [2, 1],
            "empty": 1,
            "ready": [160, 260],
            "dropped": [{"head": 1, "tail": 2}],
        },
    ),
    # [100, 125) closes when its sensor is 10 ms past it.
    (
        "0:70..330/10",
        replace(TEN_HZ, slices=4),
        {"spans": [(n // 4, 100 + 25 * n, 125 + 25 * n) for n in range(8)], "ready0": 140},
    ),
    # Limits choose windows by their start, and empty ones within: [200, 900), 3 of them.
    (
        "0:50..800",
        replace(TEN_HZ, start_ns=200 * MS, end_ns=400 * MS),
        {"t": 100, "windows": [1, 2], "dropped": [{"outside_time": 11}]},
    ),
    ("0:50..200 0:900..1200", TEN_HZ, {"empty": 7}),
    ("0:50..200 0:900..1200", replace(TEN_HZ, start_ns=450 * MS, end_ns=750 * MS), {"empty": 3}),
]


@pytest.mark.parametrize(("text", "options", "expected"), CASES, ids=lambda one: str(one)[:40])
def test_by_hand(text: str, options: Settings, expected: Seen | str) -> None:
    feed = feed_of(text)
    if isinstance(expected, str):
        with pytest.raises(ClockError, match=expected):
            batched(feed, options)
        return
    seen = seen_of(batched(feed, options))
    assert {name: seen[name] for name in expected} == expected


@settings(max_examples=150)
@given(feeds())
def test_every_column_is_written_or_dropped_and_windows_follow_the_grid(case: Case) -> None:
    feed, options = case
    try:
        outcome = reference_scans(feed, options)
    except ClockError:
        return
    for sensor, decoded in enumerate(outcome.decoded):
        assert decoded == outcome.written[sensor] + sum(outcome.dropped[sensor].values())
        read = sum(one.sensor == sensor for one in feed)
        assert sum(outcome.rejected[sensor].values()) <= read
    windows = outcome.windows
    columns = [column for window in windows for column in window.columns]
    assert len(columns) == len(set(columns)) == sum(outcome.written)
    assert all(a.end_ns <= b.start_ns for a, b in pairwise(windows))
    assert all(a.ready_host_ns <= b.ready_host_ns for a, b in pairwise(windows))
    for window in windows:
        # A slice is as long as its share of a period, give or take the rounding of its bounds.
        length = Fraction(10**9) / options.rate / options.slices
        assert abs(window.end_ns - window.start_ns - length) < 1
        assert (window.index == -1) <= options.keep_partial
