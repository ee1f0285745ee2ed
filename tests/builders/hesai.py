"""Names of `mlbatch/sensors/hesai/encode.py` that tests use."""

from __future__ import annotations

from mlbatch.sensors.hesai.encode import (
    DUAL,
    TRIPLE,
    HesaiSpec,
    MirrorAngles,
    angles_csv,
    azimuths_deg,
    crc32_mpeg2,
    date_field,
    directions,
    encode_packets,
    fires,
    firing_times_ns,
    host_times_ns,
)

__all__ = [
    "DUAL",
    "TRIPLE",
    "HesaiSpec",
    "MirrorAngles",
    "angles_csv",
    "azimuths_deg",
    "crc32_mpeg2",
    "date_field",
    "directions",
    "encode_packets",
    "fires",
    "firing_times_ns",
    "host_times_ns",
]
