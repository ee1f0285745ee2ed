"""nuScenes folders: rows of five float32; times and lidars in a second file."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from mlbatch.writers import WriterOptions, open_writer
from tests.builders.scans import SUMMARY, dense_scan, point_scan, run_job


def test_one_row_by_hand(tmp_path: Path) -> None:
    scan = point_scan()
    writer = open_writer("nuscenes", tmp_path / "out", scan.info, WriterOptions())
    run_job(writer.write(scan))
    writer.finish(SUMMARY)
    row = (tmp_path / "out" / "000000.pcd.bin").read_bytes()
    assert row == struct.pack("<fffff", 1.0, 2.0, 3.0, 7.0, 258.0)
    times = (tmp_path / "out" / "000000.time.bin").read_bytes()
    assert times == struct.pack("<ff", 0.0625, 1.0)
    assert (tmp_path / "out" / "times.txt").read_text() == "1700000000.100000000\n"


def test_both_files_make_seven_columns(tmp_path: Path) -> None:
    scan = dense_scan(points=20_001)
    writer = open_writer("nuscenes", tmp_path / "out", scan.info, WriterOptions())
    run_job(writer.write(scan))
    writer.finish(SUMMARY)
    # As nuscenes-devkit reads a sweep: LidarPointCloud.from_file.
    points = np.fromfile(tmp_path / "out" / "000000.pcd.bin", np.float32).reshape((-1, 5))
    times = np.fromfile(tmp_path / "out" / "000000.time.bin", np.float32).reshape((-1, 2))
    rows = np.hstack([points, times])
    np.testing.assert_array_equal(rows[:, :3], scan.xyz)
    for column, values in ((3, scan.intensity), (4, scan.ring), (6, scan.lidar_id)):
        np.testing.assert_array_equal(rows[:, column], values)
    late_s = scan.time_ns / 1e9 - rows[:, 5]
    # A float32 of up to 0.125 s, rounded toward zero.
    assert 0 <= late_s.min() <= late_s.max() < 2**-27
