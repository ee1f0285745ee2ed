"""Names of `mlbatch/sensors/robosense/encode.py` that tests use."""

from __future__ import annotations

from mlbatch.sensors.robosense.encode import (
    DIFOP_MAGIC,
    START_NS,
    Angles,
    RobosenseSpec,
    angles_csv,
    azimuths_deg,
    difop,
    directions,
    fan,
    firing_times_ns,
    msop,
    origins,
    rounds,
)

__all__ = [
    "DIFOP_MAGIC",
    "START_NS",
    "Angles",
    "RobosenseSpec",
    "angles_csv",
    "azimuths_deg",
    "difop",
    "directions",
    "fan",
    "firing_times_ns",
    "msop",
    "origins",
    "rounds",
]
