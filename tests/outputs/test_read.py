"""Outputs read back are the scans that were written."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mlbatch
from mlbatch.errors import RecordingError, UsageError
from mlbatch.options import PLY_STYLES
from mlbatch.outputs.read import point_arrays
from mlbatch.outputs.scan import Scan
from mlbatch.outputs.stored_scan import StoredScan
from mlbatch.python.recording import Recording
from mlbatch.writers.point_layouts import CLOUD_LAYOUTS
from tests.contract.tree import ROOT

FIXTURE = ROOT / "fixtures" / "two_lidars"
FOUR = ROOT / "fixtures" / "four_makers"
# Output, and its format.
FORMATS = (
    ("scans.mcap", None),
    ("scans.bag", None),
    ("bag", "rosbag2"),
    ("npz", "npz"),
    ("webdataset", "webdataset"),
    ("ply", "ply"),
    ("pcd", "pcd"),
    ("las", "las"),
    ("laz", "laz"),
    ("kitti", "kitti"),
    ("nuscenes", "nuscenes"),
)
EXACT_TIMES = ("npz", "webdataset", "ply", "las", "laz")
# Half a step of 0.1 mm, rounded to float32.
LAS_ERROR_M = 0.51e-4
ARRAYS = ("intensity", "reflectivity", "range_m", "time_ns", "ring", "return_type", "lidar_id")
FLOAT32_STEP_NS = 8  # of seconds below 0.125
FLOAT64_STEP_NS = 300  # of seconds since 1970


@pytest.fixture(scope="module")
def rec() -> Recording:
    return mlbatch.open(FIXTURE / "two_lidars.pcap", rig=FIXTURE / "rig.yaml")


def _assert_same(read: Scan, wrote: Scan, step_ns: int, error_m: float = 0.0) -> None:
    """Equal in all that the output stores; times may be up to `step_ns` earlier."""
    for name in ("index", "slice", "start_ns", "end_ns", "complete", "columns_per_sensor"):
        assert getattr(read, name) == getattr(wrote, name), name
    assert read.max_gap_ns == wrote.max_gap_ns
    assert read.ready_host_ns == wrote.ready_host_ns
    np.testing.assert_array_equal(read.fill, wrote.fill)
    np.testing.assert_allclose(read.coverage, wrote.coverage, atol=5e-4)
    assert read.sensors == wrote.sensors
    # Empty where neither the format nor the report has it.
    assert read.frame_id in ("", wrote.frame_id)
    assert (read.rate_hz, read.timescale) == (wrote.rate_hz, wrote.timescale)
    assert (read.slices, read.info.layout) == (wrote.slices, wrote.info.layout)
    assert read.sort == wrote.sort
    for one, other in zip(read.info.sensors, wrote.info.sensors, strict=True):
        assert (one.name, one.model) == (other.name, other.model)
        np.testing.assert_array_equal(one.body_from_sensor, other.body_from_sensor)
    np.testing.assert_allclose(read.xyz, wrote.xyz, rtol=0, atol=error_m)
    for name in ARRAYS:
        found, expected = getattr(read, name), getattr(wrote, name)
        if name in read.absent:
            assert found is None or len(found) == 0
        elif name == "time_ns":
            early = expected.astype(np.int64) - found
            assert early.min(initial=0) >= 0
            assert early.max(initial=0) <= step_ns
        elif expected is None:
            assert found is None or not found.any(), name
        else:
            assert found.dtype == expected.dtype
            np.testing.assert_array_equal(found, expected, err_msg=name)


PARTIAL: dict[str, Any] = {"keep_partial": True}
OPTIONS: dict[str, dict[str, Any]] = {
    "10 Hz": {"rate": 10, **PARTIAL},
    "15 Hz": {"rate": "15", **PARTIAL},
    "10/3 Hz": {"rate": "10/3", **PARTIAL},
    "points": {"sort": "points"},
    "organized": {"layout": "organized"},
    "slices": {"split": True, "slices": 4},
}
ORGANIZED = [*FORMATS[:5], ("pcd", "pcd")]
OF_WORDS = {"15 Hz": FORMATS[::2], "10/3 Hz": FORMATS[1::2], "organized": ORGANIZED}
CASES = [(word, *one) for word in OPTIONS for one in OF_WORDS.get(word, FORMATS)]


@pytest.mark.parametrize(("word", "name", "kind"), CASES)
def test_scans_come_back(
    word: str, name: str, kind: str | None, rec: Recording, tmp_path: Path
) -> None:
    options = OPTIONS[word]
    is_split = "split" in options

    # Folders have the scans sensor by sensor, and the head as the last file by name.
    def key(scan: Scan) -> tuple[int, int, int]:
        return int(scan.lidar_id[0]) if is_split else 0, scan.index, scan.slice

    run = mlbatch.convert(rec, tmp_path / name, format=kind, **options)
    read = sorted(mlbatch.read(tmp_path / name), key=key)
    wrote = sorted(rec.scans(**options), key=key)
    assert len({key(scan) for scan in read}) == len(read) == len(wrote) > 0
    assert is_split or len(read) == run.report.scans.written
    step_ns = 0 if kind in EXACT_TIMES else FLOAT32_STEP_NS * (4 if "rate" in options else 1)
    for one, other in zip(read, wrote, strict=True):
        if is_split:
            # The table has the last arrival and the gaps of both sensors.
            other.ready_host_ns = one.ready_host_ns
            own = int(one.lidar_id[0])
            assert one.max_gap_ns[own] == other.max_gap_ns[own]
            other.max_gap_ns = one.max_gap_ns
        _assert_same(one, other, step_ns, LAS_ERROR_M if kind in ("las", "laz") else 0.0)
        assert (one.frame_id == "") == (kind in ("kitti", "nuscenes"))
        if kind in ("npz", "webdataset") and "rate" in options:
            assert one.absent == {"ring_base"}
            for name in ("column", "column_stamp_ns", "column_lidar_id"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("style", PLY_STYLES)
def test_every_ply_style_is_read(style: str, rec: Recording, tmp_path: Path) -> None:
    mlbatch.convert(rec, tmp_path / "out", format="ply", ply_style=style)
    for one, other in zip(mlbatch.read(tmp_path / "out"), rec.scans(), strict=True):
        assert ("ring" in one.absent) == (style == "float")
        _assert_same(one, other, FLOAT32_STEP_NS if style == "float" else 0)


@pytest.mark.parametrize("layout", CLOUD_LAYOUTS)
def test_every_point_layout_is_read(layout: str, tmp_path: Path) -> None:
    """Four vendors, dual returns: what is read gives the stored records again, byte by byte."""
    rec = mlbatch.open(FOUR / "four_makers.pcap", rig=FOUR / "rig.yaml")
    mlbatch.convert(rec, tmp_path / "scans.mcap", point_layout=layout)
    read = list(mlbatch.read(tmp_path / "scans.mcap"))
    wrote = list(rec.scans())
    steps_ns = {"hesai": FLOAT64_STEP_NS, "ouster": 0, "autoware": 0}
    for one, other in zip(read, wrote, strict=True):
        if layout == "autoware":
            # Its intensity has 8 bits.
            other.intensity = other.points("autoware")["intensity"].astype(np.float32)
        if layout == "ouster":
            assert one.range_m is not None
            assert other.range_m is not None
            np.testing.assert_allclose(one.range_m, other.range_m, atol=6e-4)
            other.range_m = one.range_m
        if layout == "hesai":
            late = one.time_ns.astype(np.int64) - other.time_ns
            assert abs(late).max() <= FLOAT64_STEP_NS
            other.time_ns = one.time_ns
        _assert_same(one, other, steps_ns.get(layout, FLOAT32_STEP_NS))
        if layout != "autoware":
            np.testing.assert_array_equal(one.points(layout), other.points(layout))


def test_a_sensor_of_a_scan_that_was_read(rec: Recording, tmp_path: Path) -> None:
    mlbatch.convert(rec, tmp_path / "scans.mcap")
    for one, other in zip(mlbatch.read(tmp_path / "scans.mcap"), rec.scans(), strict=True):
        np.testing.assert_array_equal(one["right"].xyz_sensor, other["right"].xyz_sensor)


def test_one_file_of_a_folder(rec: Recording, tmp_path: Path) -> None:
    suffixes = {"kitti": "bin", "nuscenes": "pcd.bin"}
    for kind in ("npz", "ply", "pcd", "laz", "kitti", "nuscenes"):
        mlbatch.convert(rec, tmp_path / kind, format=kind, split=True)
        name = f"000002.{suffixes.get(kind, kind)}"
        (scan,) = mlbatch.read(str(tmp_path / kind / "right" / name))
        assert (scan.index, set(scan.lidar_id.tolist())) == (2, {1})
        assert np.isfinite(scan.xyz_sensor).all()


@given(st.lists(st.integers(0, 4_000_000_000), min_size=1))
def test_float32_seconds_are_the_ns_that_give_them(times: list[int]) -> None:
    """Reading is the inverse of writing: what is read rounds to the same float32, toward zero."""
    stored = StoredScan("", 0, np.zeros((len(times), 3), np.float32), organized=False)
    stored.time_s = np.zeros(len(times), np.float32)
    exact = [Fraction(time, 10**9) for time in times]
    for place, value in enumerate(exact):
        rounded = np.float32(float(value))
        if Fraction(float(rounded)) > value:
            rounded = np.nextafter(rounded, np.float32(0))
        stored.time_s[place] = rounded
    read = point_arrays(stored)["time_ns"].tolist()
    for rounded_s, found, time in zip(stored.time_s.tolist(), read, times, strict=True):
        # The smallest whole nanosecond that is not before the stored time.
        assert Fraction(found - 1, 10**9) < Fraction(rounded_s) <= Fraction(found, 10**9)
        assert found <= time


# -- mistakes -------------------------------------------------------------------------------------


def _converted(rec: Recording, tmp_path: Path, name: str, kind: str | None = None) -> Path:
    mlbatch.convert(rec, tmp_path / name, format=kind)
    return tmp_path / name


def test_a_bag_without_its_report(rec: Recording, tmp_path: Path) -> None:
    bag = _converted(rec, tmp_path, "scans.bag")
    (tmp_path / "scans.bag.report.json").unlink()
    with pytest.raises(RecordingError, match=r"expected the report of the run, .* found none"):
        list(mlbatch.read(bag))


@pytest.mark.parametrize("kind", ["kitti", "nuscenes"])
@pytest.mark.parametrize(
    ("missing", "expected"),
    [
        ("report.json", "expected the report of the run"),
        ("scans.csv", "expected a row of scan 0 slice 0 in scans.csv"),
        ("times.txt", r"expected a readable times\.txt next to the scans"),
    ],
)
def test_rows_without_their_side_files(
    kind: str, missing: str, expected: str, rec: Recording, tmp_path: Path
) -> None:
    folder = _converted(rec, tmp_path, "out", kind)
    (folder / missing).unlink()
    with pytest.raises(RecordingError, match=expected):
        list(mlbatch.read(folder))


def test_npz_without_a_report_has_no_poses(rec: Recording, tmp_path: Path) -> None:
    folder = _converted(rec, tmp_path, "npz")
    (folder / "report.json").unlink()
    scan = next(iter(mlbatch.read(folder)))
    with pytest.raises(UsageError, match="expected the extrinsics of left, found no report"):
        _ = scan.xyz_sensor


@pytest.mark.parametrize(("name", "kind"), [FORMATS[0], *FORMATS[3:]])
def test_damage_is_an_error(name: str, kind: str | None, rec: Recording, tmp_path: Path) -> None:
    output = _converted(rec, tmp_path, name, kind)
    file = output
    if output.is_dir():
        (file,) = (
            one
            for one in output.glob("00000[03].*")
            if one.name.startswith("000003") == (kind != "webdataset") and ".time" not in one.name
        )
    data = bytearray(file.read_bytes())
    half = len(data) // 2 | 1
    has_checksums = kind in (None, "npz", "webdataset")
    damaged = data[:half] + b"\xa5" * 64 + data[half + 64 :] if has_checksums else data[:half]
    file.write_bytes(damaged)
    with pytest.raises(RecordingError, match=r"expected .*, found .*; .*convert again"):
        list(mlbatch.read(output))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("nothing.mcap", "found 'No such file or directory'"),
        ("scans.mcap.partial", "expected a finished output, found that of an unfinished run"),
        ("empty", "found an empty folder"),
        ("other.txt", "found a file of another kind"),
    ],
)
def test_what_is_no_output(name: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "other.txt").write_text("text")
    with pytest.raises(RecordingError, match=expected):
        list(mlbatch.read(tmp_path / name))


def test_mcap_of_others(tmp_path: Path) -> None:
    from mcap.writer import Writer

    with (tmp_path / "other.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(RecordingError, match=r"expected an MCAP file of mlbatch"):
        list(mlbatch.read(tmp_path / "other.mcap"))
