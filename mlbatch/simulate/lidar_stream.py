"""The packets of one lidar of the rig: poses of its shots, what they meet, noise, receive times."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.motion.se3 import skew
from mlbatch.simulate.interface import Sent, Shots, simulated_lidar
from mlbatch.simulate.rays import Rays
from mlbatch.simulate.scenario import Clock, ImuErrors, LidarPlan, Scenario
from mlbatch.simulate.scene import Scene
from mlbatch.units import NS_PER_S

# Full width at half maximum of a Gaussian: 2 sqrt(2 ln 2).
_WIDTH_PER_SIGMA = 2.354820045


@dataclass(frozen=True, slots=True, order=True)
class Received:
    """A packet at the capture host, ns of true time; lidar: index in the rig."""

    host_ns: int
    lidar: int
    number: int
    port: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class SensorClock:
    """Conversion between true time since the start, s, and the time of a sensor clock, ns."""

    start_ns: int
    clock: Clock

    @property
    def first_ns(self) -> int:
        """Return the sensor's time at the start."""
        return self.start_ns + round(self.clock.offset_s * NS_PER_S)

    @property
    def rate(self) -> float:
        """Return seconds of the sensor per true second."""
        return 1.0 + self.clock.drift_ppm * 1e-6

    def true_s(self, sensor_ns: I64Array) -> F64Array:
        """Return true times since the start."""
        since: F64Array = (sensor_ns - self.first_ns) / (NS_PER_S * self.rate)
        return since

    def sensor_ns(self, true_s: F64Array) -> I64Array:
        """Return times of the sensor clock."""
        own: I64Array = np.rint(true_s * (self.rate * NS_PER_S)).astype(np.int64)
        return own + self.first_ns


class LidarStream:
    """Packets of a lidar, chunk by chunk."""

    def __init__(self, scenario: Scenario, index: int) -> None:
        """index: of the lidar in the rig."""
        self.plan: LidarPlan = scenario.lidars[index]
        self._scenario = scenario
        self._index = index
        self._clock = SensorClock(scenario.start_ns, self.plan.clock)
        settings = replace(self.plan.settings, start_ns=self._clock.first_ns)
        self.lidar = simulated_lidar(settings)
        self._chunk = 0
        self._sent = 0
        self._last_ns = 0
        self._imu_samples = 0
        # Shots, returns, packets and lost packets so far.
        self.shots = 0
        self.returns = 0
        self.packets = 0
        self.lost = 0

    @property
    def next_s(self) -> float:
        """True time before which no further packet is received."""
        return self._chunk * self.lidar.chunk_s / self._clock.rate

    def receive(self) -> list[Received]:
        """Simulate the next chunk; return its packets that are not lost."""
        random = np.random.default_rng((self._scenario.seed, 1 + self._index, self._chunk))
        shots = self.lidar.shots(self._chunk)
        distance_m, level = self._measured(shots, random)
        sent = self.lidar.packets(self._chunk, distance_m, level)
        self._chunk += 1
        if self.lidar.imu is not None:
            sent += self._inertial(random)
        sent.sort(key=lambda one: (one.time_ns, one.port))
        return self._received(sent, random)

    def _measured(self, shots: Shots, random: np.random.Generator) -> tuple[F64Array, F64Array]:
        """Return distances with noise, inf for no return, and reflectivities (n, c)."""
        origin, direction, time_s = self._world_rays(shots)
        shape = direction.shape[:2]
        chosen = np.arange(shape[0] * shape[1])
        if shots.fires is not None:
            chosen = np.flatnonzero(shots.fires.ravel())
        rays = Rays.of(
            origin.reshape(-1, 3)[chosen], direction.reshape(-1, 3)[chosen], time_s.ravel()[chosen]
        )
        if self.plan.divergence_rad > 0.0:
            _spread(rays, self.plan.divergence_rad, random)
        distance_m = np.full(shape[0] * shape[1], np.inf)
        level = np.zeros(shape[0] * shape[1])
        if len(chosen):
            distance_m[chosen], level[chosen] = self._scenario.scene.cast(
                rays, self.plan.max_range_m, random
            )
            if self._scenario.body is not None:
                self._hide(self._scenario.body, shots, rays.time_s, chosen, distance_m, level)
        if self.plan.noise_m > 0.0:
            noise = random.standard_normal(len(distance_m), dtype=np.float32)
            distance_m += self.plan.noise_m * noise
        if self.plan.dropout > 0.0:
            missing = random.random(len(distance_m), dtype=np.float32) < self.plan.dropout
            distance_m[missing] = np.inf
        self.shots += len(chosen)
        self.returns += int(np.isfinite(distance_m).sum())
        return distance_m.reshape(shape), level.reshape(shape)

    def _hide(
        self,
        body: Scene,
        shots: Shots,
        time_s: F64Array,
        chosen: I64Array,
        distance_m: F64Array,
        level: F64Array,
    ) -> None:
        """Replace what is behind the machine itself; its poses do not matter.

        time_s: of the chosen shots.
        """
        turn, arm = self.plan.body_from_sensor[:3, :3], self.plan.body_from_sensor[:3, 3]
        shape = shots.direction.shape
        origin = np.broadcast_to(np.matmul(shots.origin_m, turn.T) + arm, shape)
        direction = np.matmul(shots.direction, turn.T).reshape(-1, 3)[chosen]
        rays = Rays.of(origin.reshape(-1, 3)[chosen], direction, time_s)
        own_m, own_level = body.cast(rays, self.plan.max_range_m)
        nearer = own_m < distance_m[chosen]
        distance_m[chosen[nearer]] = own_m[nearer]
        level[chosen[nearer]] = own_level[nearer]

    def _world_rays(self, shots: Shots) -> tuple[F64Array, F64Array, F64Array]:
        """Return origins and directions (n, c, 3), world frame, and true times (n, c).

        Within a column the pose changes by its rates: the square of a rotation of 1e-4 rad is
        left out.
        """
        first_s = self._clock.true_s(shots.time_ns)
        poses = self._scenario.trajectory.poses(first_s)
        body = self.plan.body_from_sensor
        turn, arm = body[:3, :3], body[:3, 3]
        delay_s = shots.delay_s / self._clock.rate
        shape = shots.direction.shape
        # Rows are vectors: they are multiplied by transposed matrices.
        turned = np.matmul(poses.rotation, turn).transpose(0, 2, 1)
        place = np.matmul(poses.rotation, arm) + poses.position_m
        direction = np.matmul(shots.direction, turned)
        origin = np.matmul(shots.origin_m, turned) + place[:, None]
        if delay_s.any():
            later = delay_s[..., None]
            spin = np.matmul(poses.rotation, skew(poses.angular_velocity))
            turning = np.matmul(spin, turn).transpose(0, 2, 1)
            speed = np.matmul(spin, arm) + poses.velocity
            direction += later * np.matmul(shots.direction, turning)
            origin = origin + later * (np.matmul(shots.origin_m, turning) + speed[:, None])
        time_s = np.broadcast_to(first_s[:, None] + delay_s, shape[:2])
        return np.broadcast_to(origin, shape), direction, time_s

    def _inertial(self, random: np.random.Generator) -> list[Sent]:
        """Return the IMU packets until the end of the chunk."""
        unit = self.lidar.imu
        if unit is None:
            return []
        until = int(np.ceil(self._chunk * self.lidar.chunk_s * unit.rate_hz))
        number = np.arange(self._imu_samples, until)
        self._imu_samples = until
        stamp_ns = self._clock.first_ns + number * NS_PER_S // unit.rate_hz
        true_s = self._clock.true_s(stamp_ns)
        pose = self.plan.body_from_sensor @ unit.sensor_from_imu
        force, rate = self._scenario.trajectory.inertial(true_s, pose)
        force, rate = with_errors(force, rate, self.plan.imu, random)
        return self.lidar.imu_packets(stamp_ns, force, rate)

    def _received(self, sent: list[Sent], random: np.random.Generator) -> list[Received]:
        """Return packets with receive times: delayed, in their order, until the end."""
        plan = self.plan
        sensor_ns = np.array([one.time_ns for one in sent], np.int64)
        true_s = self._clock.true_s(sensor_ns)
        late_s = plan.latency_s + plan.jitter_s * random.random(len(sent))
        arrival_ns = np.rint((true_s + late_s) * NS_PER_S).astype(np.int64)
        arrival_ns += self._scenario.start_ns
        lost = random.random(len(sent)) < plan.loss
        found = []
        for one, at_s, at_ns, is_lost in zip(
            sent, true_s.tolist(), arrival_ns.tolist(), lost.tolist(), strict=True
        ):
            if not 0.0 <= at_s < self._scenario.duration_s:
                continue
            self.packets += 1
            if is_lost:
                self.lost += 1
                continue
            self._last_ns = max(self._last_ns, at_ns)
            self._sent += 1
            found.append(Received(self._last_ns, self._index, self._sent, one.port, one.payload))
        return found


def _spread(rays: Rays, divergence_rad: float, random: np.random.Generator) -> None:
    """Move each ray to one place in its beam, whose profile is Gaussian.

    A stem thinner than the beam is then met by its share of the shots, as is the edge of a wall.
    """
    sigma = divergence_rad / _WIDTH_PER_SIGMA
    direction = rays.direction
    direction += sigma * random.standard_normal(direction.shape, dtype=np.float32)
    direction /= np.sqrt(np.einsum("in,in->n", direction, direction))


def with_errors(
    force: F64Array, rate: F64Array, errors: ImuErrors, random: np.random.Generator
) -> tuple[F64Array, F64Array]:
    """Return specific force and angular velocity (n, 3) with bias and noise."""
    noise = random.standard_normal((2, *force.shape))
    return (
        force + np.array(errors.accel_bias) + errors.accel_noise * noise[0],
        rate + np.array(errors.gyro_bias) + errors.gyro_noise * noise[1],
    )
