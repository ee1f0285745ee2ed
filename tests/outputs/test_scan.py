"""Scans of users: parts, frames, tables; by hand."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from mlbatch.errors import UsageError
from mlbatch.outputs.scan import Scan
from mlbatch.writers.point_layouts import CLOUD_LAYOUTS
from tests.builders.scans import dense_scan, organized_scan, point_scan


def test_a_point_in_the_frame_of_its_sensor() -> None:
    """The right sensor is at (1, 0, 2), rotated by 90 degrees about z: its x axis is the body's y.

    (1, 2, 3) is (0, 2, 1) from its origin, which is 2 along its x and 1 up.
    """
    scan = Scan.copied(point_scan())
    np.testing.assert_allclose(scan.xyz_sensor, [[2.0, 0.0, 1.0]], atol=1e-6)
    assert scan.xyz_sensor.dtype == np.float32


def test_times_of_points() -> None:
    scan = Scan.copied(point_scan())
    assert scan.time_s.tolist() == [0.0625]
    assert scan.stamp_ns.tolist() == [scan.start_ns + 62_500_000]


def test_the_parts_of_sensors_are_the_whole() -> None:
    scan = Scan.copied(dense_scan())
    left, right = scan["left"], scan["right"]
    assert left.point_count + right.point_count == scan.point_count
    assert set(left.lidar_id.tolist()) == {0}
    assert set(right.lidar_id.tolist()) == {1}
    np.testing.assert_array_equal(right.xyz, scan.xyz[scan.lidar_id == 1])
    # Columns are counted anew, and are the same columns.
    assert left.column is not None
    assert scan.column is not None
    before = scan.column_stamp_ns[scan.column][scan.lidar_id == 0]
    np.testing.assert_array_equal(left.column_stamp_ns[left.column], before)
    assert left.columns_per_sensor == (25, 0)
    assert right.columns_per_sensor == (0, 25)


def test_a_sensor_of_an_organized_scan_keeps_its_slots() -> None:
    scan = Scan.copied(organized_scan())
    right = scan["right"]
    mine = scan.column_lidar_id == 1
    assert right.xyz.shape == (int(mine.sum()), *scan.xyz.shape[1:])
    np.testing.assert_array_equal(right.xyz, scan.xyz[mine])
    assert right.points("standard").shape == right.time_ns.shape


def test_an_unknown_sensor() -> None:
    with pytest.raises(UsageError, match="expected one of left, right, found 'front'; choose one"):
        Scan.copied(dense_scan())["front"]


@pytest.mark.parametrize("layout", CLOUD_LAYOUTS)
def test_records_of_every_layout(layout: str) -> None:
    scan = Scan.copied(point_scan())
    records = scan.points(layout)
    assert records.dtype == CLOUD_LAYOUTS[layout].dtype
    assert [records[axis].tolist() for axis in "xyz"] == [[1.0], [2.0], [3.0]]


def test_records_of_an_organized_scan_have_its_shape() -> None:
    scan = Scan.copied(organized_scan())
    records = scan.points()
    assert records.shape == scan.time_ns.shape
    np.testing.assert_array_equal(records["x"], scan.xyz[..., 0])


def test_an_unknown_layout() -> None:
    with pytest.raises(UsageError, match=r"expected one of standard, .*, found 'pcl'; choose one"):
        Scan.copied(dense_scan()).points("pcl")


def test_what_is_not_stored_is_refused_not_zero() -> None:
    scan = replace(
        Scan.copied(dense_scan()), time_ns=np.zeros(0, np.uint32), absent=frozenset({"time_ns"})
    )
    for read in (lambda: scan.time_s, lambda: scan.stamp_ns, lambda: scan.points("standard")):
        with pytest.raises(UsageError, match="expected time_ns in the output, which does not"):
            read()
    assert scan.points("minimal").shape == (1000,)


def test_an_unknown_pose_is_refused() -> None:
    scan = Scan.copied(point_scan())
    unknown = replace(scan.info.sensors[1], body_from_sensor=np.full((4, 4), math.nan))
    info = scan.info._replace(sensors=(scan.info.sensors[0], unknown))
    with pytest.raises(UsageError, match="expected the extrinsics of right, found no report"):
        _ = replace(scan, info=info).xyz_sensor


def test_a_copy_is_independent() -> None:
    source = dense_scan()
    scan = Scan.copied(source)
    source.xyz[:] = 0
    source.ring[:] = 0
    assert scan.xyz.any()
    assert scan.ring.any()
    assert scan.xyz.flags.c_contiguous


# -- optional packages ----------------------------------------------------------------------------


@pytest.mark.parametrize(("method", "package"), [("to_pandas", "pandas"), ("to_open3d", "open3d")])
def test_a_missing_package_is_named(
    method: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    expected = rf"{method}: expected the package {package}, found none .*; pip install {package}"
    with pytest.raises(UsageError, match=expected):
        getattr(Scan.copied(dense_scan()), method)()


def test_a_table_of_pandas() -> None:
    pytest.importorskip("pandas")
    scan = Scan.copied(point_scan())
    table = scan.to_pandas()
    assert list(table.columns) == [
        *("x", "y", "z", "intensity", "reflectivity", "range_m", "time_ns", "ring"),
        *("return_type", "lidar_id", "stamp_ns"),
    ]
    row = table.iloc[0]
    assert (row.x, row.y, row.z, row.ring, row.lidar_id) == (1.0, 2.0, 3.0, 258, 1)
    assert table.stamp_ns[0] == scan.start_ns + 62_500_000
    assert str(table.stamp_ns.dtype) == "int64"


def test_a_table_leaves_out_empty_slots() -> None:
    pytest.importorskip("pandas")
    scan = Scan.copied(organized_scan())
    assert len(scan.to_pandas()) == scan.point_count < scan.time_ns.size


def test_a_cloud_of_open3d(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a stand-in with the two constructors of open3d 0.17 to 0.19 that are used."""

    class Cloud:
        def __init__(self, positions: object) -> None:
            self.point = {"positions": positions}

    fake = ModuleType("open3d")
    geometry = SimpleNamespace(geometry=SimpleNamespace(PointCloud=Cloud))
    fake.__dict__.update(core=SimpleNamespace(Tensor=np.asarray), t=geometry)
    monkeypatch.setitem(sys.modules, "open3d", fake)
    scan = Scan.copied(organized_scan())
    cloud = scan.to_open3d()
    valid = scan.is_valid
    np.testing.assert_array_equal(cloud.point["positions"], scan.xyz[valid])
    np.testing.assert_array_equal(cloud.point["intensity"][:, 0], scan.intensity[valid])
    np.testing.assert_array_equal(cloud.point["time"][:, 0], scan.time_s[valid])
