"""PLY folders: properties of docs/sources/outputs.md, section 5."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.types import Scan
from mlbatch.writers import WriterOptions, open_writer
from tests.builders.scans import (
    SUMMARY,
    dense_scan,
    point_scan,
    run_job,
)


def written(folder: Path, scan: Scan, style: str = "standard") -> bytes:
    """Write one scan; its file."""
    writer = open_writer("ply", folder, scan.info, WriterOptions(ply_style=style))
    run_job(writer.write(scan))
    writer.finish(SUMMARY)
    return (folder / "000000.ply").read_bytes()


def test_one_vertex_by_hand(tmp_path: Path) -> None:
    head, body = written(tmp_path / "out", point_scan()).split(b"end_header\n")
    # 0.0625 s = 62 500 000 ns, exact in binary.
    assert body == struct.pack("<ffffdiBB", 1.0, 2.0, 3.0, 7.0, 0.0625, 258, 2, 1)
    assert head.decode().splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        "comment mlbatch 0.1.0",
        "comment start_ns 1700000000100000000",
        "comment end_ns 1700000000200000000",
        "comment index 0 slice 0 of 1",
        "comment complete true",
        "comment fill 1.0 0.75",
        "comment sort columns",
        "comment timescale utc",
        "comment rate_hz 10",
        "comment frame_id base_link",
        "comment units: x y z m; time s after start_ns; intensity as sent by the sensor",
        "comment lidar_id from 0: left right",
        "element vertex 1",
        "property float x",
        "property float y",
        "property float z",
        "property float intensity",
        "property double time",
        "property int ring",
        "property uchar return_type",
        "property uchar lidar_id",
    ]


def test_a_frame_of_any_name_stays_in_its_line(tmp_path: Path) -> None:
    scan = point_scan()
    scan = replace(scan, info=scan.info._replace(frame_id="map\nend_header\n\x1b"))
    head, body = written(tmp_path / "out", scan).split(b"end_header\n")
    assert rb"comment frame_id map\nend_header\n\x1b" in head.splitlines()
    assert len(body) == 30


def test_trimesh_reads_all_points(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    # More points than a block of the packing, and not a multiple of it.
    scan = dense_scan(points=20_001)
    written(tmp_path / "out", scan)
    cloud = trimesh.load(tmp_path / "out" / "000000.ply")
    np.testing.assert_array_equal(np.asarray(cloud.vertices, np.float32), scan.xyz)
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    for name in ("intensity", "ring", "return_type", "lidar_id"):
        np.testing.assert_array_equal(np.ravel(raw[name]), getattr(scan, name))
    np.testing.assert_array_equal(np.ravel(raw["time"]), scan.time_ns / 1e9)


def test_a_scan_without_points_is_a_valid_file(tmp_path: Path) -> None:
    assert b"element vertex 0\n" in written(tmp_path / "out", dense_scan(points=0))


def test_scalars_of_cloudcompare(tmp_path: Path) -> None:
    """The same bytes as `standard`, under names that CloudCompare keeps."""
    head, body = written(tmp_path / "out", point_scan(), "cloudcompare").split(b"end_header\n")
    assert body == struct.pack("<ffffdiBB", 1.0, 2.0, 3.0, 7.0, 0.0625, 258, 2, 1)
    assert [line for line in head.decode().splitlines() if line.startswith("property")] == [
        "property float x",
        "property float y",
        "property float z",
        "property float scalar_intensity",
        "property double scalar_time",
        "property int scalar_ring",
        "property uchar scalar_return_type",
        "property uchar scalar_lidar_id",
    ]


def test_floats_only(tmp_path: Path) -> None:
    """Four floats: small_gicp 1.0.1 reads 16 bytes a vertex, whatever the header says."""
    head, body = written(tmp_path / "out", point_scan(), "float").split(b"end_header\n")
    assert body == struct.pack("<4f", 1.0, 2.0, 3.0, 0.0625)
    assert [line for line in head.decode().splitlines() if line.startswith("property")] == [
        f"property float {name}" for name in ("x", "y", "z", "time")
    ]


def test_trimesh_reads_all_styles(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    scan = dense_scan(points=20_001)
    for style in ("cloudcompare", "float"):
        written(tmp_path / style, scan, style)
        cloud = trimesh.load(tmp_path / style / "000000.ply")
        np.testing.assert_array_equal(np.asarray(cloud.vertices, np.float32), scan.xyz)
        raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
        names = ("intensity", "ring", "return_type", "lidar_id") if style != "float" else ()
        for name in names:
            np.testing.assert_array_equal(np.ravel(raw[f"scalar_{name}"]), getattr(scan, name))
        time = "time" if style == "float" else "scalar_time"
        np.testing.assert_allclose(np.ravel(raw[time]), scan.time_ns / 1e9, rtol=0, atol=2**-27)
