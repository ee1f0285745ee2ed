"""Option values from text, with errors that say what was wanted."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

from mlbatch.batching.windows import Limit
from mlbatch.errors import UsageError, one_line
from mlbatch.pipeline.job import MOST_S, check_ranges_m, check_slices, wait_ns
from mlbatch.sensors import DECODE_OPTIONS
from mlbatch.units import NS_PER_S, parse_rate

if TYPE_CHECKING:
    from mlbatch.faults.replay import Fault

# Every job holds a few scans in memory.
MAX_JOBS = 64


def rate(text: str) -> Fraction:
    """`--rate`, exactly the number in the text."""
    try:
        return parse_rate(text)
    except UsageError as err:
        raise UsageError(f"--{err}") from err


def slices(count: int) -> None:
    """`--slices`."""
    check_slices("--slices", count)


def ranges_m(low: float, high: float) -> None:
    """`--min-range` and `--max-range`."""
    check_ranges_m("--min-range", low, "--max-range", high)


def in_order(first: Limit | None, last: Limit | None) -> None:
    """`--start` before `--end`, where both count from the same time."""
    if first is None or last is None or first.from_t_init != last.from_t_init:
        return
    if last.ns <= first.ns:
        raise UsageError(
            f"--end: wanted a time after --start ({first.ns / NS_PER_S:g} s), got "
            f"{last.ns / NS_PER_S:g} s; swap them"
        )


def time_limit(option: str, text: str | None) -> tuple[Limit | None, bool]:
    """A `--start`/`--end`: epoch seconds, ISO time, or +S; and whether it was a date."""
    if text is None:
        return None, False
    relative = text.startswith("+")
    try:
        seconds = Decimal(text)
        # Compared, not computed: even the absolute value of 1e999999999 overflows.
        if seconds.is_finite() and -MOST_S <= seconds <= MOST_S:
            return Limit(int(seconds * NS_PER_S), from_t_init=relative), False
    except InvalidOperation:
        pass
    try:
        return Limit(_iso_ns(text)), True
    except ValueError:
        raise UsageError(
            f"{option}: wanted epoch seconds, an ISO time or +SECONDS, got {text!r}; "
            "write 1700000000.5, 2026-05-01T12:00:00 or +12.5"
        ) from None


def _iso_ns(text: str) -> int:
    text = text.replace("Z", "+00:00")
    # Python 3.10 takes three or six decimals only.
    text = re.sub(r"\.(\d{1,6})(?!\d)", lambda found: f".{found[1]:0<6}", text)
    moment = datetime.datetime.fromisoformat(text)
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=datetime.timezone.utc)
    since = moment - datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)
    return (since.days * 86400 + since.seconds) * NS_PER_S + since.microseconds * 1000


def max_wait_ns(text: str) -> int | None:
    """`--max-wait` in s; None for `inf`."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    return wait_ns("--max-wait", seconds, text)


def box_m(text: str) -> tuple[float, ...]:
    """`--exclude-box x0,y0,z0,x1,y1,z1`, metres in the body frame."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    ordered = len(values) == 6 and all(a < b for a, b in zip(values[:3], values[3:], strict=True))
    if not ordered:
        raise UsageError(
            f"--exclude-box: wanted x0,y0,z0,x1,y1,z1 in metres with x0 < x1, y0 < y1, z0 < z1, "
            f"got {text!r}; write --exclude-box=-1,-1,0,1,1,2"
        )
    return values


def decode_options(texts: Sequence[str]) -> dict[str, str]:
    """`--decode KEY=VALUE`, repeatable."""
    options = {}
    for text in texts:
        key, sign, value = text.partition("=")
        if key not in DECODE_OPTIONS:
            raise UsageError(
                f"--decode: wanted one of {', '.join(DECODE_OPTIONS)}, got {key!r}; "
                "write --decode crc=check"
            )
        if not sign or value not in DECODE_OPTIONS[key]:
            raise UsageError(
                f"--decode {key}: wanted {' or '.join(DECODE_OPTIONS[key])}, got {value!r}; "
                f"write --decode {key}={DECODE_OPTIONS[key][0]}"
            )
        options[key] = value
    return options


def choice(option: str, text: str, allowed: Sequence[str]) -> str:
    """One of a few words."""
    if text in allowed:
        return text
    raise UsageError(f"{option}: wanted {' or '.join(allowed)}, got {text!r}; choose one of them")


def percent(option: str, value: float) -> float:
    """A share in percent."""
    if not 0 <= value <= 100:
        raise UsageError(f"{option}: wanted a share from 0 to 100 %, got {value:g}; correct it")
    return value


def faults(texts: Sequence[str]) -> tuple[Fault, ...]:
    """`--fault KIND:SENSOR:VALUE`, repeatable."""
    if not texts:
        return ()
    # Not loaded for runs without faults.
    from mlbatch.faults.replay import parse_fault

    return tuple(parse_fault(text) for text in texts)


def seed(number: int) -> int:
    """`--fault-seed`, a whole number from 0."""
    if number < 0:
        raise UsageError(f"--fault-seed: wanted a whole number from 0, got {number}; correct it")
    return number


def jobs(number: int) -> int:
    """`--jobs`, scans that are made at the same time."""
    if not 1 <= number <= MAX_JOBS:
        raise UsageError(
            f"--jobs: wanted 1 to {MAX_JOBS}, got {number}; give the number of free cores"
        )
    return number


def output(path: Path | None, *, dry_run: bool) -> None:
    """`-o`, which only a dry run goes without."""
    if path is None and not dry_run:
        raise UsageError("-o: wanted an output, got none; give -o scans.mcap, or --dry-run")


def choices(**options: tuple[str, Sequence[str]]) -> None:
    """Options that are one of a few words: what was given, and the words."""
    for name, (text, allowed) in options.items():
        choice(f"--{name.replace('_', '-')}", text, allowed)


def time_limits(start: str | None, end: str | None) -> tuple[Limit | None, Limit | None, bool]:
    """`--start` and `--end` in this order, and whether one of them is a date."""
    first, first_is_date = time_limit("--start", start)
    last, last_is_date = time_limit("--end", end)
    in_order(first, last)
    return first, last, first_is_date or last_is_date


def resume(wanted: bool, *, dry_run: bool) -> bool:
    """Whether to go on; a dry run leaves nothing to go on with."""
    if wanted and dry_run:
        raise UsageError(
            "--resume: wanted an output to go on with, got --dry-run; give one of both"
        )
    return wanted


# Plain text tables; cells may quote recordings, and hold nothing that a terminal obeys.


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines, cells padded to the width of their column."""
    rows = [[one_line(cell) for cell in row] for row in rows]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
