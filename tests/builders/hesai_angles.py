"""Names of `mlbatch/sensors/hesai/encode_angles.py` that tests use."""

from __future__ import annotations

from mlbatch.sensors.hesai.encode_angles import (
    Angles,
    Beams,
    MirrorAngles,
    angles_csv,
    fan,
)

__all__ = ["Angles", "Beams", "MirrorAngles", "angles_csv", "fan"]
