"""Names of `mlbatch/sensors/ouster/encode.py` that tests use."""

from __future__ import annotations

from mlbatch.sensors.ouster.encode import (
    IntLike,
    JsonObject,
    OusterSpec,
    encode_frame,
    encode_packets,
    flat_json,
    imu_packet,
    metadata_json,
)

__all__ = [
    "IntLike",
    "JsonObject",
    "OusterSpec",
    "encode_frame",
    "encode_packets",
    "flat_json",
    "imu_packet",
    "metadata_json",
]
