"""Files of one scan in every format: one point by hand, and all points by other programs.

Layouts: the PCD documentation, the LAS specification 1.4, docs/sources/outputs.md section 5 (PLY).
"""

from __future__ import annotations

import io
import json
import math
import struct
import tarfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mlbatch.errors import ExportError
from mlbatch.types import Scan
from mlbatch.writers import open_writer
from mlbatch.writers.base import WriterOptions
from tests.builders.scans import (
    START_NS,
    SUMMARY,
    dense_scan,
    imu_samples,
    organized_scan,
    point_scan,
    run_info,
    run_job,
)

laspy = pytest.importorskip("laspy")
pytest.importorskip("lazrs")
pypcd4 = pytest.importorskip("pypcd4")
trimesh = pytest.importorskip("trimesh")

# Of the fields that a program reads: name of the array of the scan, values.
Fields = dict[str, Any]
LABELS = ("ring", "return_type", "lidar_id")


def written(folder: Path, name: str, *scans: Scan) -> Path:
    """Write scans in a format, or a style of PLY; the folder."""
    options = WriterOptions(ply_style=name) if name in ("cloudcompare", "float") else None
    format_ = "ply" if options else name
    writer = open_writer(format_, folder, scans[0].info, options or WriterOptions())
    for scan in scans:
        run_job(writer.write(scan))
    writer.write_imu(imu_samples())
    writer.finish(SUMMARY)
    return folder


# -- one point ------------------------------------------------------------------------------------

ABOUT = (
    "mlbatch 0.1.0",
    "start_ns 1700000000100000000",
    "end_ns 1700000000200000000",
    "index 0 slice 0 of 1",
    "complete true",
    "fill 1.0 0.75",
    "sort columns",
    "timescale utc",
    "rate_hz 10",
    "frame_id base_link",
    "units: x y z m; time s after start_ns; intensity as sent by the sensor",
    "lidar_id from 0: left right",
)
PCD = (
    "# .PCD v0.7 - Point Cloud Data file format",
    *(f"# {line}" for line in ABOUT),
    "VERSION 0.7",
    "FIELDS x y z intensity time ring return_type lidar_id",
    "SIZE 4 4 4 4 4 2 1 1",
    "TYPE F F F F F U U U",
    "COUNT 1 1 1 1 1 1 1 1",
    "WIDTH 1",
    "HEIGHT 1",
    "VIEWPOINT 0 0 0 1 0 0 0",
    "POINTS 1",
    "DATA binary",
)


def _ply(*properties: str) -> tuple[str, ...]:
    return (
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in ABOUT),
        "element vertex 1",
        *(f"property {line}" for line in properties),
        "end_header",
    )


XYZ = ("float x", "float y", "float z")
# 0.0625 s = 62 500 000 ns, exact in binary.
PLY_ROW = struct.pack("<ffffdiBB", 1.0, 2.0, 3.0, 7.0, 0.0625, 258, 2, 1)
TIMES = b"1700000000.100000000\n"
# Of each format: files, their lines of text and the row after them.
BY_HAND: Mapping[str, Mapping[str, tuple[tuple[str, ...], bytes]]] = {
    "kitti": {
        "000000.bin": ((), struct.pack("<ffff", 1.0, 2.0, 3.0, 7.0)),
        "times.txt": ((), TIMES),
    },
    "nuscenes": {
        "000000.pcd.bin": ((), struct.pack("<fffff", 1.0, 2.0, 3.0, 7.0, 258.0)),
        "000000.time.bin": ((), struct.pack("<ff", 0.0625, 1.0)),
        "times.txt": ((), TIMES),
    },
    "pcd": {
        "000000.pcd": (PCD, struct.pack("<fffffHBB", 1.0, 2.0, 3.0, 7.0, 0.0625, 258, 2, 1)),
    },
    "ply": {
        "000000.ply": (
            _ply(
                *(*XYZ, "float intensity", "double time"),
                *("int ring", "uchar return_type", "uchar lidar_id"),
            ),
            PLY_ROW,
        )
    },
    # The same bytes, under names that CloudCompare keeps.
    "cloudcompare": {
        "000000.ply": (
            _ply(
                *(*XYZ, "float scalar_intensity", "double scalar_time"),
                *("int scalar_ring", "uchar scalar_return_type", "uchar scalar_lidar_id"),
            ),
            PLY_ROW,
        )
    },
    # Four floats: small_gicp 1.0.1 reads 16 bytes a vertex, whatever the header says.
    "float": {
        "000000.ply": (_ply(*XYZ, "float time"), struct.pack("<4f", 1.0, 2.0, 3.0, 0.0625)),
    },
}


@pytest.mark.parametrize("name", BY_HAND)
def test_one_point_by_hand(name: str, tmp_path: Path) -> None:
    folder = written(tmp_path / "out", name, point_scan())
    assert {path.name for path in folder.iterdir()} == {*BY_HAND[name], "scans.csv"}
    for file, (lines, row) in BY_HAND[name].items():
        head = "".join(f"{line}\n" for line in lines).encode()
        assert (folder / file).read_bytes() == head + row


@pytest.mark.parametrize("name", ["las", "laz"])
def test_one_point_of_las_by_hand(name: str, tmp_path: Path) -> None:
    las = laspy.read(written(tmp_path / "out", name, point_scan()) / f"000000.{name}")
    header = las.header
    assert (str(header.version), header.point_format.id, header.point_count) == ("1.4", 6, 1)
    assert header.are_points_compressed == (name == "laz")
    assert header.global_encoding.wkt
    assert header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    # 1 700 000 000 s is 2023-11-14 22:13:20 UTC.
    assert header.creation_date == date(2023, 11, 14)
    (vlr,) = [one for one in header.vlrs if one.user_id == "mlbatch"]
    text = bytes(vlr.record_data).decode().splitlines()
    assert (text[:4], text[-1]) == (list(ABOUT[:4]), ABOUT[-1])
    assert (las.X[0], las.Y[0], las.Z[0]) == (10_000, 20_000, 30_000)
    assert (las.x[0], las.y[0], las.z[0]) == pytest.approx((1.0, 2.0, 3.0), abs=1e-12)
    # Second sensor; last return in single return mode.
    assert (las.point_source_id[0], las.return_number[0], las.number_of_returns[0]) == (2, 1, 1)
    assert (las.intensity[0], las.intensity_f32[0], las.reflectivity[0]) == (7, 7.0, 300)
    assert (las.time_ns[0], las.ring[0], las.return_type[0]) == (62_500_000, 258, 2)
    # GPS time is UTC + 18 s since 2017, counts from 315 964 800 s, and is adjusted by 10^9 s.
    assert las.gps_time[0] == 1_700_000_018 - 1_315_964_800 + 0.1625


# -- all points -----------------------------------------------------------------------------------


def _npz(folder: Path, number: int) -> Fields:
    with np.load(folder / f"{number:06}.npz", allow_pickle=False) as loaded:
        return {key: loaded[key] for key in loaded.files}


def _pypcd4(folder: Path, number: int) -> Fields:
    cloud = pypcd4.PointCloud.from_path(folder / f"{number:06}.pcd")
    assert cloud.fields == ("x", "y", "z", "intensity", "time", *LABELS)
    xyz = np.stack([cloud.pc_data[axis] for axis in "xyz"], 1)
    return {"xyz": xyz, **{field: cloud.pc_data[field] for field in cloud.fields[3:]}}


def _trimesh(folder: Path, number: int) -> Fields:
    path = folder / f"{number:06}.ply"
    if b"element vertex 0\n" in path.read_bytes():
        # It takes such a file for a scene without a cloud.
        return {"xyz": np.zeros((0, 3))}
    cloud = trimesh.load(path)
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    fields = {field.removeprefix("scalar_"): np.ravel(raw[field]) for field in raw.dtype.names}
    for axis in "xyz":
        fields.pop(axis)
    return {**fields, "xyz": np.asarray(cloud.vertices, np.float32)}


def _laspy(suffix: str) -> Callable[[Path, int], Fields]:
    def read(folder: Path, number: int) -> Fields:
        las = laspy.read(folder / f"{number:06}.{suffix}")
        fields = {field: las[field] for field in ("time_ns", "ring", "return_type", "reflectivity")}
        assert len(las.points) == las.header.point_count
        if len(las.points):
            np.testing.assert_allclose(las.header.mins, las.xyz.min(axis=0), atol=1e-4)
            np.testing.assert_allclose(las.header.maxs, las.xyz.max(axis=0), atol=1e-4)
        lidar_id = np.asarray(las.point_source_id) - 1
        return {**fields, "xyz": las.xyz, "intensity": las.intensity_f32, "lidar_id": lidar_id}

    return read


READ: Mapping[str, Callable[[Path, int], Fields]] = {
    "pcd": _pypcd4,
    "ply": _trimesh,
    "cloudcompare": _trimesh,
    "float": _trimesh,
    "las": _laspy("las"),
    "laz": _laspy("laz"),
}
# Besides x, y, z: all that have their types have all values.
FIELDS = {
    "float": {"time"},
    **{name: {"intensity", "time", *LABELS} for name in ("pcd", "ply", "cloudcompare")},
    **{name: {"intensity", "time_ns", "reflectivity", *LABELS} for name in ("las", "laz")},
}


@pytest.mark.parametrize("name", READ)
def test_other_programs_read_all_points(name: str, tmp_path: Path) -> None:
    """More points than a block of the packing, fewer in a used buffer, and none."""
    scans = [dense_scan(0, 20_001), dense_scan(1, 3), dense_scan(2, 0)]
    folder = written(tmp_path / "out", name, *scans)
    for scan in scans:
        fields = READ[name](folder, scan.index)
        assert len(fields["xyz"]) == scan.points
        if not scan.points:
            continue
        # The unit of LAS is 0.1 mm.
        tolerance = 0.5001e-4 if name in ("las", "laz") else 0.0
        np.testing.assert_allclose(fields.pop("xyz"), scan.xyz, rtol=0, atol=tolerance)
        assert set(fields) == FIELDS[name]
        for field in ("intensity", "time_ns", "reflectivity", *LABELS):
            if field in fields:
                np.testing.assert_array_equal(fields[field], getattr(scan, field))
        if "time" in fields:
            late_s = scan.time_ns / 1e9 - fields["time"]
            # A float32 of up to 0.125 s, rounded toward zero.
            assert 0 <= late_s.min() <= late_s.max() < 2**-27


def test_organized_scans_have_a_row_for_each_slot(tmp_path: Path) -> None:
    scan = organized_scan(columns=5)
    cloud = pypcd4.PointCloud.from_path(written(tmp_path / "pcd", "pcd", scan) / "000000.pcd")
    assert (cloud.metadata.width, cloud.metadata.height) == (5, 4)
    x = cloud.pc_data["x"].reshape(4, 5)
    np.testing.assert_array_equal(x.T, scan.xyz[..., 0])
    assert np.isnan(x[0]).all()
    loaded = _npz(written(tmp_path / "npz", "npz", scan), 0)
    assert set(loaded) == {*TYPES, *WORDS} - {"column", "reflectivity"}
    assert np.isnan(loaded["xyz"][:, 0]).all()
    np.testing.assert_array_equal(loaded["xyz"], scan.xyz)
    np.testing.assert_array_equal(loaded["ring"], scan.ring)


# -- npz ------------------------------------------------------------------------------------------

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
WORDS = {
    "frame_id": "base_link",
    "rate_hz": "10",
    "timescale": "utc",
    "sort": "columns",
    "schema": "mlbatch.scan/1",
    "sensors": "['left' 'right']",
}


def test_every_key_of_npz_comes_back_as_it_was(tmp_path: Path) -> None:
    scan = dense_scan()
    folder = written(tmp_path / "out", "npz", scan)
    assert sorted(path.name for path in folder.iterdir()) == ["000000.npz", "scans.csv"]
    loaded = _npz(folder, 0)
    assert {key: loaded[key].dtype.str for key in TYPES} == TYPES
    for key in [key for key in TYPES if key != "slices"]:
        np.testing.assert_array_equal(loaded[key], getattr(scan, key))
    assert loaded["xyz"].flags.c_contiguous
    assert loaded["slices"] == 1
    assert {key: str(loaded[key]) for key in set(loaded) - {*TYPES}} == WORDS


# -- webdataset -----------------------------------------------------------------------------------


def test_the_tar_is_that_of_tarfile_with_npz_and_json(tmp_path: Path) -> None:
    """Keys have no dot: WebDataset ends a key there. The fill of a lidar may not be known."""
    scan = replace(point_scan(), index=499, fill=np.array([math.nan, 0.75], np.float32))
    later = replace(dense_scan(), index=500, slice=1, info=run_info(slices=2))
    head = replace(scan, index=-1)
    folder = written(tmp_path / "out", "webdataset", head, scan, later)
    assert sorted(one.name for one in folder.iterdir()) == ["000000.tar", "000500.tar", "scans.csv"]
    found = {}
    for path in sorted(folder.glob("*.tar")):
        again = io.BytesIO()
        with (
            tarfile.open(path) as read,
            tarfile.open(fileobj=again, mode="w", format=tarfile.USTAR_FORMAT) as expected,
        ):
            for member in read.getmembers():
                content = read.extractfile(member)
                assert content is not None
                found[member.name] = content.read()
                plain = tarfile.TarInfo(member.name)
                plain.size = member.size
                expected.addfile(plain, io.BytesIO(found[member.name]))
        assert path.read_bytes() == again.getvalue()
    keys = ("head", "000499", "000500-1")
    assert list(found) == [f"{key}.{suffix}" for key in keys for suffix in ("npz", "json")]
    alone = written(tmp_path / "npz", "npz", scan) / "000499.npz"
    assert found["000499.npz"] == alone.read_bytes()
    assert json.loads(found["000499.json"]) == {
        "index": 499,
        "slice": 0,
        "start_ns": 1_700_000_000_100_000_000,
        "end_ns": 1_700_000_000_200_000_000,
        "points": 1,
        "columns": 1,
        "columns_left": 1,
        "columns_right": 0,
        "complete": True,
        "fill_left": None,
        "fill_right": 0.75,
        "frame_id": "base_link",
        "rate_hz": "10",
        "timescale": "utc",
    }


# -- PLY, LAS, KITTI ------------------------------------------------------------------------------


def test_a_frame_of_any_name_stays_in_its_line(tmp_path: Path) -> None:
    scan = point_scan()
    scan = replace(scan, info=scan.info._replace(frame_id="map\nend_header\n\x1b"))
    data = (written(tmp_path / "out", "ply", scan) / "000000.ply").read_bytes()
    head, body = data.split(b"end_header\n")
    assert rb"comment frame_id map\nend_header\n\x1b" in head.splitlines()
    assert body == PLY_ROW


def test_returns_of_las_are_numbered_by_distance(tmp_path: Path) -> None:
    """Of two returns the nearer one is the first: types 3 and 5 are the nearer, 4 and 6 not."""
    scan = replace(dense_scan(points=8), return_type=np.arange(8, dtype=np.uint8))
    las = laspy.read(written(tmp_path / "out", "las", scan) / "000000.las")
    assert np.asarray(las.return_number).tolist() == [1, 1, 1, 1, 2, 1, 2, 1]
    assert np.asarray(las.number_of_returns).tolist() == [1, 1, 1, 2, 2, 2, 2, 1]
    # Counts of the header: 6 first returns, 2 second ones.
    assert las.header.number_of_points_by_return.tolist()[:3] == [6, 2, 0]


def test_intensities_of_16_bits_and_their_exact_values(tmp_path: Path) -> None:
    values = np.array([0.4, 1.6, 70_000.0, -1.0], np.float32)
    scan = replace(dense_scan(points=4), intensity=values, reflectivity=None)
    las = laspy.read(written(tmp_path / "out", "las", scan) / "000000.las")
    assert np.asarray(las.intensity).tolist() == [0, 2, 65535, 0]
    np.testing.assert_array_equal(las.intensity_f32, values)
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
    las = laspy.read(written(tmp_path / "out", "las", scan) / "000000.las")
    np.testing.assert_allclose(las.gps_time, expected, rtol=0, atol=3e-7)
    standard = las.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    assert standard == (shift_s != 0)


def test_coordinates_beyond_32_bits_are_one_line(tmp_path: Path) -> None:
    scan = point_scan()
    scan.xyz[0, 1] = -300_000.0
    with pytest.raises(ExportError) as caught:
        written(tmp_path / "out", "las", scan)
    assert str(caught.value) == (
        "scan 0: expected coordinates up to 214748 m for las and laz, found 300000 m; write "
        "another format, or --max-range"
    )


@pytest.mark.parametrize("split", [False, True])
def test_line_i_of_the_times_is_file_i(split: bool, tmp_path: Path) -> None:
    """In the order of names: the head, which is written first, is last."""
    info = run_info(slices=2)
    folder = tmp_path / "out"
    writer = open_writer("kitti", folder, info, WriterOptions(split=split))
    for index, part in ((-1, 1), (0, 0), (0, 1), (2, 0)):
        scan = dense_scan(max(index, 0), 5)
        start_ns = 1_700_000_000_000_000_007 + (2 * index + part) * 50_000_000
        scan = replace(scan, info=info, index=index, slice=part, start_ns=start_ns)
        run_job(writer.write(scan, 1 if split else None))
    writer.finish(SUMMARY)
    folder = folder / "right" if split else folder
    names = sorted(path.name for path in folder.glob("*.bin"))
    assert names == ["000000-0.bin", "000000-1.bin", "000002-0.bin", "head-1.bin"]
    assert (folder / "times.txt").read_text().splitlines() == [
        "1700000000.000000007",
        "1700000000.050000007",
        "1700000000.200000007",
        "1699999999.950000007",
    ]
