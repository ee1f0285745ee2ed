"""What unmodified programs of others read from our outputs is what the npz has, number by number.

Run by `make test-consumers`; the table of results is docs/formats.md. Not part of `make test`: it
installs a gigabyte of packages.
"""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.builders.captures import pcap_bytes
from tests.builders.run import FOUR_MAKERS, TWO_LIDARS, command
from tests.builders.traffic import datagrams_of, read_pcap
from tests.consumers.environments import need_library, read_by, run_in, run_of_system

SCANS = 7
# Name of the output, and its options.
OUTPUTS: dict[str, tuple[str, ...]] = {
    "npz": (),
    "scans.mcap": (),
    "zstd.mcap": ("--compression", "zstd"),
    "scans.bag": (),
    "bag": ("--format", "rosbag2"),
    "ply": ("--format", "ply"),
    "cloudcompare": ("--format", "ply", "--ply-style", "cloudcompare"),
    "float": ("--format", "ply", "--ply-style", "float"),
    "pcd": ("--format", "pcd"),
    "organized": ("--format", "pcd", "--layout", "organized"),
    "las": ("--format", "las"),
    "laz": ("--format", "laz"),
    "kitti": ("--format", "kitti"),
}
# A float32 of seconds below 0.125, rounded toward zero.
TIME_STEP_S = 2**-27
LABELS = ("ring", "return_type", "lidar_id")
# Open3D loads it, and its wheel lacks it.
USB = "libusb-1.0.so.0"

Arrays = dict[str, Any]


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an output of each kind."""
    folder = tmp_path_factory.mktemp("outputs")
    recording = (TWO_LIDARS / "two_lidars.pcap", "--rig", TWO_LIDARS / "rig.yaml", "--quiet")
    for name, options in OUTPUTS.items():
        run = command("convert", *recording, "-o", folder / name, *options)
        assert (run.code, run.err) == (0, "")
    return folder


@pytest.fixture(scope="module")
def scans(outputs: Path) -> list[Arrays]:
    """Our own scans, from npz."""
    files = sorted((outputs / "npz").glob("*.npz"))
    assert len(files) == SCANS
    return [dict(np.load(file)) for file in files]


def counts(scans: list[Arrays]) -> list[int]:
    """Points of each scan."""
    return [len(scan["xyz"]) for scan in scans]


def assert_times(found_s: Any, scan: Arrays) -> None:
    """Seconds after the start: those of the scan, at most one float32 step earlier."""
    early_s = scan["time_ns"] / 1e9 - np.asarray(found_s, np.float64)
    assert early_s.min() >= 0
    assert early_s.max() < TIME_STEP_S


# -- odometry -------------------------------------------------------------------------------------


@pytest.mark.parametrize("consumer", ["kiss-icp", "genz-icp"])
@pytest.mark.parametrize("name", ["scans.mcap", "zstd.mcap", "bag", "scans.bag"])
def test_odometry_by_the_loader_of_rosbags(
    consumer: str, name: str, outputs: Path, scans: list[Arrays], tmp_path: Path
) -> None:
    target = tmp_path / "first.npz"
    found = read_by(consumer, "rosbag", outputs / name, target)
    assert found["points"] == counts(scans)
    first = np.load(target)
    np.testing.assert_array_equal(first["points"], scans[0]["xyz"])
    assert_times(first["times"], scans[0])
    # The vehicle of the fixture stands.
    assert found["moved_m"] < 0.05


def test_odometry_of_kiss_icp_by_its_folder_reader(
    outputs: Path, scans: list[Arrays], tmp_path: Path
) -> None:
    """PLY files with times, opened by Open3D; .bin files without."""
    need_library(USB)
    target = tmp_path / "first.npz"
    found = read_by("kiss-icp", "generic", outputs / "ply", target)
    assert found["points"] == counts(scans)
    first = np.load(target)
    np.testing.assert_array_equal(first["points"], scans[0]["xyz"])
    found = read_by("kiss-icp", "generic", outputs / "kitti", target)
    assert found["points"] == counts(scans)
    first = np.load(target)
    np.testing.assert_array_equal(first["points"], scans[0]["xyz"])
    assert len(first["times"]) == 0


def test_the_mcap_reader_of_kiss_icp_fails(outputs: Path, tmp_path: Path) -> None:
    """Known upstream, for every MCAP file; the loader of rosbags reads the same file."""
    with pytest.raises(AssertionError, match="Unknown datatype code 7"):
        read_by("kiss-icp", "mcap", outputs / "scans.mcap", tmp_path / "first.npz")


def test_small_gicp_reads_floats_only(outputs: Path, scans: list[Arrays], tmp_path: Path) -> None:
    target = tmp_path / "points.npz"
    assert read_by("small-gicp", outputs / "float" / "000000.ply", target) == {
        "points": counts(scans)[0]
    }
    np.testing.assert_array_equal(np.load(target)["points"][:, :3], scans[0]["xyz"])
    assert read_by("small-gicp", outputs / "ply" / "000000.ply", target) == {"points": 0}


# -- files of scans -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "prefix"),
    [
        ("pcd/000003.pcd", ""),
        ("ply/000003.ply", ""),
        ("cloudcompare/000003.ply", "scalar_"),
        ("float/000003.ply", ""),
    ],
)
def test_open3d_reads_all_fields(
    name: str, prefix: str, outputs: Path, scans: list[Arrays], tmp_path: Path
) -> None:
    need_library(USB)
    target = tmp_path / "fields.npz"
    count = counts(scans)[3]
    found = read_by("open3d", outputs / name, target)
    assert found == {"points": count, "legacy_points": count}
    fields = np.load(target)
    np.testing.assert_array_equal(fields["positions"], scans[3]["xyz"])
    for field in () if name.startswith("float") else ("intensity", *LABELS):
        np.testing.assert_array_equal(fields[prefix + field][:, 0], scans[3][field])
    assert_times(fields[f"{prefix}time"][:, 0], scans[3])


def test_pypcd4_reads_all_fields(outputs: Path, scans: list[Arrays], tmp_path: Path) -> None:
    target = tmp_path / "fields.npz"
    found = read_by("pypcd4", outputs / "pcd" / "000003.pcd", target)
    assert found == {"width": counts(scans)[3], "height": 1}
    fields = np.load(target)
    np.testing.assert_array_equal(np.stack([fields[axis] for axis in "xyz"], 1), scans[3]["xyz"])
    for field in ("intensity", *LABELS):
        np.testing.assert_array_equal(fields[field], scans[3][field])
    assert_times(fields["time"], scans[3])


def test_pcl_reads_all_fields(outputs: Path, scans: list[Arrays], tmp_path: Path) -> None:
    """Debian's pcl-tools: binary to ASCII, whose numbers have 7 digits."""
    scan = scans[3]
    source = outputs / "pcd" / "000003.pcd"
    run_of_system("pcl_convert_pcd_ascii_binary", source, "ascii.pcd", "0", cwd=tmp_path)
    head, _, body = (tmp_path / "ascii.pcd").read_text().partition("DATA ascii\n")
    assert "\nFIELDS x y z intensity time ring return_type lidar_id\n" in head
    assert f"\nPOINTS {len(scan['xyz'])}\n" in head
    rows = np.array([line.split() for line in body.splitlines()], np.float64)
    np.testing.assert_allclose(rows[:, :3], scan["xyz"], rtol=5.1e-7)
    np.testing.assert_allclose(rows[:, 4], scan["time_ns"] / 1e9, rtol=5.1e-7, atol=TIME_STEP_S)
    for column, field in ((3, "intensity"), (5, "ring"), (6, "return_type"), (7, "lidar_id")):
        np.testing.assert_array_equal(rows[:, column], scan[field])


def test_pcl_reads_organized_scans(outputs: Path, scans: list[Arrays], tmp_path: Path) -> None:
    """Written again by PCL, read by pypcd4: a row for each slot, NaN where empty."""
    source = outputs / "organized" / "000003.pcd"
    run_of_system("pcl_convert_pcd_ascii_binary", source, "same.pcd", "1", cwd=tmp_path)
    target = tmp_path / "fields.npz"
    found = read_by("pypcd4", tmp_path / "same.pcd", target)
    assert found["width"] == len(scans[3]["column_stamp_ns"])
    assert found["height"] > 1
    valid = np.isfinite(np.load(target)["x"])
    assert np.count_nonzero(valid) == counts(scans)[3]


@pytest.mark.parametrize("name", ["las", "laz"])
def test_laspy_reads_all_dimensions(
    name: str, outputs: Path, scans: list[Arrays], tmp_path: Path
) -> None:
    target = tmp_path / "fields.npz"
    scan = scans[3]
    found = read_by("laspy", outputs / name / f"000003.{name}", target)
    assert found == {"points": len(scan["xyz"]), "version": "1.4"}
    fields = np.load(target)
    assert np.abs(fields["xyz"] - scan["xyz"]).max() < 0.51e-4
    for field in ("time_ns", "ring", "return_type"):
        np.testing.assert_array_equal(fields[field], scan[field])
    np.testing.assert_array_equal(fields["point_source_id"], scan["lidar_id"] + 1)
    np.testing.assert_array_equal(fields["intensity_f32"], scan["intensity"])
    # GPS time is 18 s ahead of UTC, counts from 1980-01-06, and is adjusted by 10^9 s.
    utc_s = fields["gps_time"] + 1_315_964_800 - 18
    exact_s = int(scan["start_ns"]) / 1e9 + scan["time_ns"] / 1e9
    np.testing.assert_allclose(utc_s, exact_s, rtol=0, atol=5e-7)


@pytest.mark.parametrize(
    ("style", "names"),
    [
        ("cloudcompare", "intensity time ring return_type lidar_id"),
        # All others are dropped without a dialog.
        ("ply", "intensity"),
    ],
)
def test_cloudcompare_keeps_scalars(
    style: str, names: str, outputs: Path, scans: list[Arrays], tmp_path: Path
) -> None:
    """Debian's cloudcompare, without a display: opened and saved as text."""
    scan = scans[3]
    copy = tmp_path / "scan.ply"
    copy.write_bytes((outputs / style / "000003.ply").read_bytes())
    run_of_system(
        *("CloudCompare", "-SILENT", "-O", "scan.ply", "-C_EXPORT_FMT", "ASC", "-ADD_HEADER"),
        *("-PREC", "9", "-NO_TIMESTAMP", "-SAVE_CLOUDS"),
        cwd=tmp_path,
    )
    lines = (tmp_path / "scan.asc").read_text().splitlines()
    assert lines[0] == f"//X Y Z {names}"
    rows = np.array([line.split() for line in lines[1:]], np.float64)
    np.testing.assert_allclose(rows[:, :3], scan["xyz"], rtol=0, atol=1e-8)
    for column, field in enumerate(names.split(), 3):
        if field == "time":
            np.testing.assert_allclose(rows[:, column], scan["time_ns"] / 1e9, atol=TIME_STEP_S)
        else:
            np.testing.assert_array_equal(rows[:, column], scan[field])


# -- containers -----------------------------------------------------------------------------------


def test_rerun_checks_and_loads(outputs: Path, scans: list[Arrays], tmp_path: Path) -> None:
    # Not --full: it reports chunks of large clouds as unordered for files of any writer.
    checked = run_in("rerun", "rerun", "mcap", "check", outputs / "scans.mcap")
    topics = dict(re.findall(r"^(\w+) +\d+ +\d+ +(/\S+)", checked, re.MULTILINE))
    assert "/points" in checked
    assert set(topics) == {"ok"}, checked
    recording = tmp_path / "scans.rrd"
    run_in("rerun", "rerun", "mcap", "convert", outputs / "scans.mcap", "-o", recording)
    target = tmp_path / "first.npz"
    assert read_by("rerun", recording, target) == {"points": counts(scans)}
    np.testing.assert_array_equal(np.load(target)["first"], scans[0]["xyz"])


def records(data: Any) -> Any:
    """Points of the layout `standard` from the bytes of a cloud."""
    kinds = [(name, "<f4") for name in ("x", "y", "z", "intensity", "time")]
    return np.frombuffer(
        bytes(data), [*kinds, ("ring", "<u2"), ("return_type", "u1"), ("lidar_id", "u1")]
    )


def assert_records(points: Any, scan: Arrays) -> None:
    """All fields of a cloud."""
    np.testing.assert_array_equal(np.stack([points[axis] for axis in "xyz"], 1), scan["xyz"])
    for field in ("intensity", *LABELS):
        np.testing.assert_array_equal(points[field], scan[field])
    assert_times(points["time"], scan)


def test_mcap_ros2_support_reads_all_messages(
    outputs: Path, scans: list[Arrays], tmp_path: Path
) -> None:
    target = tmp_path / "first.npz"
    found = read_by("mcap-ros2", outputs / "scans.mcap", target)
    assert found["points"] == counts(scans)
    assert found["stamps_ns"] == [int(scan["start_ns"]) for scan in scans]
    assert found["messages"]["/tf_static"] == 1
    assert found["messages"]["/left/imu"] > 0
    assert_records(records(np.load(target)["data"]), scans[0])


def test_the_javascript_reader_with_the_decoder_of_foxglove(
    outputs: Path, scans: list[Arrays]
) -> None:
    found = read_by("node", outputs / "scans.mcap")
    assert found["points"] == counts(scans)
    assert found["stamps_ns"] == [str(scan["start_ns"]) for scan in scans]
    assert found["fields"] == ["x", "y", "z", "intensity", "time", *LABELS]
    for first, last_s, scan in zip(found["first"], found["last_time_s"], scans, strict=True):
        np.testing.assert_array_equal(np.float32(first), scan["xyz"][0])
        assert 0 <= scan["time_ns"][-1] / 1e9 - last_s < TIME_STEP_S
    assert found["messages"]["/tf_static"] == 1


def test_rosbags_converts_between_containers(
    outputs: Path, scans: list[Arrays], tmp_path: Path
) -> None:
    """The program rosbags-convert: our ROS 1 bag to ROS 2, our ROS 2 bag to ROS 1."""
    target = tmp_path / "first.npz"
    for source, name in (("scans.bag", "two"), ("bag", "one.bag")):
        converted = tmp_path / name
        run_in("rosbags", "rosbags-convert", "--src", outputs / source, "--dst", converted)
        found = read_by("rosbags", converted, target)
        assert found["points"] == counts(scans)
        assert found["stamps_ns"] == [int(scan["start_ns"]) for scan in scans]
        assert "/tf_static" in found["topics"]
        assert_records(records(np.load(target)["data"]), scans[0])


def test_rko_lio_reads_clouds_and_imu(outputs: Path, tmp_path: Path) -> None:
    """It needs the frames of IMU and clouds by name, as /tf_static has both."""
    run_in(
        *("rko-lio", "rko_lio", "-d", "rosbag", "--imu", "/left/imu", "--lidar", "/points"),
        *("--imu_frame", "left_imu", "--lidar_frame", "base_link", "--base_frame", "base_link"),
        *("--log", "--log_dir", tmp_path, "--run_name", "run", outputs / "bag"),
    )
    (path,) = tmp_path.rglob("*tum*.txt")
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    assert len(lines) > 0


# -- scans.csv ------------------------------------------------------------------------------------


@pytest.mark.parametrize("consumer", ["polars", "pandas"])
def test_scans_csv_has_numbers_only(consumer: str, outputs: Path) -> None:
    """Rates of the fixture are unknown, so that columns of it are: they are numbers as well."""
    path = outputs / "npz" / "scans.csv"
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["missing_left"] for row in rows} == {"NaN"}
    found = read_by(consumer, path)
    assert found["rows"] == len(rows) == SCANS
    kinds = dict(zip(rows[0], found["types"], strict=True))
    expected = (
        ("Int64", "Float64", "Boolean") if consumer == "polars" else ("int64", "float64", "bool")
    )
    assert set(kinds.values()) == set(expected)
    assert kinds["complete"] == expected[2]
    assert kinds["missing_left"] == kinds["fill_left"] == expected[1]
    for name, total in found["sums"].items():
        # Sums of stamps are above 2^63: 64-bit sums wrap around.
        wrapped = (sum(int(row[name]) for row in rows) + 2**63) % 2**64 - 2**63
        assert int(total) == wrapped, name
    assert json.dumps(found)


# -- vendors: captures of `mlbatch extract` -------------------------------------------------------


def extracted(folder: Path, source: Path, rig: Path, lidar: str) -> Path:
    """A capture of one lidar, by way of an MCAP file."""
    bag = folder / "bag.mcap"
    capture = folder / "capture.pcap"
    for run in (
        command("extract", source, "--rig", rig, "--only", lidar, "-o", bag, "--quiet"),
        command("extract", bag, "--rig", folder / "bag.rig.yaml", "-o", capture, "--quiet"),
    ):
        assert run.code == 0, run.err
    return capture


def test_ouster_sdk(tmp_path: Path) -> None:
    """SOURCE.md: 4336 columns. The SDK refuses the fixture itself: two IMUs on one port."""
    source = TWO_LIDARS / "two_lidars.pcap"
    capture = extracted(tmp_path, source, TWO_LIDARS / "rig.yaml", "left")
    metadata = json.loads((TWO_LIDARS / "left.json").read_text(encoding="utf-8"))
    # The SDK requires this key, with any content.
    path = tmp_path / "sdk.json"
    path.write_text(json.dumps(metadata | {"calibration_status": {}}), encoding="utf-8")
    found = read_by("ouster-sdk", capture, path)
    assert found == {"columns": 4336, "serials": ["122647000123"]}


def test_velodyne_decoder(tmp_path: Path) -> None:
    """What it reads from the frames of the lidar as they were captured."""
    source = FOUR_MAKERS / "four_makers.pcap"
    frames = [
        one.frame()
        for one in datagrams_of(read_pcap(source))
        if (one.source, one.port) == ("192.168.1.201", 2368)
    ]
    original = tmp_path / "original.pcap"
    original.write_bytes(pcap_bytes(frames))
    capture = extracted(tmp_path, source, FOUR_MAKERS / "rig.yaml", "roof")
    found = read_by("velodyne-decoder", capture)
    assert found["points"] > 50_000
    assert found == read_by("velodyne-decoder", original)
