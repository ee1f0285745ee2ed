"""`--start` and `--end` against the times of a recording: what can only be a mistake is refused.

`--start 10`, meant as `+10`, is ten seconds after 1970: it would select everything, without a word.
"""

from __future__ import annotations

from mlbatch.batching.windows import Limit
from mlbatch.clocks.timescale import DAY_NS, EPOCH_NS, UNKNOWN, describe_time
from mlbatch.errors import UsageError
from mlbatch.units import NS_PER_S

# The longest window (0.25 Hz): one that contains the first stamp may begin so long before it.
WINDOW_NS = 4 * NS_PER_S
# How long before the recording `--start` may be: on its day; on clocks without a date, where a
# small number is more often meant as `+S`, at the start of a window.
EARLY_NS = DAY_NS
EARLY_UPTIME_NS = WINDOW_NS


def refuse_outside(start: Limit | None, end: Limit | None, first_ns: int) -> None:
    """Raise UsageError for a limit, no `+S`, before the recording; first_ns: its first stamp."""
    early_ns = EARLY_NS if first_ns >= EPOCH_NS else EARLY_UPTIME_NS
    for option, limit, allowed_ns in (("--start", start, early_ns), ("--end", end, WINDOW_NS)):
        if limit is None or limit.from_t_init or limit.ns >= first_ns - allowed_ns:
            continue
        raise UsageError(
            f"{option}: expected a time of the recording, which begins at "
            f"{text_of_time(first_ns)}, found {text_of_time(limit.ns)}; {_advice(option, limit.ns)}"
        )


def text_of_range(first_ns: int, last_ns: int) -> str:
    """The times of a recording."""
    return f"from {text_of_time(first_ns)} to {text_of_time(last_ns)}"


def _advice(option: str, limit_ns: int) -> str:
    if 0 <= limit_ns < DAY_NS:
        seconds = _seconds(limit_ns)
        return f"write {option} +{seconds} for {seconds} s after the start of scan 0"
    return "correct it, or write +SECONDS after the start of scan 0"


def text_of_time(time_ns: int) -> str:
    """A time as it can be given to the options, and its date."""
    if time_ns < EPOCH_NS:
        return f"{_seconds(time_ns)} s"
    return f"{_seconds(time_ns)} s ({describe_time(time_ns, UNKNOWN).split()[0]})"


def _seconds(time_ns: int) -> str:
    whole, rest = divmod(abs(time_ns), NS_PER_S)
    sign = "-" if time_ns < 0 else ""
    return f"{sign}{whole}" + f".{rest:09d}".rstrip("0").rstrip(".")
