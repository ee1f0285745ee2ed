"""The page of a comparison: figures by hand, nothing foreign, drawn without errors."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.page import write_text_page
from mlbatch.page.clouds import CloudPoints
from mlbatch.page.comparison import binned, comparison_page, nice_step
from mlbatch.page.instant import InstantSet, SharedInstant, Spot
from mlbatch.page.policies import PolicyFigures, offset_m
from tests.page.browser import CHROMIUM, NO_CHROMIUM, Browser

HOSTILE = "<script>alert(1)</script>&'\""


def _policy(
    name: str, span_ms: float, apart_ms: float, latency_ms: float, sets: int = 50
) -> PolicyFigures:
    return PolicyFigures(
        name=name,
        without_a_sensor=1,
        stale=2,
        columns=1000,
        used_twice=100,
        never_used=250,
        start_s=np.arange(sets) / 10,
        span_ms=np.full(sets, float(span_ms)),
        apart_ms=np.full(sets, float(apart_ms)),
        latency_ms=np.full(sets, float(latency_ms)),
        lidars=np.full(sets, 2),
    )


POLICIES = (_policy("latest sweeps", 180, 36, 200), _policy("windows (mlbatch)", 100, 0, 110))


def _page(
    policies: tuple[PolicyFigures, ...] = POLICIES,
    title: str = "drive.pcap",
    instant: SharedInstant | None = None,
) -> str:
    notes = [f"loss: {title}"]
    return comparison_page(title, f"of {title}", policies, notes, f"mlbatch {title}", instant)


def _set(name: str, oldest_ms: float, *, has_cloud: bool = True) -> InstantSet:
    """A ring of two lidars, the second of which is up to 50 ms older; a third one is silent."""
    turn = np.linspace(-np.pi, np.pi, 3600, endpoint=False)
    height = np.random.default_rng(1).uniform(0, 2, len(turn))
    xyz = np.stack([10 * np.cos(turn), 10 * np.sin(turn), height], 1).astype(np.float32)
    lidar = (np.arange(len(turn)) % 2).astype(np.uint8)
    time_ns = np.linspace(-1e8, 0, len(turn)).astype(np.int64)
    time_ns[lidar == 1] -= round((oldest_ms - 100) * 1e6)
    intensity = np.zeros(len(turn), np.float32)
    points = CloudPoints(xyz, lidar, time_ns, lidar.astype(np.uint16), intensity)
    ages_ms = ((100.0, 0.0), (oldest_ms, oldest_ms - 100), None)
    if not has_cloud:
        return InstantSet(name, ages_ms)
    apart_ms = oldest_ms - 100
    return InstantSet(name, ages_ms, points, apart_ms, (apart_ms, apart_ms))


def _instant(name: str = "latest sweeps", *, has_clouds: bool = True) -> SharedInstant:
    return SharedInstant(
        at_s=2.1,
        looked=8,
        sensors=(name, "rear", "silent"),
        poses=(np.eye(4),) * 3,
        period_ns=100_000_000,
        columns=np.array([1800, 1800, 0]),
        sets=tuple(
            _set(one, oldest_ms, has_cloud=has_clouds)
            for one, oldest_ms in ((name, 150.0), ("windows (mlbatch)", 100.0))
        ),
        shown=0,
        spot=Spot((10.0, 0.0, 0.0), 50e6, 140, 157) if has_clouds else None,
        why="" if has_clouds else "No merged clouds: rear without extrinsics.",
    )


def test_the_way_of_an_object() -> None:
    # The example of the paper: 10 km/h, a period of 10 Hz.
    assert offset_m(10 / 3.6, 100) == pytest.approx(0.28, abs=0.005)
    assert offset_m(10, 97) == pytest.approx(0.97)


def test_the_verdict_is_in_words() -> None:
    page = _page()
    assert "Joined sweeps span up to 180 ms (latest sweeps), windows up to 100 ms" in page
    # 180 ms, 100 ms and 36 ms at 10 m/s.
    assert "moves 1.80 m within such a set, 1.00 m within a window" in page
    assert "36 ms apart (latest sweeps, median): 0.36 m" in page
    assert "<div class='verdict warning'" in page
    alike = (_policy("latest sweeps", 100, 0, 100), POLICIES[1])
    assert "<div class='verdict good'" in _page(alike)


def test_offsets_columns_and_latencies_are_shown() -> None:
    page = _page()
    # At 10, 30, 50, 100 km/h: 36 and 180 ms.
    for speed, median, worst in (
        ("10", "0.100", "0.500"),
        ("30", "0.300", "1.500"),
        ("50", "0.500", "2.500"),
        ("100", "1.000", "5.000"),
    ):
        text = f"latest sweeps, {speed} km/h: median {median} m, worst case {worst} m"
        assert text in page
    assert "10.0 % twice, 25.0 % never" in page
    assert "latest sweeps: 65.0 % used once" in page
    assert "110 ms (to 110 ms)" in page


@pytest.mark.parametrize(("instant", "scripts"), [(None, 0), (_instant(HOSTILE), 2)])
def test_nothing_of_a_recording_is_code_or_loaded(
    instant: SharedInstant | None, scripts: int
) -> None:
    page = _page((_policy(HOSTILE, 1, 1, 1), POLICIES[1]), HOSTILE, instant)
    tags: list[str] = []

    class Parser(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            tags.append(tag)
            assert not {name for name, _ in attrs} & {"src", "onload", "onclick"}

    Parser().feed(page)
    assert tags.count("script") == scripts
    assert "default-src 'none'" in page
    # Base64 has slashes.
    page = re.sub(r'"data":"[^"]*"', "", page)
    assert re.findall(r"(?:https?:)?//\w", page) == []


def test_the_instant_is_in_words() -> None:
    page = " ".join(_page(instant=_instant()).split())
    assert "140 of 157 points of the fused set above the ground have no point of the window" in page
    # 50 ms at 10 m/s.
    assert "stands at two places 0.50 m apart (latest sweeps: 50 ms between the lidars)" in page
    assert "in the window: 0.00 m (0 ms)" in page
    assert "At the worst place of the window: 0.00 m (0 ms)." in page
    without = _page(instant=_instant(has_clouds=False))
    assert "No merged clouds: rear without extrinsics." in without
    assert "latest sweeps, rear: 150.0 to 50.0 ms before the instant" in without
    assert "latest sweeps, silent:" not in without
    same = _page(instant=replace(_instant(), spot=None))
    assert "At no place are the lidars of a fused set farther apart" in same


def test_large_clouds_keep_every_nth_column(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = _instant().clouds()
    assert [(one.stride, one.shown) for one in whole] == [(1, 3600)] * 2
    monkeypatch.setattr("mlbatch.page.instant.MOST_CHARS", sum(one.chars for one in whole) * 0.8)
    fewer = _instant().clouds()
    assert [one.stride for one in fewer] == [2, 2]
    assert all(abs(one.shown - 1800) <= 1 for one in fewer)
    assert "with every 2nd column" in _page(instant=_instant())


def test_a_policy_without_sets_is_shown() -> None:
    assert "approximate time" in _page((_policy("approximate time", 0, 0, 0, sets=0), POLICIES[1]))


def test_long_recordings_make_no_long_pages() -> None:
    long = tuple(_policy(name, 150, 50, 160, sets=36_000) for name in ("latest sweeps", "windows"))
    assert len(_page(long)) < 200_000


@given(st.floats(1e-6, 1e9), st.integers(2, 12))
def test_steps_are_round(span: float, count: int) -> None:
    step = nice_step(span, count)
    assert span / count * 0.999 <= step <= span / count * 5.001
    assert float(f"{step:.0e}") == pytest.approx(step)
    assert f"{step:.0e}"[0] in "125"


@given(st.lists(st.tuples(st.floats(0, 100), st.floats(0, 1e4)), min_size=1, max_size=50))
def test_parts_contain_every_extreme(pairs: list[tuple[float, float]]) -> None:
    at = np.array([one for one, _ in pairs])
    values = np.array([two for _, two in pairs])
    parts = binned(at, values, 100.0, 7)
    assert len(parts) <= 7
    assert [one[0] for one in parts] == sorted(one[0] for one in parts)
    assert min(low for _, low, _ in parts) == values.min()
    assert max(high for _, _, high in parts) == values.max()
    width = 100 / 7
    for place, low, high in parts:
        inside = values[np.abs(at - place) <= width / 2 * (1 + 1e-9)]
        assert low in inside
        assert high in inside


def test_medians_are_by_nearest_rank() -> None:
    assert PolicyFigures.median(np.array([4.0, 1.0, 3.0, 2.0])) == 2.0
    assert PolicyFigures.median(np.zeros(0)) == 0.0


@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_both_clouds_are_shown_from_one_place(tab: Browser, tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    write_text_page(path, _page(instant=_instant()))
    tab.open(path)
    image = "document.querySelector('#stage canvas').toDataURL()"
    shown = "document.documentElement.dataset.shown"
    tab.wait(shown, "0")
    assert "age 150 to 0 ms" in tab.run("document.getElementById('legend').textContent")
    tab.run("document.getElementById('cloud').focus()")
    tab.press(" ")
    tab.wait(shown, "1")
    windows = tab.run(image)
    tab.run("document.getElementById('play').click()")
    tab.wait(shown, "0")
    fused = tab.run(image)
    # Of another colour, since older.
    assert windows != fused
    tab.press("f")
    tab.wait(f"{image} === {json.dumps(fused)}", False)
    tab.press("p")
    tab.wait(f"{image} === {json.dumps(fused)}", True)
    assert tab.errors == []


@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [400, 1400])
def test_it_is_drawn_in_a_browser(tab: Browser, tmp_path: Path, width: int, dark: bool) -> None:
    path = tmp_path / "page.html"
    write_text_page(path, _page())
    tab.open(path, width=width, dark=dark)
    assert tab.errors == []
    assert tab.requests == [path.as_uri()]
    plots = tab.run(
        "[...document.querySelectorAll('svg')].map(s => [s.clientWidth, s.clientHeight, "
        "s.querySelectorAll('rect, path').length])"
    )
    assert len(plots) == 4
    assert all(wide > 300 and high > 40 and shapes >= 2 for wide, high, shapes in plots)
    # Plots scroll and say so, the page does not.
    hints = (
        "[...document.querySelectorAll('.plot')].map(p => [getComputedStyle(p, '::before').content"
    )
    found = tab.run(f"{hints} !== 'none', p.scrollWidth > p.clientWidth])")
    assert found == [[width == 400] * 2] * 4
    assert tab.run("document.documentElement.scrollWidth") <= width
