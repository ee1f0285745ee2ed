"""Gravity in the samples of an IMU: what a mean must be to be that, and its angle from a vertical.

Apart from `imu.py`, since every conversion of a lidar with an IMU and a pose asks for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.types import ImuSamples
from mlbatch.units import NS_PER_S, STANDARD_GRAVITY

STANDSTILL_NS = NS_PER_S
LEAST_SAMPLES = 20
# Largest mean rate, rad/s: more than the bias of small gyroscopes (5 degrees/s), so a turn.
MOST_BIAS = 0.2
GRAVITY_TOLERANCE = 0.05
# Largest mean rate at rest, rad/s: the bias of a small gyroscope.
MOST_STANDING = 0.02
# Of the body's z axis from the vertical at rest: no vehicle stands on a steeper slope.
MOST_TILT_DEG = 30.0


def mean_gravity(parts: Sequence[ImuSamples]) -> F64Array | None:
    """Mean specific force (3,), m/s2, IMU frame, of samples; None if that is not gravity alone."""
    stamp_ns = np.concatenate([part.stamp_ns for part in parts])
    if len(stamp_ns) < LEAST_SAMPLES or int(stamp_ns.max()) - int(stamp_ns.min()) < STANDSTILL_NS:
        return None
    force: F64Array = np.concatenate([part.acceleration for part in parts]).mean(axis=0)
    rate = np.concatenate([part.angular_velocity for part in parts]).mean(axis=0)
    is_still = math.hypot(*rate.tolist()) <= MOST_BIAS
    size = math.hypot(*force.tolist())
    return force if is_still and abs(size / STANDARD_GRAVITY - 1.0) <= GRAVITY_TOLERANCE else None


def standing_gravity(parts: Sequence[ImuSamples]) -> F64Array | None:
    """Mean specific force (3,) of the first second; None if the IMU does not rest in it."""
    stamp_ns = np.concatenate([part.stamp_ns for part in parts])
    first = stamp_ns - stamp_ns.min() <= STANDSTILL_NS
    force = np.concatenate([part.acceleration for part in parts])[first]
    rate = np.concatenate([part.angular_velocity for part in parts])[first]
    if np.count_nonzero(first) < LEAST_SAMPLES:
        return None
    mean: F64Array = force.mean(axis=0)
    # Halves of a second at rest have one mean; vibration averages out.
    half = len(force) // 2
    changes = math.hypot(*(force[:half].mean(axis=0) - force[half:].mean(axis=0)).tolist())
    turns = math.hypot(*(rate[:half].mean(axis=0) - rate[half:].mean(axis=0)).tolist())
    is_still = math.hypot(*rate.mean(axis=0).tolist()) <= MOST_STANDING and turns <= MOST_STANDING
    return mean if is_still and changes <= GRAVITY_TOLERANCE else None


def tilt_deg(up: F64Array, vertical: F64Array) -> float:
    """Angle between two vectors (3,); rounded, so that a slope of 30 degrees is not one more."""
    across = math.hypot(*np.cross(vertical, up).tolist())
    return round(math.degrees(math.atan2(across, float(vertical @ up))), 6)
