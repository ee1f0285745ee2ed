"""What the first packets of a ROBOSENSE unit tell beyond its model: mode, steps, times, doubts.

Source: facts/robosense.md sections 1 to 5.
"""

from __future__ import annotations

import numpy as np

from mlbatch.median import median
from mlbatch.sensors.packet_bytes import number, usual
from mlbatch.sensors.robosense.difop import Difop
from mlbatch.sensors.robosense.identify import identify, returns_of
from mlbatch.sensors.robosense.models import (
    AIRY_LAYOUT,
    HELIOS_LAYOUT,
    OTHER,
    RS16,
    RS32,
    RUBY_PLUS_80,
    Model,
    ReturnMode,
)
from mlbatch.types import I64Array, U8Array

COUNTER_MODULUS = 1 << 32
_COUNTED_PACKETS = 16
# Helios, byte 17: step of distances, here as steps in a metre.
_STEP_AT, _STEPS_PER_M = 17, {0: 200, 1: 400}
# Ruby Plus 80: the model byte, which sources put at either place.
_VARIANT_BYTES, _PLUS_80V = (31, 32), 3


def mode(points: U8Array, row: Model, difop: Difop | None) -> tuple[ReturnMode, tuple[str, ...]]:
    """Return mode: how many returns by the point packets, which one by the device packet."""
    told = None if difop is None else row.modes.get(difop.mode)
    seen = returns_of(points, row)
    if told is not None and seen in (0, told.returns):
        return told, ()
    if seen:
        return ReturnMode(seen, OTHER), ()
    note = "neither point nor DIFOP packets tell the return mode: single return is taken"
    return ReturnMode(1, OTHER), (note,)


def units_per_m(points: U8Array, row: Model) -> tuple[int, tuple[str, ...]]:
    """Steps of a raw distance in a metre."""
    if row.layout is not HELIOS_LAYOUT or not len(points):
        return row.units_per_m, ()
    code = usual(number(points, _STEP_AT, 1))
    found = _STEPS_PER_M.get(code, row.units_per_m)
    if found == row.units_per_m:
        return found, ()
    note = "byte 17 of its packets says that distances count in 5 mm, other units send 2.5 mm"
    return found, (note,)


def firing_ns(points: U8Array, row: Model, difop: Difop | None) -> I64Array:
    """(1, channels) firing times after the column's stamp."""
    chosen = 0
    if row.layout is AIRY_LAYOUT and difop is not None:
        chosen = difop.installation
    elif row is RUBY_PLUS_80 and len(points):
        chosen = int(_PLUS_80V in {usual(number(points, at, 1)) for at in _VARIANT_BYTES})
    known = row.firing_ns[chosen] if chosen < len(row.firing_ns) else row.firing_ns[0]
    return np.array([known], np.int64) - min(known)


def is_counted(points: U8Array, row: Model) -> bool:
    """Whether packets have a count that goes up by one; not all firmware fills it in."""
    if not row.counter_at:
        return False
    count = number(points[:_COUNTED_PACKETS], row.counter_at, 4, ">")
    steps = np.diff(count) % COUNTER_MODULUS
    return len(steps) > 0 and median(steps) == 1.0


def doubts(points: U8Array, row: Model, difop: Difop | None, *, is_named: bool) -> tuple[str, ...]:
    """What the packets leave open and the user may know, or has said: is_named."""
    texts = []
    found = identify(points)
    if found is not None and found.other is not None and not is_named:
        texts.append(
            f"packets do not surely tell {found.name} apart: decoded as {row.name}; name the "
            "sensor's model in the rig if it is the other (times differ by up to 34 us)"
        )
    if row in (RS16, RS32) and difop is not None and difop.firmware == 0:
        texts.append(
            "DIFOP names no firmware: that of the first years counted distances in 1 cm, "
            "not in 5 mm as decoded here; check a known distance"
        )
    return tuple(texts)
