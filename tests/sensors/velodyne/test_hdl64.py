"""Points of the HDL-64E by hand, and in a scalar loop (docs/sources/velodyne.md section 10)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import F32Array, F64Array, I64Array
from mlbatch.sensors.velodyne.calibration import VelodyneFile, read_velodyne
from mlbatch.sensors.velodyne.packets import hdl64_projection
from mlbatch.simulate.velodyne.models import calibration_yaml
from tests.builders.decoded import Rotor, projected
from tests.builders.rotor import rotor_words

LASERS = 64
AT_ONCE = np.zeros((1, LASERS), np.int64)


@dataclass(frozen=True)
class Laser:
    """Corrections of a laser, rad and m: rot, vertical, c, cx, cy, h and o of section 10."""

    rot: float = 0.0
    w: float = 0.0
    c: float = 0.0
    cx: float = 0.0
    cy: float = 0.0
    h: float = 0.0
    o: float = 0.0


def unit(laser: Laser) -> VelodyneFile:
    """A sensor whose lasers are all alike."""

    def all_of(value: float) -> F64Array:
        return np.full(LASERS, value)

    return VelodyneFile(
        path=Path("db.xml"),
        lasers=LASERS,
        unit_m=0.002,
        azimuth_rad=all_of(laser.rot),
        elevation_rad=all_of(laser.w),
        dist_correction_m=all_of(laser.c),
        dist_correction_x_m=all_of(laser.cx),
        dist_correction_y_m=all_of(laser.cy),
        vert_offset_m=all_of(laser.o),
        horiz_offset_m=all_of(laser.h),
        enabled=np.ones(LASERS, np.bool_),
    )


def project(
    file: VelodyneFile,
    azimuth_deg: F64Array,
    range_m: F64Array,
    firing_ns: I64Array = AT_ONCE,
    hz: float = 0.0,
    table: int = 0,
    pose: F64Array | None = None,
) -> F32Array:
    """Points (n, 64, 3) of columns at these rotor azimuths (n,)."""
    count = len(azimuth_deg)
    words = rotor_words(azimuth_deg / 360, np.full(count, hz), np.full(count, table))
    rotor = Rotor(firing_ns, project=lambda pose: hdl64_projection(file, pose))
    return projected(rotor, words, range_m.astype(np.float32), pose)


def project_one(laser: Laser, azimuth_deg: float, range_m: float) -> list[float]:
    points = project(unit(laser), np.array([azimuth_deg]), np.full((1, LASERS), range_m))
    assert (points == points[:, :1]).all()
    return [float(value) for value in points[0, 0]]


NEAR = Laser(c=1.0, cx=1.2, cy=1.4)
UP_30 = math.pi / 6


@pytest.mark.parametrize(
    ("laser", "azimuth_deg", "range_m", "xyz"),
    [
        (Laser(), 0.0, 10.0, (10, 0, 0)),
        # 90 degrees clockwise is to the right, where y is negative.
        (Laser(), 90.0, 10.0, (0, -10, 0)),
        # alpha = azimuth - rot.
        (Laser(rot=math.pi / 6), 30.0, 10.0, (10, 0, 0)),
        # 10 m 30 degrees up: 8.660254 to the right, h forward, 5 + o up.
        (Laser(w=UP_30, c=1.0, h=0.5, o=0.2), 90.0, 9.0, (0.5, -8.660254, 5.2)),
        # Ahead, h moves to the left.
        (Laser(h=0.5), 0.0, 10.0, (10, 0.5, 0)),
        # Y = 11: ky = 1.4 - 0.4 x 9.07 / 23.11 = 1.2430117.
        (NEAR, 0.0, 10.0, (11.2430117, 0, 0)),
        # X = 11: kx = 1.2 - 0.2 x 8.6 / 22.64 = 1.1240283, on either side.
        (NEAR, 90.0, 10.0, (0, -11.1240283, 0)),
        (NEAR, 270.0, 10.0, (0, 11.1240283, 0)),
        (NEAR, 180.0, 10.0, (-11.2430117, 0, 0)),
        # q = 8.660254: kx = 1.2 + 0.2 x 2.4 / 22.64 = 1.2212014,
        # ky = 1.4 - 0.4 x 6.730254 / 23.11 = 1.2835092, kz = 1.2523553.
        (replace(NEAR, w=UP_30), 0.0, 9.0, (8.9057802, 0, 5.1261777)),
        # From 25.04 m on there is one correction only.
        (NEAR, 0.0, 30.0, (31, 0, 0)),
        (NEAR, 0.0, 25.04, (26.04, 0, 0)),
        # Without both values near by, too.
        (replace(NEAR, cx=0.0), 0.0, 10.0, (11, 0, 0)),
        (replace(NEAR, cy=0.0), 90.0, 10.0, (0, -11, 0)),
    ],
)
def test_points_by_hand(
    laser: Laser, azimuth_deg: float, range_m: float, xyz: tuple[float, float, float]
) -> None:
    assert project_one(laser, azimuth_deg, range_m) == pytest.approx(xyz, abs=3e-6)


def test_beams_fire_while_the_rotor_rotates() -> None:
    # 50 us at 10 Hz: 0.00314159 rad. Beams that do not fire (-1) are not rotated.
    firing_ns = np.array([[0] * 64, [-1, 50_000] * 32])
    ranges = np.full((2, LASERS), 10.0)
    points = project(unit(Laser()), np.zeros(2), ranges, firing_ns, hz=10.0, table=1)
    assert points[1, 0] == pytest.approx([10, 0, 0], abs=1e-6)
    assert points[1, 1] == pytest.approx([9.9999507, -0.0314154, 0], abs=1e-6)
    still = project(unit(Laser()), np.zeros(2), ranges, firing_ns, hz=10.0, table=0)
    assert still[1, 1] == pytest.approx([10, 0, 0], abs=1e-6)


def test_points_are_moved_into_the_body_frame() -> None:
    # Forward becomes left; then by 1, 2, 3 m.
    pose = np.array([[0, -1.0, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    points = project(unit(Laser(o=0.2)), np.zeros(1), np.full((1, LASERS), 10.0), pose=pose)
    assert points[0, 0] == pytest.approx([1, 12, 3.2], abs=1e-6)


def scalar_points(
    file: VelodyneFile, azimuth_rad: F64Array, turn_per_ns: float, firing_ns: I64Array, d: F32Array
) -> F64Array:
    """Section 10 literally, in the ROS axes of section 5."""
    points = np.empty((*d.shape, 3))
    for n in range(d.shape[0]):
        for laser in range(d.shape[1]):
            turned = azimuth_rad[n] + 2 * math.pi * turn_per_ns * int(firing_ns[laser])
            points[n, laser] = scalar_point(file, laser, turned, float(d[n, laser]))
    return points


def scalar_point(
    file: VelodyneFile, laser: int, azimuth_rad: float, d: float
) -> tuple[float, float, float]:
    c = float(file.dist_correction_m[laser])
    cx = float(file.dist_correction_x_m[laser])
    cy = float(file.dist_correction_y_m[laser])
    h, o = float(file.horiz_offset_m[laser]), float(file.vert_offset_m[laser])
    alpha = azimuth_rad - float(file.azimuth_rad[laser])
    w = float(file.elevation_rad[laser])
    q = (d + c) * math.cos(w)
    x, y = abs(q * math.sin(alpha)), abs(q * math.cos(alpha))
    kx = ky = kz = c
    if cx != 0 and cy != 0 and d < 25.04:
        kx = cx + (c - cx) * (x - 2.40) / (25.04 - 2.40)
        ky = cy + (c - cy) * (y - 1.93) / (25.04 - 1.93)
        kz = (kx + ky) / 2
    right = (d + kx) * math.cos(w) * math.sin(alpha) - h * math.cos(alpha)
    forward = (d + ky) * math.cos(w) * math.cos(alpha) + h * math.sin(alpha)
    up = (d + kz) * math.sin(w) + o
    return forward, -right, up


def test_many_points_equal_the_scalar_loop() -> None:
    file = read_velodyne(Path("unit.yaml"), calibration_yaml("HDL-64E S2").encode())
    assert file is not None
    check_many_points(file)


def check_many_points(file: VelodyneFile) -> None:
    """Random points against the formulas, point by point."""
    rng = np.random.default_rng(64)
    azimuth_deg = rng.uniform(0, 360, 40)
    # Half of them nearer than 25 m, where corrections change.
    range_m = np.where(
        rng.random((40, LASERS)) < 0.5, rng.uniform(0.5, 25, (40, 64)), rng.uniform(25, 120)
    ).astype(np.float32)
    firing_ns = rng.integers(0, 57_600, LASERS)
    points = project(
        file, azimuth_deg, range_m.astype(np.float64), firing_ns[None].astype(np.int64), hz=15.0
    )
    expected = scalar_points(file, np.deg2rad(azimuth_deg), 15e-9, firing_ns, range_m)
    # Float32 at 120 m: 8e-6 m a step; a count of distance is 2e-3 m.
    assert np.abs(points - expected).max() < 5e-5
