"""docs/batching.md: its loop gives the scans of the reference, its figure shows them."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import TypeAlias, cast

from hypothesis import given
from hypothesis import strategies as st

from tests.builders.fast import run_fast
from tests.builders.hand import MS, TEN_HZ, by_host, packet
from tests.contract.tree import ROOT
from tests.reference.batching import FeedPacket, Settings, reference_scans

DOCS = ROOT / "docs"
SECOND = 10**9
Columns: TypeAlias = list[tuple[int, int]]
Loop: TypeAlias = Callable[..., Iterator[tuple[int, Columns]]]
RATES = (Fraction(10), Fraction(15), Fraction("29.97"), Fraction(10, 3))
WAITS_NS = (50 * MS, 200 * MS, SECOND, None)


def _loop() -> Loop:
    """The function of the page."""
    page = (DOCS / "batching.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(.*?def merged_scans.*?)^```$", page, re.M | re.S)
    names: dict[str, object] = {}
    exec(compile(block, "docs/batching.md", "exec"), names)
    return cast(Loop, names["merged_scans"])


LOOP = _loop()


@st.composite
def simple_feeds(draw: st.DrawFn) -> tuple[list[FeedPacket], Settings]:
    """Packets of one column: stalls, columns out of order, late ones; none that intake rejects."""
    sensors = draw(st.integers(1, 3))
    settings = Settings(
        rate=draw(st.sampled_from(RATES)),
        sensors=sensors,
        max_wait_ns=draw(st.sampled_from(WAITS_NS)),
    )
    now = draw(st.sampled_from([50 * MS, 1_700_000_000 * SECOND]))
    newest: dict[int, int] = {}
    feed = []
    for _ in range(draw(st.integers(1, 80))):
        sensor = draw(st.integers(0, sensors - 1))
        now += draw(st.integers(0, 60)) * MS
        stamp = now - draw(st.sampled_from([0, 0, 0, 7, 30, 130])) * MS
        # A step of more than 1 s from the newest is a matter of intake.
        if stamp >= 0 and abs(stamp - newest.get(sensor, stamp)) <= SECOND:
            newest[sensor] = max(stamp, newest.get(sensor, stamp))
            feed.append(FeedPacket(sensor, now, -1, (stamp,), (True,)))
    return feed, settings


def _expected(feed: Sequence[FeedPacket], settings: Settings) -> list[tuple[int, Columns]]:
    """Scans of the reference, columns as (stamp, sensor)."""
    outcome = reference_scans(feed, settings)
    assert run_fast(feed, settings, [len(feed)]) == outcome
    of_sensor = [[one for one in feed if one.sensor == s] for s in range(settings.sensors)]
    return [
        (window.index, [(of_sensor[s][number].stamps[0], s) for s, number, _ in window.columns])
        for window in outcome.windows
    ]


@given(simple_feeds())
def test_the_loop_of_the_page_gives_the_scans_of_the_reference(
    case: tuple[list[FeedPacket], Settings],
) -> None:
    feed, settings = case
    if not feed:
        return
    wait = float("inf") if settings.max_wait_ns is None else settings.max_wait_ns
    columns = [(one.sensor, one.stamps[0]) for one in feed]
    found = LOOP(columns, range(settings.sensors), settings.rate, max_wait=wait)
    assert list(found) == _expected(feed, settings)


def test_the_figure_shows_what_the_reference_does() -> None:
    figure = runpy.run_path(str(DOCS / "streams.py"))
    feed = by_host(
        packet(sensor, stamp)
        for sensor, name in enumerate(figure["STREAMS"])
        for stamp in figure["stamps_ms"](name)
    )
    settings = replace(TEN_HZ, sensors=3, max_wait_ns=figure["MAX_WAIT_MS"] * MS)
    found = [
        (one.index, one.start_ns // MS, one.ready_host_ns // MS, one.complete)
        for one in reference_scans(feed, settings).windows
    ]
    assert found == list(figure["WRITTEN"])


def test_the_figure_is_what_its_script_draws() -> None:
    done = subprocess.run(
        [sys.executable, str(DOCS / "streams.py")], capture_output=True, text=True, check=True
    )
    assert done.stdout == (DOCS / "streams.svg").read_text(encoding="utf-8")
