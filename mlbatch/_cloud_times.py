"""What the time field of a cloud means, told by its type and values.

Source: facts/messages.md, section 8, "Detection rule". Drivers agree neither on the unit nor on the
zero of the times of their points, and say nothing of either in the message.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch._cloud_packets import CloudError
from mlbatch.arrays import I64Array
from mlbatch.units import NS_PER_S

# Numbers of the type that a cloud's time field has.
Times: TypeAlias = npt.NDArray[Any]

_LIMIT_NS = 2**31 * NS_PER_S
# No turn takes longer; another unit than the one supposed would.
_LONGEST_S = 10
_FLOAT64_BYTES = 8


@dataclass(frozen=True, slots=True)
class Zero:
    """What times may count from; field: name and type; base: what base_ns is, in words."""

    field: str
    base_ns: int
    base: str


@dataclass(frozen=True, slots=True)
class _FloatTime:
    """What floating-point times mean whose largest is between two values; ns: of their unit."""

    above: float
    below: float
    ns: int
    absolute: bool
    words: str


_FLOAT_TIMES = (
    _FloatTime(-1e3, 1e3, NS_PER_S, False, "s after"),
    _FloatTime(1e8, 1e11, NS_PER_S, True, "s since 1970"),
    _FloatTime(1e14, float(_LIMIT_NS), 1, True, "ns since 1970"),
)


def stamps(time: Times, zero: Zero) -> tuple[I64Array, str]:
    """Stamps (ns) of points by their finite times (n > 0,); and what the times were taken for."""
    if time.dtype.kind != "f":
        # At most 32 bits, hence 4.3 s.
        return _after(zero, time.astype(np.int64)), f"{zero.field}, ns after {zero.base}"
    value = time.astype(np.float64)
    low, high = float(value.min()), float(value.max())
    meant = next((one for one in _FLOAT_TIMES if one.above < high < one.below), None)
    if meant is None or (meant.absolute and time.dtype.itemsize < _FLOAT64_BYTES):
        raise CloudError(
            f"field {zero.field}: wanted s after {zero.base} (below 1000), or float64 s or ns "
            f"since 1970, got {high:g}; its unit is not known, record the raw packets"
        )
    span_s = (high - low) * (meant.ns / NS_PER_S)
    if span_s > _LONGEST_S:
        raise CloudError(
            f"field {zero.field}: wanted times of one cloud within {_LONGEST_S} s, got "
            f"{span_s:g} s; its unit is not known, record the raw packets"
        )
    # Part by part: a float64 of nanoseconds since 1970 has a step of 256.
    whole = np.floor(value)
    ns = whole.astype(np.int64) * meant.ns
    ns += np.rint((value - whole) * meant.ns).astype(np.int64)
    if meant.absolute:
        return ns, f"{zero.field}, {meant.words}"
    words = "s up to" if high <= 0 > low else meant.words
    return _after(zero, ns), f"{zero.field}, {words} {zero.base}"


def _after(zero: Zero, offset_ns: I64Array) -> I64Array:
    if not 0 < zero.base_ns < _LIMIT_NS:
        raise CloudError(
            f"field {zero.field}: wanted times after {zero.base}, got {zero.base_ns} ns there; "
            "set the clock of its driver and record again"
        )
    return zero.base_ns + offset_ns
