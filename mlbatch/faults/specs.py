"""Faults as users write them, `kind:sensor:value`, as values (docs/faults.md)."""

from __future__ import annotations

import difflib
import re
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, I64Array
from mlbatch.errors import UsageError
from mlbatch.units import NS_PER_MS, NS_PER_S, NS_PER_US

EVERY_SENSOR = "*"
# Farther from the begin than any packet can be, and their differences still fit into int64.
FIRST_NS, LAST_NS = -(2**62), 2**62
MAX_TIME_NS = 10**9 * NS_PER_S
# Packets that are delayed wait in memory.
MAX_DELAY_NS = 60 * NS_PER_S
MAX_DRIFT_PPM = 100_000
_SHOWN = 60

_DIGITS = r"(?:\d{1,20}(?:\.\d{0,20})?|\.\d{1,20})"
_UNITS_NS = {"ns": 1, "us": NS_PER_US, "ms": NS_PER_MS, "s": NS_PER_S}
_UNIT = "(ns|us|ms|s)"
_TIME = re.compile(f"([+-]?)({_DIGITS}){_UNIT}", re.ASCII)
_SHARE = re.compile(f"({_DIGITS})%", re.ASCII)
_DRIFT = re.compile(f"([+-]?{_DIGITS})ppm", re.ASCII)


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault; it touches a packet of its sensor(s) within a time with a probability.

    text: as it was given; sensor: name or EVERY_SENSOR; share: that probability; window_ns: from
    and before when, after the first packet's arrival; by_ns: what a delay or a jump adds;
    drift_ppm: what a clock gains.
    """

    text: str
    kind: str
    sensor: str
    share: float = 1.0
    window_ns: tuple[int, int] = (FIRST_NS, LAST_NS)
    by_ns: int = 0
    drift_ppm: float = 0.0


@dataclass(frozen=True, slots=True)
class _Kind:
    """How the value of a kind is read; `parse` gives None for what it does not take."""

    wanted: str
    example: str
    parse: Callable[[str, str, str, str], Fault | None]


def parse_fault(text: str) -> Fault:
    """A fault from `kind:sensor:value`, as `drop:left:5%`; UsageError if it is none."""
    name, _, rest = text.strip().partition(":")
    # Names of sensors may hold colons, values never do.
    sensor, colon, value = rest.rpartition(":")
    kind = _KINDS.get(name)
    if kind is None:
        near = difflib.get_close_matches(name, _KINDS, 1)
        advice = f"did you mean {near[0]}?" if near else "write drop:left:5%"
        raise UsageError(
            f"--fault: wanted one of {', '.join(_KINDS)}, got {_short(name)}; {advice}"
        )
    example = f"{name}:{sensor or 'left'}:{kind.example}"
    if not colon or not sensor:
        raise UsageError(
            f"--fault: wanted {name}:SENSOR:VALUE, got {_short(text)}; write {example}"
        )
    fault = kind.parse(text.strip(), name, sensor, value)
    if fault is None:
        raise UsageError(
            f"--fault {name}: wanted {kind.wanted}, got {_short(value)}; write {example}"
        )
    return fault


def _short(text: str) -> str:
    return repr(text if len(text) <= _SHOWN else text[:_SHOWN] + "...")


def _time_ns(text: str) -> int | None:
    """Nanoseconds of `60ms`, `-37s`; None where the text is no time."""
    found = _TIME.fullmatch(text)
    if found is None:
        return None
    amount_ns = round(Fraction(found[2]) * _UNITS_NS[found[3]])
    if amount_ns > MAX_TIME_NS:
        return None
    return -amount_ns if found[1] == "-" else amount_ns


def _moment_ns(text: str) -> int | None:
    """A time after the begin; the begin itself holds back to the first packet of all."""
    moment_ns = None if text.startswith(("+", "-")) else _time_ns(text)
    return FIRST_NS if moment_ns == 0 else moment_ns


def _share(text: str, kind: str, sensor: str, value: str) -> Fault | None:
    found = _SHARE.fullmatch(value)
    share = Fraction(0) if found is None else Fraction(found[1]) / 100
    return Fault(text, kind, sensor, share=float(share)) if 0 < share <= 1 else None


def _window(text: str, kind: str, sensor: str, value: str) -> Fault | None:
    first, _, last = value.partition("-")
    begin_ns, end_ns = _moment_ns(first), _moment_ns(last)
    if begin_ns is None or end_ns is None or begin_ns >= end_ns:
        return None
    return Fault(text, kind, sensor, window_ns=(begin_ns, end_ns))


def _late(text: str, kind: str, sensor: str, value: str) -> Fault | None:
    end_ns = _moment_ns(value)
    if end_ns is None or end_ns <= 0:
        return None
    return Fault(text, kind, sensor, window_ns=(FIRST_NS, end_ns))


def _early(text: str, kind: str, sensor: str, value: str) -> Fault | None:
    begin_ns = _moment_ns(value)
    if begin_ns is None:
        return None
    return Fault(text, kind, sensor, window_ns=(begin_ns, LAST_NS))


def _delay(text: str, kind: str, sensor: str, value: str) -> Fault | None:
    by_ns = _time_ns(value)
    if by_ns is None or not 0 < by_ns <= MAX_DELAY_NS:
        return None
    return Fault(text, kind, sensor, by_ns=by_ns)


def _jump(text: str, kind: str, sensor: str, value: str) -> Fault | None:
    step, _, moment = value.partition("@")
    by_ns, begin_ns = _time_ns(step), _moment_ns(moment)
    if not by_ns or begin_ns is None:
        return None
    return Fault(text, kind, sensor, window_ns=(begin_ns, LAST_NS), by_ns=by_ns)


def _drift(text: str, kind: str, sensor: str, value: str) -> Fault | None:
    found = _DRIFT.fullmatch(value)
    drift_ppm = Fraction(0) if found is None else Fraction(found[1])
    if not 0 < abs(drift_ppm) <= MAX_DRIFT_PPM:
        return None
    return Fault(text, kind, sensor, drift_ppm=float(drift_ppm))


_A_SHARE = "a share of packets above 0% and up to 100%"
_A_TIME = "seconds after the first packet, up to 1000000000s (units ns, us, ms, s)"
_KINDS = {
    "drop": _Kind(_A_SHARE, "5%", _share),
    "stall": _Kind("a first time before a last one, after the first packet", "5s-8s", _window),
    "late": _Kind(f"a time above 0, {_A_TIME}", "2s", _late),
    "early": _Kind(_A_TIME, "3s", _early),
    "truncate": _Kind(_A_SHARE, "1%", _share),
    "bitflip": _Kind(_A_SHARE, "1%", _share),
    "reorder": _Kind(_A_SHARE, "3%", _share),
    "dup": _Kind(_A_SHARE, "2%", _share),
    "delay": _Kind(f"a time above 0, up to {MAX_DELAY_NS // NS_PER_S}s", "60ms", _delay),
    "jump": _Kind("a step other than 0, and a time after the first packet", "37s@10s", _jump),
    "drift": _Kind(f"a drift other than 0, up to {MAX_DRIFT_PPM}ppm", "50ppm", _drift),
}
KINDS = tuple(_KINDS)


# Chance that depends on what it is about, and on nothing that was drawn before.
#
# Numbers of SplitMix64 (Steele, Lea, Flood: Fast splittable pseudorandom number generators,
# OOPSLA 2014), a generator whose n-th number is a function of n. So the same packet meets the
# same fault however a recording is cut into batches, files or containers.

U64Array: TypeAlias = npt.NDArray[np.uint64]

_STEP = 0x9E3779B97F4A7C15
_WORD = 2**64 - 1
# As many bits as a float holds: shares up to 1 become whole thresholds.
_SHARE_BITS = 53


def source(seed: int, fault: int, sensor: str) -> int:
    """Where the numbers of a fault (by its place in the list) and a sensor begin."""
    state = 0
    for word in (seed & _WORD, fault, zlib.crc32(sensor.encode())):
        state = int(_mixed(np.array([(state ^ word) + _STEP & _WORD], np.uint64))[0])
    return state


def draw(source: U64Array, number: I64Array) -> U64Array:
    """The number-th (from 0) number of each source, both (n,)."""
    step = np.uint64(_STEP)
    return _mixed(source + (number.astype(np.uint64) + np.uint64(1)) * step)


def falls_below(drawn: U64Array, share: float) -> BoolArray:
    """Which of the numbers lie in the lowest `share` (0 to 1) of all there can be."""
    limit = np.uint64(round(share * 2**_SHARE_BITS))
    below: BoolArray = drawn >> np.uint64(64 - _SHARE_BITS) < limit
    return below


def again(drawn: U64Array) -> U64Array:
    """A second number for each, independent of whether the first fell below a share."""
    return _mixed(drawn + np.uint64(_STEP))


def _mixed(state: U64Array) -> U64Array:
    state = (state ^ state >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ state >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
    mixed: U64Array = state ^ state >> np.uint64(31)
    return mixed
