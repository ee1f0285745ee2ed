"""Names of `mlbatch/sensors/velodyne/encode_models.py` that tests use."""

from __future__ import annotations

from mlbatch.sensors.velodyne.encode_models import (
    MODELS,
    calibration_yaml,
)

__all__ = ["MODELS", "calibration_yaml"]
