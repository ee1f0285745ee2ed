"""Names of `mlbatch/sensors/robosense/encode_models.py` that tests use."""

from __future__ import annotations

from mlbatch.sensors.robosense.encode_models import (
    AIRY_MOUNTS,
    DUAL,
    LAST,
    MODELS,
    NEAREST,
    STRONGEST,
)

__all__ = ["AIRY_MOUNTS", "DUAL", "LAST", "MODELS", "NEAREST", "STRONGEST"]
