"""Fault specifications as users write them, `kind:sensor:value` (docs/faults.md)."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

from mlbatch.errors import UsageError
from mlbatch.units import NS_PER_MS, NS_PER_S, NS_PER_US

EVERY_SENSOR = "*"
# Beyond any time of a packet; differences still fit into int64.
FIRST_NS = -(2**62)
LAST_NS = 2**62
MAX_TIME_NS = 10**9 * NS_PER_S
# Delayed packets wait in memory.
MAX_DELAY_NS = 60 * NS_PER_S
MAX_DRIFT_PPM = 100_000
_SHOWN_CHARACTERS = 60

_DIGITS = r"(?:\d{1,20}(?:\.\d{0,20})?|\.\d{1,20})"
_UNITS_NS = {"ns": 1, "us": NS_PER_US, "ms": NS_PER_MS, "s": NS_PER_S}
_UNIT = "(ns|us|ms|s)"
_TIME = re.compile(f"([+-]?)({_DIGITS}){_UNIT}", re.ASCII)
_PERCENTAGE = re.compile(f"({_DIGITS})%", re.ASCII)
_DRIFT = re.compile(f"([+-]?{_DIGITS})ppm", re.ASCII)


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of one sensor, or of all."""

    # As the user wrote it.
    text: str
    # A key of KINDS.
    kind: str
    # Name, or EVERY_SENSOR.
    sensor: str
    # Probability that it affects a packet.
    share: float = 1.0
    # Affected receive times, [begin, end), after that of the first packet.
    window_ns: tuple[int, int] = (FIRST_NS, LAST_NS)
    # Delay, or step of the clock.
    by_ns: int = 0
    drift_ppm: float = 0.0


@dataclass(frozen=True, slots=True)
class _Kind:
    """Syntax of the value of one kind of fault."""

    expected: str
    example: str
    # From (text, kind, sensor, value); None: the value is wrong.
    parse: Callable[[str, str, str, str], Fault | None]


def parse_fault(text: str) -> Fault:
    """Parse `kind:sensor:value`, as `drop:left:5%`; raises UsageError."""
    name, _, rest = text.strip().partition(":")
    # Names of sensors may contain colons, values do not.
    sensor, colon, value = rest.rpartition(":")
    kind = _KINDS.get(name)
    if kind is None:
        near = difflib.get_close_matches(name, _KINDS, 1)
        advice = f"did you mean {near[0]}?" if near else "write drop:left:5%"
        raise UsageError(
            f"--fault: expected one of {', '.join(_KINDS)}, found {_shortened(name)}; {advice}"
        )
    example = f"{name}:{sensor or 'left'}:{kind.example}"
    if not colon or not sensor:
        raise UsageError(
            f"--fault: expected {name}:SENSOR:VALUE, found {_shortened(text)}; write {example}"
        )
    fault = kind.parse(text.strip(), name, sensor, value)
    if fault is None:
        raise UsageError(
            f"--fault {name}: expected {kind.expected}, found {_shortened(value)}; write {example}"
        )
    return fault


def _shortened(text: str) -> str:
    return repr(text if len(text) <= _SHOWN_CHARACTERS else text[:_SHOWN_CHARACTERS] + "...")


def _duration_ns(text: str) -> int | None:
    """Nanoseconds of `60ms`, `-37s`; None if the text is no duration."""
    match = _TIME.fullmatch(text)
    if match is None:
        return None
    amount_ns = round(Fraction(match[2]) * _UNITS_NS[match[3]])
    if amount_ns > MAX_TIME_NS:
        return None
    return -amount_ns if match[1] == "-" else amount_ns


def _time_ns(text: str) -> int | None:
    """A time after the first packet; 0 includes all packets of an earlier receive time."""
    time_ns = None if text.startswith(("+", "-")) else _duration_ns(text)
    return FIRST_NS if time_ns == 0 else time_ns


def _percentage(text: str, kind: str, sensor: str, value: str) -> Fault | None:
    match = _PERCENTAGE.fullmatch(value)
    share = Fraction(0) if match is None else Fraction(match[1]) / 100
    return Fault(text, kind, sensor, share=float(share)) if 0 < share <= 1 else None


def _window(text: str, kind: str, sensor: str, value: str) -> Fault | None:
    begin, _, end = value.partition("-")
    begin_ns = _time_ns(begin)
    end_ns = _time_ns(end)
    if begin_ns is None or end_ns is None or begin_ns >= end_ns:
        return None
    return Fault(text, kind, sensor, window_ns=(begin_ns, end_ns))


def _late_start(text: str, kind: str, sensor: str, value: str) -> Fault | None:
    end_ns = _time_ns(value)
    if end_ns is None or end_ns <= 0:
        return None
    return Fault(text, kind, sensor, window_ns=(FIRST_NS, end_ns))


def _early_end(text: str, kind: str, sensor: str, value: str) -> Fault | None:
    begin_ns = _time_ns(value)
    if begin_ns is None:
        return None
    return Fault(text, kind, sensor, window_ns=(begin_ns, LAST_NS))


def _delay(text: str, kind: str, sensor: str, value: str) -> Fault | None:
    by_ns = _duration_ns(value)
    if by_ns is None or not 0 < by_ns <= MAX_DELAY_NS:
        return None
    return Fault(text, kind, sensor, by_ns=by_ns)


def _clock_step(text: str, kind: str, sensor: str, value: str) -> Fault | None:
    step, _, time = value.partition("@")
    by_ns = _duration_ns(step)
    begin_ns = _time_ns(time)
    if not by_ns or begin_ns is None:
        return None
    return Fault(text, kind, sensor, window_ns=(begin_ns, LAST_NS), by_ns=by_ns)


def _clock_drift(text: str, kind: str, sensor: str, value: str) -> Fault | None:
    match = _DRIFT.fullmatch(value)
    drift_ppm = Fraction(0) if match is None else Fraction(match[1])
    if not 0 < abs(drift_ppm) <= MAX_DRIFT_PPM:
        return None
    return Fault(text, kind, sensor, drift_ppm=float(drift_ppm))


_A_PERCENTAGE = "a percentage of packets above 0% and up to 100%"
_A_TIME = "seconds after the first packet, up to 1000000000s (units ns, us, ms, s)"
_KINDS = {
    "drop": _Kind(_A_PERCENTAGE, "5%", _percentage),
    "stall": _Kind("a first time before a last one, after the first packet", "5s-8s", _window),
    "late": _Kind(f"a time above 0, {_A_TIME}", "2s", _late_start),
    "early": _Kind(_A_TIME, "3s", _early_end),
    "truncate": _Kind(_A_PERCENTAGE, "1%", _percentage),
    "bitflip": _Kind(_A_PERCENTAGE, "1%", _percentage),
    "reorder": _Kind(_A_PERCENTAGE, "3%", _percentage),
    "dup": _Kind(_A_PERCENTAGE, "2%", _percentage),
    "delay": _Kind(f"a time above 0, up to {MAX_DELAY_NS // NS_PER_S}s", "60ms", _delay),
    "jump": _Kind("a step other than 0, and a time after the first packet", "37s@10s", _clock_step),
    "drift": _Kind(f"a drift other than 0, up to {MAX_DRIFT_PPM}ppm", "50ppm", _clock_drift),
}
KINDS = tuple(_KINDS)
