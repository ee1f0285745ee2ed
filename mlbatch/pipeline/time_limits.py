"""`--start` and `--end` against the times of a recording: what can only be a mistake is refused.

`--start 10`, meant as `+10`, is ten seconds after 1970: it would select everything, without a word.
"""

from __future__ import annotations

import datetime
import re
from decimal import Decimal, InvalidOperation
from operator import index
from typing import SupportsIndex

from mlbatch.batching.windows import Limit
from mlbatch.clocks.timescale import DAY_NS, EPOCH_NS, UNKNOWN, describe_time
from mlbatch.errors import UsageError
from mlbatch.pipeline.job import MOST_S
from mlbatch.units import NS_PER_S

# The longest window (0.25 Hz): one that contains the first stamp may begin so long before it.
WINDOW_NS = 4 * NS_PER_S
# How long before the recording `--start` may be: on its day; on clocks without a date, where a
# small number is more often meant as `+S`, at the start of a window.
EARLY_NS = DAY_NS
EARLY_UPTIME_NS = WINDOW_NS


def limits_of(
    start_option: str, start: str | int | None, end_option: str, end: str | int | None
) -> tuple[Limit | None, Limit | None, bool]:
    """Start and end of a run, and True if one of them is a date; options: names for errors.

    Raises UsageError unless start is before end, if both count from the same time.
    """
    first, first_is_date = time_limit(start_option, start)
    last, last_is_date = time_limit(end_option, end)
    count_alike = first is not None and last is not None and first.from_t_init == last.from_t_init
    if first is not None and last is not None and count_alike and last.ns <= first.ns:
        raise UsageError(
            f"{end_option}: expected a time after {start_option} ({first.ns / NS_PER_S:g} s), "
            f"found {last.ns / NS_PER_S:g} s; swap them"
        )
    return first, last, first_is_date or last_is_date


def time_limit(option: str, text: str | int | None) -> tuple[Limit | None, bool]:
    """A limit (epoch seconds, ISO time, +S or +Ss; int: ns), and True if it is a date."""
    if text is None:
        return None, False
    if not isinstance(text, str):
        return Limit(_whole_ns(option, text)), False
    relative = text.startswith("+")
    try:
        seconds = Decimal(text.removesuffix("s") if relative else text)
        # No arithmetic before the range is checked: abs(1e999999999) overflows.
        if seconds.is_finite() and -MOST_S <= seconds <= MOST_S:
            return Limit(int(seconds * NS_PER_S), from_t_init=relative), False
    except InvalidOperation:
        pass
    try:
        return Limit(_iso_ns(text)), True
    except ValueError:
        raise UsageError(
            f"{option}: expected epoch seconds, an ISO time or +SECONDS, found {text!r}; "
            "write 1700000000.5, 2026-05-01T12:00:00 or +12.5"
        ) from None


def _iso_ns(text: str) -> int:
    text = text.replace("Z", "+00:00")
    # Python 3.10 accepts three or six decimals only.
    text = re.sub(r"\.(\d{1,6})(?!\d)", lambda found: f".{found[1]:0<6}", text)
    moment = datetime.datetime.fromisoformat(text)
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=datetime.timezone.utc)
    since = moment - datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)
    return (since.days * 86400 + since.seconds) * NS_PER_S + since.microseconds * 1000


def _whole_ns(option: str, value: object) -> int:
    """A time in ns; numbers with a fraction could be meant as seconds, and are refused."""
    if isinstance(value, bool) or not isinstance(value, SupportsIndex):
        raise UsageError(
            f"{option}: expected whole nanoseconds or a text, found {value!r}; write an int of ns, "
            "or seconds as a text"
        )
    ns = index(value)
    if abs(ns) > MOST_S * NS_PER_S:
        raise UsageError(
            f"{option}: expected nanoseconds of at most {MOST_S} s, found {ns}; correct it"
        )
    return ns


def refuse_outside(
    start: Limit | None, end: Limit | None, first_ns: int, zero: str = "the start of scan 0"
) -> None:
    """Raise UsageError for a limit, no `+S`, before the recording.

    first_ns: its first stamp, or receive time; zero: where `+S` counts from.
    """
    early_ns = EARLY_NS if first_ns >= EPOCH_NS else EARLY_UPTIME_NS
    for option, limit, allowed_ns in (("--start", start, early_ns), ("--end", end, WINDOW_NS)):
        if limit is None or limit.from_t_init or limit.ns >= first_ns - allowed_ns:
            continue
        raise UsageError(
            f"{option}: expected a time of the recording, which begins at "
            f"{text_of_time(first_ns)}, found {text_of_time(limit.ns)}; "
            f"{_advice(option, limit.ns, zero)}"
        )


def text_of_range(first_ns: int, last_ns: int) -> str:
    """The times of a recording."""
    return f"from {text_of_time(first_ns)} to {text_of_time(last_ns)}"


def _advice(option: str, limit_ns: int, zero: str) -> str:
    if 0 <= limit_ns < DAY_NS:
        seconds = _seconds(limit_ns)
        return f"write {option} +{seconds} for {seconds} s after {zero}"
    return f"correct it, or write +SECONDS after {zero}"


def text_of_time(time_ns: int) -> str:
    """A time as it can be given to the options, and its date."""
    if time_ns < EPOCH_NS:
        return f"{_seconds(time_ns)} s"
    return f"{_seconds(time_ns)} s ({describe_time(time_ns, UNKNOWN).split()[0]})"


def _seconds(time_ns: int) -> str:
    whole, rest = divmod(abs(time_ns), NS_PER_S)
    sign = "-" if time_ns < 0 else ""
    return f"{sign}{whole}" + f".{rest:09d}".rstrip("0").rstrip(".")
