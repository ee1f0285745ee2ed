"""LAS and LAZ folders (formats las and laz), read by laspy; values by the LAS specification 1.4."""

from __future__ import annotations

from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mlbatch.errors import ExportError
from mlbatch.types import Scan
from mlbatch.writers import WriterOptions, open_writer
from tests.builders.scans import START_NS, SUMMARY, dense_scan, point_scan, run_job

laspy = pytest.importorskip("laspy")
pytest.importorskip("lazrs")
both = pytest.mark.parametrize("name", ["las", "laz"])


def written(folder: Path, scan: Scan, name: str = "las") -> Any:
    """Write one scan; its file as laspy reads it."""
    writer = open_writer(name, folder, scan.info, WriterOptions())
    run_job(writer.write(scan))
    writer.finish(SUMMARY)
    return laspy.read(folder / f"000000.{name}")


@both
def test_one_point_by_hand(name: str, tmp_path: Path) -> None:
    las = written(tmp_path / "out", point_scan(), name)
    header = las.header
    assert (str(header.version), header.point_format.id, header.point_count) == ("1.4", 6, 1)
    assert header.are_points_compressed == (name == "laz")
    assert header.global_encoding.wkt
    assert header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    # 1 700 000 000 s is 2023-11-14 22:13:20 UTC.
    assert header.creation_date == date(2023, 11, 14)
    (vlr,) = [one for one in header.vlrs if one.user_id == "mlbatch"]
    text = bytes(vlr.record_data).decode().splitlines()
    assert text[:4] == [
        "mlbatch 0.1.0",
        "start_ns 1700000000100000000",
        "end_ns 1700000000200000000",
        "index 0 slice 0 of 1",
    ]
    assert text[-1] == "lidar_id from 0: left right"
    assert (las.X[0], las.Y[0], las.Z[0]) == (10_000, 20_000, 30_000)
    assert (las.x[0], las.y[0], las.z[0]) == pytest.approx((1.0, 2.0, 3.0), abs=1e-12)
    # Second sensor; last return in single return mode.
    assert (las.point_source_id[0], las.return_number[0], las.number_of_returns[0]) == (2, 1, 1)
    assert (las.intensity[0], las.intensity_f32[0], las.reflectivity[0]) == (7, 7.0, 300)
    assert (las.time_ns[0], las.ring[0], las.return_type[0]) == (62_500_000, 258, 2)
    # GPS time is UTC + 18 s since 2017, counts from 315 964 800 s, and is adjusted by 10^9 s.
    assert las.gps_time[0] == 1_700_000_018 - 1_315_964_800 + 0.1625


@both
def test_laspy_reads_all_points(name: str, tmp_path: Path) -> None:
    scan = dense_scan(points=20_001)
    las = written(tmp_path / "out", scan, name)
    assert np.abs(las.xyz - scan.xyz).max() <= 0.5001e-4
    for field in ("time_ns", "ring", "return_type", "reflectivity"):
        np.testing.assert_array_equal(las[field], getattr(scan, field))
    np.testing.assert_array_equal(las.intensity_f32, scan.intensity)
    np.testing.assert_array_equal(las.point_source_id, scan.lidar_id + 1)
    header = las.header
    np.testing.assert_allclose(header.mins, scan.xyz.min(axis=0), atol=1e-4)
    np.testing.assert_allclose(header.maxs, scan.xyz.max(axis=0), atol=1e-4)


def test_returns_are_numbered_by_distance(tmp_path: Path) -> None:
    """Of two returns the nearer one is the first: types 3 and 5 are the nearer, 4 and 6 not."""
    scan = replace(dense_scan(points=8), return_type=np.arange(8, dtype=np.uint8))
    las = written(tmp_path / "out", scan)
    assert np.asarray(las.return_number).tolist() == [1, 1, 1, 1, 2, 1, 2, 1]
    assert np.asarray(las.number_of_returns).tolist() == [1, 1, 1, 2, 2, 2, 2, 1]
    # Counts of the header: 6 first returns, 2 second ones.
    assert las.header.number_of_points_by_return.tolist()[:3] == [6, 2, 0]


def test_intensities_of_16_bits_and_their_exact_values(tmp_path: Path) -> None:
    values = np.array([0.4, 1.6, 70_000.0, -1.0], np.float32)
    las = written(tmp_path / "out", replace(dense_scan(points=4), intensity=values))
    assert np.asarray(las.intensity).tolist() == [0, 2, 65535, 0]
    np.testing.assert_array_equal(las.intensity_f32, values)


def test_no_reflectivity_without_a_sensor_that_has_it(tmp_path: Path) -> None:
    las = written(tmp_path / "out", replace(dense_scan(), reflectivity=None))
    names = ["time_ns", "ring", "return_type", "intensity_f32"]
    assert list(las.point_format.extra_dimension_names) == names


@pytest.mark.parametrize(
    ("timescale", "shift_s"),
    [("utc", 18 - 315_964_800 - 10**9), ("tai", -19 - 315_964_800 - 10**9), ("uptime", 0)],
)
def test_gps_time_of_other_clocks(timescale: str, shift_s: int, tmp_path: Path) -> None:
    scan = dense_scan()
    scan = replace(scan, info=scan.info._replace(timescale=timescale))
    expected = [(START_NS + shift_s * 10**9 + int(time)) / 10**9 for time in scan.time_ns]
    las = written(tmp_path / "out", scan)
    np.testing.assert_allclose(las.gps_time, expected, rtol=0, atol=3e-7)
    standard = las.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    assert standard == (shift_s != 0)


def test_coordinates_beyond_32_bits_are_one_line(tmp_path: Path) -> None:
    scan = point_scan()
    scan.xyz[0, 1] = -300_000.0
    writer = open_writer("las", tmp_path / "out", scan.info, WriterOptions())
    with pytest.raises(ExportError) as caught:
        run_job(writer.write(scan))
    assert str(caught.value) == (
        "scan 0: expected coordinates up to 214748 m for las and laz, found 300000 m; write "
        "another format, or --max-range"
    )


@both
def test_a_scan_without_points_is_a_valid_file(name: str, tmp_path: Path) -> None:
    las = written(tmp_path / "out", dense_scan(points=0), name)
    assert len(las.points) == las.header.point_count == 0
