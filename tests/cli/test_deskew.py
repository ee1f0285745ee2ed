"""`--deskew`: points moved to one instant of their window, by trajectories worked out by hand."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import mlbatch
from tests.builders.sessions import (
    CAPTURE,
    REPOSITORY,
    RIG,
    Arrays,
    Shell,
    arrays,
    names,
    report_of,
)
from tests.builders.simulated import scenario_text

WORDS = f"convert {CAPTURE} --rig {RIG} -q"
FOUR = REPOSITORY / "fixtures" / "four_makers"
MIXED = f"convert {FOUR / 'four_makers.pcap'} --rig {FOUR / 'rig.yaml'} -q"
NS = 10**9
# Poses every 50 ms.
STEP_S = 0.05
SAME = ("intensity", "range_m", "time_ns", "ring", "return_type", "lidar_id", "column")


def epoch_s(words: str) -> int:
    """A second before the first scan."""
    return int(arrays("usual/000000.npz")["start_ns"]) // NS - 1


def trajectory(name: str, begin_s: float, end_s: float, speed: float, turn: float) -> None:
    """Poses of a body that drives along x and turns to the left around z, at constant rates."""
    lines = ["# time x y z qx qy qz qw"]
    for number in range(math.ceil((end_s - begin_s) / STEP_S) + 1):
        after_s = number * STEP_S
        half = turn * after_s / 2
        pose = (speed * after_s, 0.0, 0.0, 0.0, 0.0, math.sin(half), math.cos(half))
        ns = round(begin_s * NS) + round(after_s * NS)
        lines.append(f"{ns // NS}.{ns % NS:09d} " + " ".join(f"{value:.12f}" for value in pose))
    Path(name).write_text("\n".join(lines) + "\n", encoding="utf-8")


def usual(shell: Shell, words: str) -> int:
    """Convert without motion; the second before the first scan."""
    assert shell(f"{words} -o usual").code == 0
    return epoch_s(words)


def instant_ns(scan: Arrays, to: str) -> int:
    start, end = int(scan["start_ns"]), int(scan["end_ns"])
    return {"start": start, "middle": (start + end) // 2, "end": end}[to]


def test_a_body_at_rest_leaves_all_bytes(shell: Shell) -> None:
    begin_s = usual(shell, WORDS)
    trajectory("rest.tum", begin_s, begin_s + 5, 0.0, 0.0)
    assert shell(f"{WORDS} -o rest --deskew rest.tum").code == 0
    assert names("rest") == names("usual")
    for name in names("rest"):
        old, new = arrays(f"usual/{name}"), arrays(f"rest/{name}")
        assert set(new) - set(old) == {"deskew", "deskew_to"}
        assert (str(new["deskew"]), str(new["deskew_to"])) == ("rest.tum", "start")
        for key, value in old.items():
            assert value.tobytes() == new[key].tobytes(), key


@pytest.mark.parametrize("to", ["start", "middle", "end"])
def test_a_drive_along_x_moves_points_by_speed_times_time(shell: Shell, to: str) -> None:
    """At 10 m/s a column 30 ms after the instant is moved by 0.3 m; nothing else changes."""
    begin_s = usual(shell, WORDS)
    trajectory("drive.tum", begin_s, begin_s + 5, 10.0, 0.0)
    assert shell(f"{WORDS} -o moved --deskew drive.tum --deskew-to {to}").code == 0
    assert names("moved") == names("usual")
    for name in names("moved"):
        old, new = arrays(f"usual/{name}"), arrays(f"moved/{name}")
        for key in (*SAME, "column_stamp_ns", "column_lidar_id", "fill", "complete", "start_ns"):
            np.testing.assert_array_equal(new[key], old[key], err_msg=key)
        after_s = (old["column_stamp_ns"][old["column"]] - instant_ns(old, to)) / NS
        expected = old["xyz"].astype(np.float64)
        expected[:, 0] += 10.0 * after_s
        np.testing.assert_allclose(new["xyz"], expected, atol=2e-5)
        assert np.abs(after_s).max() > 0.04
    report = report_of("moved/report.json")
    columns = sum(sensor["columns"]["written"] for sensor in report["sensors"])
    assert report["deskew"] == {
        **{"source": "drive.tum", "to": to, "poses": 101, "columns": columns, "moved": columns},
        **{"no_pose": 0, "windows_without_poses": 0},
        # Nothing turns.
        "rotation_check": {"outcome": "not checked", "reason": "little_rotation", "windows": 0},
    }
    assert shell("verify moved").code == 0


@pytest.mark.parametrize(
    "options",
    [
        "",
        "--layout organized",
        "--sort points",
        "--slices 4",
        "--split",
        "--exclude-box=-3,-3,-3,3,3,3 --min-range 1 --max-range 40",
        "--batching latest",
        "--batching collate --batching-times own",
    ],
)
def test_every_vendor(shell: Shell, options: str) -> None:
    """A turn to the left at 1 rad/s with 5 m/s: the same bytes by three jobs."""
    begin_s = usual(shell, MIXED)
    trajectory("turn.tum", begin_s, begin_s + 5, 5.0, 1.0)
    line = f"{MIXED} {options}"
    assert shell(f"{line} -o still").code == 0
    assert shell(f"{line} -o moved --deskew turn.tum").code == 0
    assert shell(f"{line} -o jobs --deskew turn.tum --jobs 3").code == 0
    files = [path.relative_to("moved") for path in sorted(Path("moved").rglob("*.npz"))]
    assert files
    for file in files:
        assert ("moved" / file).read_bytes() == ("jobs" / file).read_bytes()
        _check_turn(arrays(f"still/{file}"), arrays(f"moved/{file}"), begin_s)
    verified = shell("verify moved")
    assert verified.code == 0, verified.out


def _check_turn(old: Arrays, new: Arrays, begin_s: int) -> None:
    """Points in the world at their own time are those of the moved ones at the start."""
    for key in SAME:
        if key in old:
            np.testing.assert_array_equal(new[key], old[key], err_msg=key)
    stamps = old["column_stamp_ns"]
    column = old["column"] if "column" in old else np.arange(len(stamps))[:, None]
    after_s = (stamps - begin_s * NS)[column] / NS
    seen = in_world(old["xyz"].astype(np.float64), after_s)
    start_s = (int(old["start_ns"]) - begin_s * NS) / NS
    moved = in_world(new["xyz"].astype(np.float64), np.full(after_s.shape, start_s))
    # Between two poses the body drives on an arc instead of along x: by 5 mm at most.
    distance = np.abs(seen - moved)
    assert np.nanmax(distance, initial=0.0) < 0.01


def in_world(xyz: np.ndarray, after_s: np.ndarray) -> np.ndarray:
    cosine, sine = np.cos(after_s), np.sin(after_s)
    x, y, z = xyz[..., 0], xyz[..., 1], xyz[..., 2]
    return np.stack([cosine * x - sine * y + 5.0 * after_s, sine * x + cosine * y, z + 0 * x], -1)


def test_boxes_are_of_the_body_where_a_column_was_measured(shell: Shell) -> None:
    """The own machine is at the same place in every column: the same points are left out."""
    box = "--exclude-box=-6,-6,-6,6,6,6"
    begin_s = usual(shell, WORDS)
    trajectory("drive.tum", begin_s, begin_s + 5, 20.0, 0.5)
    assert shell(f"{WORDS} {box} -o still").code == 0
    assert shell(f"{WORDS} {box} -o moved --deskew drive.tum").code == 0
    for one, other in zip(
        report_of("still/report.json")["sensors"],
        report_of("moved/report.json")["sensors"],
        strict=True,
    ):
        assert one["points"] == other["points"]
        assert one["points"]["box"] > 0


@pytest.mark.parametrize("output", ["sets", "sets.mcap", "sets.bag"])
def test_sets_keep_their_numbers_where_others_have_no_poses(shell: Shell, output: str) -> None:
    """The trajectory begins 0.4 s after the recording: the first sets are left out."""
    begin_s = usual(shell, WORDS) + 1.4
    trajectory("late.tum", begin_s, begin_s + 4, 0.0, 0.0)
    line = f"{WORDS} --batching latest"
    assert shell(f"{line} -o all").code == 0
    assert shell(f"{line} -o {output} --deskew late.tum").code == 0
    expected = {scan.index: scan.start_ns for scan in mlbatch.read("all")}
    found = {scan.index: scan.start_ns for scan in mlbatch.read(output)}
    assert found == {index: ns for index, ns in expected.items() if ns >= begin_s * NS}
    assert 0 < len(found) < len(expected)
    verified = shell(f"verify {output}")
    assert verified.code == 0, verified.out


@pytest.mark.parametrize(
    "output",
    ["out.mcap", "out.bag --stamp middle", "out --format ply", "out --format las", "out -f kitti"],
)
def test_every_format_can_be_checked_and_read(shell: Shell, output: str) -> None:
    begin_s = usual(shell, WORDS)
    trajectory("turn.tum", begin_s, begin_s + 5, 5.0, 1.0)
    assert shell(f"{WORDS} -o {output} --deskew turn.tum --deskew-to middle").code == 0
    path = output.split()[0]
    verified = shell(f"verify {path}")
    assert verified.code == 0, verified.out
    assert shell(f"{WORDS} -o moved --deskew turn.tum --deskew-to middle").code == 0
    for scan, name in zip(mlbatch.read(path), names("moved"), strict=True):
        np.testing.assert_allclose(scan.xyz, arrays(f"moved/{name}")["xyz"], atol=6e-4)


@pytest.mark.parametrize(("x", "is_refused"), [(188, True), (-0.188, False)])
def test_an_imu_beyond_a_vehicle_is_refused(shell: Shell, x: float, is_refused: bool) -> None:
    """Millimetres that were written as metres: every turn would move the body by its arm."""
    more = f"imu: {{rate_hz: 200, extrinsics: {{translation_m: [{x}, 0, 1]}}}}\n"
    sensors = "  - {name: top, model: VLP-16, extrinsics: {translation_m: [0, 0, 2]}}\n"
    text = scenario_text(sensors, motion="", duration=1.3, more=more)
    Path("scenario.yaml").write_text(text, encoding="utf-8")
    assert shell("simulate scenario.yaml -o rec.mcap").code == 0
    done = shell("convert rec.mcap --rig rec.rig.yaml -o out --deskew imu -q --keep-partial")
    assert (done.code == 1) == is_refused, done.err
    if is_refused:
        assert done.err.startswith("mlbatch: error: --deskew imu: the IMU /imu/data: expected it ")
        assert "within 20 m of the body origin, found 188.003 m; give its static" in done.err
