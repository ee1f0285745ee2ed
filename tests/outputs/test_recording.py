"""An output that is converted again: the same points at the same times, by the same windows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import mlbatch
from mlbatch.errors import MlbatchError
from mlbatch.outputs.scan import Scan
from mlbatch.reports.report import report_of
from tests.builders.sessions import Shell
from tests.contract.tree import ROOT

TWO = ROOT / "fixtures" / "two_lidars"
FOUR = ROOT / "fixtures" / "four_makers"
MOVING = ROOT / "fixtures" / "moving"
# Of float32 seconds below 0.125, and of float64 seconds since 1970.
STEP_NS = {"scans.mcap": 8, "end.mcap": 8, "scans.bag": 8, "bag": 8, "pcd": 8, "hesai.mcap": 300}
KINDS: dict[str, dict[str, Any]] = {
    "scans.mcap": {},
    "scans.bag": {},
    "bag": {"format": "rosbag2"},
    "npz": {"format": "npz"},
    "ply": {"format": "ply"},
    "pcd": {"format": "pcd"},
    "organized": {"format": "npz", "layout": "organized"},
    "hesai.mcap": {"point_layout": "hesai", "split": True},
    "end.mcap": {"stamp": "end"},
}


def _points(scan: Scan) -> tuple[npt.NDArray[Any], npt.NDArray[np.int64]]:
    """All but the times of the points of a scan, and the times after its start, by all of them."""
    valid = scan.is_valid
    rows = np.column_stack(
        [
            np.ascontiguousarray(scan.xyz[valid]).view(np.uint32),
            np.ascontiguousarray(scan.intensity[valid]).view(np.uint32),
            scan.ring[valid],
            scan.lidar_id[valid],
            np.zeros(valid.sum()) if "return_type" in scan.absent else scan.return_type[valid],
        ]
    ).astype(np.int64)
    time_ns = scan.time_ns[valid].astype(np.int64)
    order = np.lexsort((time_ns, *rows.T))
    return rows[order], time_ns[order]


def _assert_equal(found: list[Scan], expected: list[Scan], step_ns: int) -> None:
    """The same scans, points in any order, times up to `step_ns` apart."""
    assert [(one.start_ns, one.end_ns, one.complete, one.sensor) for one in found] == [
        (one.start_ns, one.end_ns, one.complete, one.sensor) for one in expected
    ]
    for one, other in zip(found, expected, strict=True):
        rows, time_ns = _points(one)
        other_rows, other_time_ns = _points(other)
        np.testing.assert_array_equal(rows, other_rows)
        assert np.abs(time_ns - other_time_ns).max(initial=0) <= step_ns


def _converted(source: Path, output: Path, **options: Any) -> list[Scan]:
    found = _made(source, output, **options)
    assert mlbatch.verify(output).ok
    return found


def _made(source: Path, output: Path, **options: Any) -> list[Scan]:
    mlbatch.convert(source, output, **options)
    return sorted(mlbatch.read(output), key=lambda one: (one.start_ns, one.sensor))


# Of four makers beams fire one after another; of the other recording all of a column at once.
@pytest.mark.parametrize(
    ("recording", "name"),
    [*((FOUR / "four_makers.pcap", name) for name in KINDS), (TWO / "two_lidars.pcap", "npz")],
)
def test_the_same_rate_gives_the_same_scans(recording: Path, name: str, tmp_path: Path) -> None:
    rig = recording.parent / "rig.yaml"
    first = _converted(recording, tmp_path / name, rig=rig, **KINDS[name])
    again = _converted(
        tmp_path / name, tmp_path / "again", format="npz", split=bool(first[0].sensor)
    )
    _assert_equal(again, first, STEP_NS.get(name, 0))
    before, after = first[0].info, again[0].info
    assert after.timescale == before.timescale
    assert after.rate_hz == before.rate_hz
    for one, other in zip(after.sensors, before.sensors, strict=True):
        assert (one.name, one.model) == (other.name, other.model)
        np.testing.assert_array_equal(one.body_from_sensor, other.body_from_sensor)


@pytest.mark.parametrize("name", ["scans.mcap", "scans.bag", "bag", "npz"])
def test_half_windows_are_those_of_the_recording(name: str, tmp_path: Path) -> None:
    recording, rig = TWO / "two_lidars.pcap", TWO / "rig.yaml"
    whole = _converted(recording, tmp_path / name, rig=rig, **KINDS[name])
    again = _converted(tmp_path / name, tmp_path / "again", rate=20, format="npz")
    direct = _converted(recording, tmp_path / "direct", rig=rig, rate=20, format="npz")
    # Windows of 100 ms were dropped at both ends, which are halves here.
    inside = [one for one in direct if whole[0].start_ns <= one.start_ns < whole[-1].end_ns]
    assert len(again) == 2 * len(whole)
    _assert_equal(again, inside, STEP_NS.get(name, 0))


def test_columns_of_npz_are_cut_where_those_of_the_recording_are(tmp_path: Path) -> None:
    recording, rig = FOUR / "four_makers.pcap", FOUR / "rig.yaml"
    _converted(recording, tmp_path / "npz", rig=rig, rate=10, format="npz")
    again = _converted(tmp_path / "npz", tmp_path / "again", rate=40, format="npz")
    direct = _converted(recording, tmp_path / "direct", rig=rig, rate=40, format="npz")
    starts = {one.start_ns for one in again}
    assert len(again) >= 4
    _assert_equal(again, [one for one in direct if one.start_ns in starts], 0)


def test_incomplete_scans_stay_incomplete(shell: Shell, tmp_path: Path) -> None:
    done = shell(
        *("convert", MOVING / "moving.mcap", "--rig", MOVING / "moving.rig.yaml", "-q"),
        *("-o", tmp_path / "npz", "--format", "npz", "--max-wait", "0.2"),
        *("--fault", "stall:left:0.4s-0.9s", "--fault", "early:right:1.7s"),
    )
    assert done.code == 0
    first = list(mlbatch.read(tmp_path / "npz"))
    assert {one.complete for one in first} == {True, False}
    again = _converted(tmp_path / "npz", tmp_path / "again", format="npz")
    _assert_equal(again, first, 0)
    # Half as many windows: one is complete where both were.
    slow = _converted(tmp_path / "npz", tmp_path / "slow", format="npz", rate=5)
    whole = {one.start_ns for one in first if one.complete}
    assert {one.complete for one in slow} == {True, False}
    for one in slow:
        halves = {one.start_ns, one.start_ns + 100_000_000}
        assert one.complete == (halves <= whole)


def test_windows_next_to_dropped_ones_stay_complete(tmp_path: Path) -> None:
    rig = MOVING / "moving.rig.yaml"
    first = _converted(MOVING / "moving.mcap", tmp_path / "npz", rig=rig, format="npz")
    assert all(one.complete for one in first)
    for one in first[5:18]:
        (tmp_path / "npz" / f"{one.index:06d}.npz").unlink()
    again = _made(tmp_path / "npz", tmp_path / "again", format="npz")
    _assert_equal(again, first[:5] + first[18:], 0)


def test_ranges_count_from_the_lidar(tmp_path: Path) -> None:
    """A limit leaves the points that are farther from the lidar than it is from the body."""
    first = _converted(
        TWO / "two_lidars.pcap", tmp_path / "npz", rig=TWO / "rig.yaml", format="npz"
    )
    again = _converted(tmp_path / "npz", tmp_path / "near", max_range=5, format="npz")
    for one, other in zip(again, first, strict=True):
        origin_m = np.stack([sensor.body_from_sensor[:3, 3] for sensor in one.info.sensors])
        distance_m = np.linalg.norm(other.xyz - origin_m[other.lidar_id], axis=1)
        # Not decided by rounding.
        sure = np.abs(distance_m - 5) > 1e-5
        assert one.point_count == np.count_nonzero(distance_m < 5)
        assert sure.all()


def test_messages_and_counts_are_kept(tmp_path: Path) -> None:
    mlbatch.convert(TWO / "two_lidars.pcap", tmp_path / "one.mcap", rig=TWO / "rig.yaml")
    run = mlbatch.convert(tmp_path / "one.mcap", tmp_path / "two.mcap")
    assert run.report_path is not None
    report = report_of("", run.report_path.read_text())
    assert mlbatch.verify(tmp_path / "two.mcap").ok
    # 85 samples of each lidar, by fixtures/two_lidars/SOURCE.md.
    assert [(one.topic, one.written) for one in report.messages] == [
        ("/left/imu", 85),
        ("/right/imu", 85),
    ]
    (note,) = report.warnings
    assert note.code == "clouds"
    assert "columns of left (tail 354, head 398)" in note.message
    assert [one.extrinsics_source for one in report.sensors] == ["output", "output"]
    opened = mlbatch.open(tmp_path / "one.mcap")
    assert list(opened.sensors) == ["left", "right"]
    assert opened[3].start_ns == opened[0].start_ns + 300_000_000


REFUSED: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "deskewed": (
        {"deskew": "constant-velocity"},
        {},
        "expected points where they were measured, found points moved to one time",
    ),
    "sweeps": ({"batching": "latest"}, {}, "expected windows, found sets of sweeps"),
    "kitti": ({"format": "kitti"}, {}, "found an output without time, ring, lidar_id"),
    "velodyne": ({"point_layout": "velodyne"}, {}, "found an output without lidar_id"),
    "organized": ({}, {"layout": "organized"}, "--layout organized: expected raw packets"),
    "fused": ({}, {"batching": "latest"}, "expected the positions of its rotor"),
    "rig": ({}, {"rig": MOVING / "moving.rig.yaml"}, "expected no rig"),
    "host": ({}, {"clock": "host"}, "--clock host"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_batched_again_is_one_line(name: str, tmp_path: Path) -> None:
    options, again, text = REFUSED[name]
    output = tmp_path / ("out" if "format" in options else "out.mcap")
    mlbatch.convert(MOVING / "moving.mcap", output, rig=MOVING / "moving.rig.yaml", **options)
    with pytest.raises(MlbatchError) as caught:
        mlbatch.convert(output, tmp_path / "again.mcap", **again)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "again.mcap").exists()
