"""`convert --accumulate`: one cloud of a simulated drive with known poses and surfaces."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import mlbatch
from mlbatch.arrays import F64Array
from mlbatch.errors import ExportError, RigError, UsageError
from tests.builders.sessions import Shell
from tests.builders.simulated import (
    ROOM,
    Recorded,
    at_true_poses,
    distance_to_scene,
    record,
    scenario_text,
)

laspy = pytest.importorskip("laspy")
pypcd4 = pytest.importorskip("pypcd4")
trimesh = pytest.importorskip("trimesh")
pytest.importorskip("lazrs")
pytest.importorskip("pyproj")

# Nothing moves but the lidars, which have no noise.
SCENE = "\n".join(line for line in ROOM.splitlines() if "velocity" not in line) + "\n"
LIDAR = """\
  - name: {name}
    model: {model}
{more}    noise_m: 0
    extrinsics: {{translation_m: [0.2, {y}, 0.6], rotation_rpy_deg: [1, -2, {yaw}]}}
"""
SENSORS = LIDAR.format(name="left", model="OS1-32", more="    columns: 512\n", y=0.3, yaw=30)
SENSORS += LIDAR.format(name="right", model="VLP-16", more="", y=-0.3, yaw=-30)
# In the system EPSG:32632: Munich.
MUNICH_M = np.array([691_000.0, 5_335_000.0, 520.0])
OFFSET_M = [691_000.0, 5_335_000.0, 1000.0]
Points = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Drive:
    """A recording; poses: in a system, until 0.25 s before its end; local: in the scene."""

    recorded: Recorded
    poses: Path
    local: Path

    def convert(self, output: Path | None, map_path: Path, **options: Any) -> mlbatch.Run:
        """Write scans, if asked for, and a map."""
        path = self.recorded.path
        options = {"deskew": self.poses, **options}
        return mlbatch.convert(
            path, output, rig=self.recorded.rig, fsync=False, accumulate=map_path, **options
        )


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    folder = tmp_path_factory.mktemp("drive")
    recorded = record(folder, scenario_text(SENSORS, scene=SCENE, duration=1.6), "mcap")
    rows = [line.split() for line in recorded.truth.read_text().splitlines()][:-250]
    lines = []
    for time, *values in rows:
        position = np.array(values[:3], np.float64) + MUNICH_M
        lines.append(" ".join([time, *(f"{value:.9f}" for value in position), *values[3:]]))
    poses, local = folder / "poses.tum", folder / "local.tum"
    poses.write_text("\n".join(lines))
    local.write_text("\n".join(" ".join(row) for row in rows))
    return Drive(recorded, poses, local)


@pytest.fixture(scope="module")
def las(drive: Drive) -> Path:
    """A map of all points, and the scans it is made of."""
    folder = drive.poses.parent
    drive.convert(folder / "scans", folder / "map.las", crs="EPSG:32632")
    return folder / "map.las"


def _of_las(path: Path) -> Points:
    found = laspy.read(path)
    names = {"ring": "ring", "intensity_f32": "intensity", "return_type": "return_type"}
    points = {ours: np.asarray(found[name]) for name, ours in names.items()}
    # GPS time was 18 s ahead of UTC in 2026; its epoch is 1980-01-06, adjusted: less 10^9 s.
    time = np.asarray(found.gps_time) + 315_964_800 + 10**9 - 18
    lidar_id = np.asarray(found.point_source_id) - 1
    assert len(found.points) == found.header.point_count
    np.testing.assert_allclose(found.xyz.min(axis=0), found.header.mins, atol=1e-6)
    np.testing.assert_allclose(found.xyz.max(axis=0), found.header.maxs, atol=1e-6)
    return {"xyz": np.asarray(found.xyz), "time": time, "lidar_id": lidar_id, **points}


def _of_ply(path: Path) -> Points:
    data = trimesh.load(path, process=False).metadata["_ply_raw"]["vertex"]["data"]
    points = {name: np.asarray(data[name]).reshape(-1) for name in data.dtype.names}
    points["xyz"] = np.stack([points.pop(axis) for axis in "xyz"], axis=1)
    return points


def _of_pcd(path: Path) -> Points:
    cloud = pypcd4.PointCloud.from_path(path)
    points = {name: cloud.pc_data[name] for name in cloud.fields}
    (line,) = (x for x in path.read_bytes()[:2000].split(b"\n") if x.startswith(b"# offset_m"))
    xyz = np.stack([points.pop(axis).astype(np.float64) for axis in "xyz"], axis=1)
    points["xyz"] = xyz + np.array([float(word) for word in line.split()[2:]])
    return points


@pytest.mark.parametrize("suffix", ["las", "laz", "ply", "pcd"])
def test_points_are_those_of_the_scans_at_their_poses(
    drive: Drive, las: Path, tmp_path: Path, suffix: str
) -> None:
    path = las
    if suffix != "las":
        path = tmp_path / f"map.{suffix}"
        made = drive.convert(None, path, crs="EPSG:32632")
        assert made.path == path
        assert [one.name for one in sorted(tmp_path.iterdir())] == [
            path.name,
            f"{path.name}.report.json",
        ]
    points = {"las": _of_las, "laz": _of_las, "ply": _of_ply, "pcd": _of_pcd}[suffix](path)
    scans = list(mlbatch.read(las.with_name("scans")))
    placed = []
    for scan in scans:
        start_ns = np.full(len(scan.xyz), scan.start_ns, np.float64)
        placed.append(at_true_poses(scan.xyz.astype(np.float64), start_ns, drive.local))
    expected = np.concatenate(placed) + MUNICH_M
    assert points["xyz"].shape == expected.shape
    # Whole millimetres; PCD: float32 480 m below its offset.
    assert np.abs(points["xyz"] - expected).max() < 0.52e-3
    times = np.concatenate([(one.start_ns + one.time_ns.astype(np.int64)) / 1e9 for one in scans])
    assert np.abs(points["time"] - times).max() < 1e-6
    for name in ("intensity", "ring", "return_type", "lidar_id"):
        expected_values = np.concatenate([getattr(one, name) for one in scans])
        np.testing.assert_array_equal(points[name], expected_values, name)


def test_walls_are_where_they_are(drive: Drive, las: Path) -> None:
    points = _of_las(las)
    off_m: F64Array = distance_to_scene(
        drive.recorded.scenario.scene, points["xyz"] - MUNICH_M, np.zeros(len(points["xyz"]))
    )
    # Resolution of a VLP-16: 2 mm.
    assert len(off_m) > 100_000
    assert off_m.max() < 5e-3
    # Both lidars, from all directions.
    assert set(points["lidar_id"].tolist()) == {0, 1}
    assert np.ptp(points["xyz"], axis=0)[:2].min() > 10


def test_every_point_is_counted(drive: Drive, las: Path, tmp_path: Path, shell: Shell) -> None:
    report = json.loads((las.parent / "scans" / "report.json").read_text())
    scans = report["scans"]
    assert report["map"]["points"] == scans["points"] == len(laspy.read(las).points)
    assert report["map"]["scans"] == scans["written"]
    # The poses end before the recording does.
    assert report["deskew"]["windows_without_poses"] >= 2
    assert sum(one["columns"]["dropped"]["no_pose"] for one in report["sensors"]) > 0
    words = f"convert {drive.recorded.path} --rig {drive.recorded.rig} --deskew {drive.poses}"
    outcome = shell(f"{words} --accumulate {tmp_path}/map.laz --voxel 0.2")
    assert outcome.code == 0
    thinned = json.loads((tmp_path / "map.laz.report.json").read_text())["map"]
    assert thinned["points"] + thinned["thinned"] == scans["points"]
    assert (
        f"map of {thinned['scans']} scans: {thinned['points']} points ({thinned['thinned']} more in"
        in outcome.out
    )
    assert shell("verify", las.parent / "scans").code == 0


def test_a_voxel_keeps_its_first_point(drive: Drive, las: Path, tmp_path: Path) -> None:
    drive.convert(None, tmp_path / "thin.laz", voxel=0.15)
    full, thin = laspy.read(las), laspy.read(tmp_path / "thin.laz")
    units = np.stack([full.X, full.Y, full.Z], axis=1)
    first = np.sort(np.unique(units // 150, axis=0, return_index=True)[1])
    np.testing.assert_array_equal(np.stack([thin.X, thin.Y, thin.Z], axis=1), units[first])
    np.testing.assert_array_equal(thin.gps_time, np.asarray(full.gps_time)[first])
    assert len(first) < 0.5 * len(units)


def test_readers_find_the_system(drive: Drive, las: Path, tmp_path: Path) -> None:
    drive.convert(None, tmp_path / "map.laz", crs="EPSG:32632")
    for path in (las, tmp_path / "map.laz"):
        header = laspy.read(path).header
        system = header.parse_crs()
        assert system is not None
        assert system.to_epsg() == 32632
        assert header.offsets.tolist() == OFFSET_M
        assert header.scales.tolist() == [0.001] * 3
        if shutil.which("pdal"):
            words = ["pdal", "info", "--summary", str(path)]
            summary = json.loads(subprocess.run(words, capture_output=True, check=True).stdout)
            assert summary["summary"]["num_points"] == header.point_count
            assert "UTM zone 32N" in summary["summary"]["srs"]["wkt"]


def test_scans_do_not_depend_on_a_map_nor_a_map_on_jobs(
    drive: Drive, las: Path, tmp_path: Path
) -> None:
    drive.convert(tmp_path / "with.mcap", tmp_path / "map.las", crs="EPSG:32632", jobs=3)
    assert (tmp_path / "map.las").read_bytes() == las.read_bytes()
    recorded = drive.recorded
    options: dict[str, Any] = {"rig": recorded.rig, "deskew": drive.poses, "fsync": False}
    mlbatch.convert(recorded.path, tmp_path / "without.mcap", **options)
    with_map = (tmp_path / "with.mcap").read_bytes()
    assert with_map == (tmp_path / "without.mcap").read_bytes()


def test_a_local_frame_has_no_offset(drive: Drive, tmp_path: Path) -> None:
    drive.convert(None, tmp_path / "map.las", deskew=drive.local)
    header = laspy.read(tmp_path / "map.las").header
    assert header.offsets.tolist() == [0, 0, 0]
    assert header.parse_crs() is None


def test_a_full_disk_is_one_line(drive: Drive, tmp_path: Path) -> None:
    recorded = drive.recorded
    for name, limit in (("map.laz", 300_000), ("map.ply", 3_000_000), ("thin.laz", 2_000_000)):
        path = tmp_path / name
        words = ["convert", str(recorded.path), "--rig", str(recorded.rig), "--no-fsync", "-q"]
        words += ["--deskew", str(drive.poses), "--accumulate", str(path)]
        # Here the temporary file of voxels grows beyond the limit first.
        words += ["--voxel", "0.02"] if name == "thin.laz" else []
        code = (
            f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit})); "
            f"from mlbatch.cli import main; import sys; sys.argv[1:] = {words!r}; main()"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.returncode == 1
        (line,) = (x for x in done.stderr.splitlines() if "warning" not in x)
        assert "expected to write it, found 'File too large'" in line
        assert not path.exists()


@pytest.mark.parametrize("name", ["local", "swapped"])
def test_poses_elsewhere_are_refused(drive: Drive, tmp_path: Path, name: str) -> None:
    """Poses near the origin, and with northing first."""
    rows = [line.split() for line in drive.poses.read_text().splitlines()]
    swapped = tmp_path / "swapped.tum"
    swapped.write_text("\n".join(" ".join([t, y, x, *rest]) for t, x, y, *rest in rows))
    poses = {"local": drive.local, "swapped": swapped}[name]
    with pytest.raises(RigError, match="expected poses with eastings and northings of Between"):
        drive.convert(None, tmp_path / "map.laz", deskew=poses, crs="EPSG:32632")
    assert not (tmp_path / "map.laz").exists()


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:4978", "EPSG:2263", "EPSG:999999", "WGS 84"])
def test_systems_without_metres_are_refused(drive: Drive, tmp_path: Path, crs: str) -> None:
    """Degrees, an earth-centred system, US feet, an unknown code, and a name."""
    with pytest.raises(UsageError, match="--crs: expected"):
        drive.convert(None, tmp_path / "map.laz", crs=crs)


def test_float32_keeps_millimetres(drive: Drive, tmp_path: Path) -> None:
    """A pose 20 km from the first one."""
    rows = drive.local.read_text().splitlines()
    middle = len(rows) // 2
    far = []
    for row in rows[middle + 200 :]:
        time, x, *rest = row.split()
        far.append(" ".join([time, str(float(x) + 20_000), *rest]))
    poses = tmp_path / "far.tum"
    poses.write_text("\n".join([*rows[:middle], *far]))
    with pytest.raises(ExportError, match="below 16384 m from its offset, found 200"):
        drive.convert(None, tmp_path / "map.pcd", deskew=poses)


@pytest.mark.parametrize("name", ["one.ply", "one.laz"])
def test_a_map_is_not_written_over_the_scans(drive: Drive, tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match="expected no -o of the same name, found both"):
        drive.convert(tmp_path / name, tmp_path / name)
    assert list(tmp_path.iterdir()) == []
