"""Packets of spinning lidars of any vendor, by the encoders of simulate, as they are received."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import TypeAlias

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.simulate.spinning import SpinningSpec

# Receive time in ns, and payload.
Payloads: TypeAlias = list[tuple[int, bytes]]
# From the end of a packet to its receive time.
_TRAVEL_NS = {"velodyne": 100_000, "hesai": 40_000, "robosense": 200_000}


def vendor_of(spec: SpinningSpec) -> str:
    """Folder of the vendor."""
    return type(spec).__module__.split(".")[-2]


def words_of(spec: object) -> str:
    """What a spec chooses, for the name of a test."""
    if not is_dataclass(spec) or not isinstance(spec, SpinningSpec):
        return str(spec)
    chosen = [(one.default, getattr(spec, one.name)) for one in fields(spec)]
    return " ".join(str(value) for default, value in chosen if value != default)


def encoded(spec: SpinningSpec, counts: I64Array, levels: I64Array) -> Payloads:
    """Packets of ranges and levels as on the wire, (columns, channels, returns) each."""
    travel_ns = _TRAVEL_NS[vendor_of(spec)]
    return [(sent.time_ns + travel_ns, sent.payload) for sent in spec.encode(counts, levels)]


def even(spec: SpinningSpec, packets: int, count: int, level: int) -> Payloads:
    """Packets of equal readings."""
    size = spec.shape(packets)
    return encoded(spec, np.full(size, count), np.full(size, level))


def device_payloads(spec: SpinningSpec, count: int = 4) -> Payloads:
    """Packets of the device, as many as it sends in so many of its periods."""
    travel_ns = _TRAVEL_NS[vendor_of(spec)]
    after = [
        number * spec.device_period_ns for number in range(count if spec.device_period_ns else 0)
    ]
    return [(spec.begin_ns + at + travel_ns, spec.device_packet(at)) for at in after]
