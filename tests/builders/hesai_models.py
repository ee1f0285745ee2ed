"""Names of `mlbatch/sensors/hesai/encode_models.py` that tests use."""

from __future__ import annotations

from mlbatch.sensors.hesai.encode_models import (
    EPOCH,
    HIGH,
    MODELS,
    SEQUENCE,
    SINCE_1900,
    STATES,
)

__all__ = ["EPOCH", "HIGH", "MODELS", "SEQUENCE", "SINCE_1900", "STATES"]
