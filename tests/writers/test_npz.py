"""npz files: keys, types, values, and the zip around them."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from mlbatch.types import Scan
from mlbatch.writers import WriterOptions, open_writer
from tests.builders.scans import (
    SUMMARY,
    dense_scan,
    imu_samples,
    organized_scan,
    run_job,
)

TYPES = {
    "xyz": "<f4",
    "intensity": "<f4",
    "reflectivity": "<u2",
    "range_m": "<f4",
    "time_ns": "<u4",
    "ring": "<u2",
    "return_type": "|u1",
    "lidar_id": "|u1",
    "column": "<u4",
    "column_stamp_ns": "<i8",
    "column_lidar_id": "|u1",
    "start_ns": "<i8",
    "end_ns": "<i8",
    "index": "<i8",
    "slice": "<i8",
    "slices": "<i8",
    "complete": "|b1",
    "fill": "<f4",
}
WORDS = ("sensors", "frame_id", "rate_hz", "timescale", "sort", "schema")


def written(folder: Path, *scans: Scan) -> Path:
    """Write scans into a folder."""
    writer = open_writer("npz", folder, scans[0].info, WriterOptions())
    for scan in scans:
        run_job(writer.write(scan))
    writer.write_imu(imu_samples())
    writer.finish(SUMMARY)
    return folder


def test_every_key_comes_back_as_it_was(tmp_path: Path) -> None:
    scan = dense_scan()
    folder = written(tmp_path / "out", scan)
    assert sorted(path.name for path in folder.iterdir()) == ["000000.npz", "scans.csv"]
    with np.load(folder / "000000.npz", allow_pickle=False) as loaded:
        assert set(loaded.files) == {*TYPES, *WORDS}
        for key, dtype in TYPES.items():
            assert loaded[key].dtype.str == dtype, key
        for key in [key for key in TYPES if key != "slices"]:
            np.testing.assert_array_equal(loaded[key], getattr(scan, key))
        assert loaded["xyz"].flags.c_contiguous
        assert loaded["sensors"].tolist() == ["left", "right"]
        words = [str(loaded[key][()]) for key in WORDS[1:]]
        assert words == ["base_link", "10", "utc", "columns", "mlbatch.scan/1"]
        assert loaded["slices"] == 1


def test_organized_scans_have_nan_and_no_column_key(tmp_path: Path) -> None:
    scan = organized_scan()
    folder = written(tmp_path / "out", scan)
    with np.load(folder / "000000.npz", allow_pickle=False) as loaded:
        assert set(loaded.files) == {*TYPES, *WORDS} - {"column", "reflectivity"}
        assert loaded["xyz"].shape == (5, 4, 3)
        assert np.isnan(loaded["xyz"][:, 0]).all()
        np.testing.assert_array_equal(loaded["xyz"], scan.xyz)
        np.testing.assert_array_equal(loaded["ring"], scan.ring)


def test_a_scan_without_points_is_written(tmp_path: Path) -> None:
    folder = written(tmp_path / "out", dense_scan(points=0))
    with np.load(folder / "000000.npz", allow_pickle=False) as loaded:
        assert loaded["xyz"].shape == (0, 3)
        assert loaded["column_stamp_ns"].shape == (50,)


def test_the_buffer_of_a_large_scan_leaves_nothing_in_a_small_one(tmp_path: Path) -> None:
    small = dense_scan(index=1, points=3)
    folder = written(tmp_path / "out", dense_scan(), small)
    with np.load(folder / "000001.npz", allow_pickle=False) as loaded:
        np.testing.assert_array_equal(loaded["xyz"], small.xyz)


def test_the_zip_is_that_of_zipfile(tmp_path: Path) -> None:
    path = written(tmp_path / "out", dense_scan()) / "000000.npz"
    again = io.BytesIO()
    with zipfile.ZipFile(path) as found, zipfile.ZipFile(again, "w") as expected:
        assert found.testzip() is None
        for name in found.namelist():
            expected.writestr(zipfile.ZipInfo(name), found.read(name))
    assert path.read_bytes() == again.getvalue()
