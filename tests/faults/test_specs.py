"""What each fault specification means."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from mlbatch.errors import UsageError
from mlbatch.faults import KINDS, parse_fault

MS = 10**6
S = 10**9


@pytest.mark.parametrize(
    ("text", "begin_ns", "end_ns"),
    [
        ("stall:left:5s-8s", 5 * S, 8 * S),
        ("stall:left:0.5s-500.000001ms", 500 * MS, 500 * MS + 1),
        # 0 includes earlier receive times: the clock of the capture host may step back.
        ("stall:left:0s-1us", -(2**62), 1000),
        ("late:left:2s", -(2**62), 2 * S),
        ("early:left:3s", 3 * S, 2**62),
        ("jump:left:37s@10s", 10 * S, 2**62),
        ("jump:left:1ns@0s", -(2**62), 2**62),
    ],
)
def test_times_count_from_the_first_packet(text: str, begin_ns: int, end_ns: int) -> None:
    assert parse_fault(text).window_ns == (begin_ns, end_ns)


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("bitflip:a:b:2.5%", "share", 0.025),
        ("delay:left:.25us", "by_ns", 250),
        ("jump:left:-37s@10s", "by_ns", -37 * S),
        ("drift:left:-0.5ppm", "drift_ppm", -0.5),
    ],
)
def test_values_have_units_and_signs(text: str, name: str, value: float) -> None:
    assert getattr(parse_fault(text), name) == value


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected one of drop, "),
        ("dropp:left:5%", "found 'dropp'; did you mean drop?"),
        ("drop", "expected drop:SENSOR:VALUE, found 'drop'; write drop:left:5%"),
        ("drop:left", "write drop:left:5%"),
        ("drop::5%", "expected drop:SENSOR:VALUE"),
        ("drop:front:5", "found '5'; write drop:front:5%"),
        ("drop:left:0%", "above 0% and up to 100%"),
        ("drop:left:101%", "up to 100%, found '101%'"),
        ("drop:left:nan%", "found 'nan%'"),
        ("drop:left:-5%", "found '-5%'"),
        ("stall:left:8s-5s", "a first time before a last one"),
        ("stall:left:5s", "found '5s'; write stall:left:5s-8s"),
        ("stall:left:5-8", "write stall:left:5s-8s"),
        ("late:left:0s", "a time above 0"),
        ("late:left:-2s", "found '-2s'"),
        ("early:left:3", "units ns, us, ms, s"),
        ("early:left:1000000001s", "up to 1000000000s"),
        ("delay:left:0ms", "above 0, up to 60s"),
        ("delay:left:-5ms", "above 0, up to 60s"),
        ("delay:left:61s", "up to 60s, found '61s'"),
        ("jump:left:37s", "write jump:left:37s@10s"),
        ("jump:left:0s@10s", "a step other than 0"),
        ("jump:left:37s@-10s", "a time after the first packet"),
        ("drift:left:0ppm", "other than 0"),
        ("drift:left:50", "write drift:left:50ppm"),
        ("drift:left:100001ppm", "up to 100000ppm"),
        (f"delay:left:{'9' * 400}s", "..."),
        ("delay:left:٦s", "found '٦s'"),
    ],
)
def test_mistakes_are_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_fault(text)
    line = str(caught.value)
    assert line.startswith("--fault")
    assert message in line
    assert "\n" not in line
    assert len(line) < 250


def test_the_page_describes_every_kind() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "faults.md").read_text("utf-8")
    assert re.findall(r"^\| `(\w+):", page, re.MULTILINE) == list(KINDS)
    for spec in re.findall(r"\w+:(?:left|\*):[^`\s]+", page):
        parse_fault(spec)
