"""PCD folders: header of the PCD documentation, fields of the layout `standard`; read by pypcd4."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from mlbatch.types import Scan
from mlbatch.writers import WriterOptions, open_writer
from tests.builders.scans import SUMMARY, dense_scan, organized_scan, point_scan, run_job

FIELDS = ("x", "y", "z", "intensity", "time", "ring", "return_type", "lidar_id")


def written(folder: Path, scan: Scan) -> Path:
    """Write one scan; the path of its file."""
    writer = open_writer("pcd", folder, scan.info, WriterOptions())
    run_job(writer.write(scan))
    writer.finish(SUMMARY)
    return folder / "000000.pcd"


def test_one_point_by_hand(tmp_path: Path) -> None:
    head, body = written(tmp_path / "out", point_scan()).read_bytes().split(b"DATA binary\n")
    # 0.0625 s is exact in binary.
    assert body == struct.pack("<fffffHBB", 1.0, 2.0, 3.0, 7.0, 0.0625, 258, 2, 1)
    assert head.decode().splitlines() == [
        "# .PCD v0.7 - Point Cloud Data file format",
        "# mlbatch 0.1.0",
        "# start_ns 1700000000100000000",
        "# end_ns 1700000000200000000",
        "# index 0 slice 0 of 1",
        "# complete true",
        "# fill 1.0 0.75",
        "# sort columns",
        "# timescale utc",
        "# rate_hz 10",
        "# frame_id base_link",
        "# units: x y z m; time s after start_ns; intensity as sent by the sensor",
        "# lidar_id from 0: left right",
        "VERSION 0.7",
        "FIELDS x y z intensity time ring return_type lidar_id",
        "SIZE 4 4 4 4 4 2 1 1",
        "TYPE F F F F F U U U",
        "COUNT 1 1 1 1 1 1 1 1",
        "WIDTH 1",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        "POINTS 1",
    ]


def test_pypcd4_reads_all_points(tmp_path: Path) -> None:
    pypcd4 = pytest.importorskip("pypcd4")
    # More points than a block of the packing, and not a multiple of it.
    scan = dense_scan(points=20_001)
    cloud = pypcd4.PointCloud.from_path(written(tmp_path / "out", scan))
    assert cloud.fields == FIELDS
    data = cloud.pc_data
    np.testing.assert_array_equal(np.stack([data[axis] for axis in "xyz"], 1), scan.xyz)
    for name in ("intensity", "ring", "return_type", "lidar_id"):
        np.testing.assert_array_equal(data[name], getattr(scan, name))
        assert data[name].dtype == getattr(scan, name).dtype
    late_s = scan.time_ns / 1e9 - data["time"]
    # A float32 of up to 0.125 s, rounded toward zero.
    assert 0 <= late_s.min() <= late_s.max() < 2**-27


def test_an_organized_scan_has_a_row_for_each_slot(tmp_path: Path) -> None:
    pypcd4 = pytest.importorskip("pypcd4")
    scan = organized_scan(columns=5)
    cloud = pypcd4.PointCloud.from_path(written(tmp_path / "out", scan))
    assert (cloud.metadata.width, cloud.metadata.height) == (5, 4)
    x = cloud.pc_data["x"].reshape(4, 5)
    np.testing.assert_array_equal(x.T, scan.xyz[..., 0])
    assert np.isnan(x[0]).all()


def test_a_scan_without_points_is_a_valid_file(tmp_path: Path) -> None:
    path = written(tmp_path / "out", dense_scan(points=0))
    assert path.read_bytes().endswith(b"\nPOINTS 0\nDATA binary\n")
