"""Ouster IMU packets, both kinds.

Source: docs/sources/ouster.md section 8 (ouster-sdk 1.0.1 `parsing.cpp`).
"""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import F32Array, F64Array, U8Array
from mlbatch.sensors.ouster.profiles import FOOTER_SIZE
from mlbatch.types import ImuSamples
from mlbatch.units import RAD_PER_DEG, STANDARD_GRAVITY

# 3 x 8 + 2 x 12 = 48 bytes, no header.
LEGACY_IMU = np.dtype(
    [
        ("system_ns", "<i8"),
        ("acceleration_ns", "<i8"),
        ("gyroscope_ns", "<i8"),
        ("acceleration_g", "<f4", 3),
        ("angular_velocity_deg", "<f4", 3),
    ]
)
# ACCEL32_GYRO32_NMEA: header 32, NMEA time 8 and text 85, padding to 132, n samples, footer 32.
SAMPLE = np.dtype(
    [
        ("stamp_ns", "<i8"),
        ("measurement_id", "<u2"),
        ("status", "<u2"),
        ("acceleration", "<f4", 3),
        ("angular_velocity", "<f4", 3),
    ]
)
SAMPLES_START = 132
LEGACY_SIZE = LEGACY_IMU.itemsize
ACCEL32 = "ACCEL32_GYRO32_NMEA"
# The header has no sample count: n follows from the size, up to this limit.
_MOST_SAMPLES = 256


def sample_count(size: int) -> int:
    """Samples in an ACCEL32_GYRO32_NMEA packet of this size; 0 if it cannot be one."""
    count, rest = divmod(size - SAMPLES_START - FOOTER_SIZE, SAMPLE.itemsize)
    return count if rest == 0 and 0 < count <= _MOST_SAMPLES else 0


def imu_size(samples: int) -> int:
    """Bytes of an ACCEL32_GYRO32_NMEA packet."""
    return SAMPLES_START + samples * SAMPLE.itemsize + FOOTER_SIZE


def float64(values: F32Array) -> F64Array:
    """Values as float64, without warnings for the signaling NaN of damaged packets."""
    with np.errstate(invalid="ignore"):
        return values.astype(np.float64)


def read_legacy(payloads: U8Array, sensor: int) -> ImuSamples:
    """The sample of each 48-byte packet, at the gyroscope's timestamp, as in the SDK."""
    sample = np.ascontiguousarray(payloads[:, :LEGACY_SIZE]).view(LEGACY_IMU)[:, 0]
    return ImuSamples(
        sensor,
        sample["gyroscope_ns"].astype(np.int64),
        float64(sample["acceleration_g"]) * STANDARD_GRAVITY,
        float64(sample["angular_velocity_deg"]) * RAD_PER_DEG,
    )


def read_accel32(payloads: U8Array, sensor: int) -> ImuSamples:
    """The valid samples of ACCEL32_GYRO32_NMEA packets."""
    count = (payloads.shape[1] - SAMPLES_START - FOOTER_SIZE) // SAMPLE.itemsize
    end = SAMPLES_START + count * SAMPLE.itemsize
    samples = np.ascontiguousarray(payloads[:, SAMPLES_START:end]).view(SAMPLE).reshape(-1)
    samples = samples[(samples["status"] & 1) != 0]
    return ImuSamples(
        sensor,
        samples["stamp_ns"].astype(np.int64),
        float64(samples["acceleration"]),
        float64(samples["angular_velocity"]),
    )
