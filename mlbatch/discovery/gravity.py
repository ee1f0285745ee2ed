"""Do the poses of lidars agree with the gravity that their own IMUs measure in the first seconds?

A pose of another mount or vehicle turns gravity away from the vertical of the body. The vertical
is z, upward, unless the name of the body frame states another (REP 103).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.discovery.router import Role, Router
from mlbatch.discovery.sampler import Sampler
from mlbatch.discovery.types import DetectedSensor, Note
from mlbatch.motion.gravity import MOST_TILT_DEG, mean_gravity, tilt_deg
from mlbatch.types import ImuSamples

# Upward, by the end of the name of the body frame: of aircraft and ships, and of cameras.
_UP: Mapping[str, tuple[float, float, float]] = {
    "_frd": (0.0, 0.0, -1.0),
    "_ned": (0.0, 0.0, -1.0),
    "_optical": (0.0, -1.0, 0.0),
    "": (0.0, 0.0, 1.0),
}


def gravity_notes(
    sampler: Sampler, router: Router, sensors: Sequence[DetectedSensor], body_frame: str
) -> Iterator[Note]:
    """Warnings about sensors whose pose turns the gravity of their own IMU from the vertical."""
    vertical = vertical_of(body_frame)
    for sensor, up in ups(sampler, router, sensors):
        tilted_deg = tilt_deg(up, np.array(vertical))
        if not sensor.pose.is_known or tilted_deg <= MOST_TILT_DEG:
            continue
        axis = " ".join(f"{value:g}" for value in vertical)
        found = " ".join(f"{round(value, 2) + 0.0:.2f}" for value in up.tolist())
        text = (
            f"{sensor.name}: expected [{axis}] of {body_frame} upward within {MOST_TILT_DEG:.0f} "
            f"degrees, found [{found}] upward by the gravity of its IMU, {tilted_deg:.0f} degrees "
            f"from it: its pose ({sensor.pose.describe()}) is of another mount or vehicle, or "
            f"another axis of {body_frame} points upward; correct the pose, or end the name of the "
            "body frame in _ned or _frd (z downward) or _optical (y downward)"
        )
        yield Note("pose_gravity", sensor.name, text)


def vertical_of(body_frame: str) -> tuple[float, float, float]:
    """The axis of the body that points upward, by the name of its frame."""
    return next(axis for end, axis in _UP.items() if body_frame.endswith(end))


def ups(
    sampler: Sampler,
    router: Router,
    sensors: Sequence[DetectedSensor],
    mean: Callable[[Sequence[ImuSamples]], F64Array | None] = mean_gravity,
) -> Iterator[tuple[DetectedSensor, F64Array]]:
    """Sensors with an IMU, and up (3,) by its gravity in the first seconds, body frame.

    mean: of the samples, IMU frame.
    """
    for number, sensor in enumerate(sensors):
        sensor_from_imu = sensor.lidar.sensor_from_imu()
        parts = list(_samples(sampler, router, number, sensor))
        if sensor_from_imu is None or not parts:
            continue
        gravity = mean(parts)
        if gravity is not None:
            up = sensor.pose.body_from_sensor[:3, :3] @ sensor_from_imu[:3, :3] @ gravity
            yield sensor, up / np.linalg.norm(up)


def _samples(
    sampler: Sampler, router: Router, number: int, sensor: DetectedSensor
) -> Iterator[ImuSamples]:
    """IMU samples of a sensor among the packets of the first seconds."""
    for kind, samples in sampler.kinds.items():
        if not sensor.lidar.is_imu(kind.size):
            continue
        payloads, _ = samples.arrays()
        if router.route(kind, payloads[0]) == (Role.IMU, (number,)):
            yield sensor.lidar.imu(payloads, number)
