"""Clouds of points made by hand: faces of rooms and visible sides of stems, with noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.motion.registration import Pose
from mlbatch.motion.se3 import exp_rotation, exp_transform
from mlbatch.poses.solve import Cloud

NOISE_M = 0.01
WINDOW_S = 0.1
# A face: corner and the two edges from it, m.
Face = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]

GROUND: Face = ((-10, -10, 0), (20, 0, 0), (0, 20, 0))
WALL: Face = ((-10, 6, 0), (20, 0, 0), (0, 0, 4))
END: Face = ((8, -10, 0), (0, 20, 0), (0, 0, 4))
# The walls go on far beyond what is seen of them.
CORRIDOR: tuple[Face, ...] = (
    ((-12, -2, 0), (24, 0, 0), (0, 4, 0)),
    ((-12, -2, 3), (24, 0, 0), (0, 4, 0)),
    ((-12, -2, 0), (24, 0, 0), (0, 0, 3)),
    ((-12, 2, 0), (24, 0, 0), (0, 0, 3)),
)
ROOM: tuple[Face, ...] = (
    ((-5, -4, 0), (10, 0, 0), (0, 8, 0)),
    ((-5, -4, 3), (10, 0, 0), (0, 8, 0)),
    ((-5, -4, 0), (10, 0, 0), (0, 0, 3)),
    ((-5, 4, 0), (10, 0, 0), (0, 0, 3)),
    ((-5, -4, 0), (0, 8, 0), (0, 0, 3)),
    ((5, -4, 0), (0, 8, 0), (0, 0, 3)),
)


def faces_points(rng: np.random.Generator, faces: tuple[Face, ...], count: int) -> F64Array:
    """Points (count, 3) on faces, as many by area, without noise."""
    corner, along, across = (np.array(part, float) for part in zip(*faces, strict=True))
    area = np.linalg.norm(np.cross(along, across), axis=1)
    face = rng.choice(len(faces), count, p=area / area.sum())
    shares = rng.random((2, count, 1))
    points: F64Array = corner[face] + shares[0] * along[face] + shares[1] * across[face]
    return points


def stem_points(
    rng: np.random.Generator,
    foot_m: F64Array,
    radius_m: float,
    origin_m: F64Array,
    count: int,
    height_m: float = 3.2,
) -> F64Array:
    """Points (count, 3) of an upright cylinder, on the side that is seen from an origin.

    Beams meet it evenly across its width.
    """
    view = foot_m[:2] - origin_m[:2]
    view = view / np.linalg.norm(view)
    across = radius_m * rng.uniform(-1, 1, count)
    deep = -np.sqrt(radius_m**2 - across**2)
    level = foot_m[:2] + deep[:, None] * view + across[:, None] * np.array([-view[1], view[0]])
    return np.column_stack([level, foot_m[2] + height_m * rng.random(count)])


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Lidars that see the same faces.

    wrong: of each lidar, how its points are moved by an error of its pose; twist: (6,), of the
    body, m/s and rad/s, about the instant of the place; late_s: of each lidar, how much its times
    are too early.
    """

    wrong: tuple[Pose, ...]
    twist: F64Array
    late_s: tuple[float, ...] = ()

    def place(
        self, rng: np.random.Generator, faces: tuple[tuple[Face, ...], ...], count: int
    ) -> list[Cloud]:
        """Two windows of each lidar; faces: of each lidar."""
        clouds = []
        for window in (-1, 0):
            for lidar, wrong in enumerate(self.wrong):
                points_m = faces_points(rng, faces[lidar], count)
                # The beams turn once in a window, each lidar from another direction.
                turned = np.arctan2(points_m[:, 1], points_m[:, 0]) / (2 * np.pi) + 0.37 * lidar
                time_s = WINDOW_S * (window + turned % 1.0)
                clouds.append(self.cloud(lidar, wrong, points_m, time_s, rng))
        return clouds

    def cloud(
        self,
        lidar: int,
        wrong: Pose,
        points_m: F64Array,
        time_s: F64Array,
        rng: np.random.Generator,
    ) -> Cloud:
        """Points that stand still, as the moving body sees them."""
        rotation, shift = exp_transform(
            time_s[:, None] * self.twist[:3], time_s[:, None] * self.twist[3:]
        )
        seen = np.einsum("nji,nj->ni", rotation, points_m - shift)
        seen += NOISE_M * rng.standard_normal(seen.shape)
        late_s = self.late_s[lidar] if self.late_s else 0.0
        return Cloud(
            lidar, seen @ wrong.rotation.T + wrong.position_m, time_s - late_s, np.zeros(3)
        )


def motion(shift_m: tuple[float, ...], turn_deg: tuple[float, ...]) -> Pose:
    """A shift and a turn."""
    turn = np.deg2rad(np.array([turn_deg], float))
    return Pose(exp_rotation(turn)[0], np.array(shift_m, float))
