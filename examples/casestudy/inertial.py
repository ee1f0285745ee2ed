"""The positioning algorithm of the paper's section 2.2: IMU, D2D-NDT, factor graph, iSAM2.

A scan is deskewed by the integrated IMU, registered with cells of 2.5 m from the IMU's guess, and
enters the graph as a prior factor on its pose, next to the preintegrated IMU. After 4.0 m it is
registered again with cells of 0.5 m and merged into the map of the last 3. All in the frame of the
IMU; gravity along -z.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import ndt
import numpy as np
from evaluation import Track, at_times
from gtsam.symbol_shorthand import B, V, X
from ndt import Array, Indices
from scipy.spatial.transform import Rotation

KEYFRAME_M = 4.0
KEYFRAMES = 3
GRAVITY = 9.80665
REST_S = 1.5
SCAN_S = 0.1
# Of the IMU, per sample at 200 Hz: twice the simulated noise, for vibration between samples.
_GYRO_NOISE = 0.003
_ACCEL_NOISE = 0.02
_GYRO_WALK = 1e-4
_ACCEL_WALK = 1e-3
# Of a registration. Its information is that of independent Gaussians, which neighbours are not:
# divided. Registrations to one map share its errors: no better than a floor.
_INFLATION = 25.0
_FLOOR = np.array([np.radians(0.1)] * 3 + [0.02] * 3)
_LOST_M = 500.0


class Diverged(Exception):
    """The estimate has left the scene or is not a number."""


@dataclass(frozen=True, slots=True, eq=False)
class Imu:
    """Samples at times (n,), s: angular velocity, rad/s, and specific force, m/s2, (n, 3)."""

    stamp_s: Array
    rate: Array
    force: Array


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points (p, 3) in the frame of the IMU, and the row of each in the columns' times (c,), s."""

    end_s: float
    points: Array
    column: Indices
    column_s: Array


class Odometry:
    """The graph and the map; `add` takes the scans that update it, in order."""

    def __init__(self, imu: Imu, begin_s: float) -> None:
        """The rig stands until `begin_s`: attitude and biases come from the time before."""
        self._imu = imu
        self._stamp_s = begin_s
        rest = (imu.stamp_s >= begin_s - REST_S) & (imu.stamp_s <= begin_s)
        up = imu.force[rest].mean(axis=0)
        roll = np.arctan2(up[1], up[2])
        pitch = np.arctan2(-up[0], np.hypot(up[1], up[2]))
        first = np.eye(4)
        first[:3, :3] = Rotation.from_euler("xyz", [roll, pitch, 0.0]).as_matrix()
        self._state = gtsam.NavState(gtsam.Pose3(first), np.zeros(3))
        # At rest only the part along gravity can be distinguished from a tilt.
        along = up * (1.0 - GRAVITY / float(np.sqrt((up**2).sum())))
        self._bias = gtsam.imuBias.ConstantBias(along, imu.rate[rest].mean(axis=0))
        self._node = 0
        # Nodes to which the IMU alone led.
        self.unmatched = 0
        self._map = ndt.KeyframeMap(KEYFRAMES)
        self._mapped_m: Array | None = None
        self._isam = gtsam.ISAM2(gtsam.ISAM2Params())
        self._params = _imu_params()
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        # A biased accelerometer tilts the first attitude.
        sigmas = np.array([1e-2, 1e-2, 1e-6, 1e-6, 1e-6, 1e-6])
        graph.push_back(gtsam.PriorFactorPose3(X(0), self._state.pose(), _diagonal(sigmas)))
        graph.push_back(gtsam.PriorFactorVector(V(0), np.zeros(3), _diagonal([1e-3] * 3)))
        spread = _diagonal([0.1] * 3 + [5e-4] * 3)
        graph.push_back(gtsam.PriorFactorConstantBias(B(0), self._bias, spread))
        values.insert(X(0), self._state.pose())
        values.insert(V(0), np.zeros(3))
        values.insert(B(0), self._bias)
        self._isam.update(graph, values)

    def add(self, cloud: Cloud) -> Array:
        """Return the pose (4, 4) at the end of a scan; Diverged where there is none."""
        try:
            factor = gtsam.PreintegratedCombinedMeasurements(self._params, self._bias)
            poses = self._integrate(factor, cloud.end_s)
            predicted = factor.predict(self._state, self._bias)
            guess = predicted.pose().matrix()
            columns = at_times(poses, np.clip(cloud.column_s, *poses.stamp_s[[0, -1]])).poses
            points = _deskewed(cloud, np.linalg.inv(guess) @ columns)
            match = ndt.Match(guess, None)
            if not self._map.empty:
                rough = ndt.voxel_gaussians(points, ndt.ROUGH_M)
                match = ndt.register(rough, self._map, guess)
                self.unmatched += match.information is None
            pose = self._update(factor, predicted, match)
        # Of gtsam: an indeterminate system; of numpy: a singular matrix.
        except (RuntimeError, np.linalg.LinAlgError, ValueError) as error:
            raise Diverged(f"{type(error).__name__}: {error}") from error
        if not np.isfinite(pose).all() or np.abs(pose[:3, 3]).max() > _LOST_M:
            raise Diverged("the position has left the scene")
        self._stamp_s = cloud.end_s
        self._map_after(points, pose)
        return pose

    def _map_after(self, points: Array, pose: Array) -> None:
        """Merge a scan into the map when the machine is far enough from the last one."""
        if self._mapped_m is not None:
            if np.sqrt(((pose[:3, 3] - self._mapped_m) ** 2).sum()) <= KEYFRAME_M:
                return
            pose = ndt.register(ndt.voxel_gaussians(points, ndt.FINE_M), self._map, pose).pose
        self._map.insert(points @ pose[:3, :3].T + pose[:3, 3])
        self._mapped_m = pose[:3, 3].copy()

    def _integrate(self, factor: gtsam.PreintegratedCombinedMeasurements, end_s: float) -> Track:
        """Integrate the samples up to a time; return the poses during the scan that ends then."""
        imu = self._imu
        first, last = np.searchsorted(imu.stamp_s, [self._stamp_s, end_s], side="right")
        inside = imu.stamp_s[first:last]
        bounds = np.concatenate([[self._stamp_s], inside[inside < end_s], [end_s]])
        middle = 0.5 * (bounds[1:] + bounds[:-1])
        near = slice(max(first - 2, 0), last + 2)
        force, rate = (
            np.stack([np.interp(middle, imu.stamp_s[near], part[near, axis]) for axis in range(3)])
            for part in (imu.force, imu.rate)
        )
        stamps, poses = [self._stamp_s], [self._state.pose().matrix()]
        for row, step_s in enumerate(np.diff(bounds)):
            if step_s < 1e-7:
                continue
            factor.integrateMeasurement(force[:, row], rate[:, row], step_s)
            if bounds[row + 1] > end_s - 1.2 * SCAN_S or len(poses) == 1:
                stamps.append(bounds[row + 1])
                poses.append(factor.predict(self._state, self._bias).pose().matrix())
        return Track(np.array(stamps), np.array(poses))

    def _update(
        self,
        factor: gtsam.PreintegratedCombinedMeasurements,
        predicted: gtsam.NavState,
        match: ndt.Match,
    ) -> Array:
        last, node = self._node, self._node + 1
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        keys = (X(last), V(last), X(node), V(node), B(last), B(node))
        graph.push_back(gtsam.CombinedImuFactor(*keys, factor))
        if match.information is not None:
            covariance = np.linalg.inv(match.information / _INFLATION + 1e-3 * np.eye(6))
            noise = gtsam.noiseModel.Gaussian.Covariance(covariance + np.diag(_FLOOR**2))
            graph.push_back(gtsam.PriorFactorPose3(X(node), gtsam.Pose3(match.pose), noise))
        values.insert(X(node), predicted.pose())
        values.insert(V(node), predicted.velocity())
        values.insert(B(node), self._bias)
        self._isam.update(graph, values)
        self._node = node
        pose = self._isam.calculateEstimatePose3(X(node))
        velocity = self._isam.calculateEstimateVector(V(node))
        self._state = gtsam.NavState(pose, velocity)
        self._bias = self._isam.calculateEstimateConstantBias(B(node))
        matrix: Array = pose.matrix()
        return matrix


def _deskewed(cloud: Cloud, end_from_column: Array) -> Array:
    """Move points (p, 3) to the pose at the end, by the transforms of their columns (c, 4, 4)."""
    moved = end_from_column[cloud.column]
    turned: Array = np.einsum("pij,pj->pi", moved[:, :3, :3], cloud.points) + moved[:, :3, 3]
    return turned


def _diagonal(sigmas: object) -> gtsam.noiseModel.Diagonal:
    return gtsam.noiseModel.Diagonal.Sigmas(np.asarray(sigmas, np.float64))


def _imu_params() -> gtsam.PreintegrationCombinedParams:
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY)
    # Densities: the noise of a sample times the root of its period.
    params.setGyroscopeCovariance(np.eye(3) * _GYRO_NOISE**2 / 200.0)
    params.setAccelerometerCovariance(np.eye(3) * _ACCEL_NOISE**2 / 200.0)
    params.setIntegrationCovariance(np.eye(3) * 1e-8)
    params.setBiasOmegaCovariance(np.eye(3) * _GYRO_WALK**2)
    params.setBiasAccCovariance(np.eye(3) * _ACCEL_WALK**2)
    return params
