"""Scans for tests: seeded random arrays, or single points with chosen values."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.types import ImuSamples, RunInfo, Scan, SensorInfo, Summary
from mlbatch.writers.base import ScanJob

START_NS = 1_700_000_000_100_000_000
PERIOD_NS = 100_000_000
CHANNELS = 4


def pose(yaw_rad: float, x_m: float, y_m: float, z_m: float) -> F64Array:
    """Return a (4, 4) rotation about z with a translation."""
    cosine = math.cos(yaw_rad)
    sine = math.sin(yaw_rad)
    return np.array(
        [[cosine, -sine, 0, x_m], [sine, cosine, 0, y_m], [0, 0, 1, z_m], [0, 0, 0, 1]], float
    )


def run_info(layout: str = "dense", slices: int = 1) -> RunInfo:
    """Return a run of two sensors, the second rotated by 90 degrees and 2 m above the body."""
    sensors = (
        SensorInfo("left", "OS1-4", CHANNELS, 1, 0, np.eye(4)),
        SensorInfo("right", "OS1-4", CHANNELS, 1, CHANNELS, pose(math.pi / 2, 1.0, 0.0, 2.0)),
    )
    return RunInfo(sensors, "base_link", "10", "utc", slices, layout)


def dense_scan(index: int = 0, points: int = 1000, columns: int = 50, seed: int = 1) -> Scan:
    """Return a scan with xyz in a buffer of four floats a point, as decoders give them."""
    rng = np.random.default_rng(seed + index)
    column = np.sort(rng.integers(0, columns, points)).astype(np.uint32)
    start_ns = START_NS + index * PERIOD_NS
    column_lidar = (np.arange(columns) % 2).astype(np.uint8)
    per_sensor = (int((column_lidar == 0).sum()), int((column_lidar == 1).sum()))
    lidar_id = column_lidar[column]
    return Scan(
        info=run_info(),
        index=index,
        slice=0,
        start_ns=start_ns,
        end_ns=start_ns + PERIOD_NS,
        complete=index % 2 == 0,
        ready_host_ns=start_ns + PERIOD_NS + 7,
        xyz=rng.normal(0, 20, (points, 4)).astype(np.float32)[:, :3],
        intensity=rng.integers(0, 2000, points).astype(np.float32),
        reflectivity=rng.integers(0, 256, points).astype(np.uint16),
        range_m=rng.uniform(1, 100, points).astype(np.float32),
        time_ns=(column * (PERIOD_NS // columns)).astype(np.uint32),
        ring=(rng.integers(0, CHANNELS, points) + CHANNELS * lidar_id).astype(np.uint16),
        return_type=rng.integers(0, 3, points).astype(np.uint8),
        lidar_id=lidar_id,
        column=column,
        column_stamp_ns=start_ns + np.arange(columns, dtype=np.int64) * (PERIOD_NS // columns),
        column_lidar_id=column_lidar,
        points=points,
        columns_per_sensor=per_sensor,
        points_per_sensor=(int((lidar_id == 0).sum()), int((lidar_id == 1).sum())),
        max_gap_ns=(5, 6),
        fill=np.array([1.0, 0.75], np.float32),
    )


def point_scan() -> Scan:
    """Return one point of the second sensor with values that are exact in every type."""
    return replace(
        dense_scan(points=1, columns=1),
        xyz=np.array([[1.0, 2.0, 3.0, 9.0]], np.float32)[:, :3],
        intensity=np.array([7.0], np.float32),
        reflectivity=np.array([300], np.uint16),
        range_m=np.array([1.5], np.float32),
        time_ns=np.array([62_500_000], np.uint32),
        ring=np.array([258], np.uint16),
        return_type=np.array([2], np.uint8),
        lidar_id=np.array([1], np.uint8),
    )


def organized_scan(columns: int = 5) -> Scan:
    """Return an organized scan; the first slot of every column is empty."""
    rng = np.random.default_rng(3)
    shape = (columns, CHANNELS)
    xyz = rng.normal(0, 20, (*shape, 4)).astype(np.float32)[..., :3]
    intensity = rng.integers(0, 2000, shape).astype(np.float32)
    range_m = rng.uniform(1, 100, shape).astype(np.float32)
    for values in (xyz, intensity, range_m):
        values[:, 0] = np.nan
    lidar_id = np.repeat((np.arange(columns) % 2).astype(np.uint8)[:, None], CHANNELS, 1)
    ring = (np.arange(CHANNELS) + CHANNELS * lidar_id).astype(np.uint16)
    ring[:, 0] = 0
    return replace(
        dense_scan(columns=columns),
        info=run_info("organized"),
        xyz=xyz,
        intensity=intensity,
        reflectivity=None,
        range_m=range_m,
        time_ns=rng.integers(0, PERIOD_NS, shape).astype(np.uint32),
        ring=ring,
        return_type=np.ones(shape, np.uint8),
        lidar_id=lidar_id,
        column=None,
        points=columns * (CHANNELS - 1),
    )


def imu_samples(sensor: int = 0, first_ns: int = START_NS - 5, count: int = 2) -> ImuSamples:
    """Return samples with distinct values: 1, 2, 3 m/s2 and 4, 5, 6 rad/s, + 10 each."""
    step = 10.0 * np.arange(count)[:, None]
    return ImuSamples(
        sensor,
        first_ns + np.arange(count, dtype=np.int64) * 10_000_000,
        np.array([[1.0, 2.0, 3.0]]) + step,
        np.array([[4.0, 5.0, 6.0]]) + step,
    )


def run_job(job: ScanJob) -> None:
    """Run all stages of a job."""
    job.pack()
    job.append()
    job.compress()
    job.commit()


SUMMARY = Summary(
    START_NS,
    '{"schema": "mlbatch.report/1"}\n',
    "index,slice\n0,0\n",
    {"underfilled": "0", "fill": '{"left": 1.0, "right": 0.75}', "without": "{}"},
)
