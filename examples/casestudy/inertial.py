"""Odometry of scans and an IMU: deskew, D2D-NDT against a local map, factor graph, iSAM2.

Each scan ends with a node of the graph: pose, velocity and biases. Between nodes: the preintegrated
IMU; at each node: the registered pose. All in the frame of the IMU; gravity along -z.
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

LOCAL_MAP_S = 5.0
GRAVITY = 9.80665
REST_S = 1.5
# Of the IMU, per sample at 200 Hz: larger than the simulated noise of 0.002 rad/s, 0.02 m/s2.
_GYRO_NOISE = 0.003
_ACCEL_NOISE = 0.03
_GYRO_WALK = 1e-4
_ACCEL_WALK = 1e-3
# Of the predicted pose as a start of the registration: degrees, m.
_PRIOR_DEG = 0.5
_PRIOR_M = 0.05
# Errors of neighbouring Gaussians are not independent: the information is divided by this.
_INFLATION = 25.0


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
    """The graph and the local map; `add` takes scans in order."""

    def __init__(self, imu: Imu, begin_s: float, truth: Track | None = None) -> None:
        """The rig stands until `begin_s`: biases and gravity come from the time before.

        truth: the floor; true poses deskew, begin each registration and make the map.
        """
        self._imu = imu
        self._truth = truth
        self._stamp_s = begin_s
        rest = (imu.stamp_s >= begin_s - REST_S) & (imu.stamp_s <= begin_s)
        up = imu.force[rest].mean(axis=0)
        roll = np.arctan2(up[1], up[2])
        pitch = np.arctan2(-up[0], np.hypot(up[1], up[2]))
        first = np.eye(4)
        first[:3, :3] = Rotation.from_euler("xyz", [roll, pitch, 0.0]).as_matrix()
        if truth is not None:
            first = at_times(truth, np.array([begin_s])).poses[0]
        self._state = gtsam.NavState(gtsam.Pose3(first), np.zeros(3))
        # At rest only the part along gravity can be distinguished from a tilt.
        felt = float(np.sqrt((up**2).sum()))
        along = up * (1.0 - GRAVITY / felt)
        self._bias = gtsam.imuBias.ConstantBias(along, imu.rate[rest].mean(axis=0))
        self._node = 0
        # Nodes to which the IMU alone led: their scan has no Gaussian that the map has.
        self.unmatched = 0
        self._map = ndt.LocalMap(LOCAL_MAP_S)
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
        """Return the pose (4, 4) at the end of a scan, and add the scan to the map."""
        imu_factor = gtsam.PreintegratedCombinedMeasurements(self._params, self._bias)
        poses = self._integrate(imu_factor, cloud.end_s)
        predicted = imu_factor.predict(self._state, self._bias)
        poses = self._truth or poses
        column_s = np.clip(cloud.column_s, poses.stamp_s[0], poses.stamp_s[-1])
        columns = at_times(poses, column_s).poses
        guess = at_times(poses, np.array([min(cloud.end_s, poses.stamp_s[-1])])).poses[0]
        points = _deskewed(cloud, np.linalg.inv(guess) @ columns)
        match = ndt.register(ndt.voxel_gaussians(points), self._map, guess, _prior())
        self.unmatched += match.matched == 0
        self._update(imu_factor, predicted, match)
        self._stamp_s = cloud.end_s
        pose: Array = self._state.pose().matrix()
        placed = pose if self._truth is None else guess
        self._map.insert(cloud.end_s, points @ placed[:3, :3].T + placed[:3, 3])
        return pose

    def _integrate(self, factor: gtsam.PreintegratedCombinedMeasurements, end_s: float) -> Track:
        """Integrate the samples up to a time; return the poses after each."""
        imu = self._imu
        inside = (imu.stamp_s > self._stamp_s) & (imu.stamp_s < end_s)
        bounds = np.concatenate([[self._stamp_s], imu.stamp_s[inside], [end_s]])
        middle = 0.5 * (bounds[1:] + bounds[:-1])
        stamps, poses = [self._stamp_s], [self._state.pose().matrix()]
        for step_s, at_s, until_s in zip(np.diff(bounds), middle, bounds[1:], strict=True):
            if step_s < 1e-7:
                continue
            force = [np.interp(at_s, imu.stamp_s, imu.force[:, axis]) for axis in range(3)]
            rate = [np.interp(at_s, imu.stamp_s, imu.rate[:, axis]) for axis in range(3)]
            factor.integrateMeasurement(np.array(force), np.array(rate), step_s)
            stamps.append(until_s)
            poses.append(factor.predict(self._state, self._bias).pose().matrix())
        return Track(np.array(stamps), np.array(poses))

    def _update(
        self,
        imu_factor: gtsam.PreintegratedCombinedMeasurements,
        predicted: gtsam.NavState,
        match: ndt.Match,
    ) -> None:
        last, node = self._node, self._node + 1
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        keys = (X(last), V(last), X(node), V(node), B(last), B(node))
        graph.push_back(gtsam.CombinedImuFactor(*keys, imu_factor))
        if match.matched:
            information = match.information / _INFLATION + 1e-3 * np.eye(6)
            noise = gtsam.noiseModel.Gaussian.Information(information)
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


def _deskewed(cloud: Cloud, end_from_column: Array) -> Array:
    """Move points (p, 3) to the pose at the end, by the transforms of their columns (c, 4, 4)."""
    moved = end_from_column[cloud.column]
    turned: Array = np.einsum("pij,pj->pi", moved[:, :3, :3], cloud.points) + moved[:, :3, 3]
    return turned


def _prior() -> Array:
    sigmas = np.array([np.radians(_PRIOR_DEG)] * 3 + [_PRIOR_M] * 3)
    return np.diag(1.0 / sigmas**2)


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
