"""The drives as a dataset of evalio: merged scans of both lidars, the IMU, the true poses.

    python casestudy.py --recordings evalio_data/drives --seeds 1
    EVALIO_CUSTOM=evalio_drives evalio run -d 'drives/*' -p kiss ...

Times and frames as evalio has them: a scan is stamped at its start, points after it; scans and
ground truth are in the body frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import auto
from pathlib import Path

import numpy as np
from evalio.datasets import Dataset
from evalio.datasets.base import DatasetIterator
from evalio.datasets.loaders import RawDataIter
from evalio.types import (
    SE3,
    SO3,
    Duration,
    ImuMeasurement,
    ImuParams,
    LidarMeasurement,
    LidarParams,
    Point,
    Stamp,
    Trajectory,
)
from machine import IMU_IN_BODY_M, MACHINE_BOX

import mlbatch

RATE_HZ = 10


class Drives(Dataset):  # type: ignore[misc]  # evalio is not installed here
    """Folders of `casestudy.py --recordings`: scene and seed."""

    harvester_easy_01 = auto()
    harvester_easy_02 = auto()
    harvester_easy_03 = auto()
    harvester_easy_04 = auto()
    harvester_easy_05 = auto()
    harvester_hard_01 = auto()
    harvester_hard_02 = auto()
    harvester_hard_03 = auto()
    harvester_hard_04 = auto()
    harvester_hard_05 = auto()

    @property
    def drive(self) -> Path:
        """Where its files are; `_` of a member is `-` of a folder."""
        folder: Path = self.folder
        return folder.with_name(folder.name.replace("_", "-"))

    def data_iter(self) -> DatasetIterator:
        """Scans and IMU samples, by their stamps."""
        table = np.loadtxt(self.drive / "drive.imu.csv", delimiter=",", skiprows=1)
        samples = (
            ImuMeasurement(Stamp.from_nsec(int(row[0])), row[1:4], row[4:7]) for row in table
        )
        count = int((table[-1, 0] - table[0, 0]) / 1e9 * RATE_HZ)
        return RawDataIter(self._scans(), samples, count)

    def _scans(self) -> Iterator[LidarMeasurement]:
        scans = mlbatch.scans(
            self.drive / "drive.mcap",
            rig=self.drive / "drive.rig.yaml",
            rate=RATE_HZ,
            exclude_boxes=[MACHINE_BOX],
        )
        for scan in scans:
            columns = scan.column if scan.column is not None else np.zeros(len(scan.xyz), np.uint32)
            rows = zip(
                scan.xyz.tolist(), scan.intensity.tolist(), scan.time_ns.tolist(),
                scan.ring.tolist(), columns.tolist(), strict=True,
            )  # fmt: skip
            points = [
                Point(
                    x=x, y=y, z=z, intensity=level, t=Duration.from_nsec(ns), row=ring, col=column
                )
                for (x, y, z), level, ns, ring, column in rows
            ]
            yield LidarMeasurement(Stamp.from_nsec(scan.start_ns), points)

    def ground_truth_raw(self) -> Trajectory:
        """True poses of the body."""
        return Trajectory.from_csv(
            self.drive / "drive.truth.tum",
            ["sec", "x", "y", "z", "qx", "qy", "qz", "qw"],
            delimiter=" ",
        )

    def imu_T_lidar(self) -> SE3:
        """Scans are in the body frame."""
        return SE3(SO3.identity(), -np.array(IMU_IN_BODY_M))

    def imu_T_gt(self) -> SE3:
        """The truth is that of the body frame."""
        return self.imu_T_lidar()

    def imu_params(self) -> ImuParams:
        """As the scenarios have it: noise of a sample times the root of its period."""
        return ImuParams(gyro=0.0015 / 200**0.5, accel=0.01 / 200**0.5, rate=200.0)

    def lidar_params(self) -> LidarParams:
        """Two lidars, whose rings follow each other."""
        return LidarParams(num_rows=256, num_columns=2048, min_range=0.8, max_range=40.0)

    def files(self) -> Sequence[str | Path]:
        """What must be there."""
        names = ("drive.mcap", "drive.rig.yaml", "drive.imu.csv", "drive.truth.tum")
        return [self.drive / name for name in names]
