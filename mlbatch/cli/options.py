"""Option values from text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

from mlbatch.batching.windows import Limit
from mlbatch.errors import UsageError
from mlbatch.pipeline.job import check_ranges_m, check_slices, wait_ns
from mlbatch.pipeline.time_limits import limits_of
from mlbatch.sensors import DECODE_OPTIONS
from mlbatch.units import parse_rate

if TYPE_CHECKING:
    from mlbatch.faults import Fault
    from mlbatch.pipeline.shards import Shard


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
            f"--exclude-box: expected x0,y0,z0,x1,y1,z1 in metres with x0 < x1, y0 < y1, z0 < z1, "
            f"found {text!r}; write --exclude-box=-1,-1,0,1,1,2"
        )
    return values


def decode_options(texts: Sequence[str]) -> dict[str, str]:
    """`--decode KEY=VALUE`, repeatable."""
    options = {}
    for text in texts:
        key, sign, value = text.partition("=")
        if key not in DECODE_OPTIONS:
            raise UsageError(
                f"--decode: expected one of {', '.join(DECODE_OPTIONS)}, found {key!r}; "
                "write --decode crc=check"
            )
        if not sign or value not in DECODE_OPTIONS[key]:
            raise UsageError(
                f"--decode {key}: expected {' or '.join(DECODE_OPTIONS[key])}, found {value!r}; "
                f"write --decode {key}={DECODE_OPTIONS[key][0]}"
            )
        options[key] = value
    return options


def choice(option: str, text: str, allowed: Sequence[str]) -> str:
    """An option with a closed list of words."""
    if text in allowed:
        return text
    raise UsageError(
        f"{option}: expected {' or '.join(allowed)}, found {text!r}; choose one of them"
    )


def percent(option: str, value: float) -> float:
    """A percentage."""
    if not 0 <= value <= 100:
        raise UsageError(f"{option}: expected a share from 0 to 100 %, found {value:g}; correct it")
    return value


def faults(texts: Sequence[str]) -> tuple[Fault, ...]:
    """`--fault KIND:SENSOR:VALUE`, repeatable."""
    if not texts:
        return ()
    # Not loaded for runs without faults.
    from mlbatch.faults import parse_fault

    return tuple(parse_fault(text) for text in texts)


def shard(text: str | None) -> Shard | None:
    """`--shard K/N`."""
    if text is None:
        return None
    # Not loaded for runs without shards.
    from mlbatch.pipeline.shards import parse_shard

    return parse_shard(text)


def seed(number: int) -> int:
    """`--fault-seed`, a whole number from 0."""
    if number < 0:
        raise UsageError(
            f"--fault-seed: expected a whole number from 0, found {number}; correct it"
        )
    return number


def is_stdout(path: Path | None) -> bool:
    """True for `-`, standard output."""
    return path == Path("-")


def output(path: Path | None, *, dry_run: bool) -> None:
    """`-o`, required unless it is a dry run."""
    if path is None and not dry_run:
        raise UsageError("-o: expected an output, found none; give -o scans.mcap, or --dry-run")


def choices(**options: tuple[str, Sequence[str]]) -> None:
    """Check options with a closed list of words: name=(text, words)."""
    for name, (text, allowed) in options.items():
        choice(f"--{name.replace('_', '-')}", text, allowed)


def time_limits(start: str | None, end: str | None) -> tuple[Limit | None, Limit | None, bool]:
    """`--start` and `--end`, and True if one of them is a date."""
    return limits_of("--start", start, "--end", end)


def resume(resume: bool, *, dry_run: bool) -> bool:
    """`--resume`, which a dry run cannot have: it leaves no output."""
    if resume and dry_run:
        raise UsageError(
            "--resume: expected an output to continue, found --dry-run; give one of them"
        )
    return resume
