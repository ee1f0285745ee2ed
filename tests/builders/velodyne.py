"""Names of `mlbatch/sensors/velodyne/encode.py` that tests use."""

from __future__ import annotations

from mlbatch.sensors.velodyne.encode import (
    Rays,
    Sent,
    VelodyneSpec,
    directions,
    encode,
    firing_times_ns,
    gprmc,
    observe,
    origins,
    position_packets,
)

__all__ = [
    "Rays",
    "Sent",
    "VelodyneSpec",
    "directions",
    "encode",
    "firing_times_ns",
    "gprmc",
    "observe",
    "origins",
    "position_packets",
]
