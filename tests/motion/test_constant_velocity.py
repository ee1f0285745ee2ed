"""`convert --deskew constant-velocity` on simulated drives, against their true poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from mlbatch.types import Scan
from mlbatch.writers import npz_encoder as npz
from mlbatch.writers.output_file import Bytes
from tests.builders.sessions import Shell, arrays, names, report_of
from tests.builders.simulated import Recorded, record, scenario_text
from tests.motion.test_wall import SCENE, bend_m

SENSORS = """\
  - name: lidar
    model: OS1-64
    columns: 512
    extrinsics: {translation_m: [0.2, -0.1, 0.6], rotation_rpy_deg: [1, -2, 30]}
"""
# Without boxes there is no information along the wall.
BOXES = """\
  boxes:
    - {centre_m: [-6, 8, 1.5], size_m: [4, 2, 3], yaw_deg: 20, reflectivity: 90}
    - {centre_m: [-5, -7, 1.0], size_m: [3, 3, 2], yaw_deg: -10, reflectivity: 90}
    - {centre_m: [1, 12, 1.5], size_m: [3, 1.5, 3], yaw_deg: -10, reflectivity: 90}
"""
# 20 degrees/s and 1 m/s.
MOTION = """\
motion:
  standstill_s: 1.5
  waypoints:
    - [0, 0, 0, 1.0, 0]
    - [2, 2, 0.5, 1.0, 35]
    - [4, 3.5, 1.6, 1.0, 75]
    - [6, 4.2, 3.2, 1.0, 115]
"""
CORRIDOR = """\
scene:
  boxes:
    - {centre_m: [0, 0, 1.5], size_m: [2000, 6, 3], reflectivity: 90}
"""
STRAIGHT = """\
motion:
  standstill_s: 1
  waypoints:
    - [0, 0, 0, 1, 0]
    - [2, 10, 0, 1, 0]
    - [20, 190, 0, 1, 0]
"""
# Scans of 0.1 s that begin within the standstill.
AT_REST = 13


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    text = scenario_text(SENSORS, scene=SCENE + BOXES, motion=MOTION, duration=5.0)
    return record(tmp_path_factory.mktemp("smooth"), text, "mcap")


def words(drive: Recorded) -> str:
    return f"convert {drive.path} --rig {drive.rig} -q"


def distance_m(one: str, other: str) -> F64Array:
    """Root mean square of the distances between the points of two outputs, of each scan."""
    return np.array(
        [
            np.sqrt(
                ((arrays(f"{one}/{name}")["xyz"] - arrays(f"{other}/{name}")["xyz"]) ** 2)
                .sum(1)
                .mean()
            )
            for name in names(one)
        ]
    )


def test_a_smooth_drive_is_corrected(shell: Shell, drive: Recorded) -> None:
    line = words(drive)
    for to in ("start", "end"):
        assert (
            shell(f"{line} -o true --deskew {drive.truth} --deskew-to {to} --overwrite").code == 0
        )
        own = f"--deskew constant-velocity --deskew-to {to} --overwrite"
        done = shell(f"{line} -o own {own}")
        # There is nothing to warn of at rest.
        assert (done.code, done.err) == (0, "")
        assert shell(f"{line} -o none --overwrite").code == 0
        # The trajectory ends before the last window.
        without, left = distance_m("true", "none"), distance_m("true", "own")
        moving = slice(AT_REST + 3, None)
        assert np.median(without[moving]) > 0.1
        assert np.median(left[moving]) < 0.005
        # While it accelerates, the velocity is that of half a window before.
        assert left[moving].max() < 0.03
        # At rest nothing is moved.
        assert without[:AT_REST].max() < 1e-6
        assert left[:AT_REST].max() < 1e-6
        # No window is worse than unmoved.
        assert (left - without).max() < 1e-4
    # The largest distance of the wall's points from a plane: that of their noise, with true poses.
    none, true, own_m = (
        np.median(bend_m(Path(name))[AT_REST + 3 :]) for name in ("none", "true", "own")
    )
    assert none > 0.09
    assert own_m < true + 0.005 < 0.05
    verified = shell("verify own")
    assert verified.code == 0, verified.out
    motion = report_of("own/report.json")["deskew"]
    assert motion["columns"] == motion["moved"] + motion["unmoved"]
    assert set(motion["windows_unmoved"]) == {"first", "no_gain"}
    assert motion["windows_unmoved"]["first"] == 2
    # At rest, and at most two windows in which the motion begins.
    assert AT_REST - 2 <= motion["windows_unmoved"]["no_gain"] <= AT_REST + 2
    assert motion["unmoved_indexes"][:AT_REST] == list(range(AT_REST))
    assert motion["windows_registered"] == len(names("own")) - 1
    assert motion["residual_mm"]["p50"] < 10
    for name in names("own"):
        old, new = arrays(f"none/{name}"), arrays(f"own/{name}")
        for key in ("time_ns", "range_m", "ring", "column", "column_stamp_ns", "intensity"):
            np.testing.assert_array_equal(old[key], new[key], err_msg=key)


def test_hard_motion_is_not_made_worse(shell: Shell, tmp_path: Path) -> None:
    """Shaken by 4 degrees at 2 Hz, the velocity of a window is not that of the one before."""
    sway = "".join(
        f"    - {{coordinate: {name}, amplitude: 4, frequency_hz: {hz}, phase_deg: {phase}}}\n"
        for name, hz, phase in (("roll", 2.0, 0), ("pitch", 1.6, 50))
    )
    text = scenario_text(
        SENSORS, scene=SCENE + BOXES, motion=f"{MOTION}  sway:\n{sway}", duration=6.0
    )
    drive = record(tmp_path, text, "mcap")
    assert shell(f"{words(drive)} -o own --deskew constant-velocity").code == 0
    assert shell(f"{words(drive)} -o true --deskew {drive.truth}").code == 0
    assert shell(f"{words(drive)} -o none").code == 0
    without, left = distance_m("true", "none"), distance_m("true", "own")
    assert np.median(left[AT_REST + 3 :]) < 0.7 * np.median(without[AT_REST + 3 :])
    worse = np.flatnonzero(left - without > 1e-4)
    # Not at rest, nor where the motion begins; one whose residual falls although it is worse.
    assert (worse > AT_REST + 8).all()
    assert len(worse) <= 1
    motion = report_of("own/report.json")["deskew"]
    assert motion["columns"] == motion["moved"] + motion["unmoved"]


def test_it_does_not_depend_on_jobs_and_layout(shell: Shell, drive: Recorded) -> None:
    line = f"{words(drive)} --deskew constant-velocity --end +2.5"
    assert shell(f"{line} -o one.mcap").code == 0
    assert shell(f"{line} -o two.mcap --jobs 3 --max-wait 0.3").code == 0
    assert Path("one.mcap").read_bytes() == Path("two.mcap").read_bytes()
    assert shell(f"{line} -o dense").code == 0
    assert shell(f"{line} -o grid --layout organized").code == 0
    for name in names("dense"):
        dense, grid = arrays(f"dense/{name}")["xyz"], arrays(f"grid/{name}")["xyz"]
        flat = grid.reshape(-1, 3)
        flat = flat[np.isfinite(flat).all(axis=1)]
        np.testing.assert_array_equal(np.sort(dense, axis=0), np.sort(flat, axis=0))


def test_a_part_until_an_end_is_that_of_the_whole(shell: Shell, drive: Recorded) -> None:
    line = f"{words(drive)} --deskew constant-velocity"
    assert shell(f"{line} -o whole").code == 0
    assert shell(f"{line} -o part --end +2").code == 0
    for name in names("part"):
        assert Path("part", name).read_bytes() == Path("whole", name).read_bytes()


def test_shards_give_the_same_bytes(shell: Shell, drive: Recorded) -> None:
    line = f"{words(drive)} --deskew constant-velocity --end +2.5"
    assert shell(f"{line} -o whole").code == 0
    for number in (1, 2):
        assert shell(f"{line} -o part{number} --shard {number}/2").code == 0
        for name in names(f"part{number}"):
            assert Path(f"part{number}", name).read_bytes() == Path("whole", name).read_bytes()
    assert sorted([*names("part1"), *names("part2")]) == names("whole")
    assert shell("merge part1 part2 -o merged -q").code == 0
    assert report_of("merged/report.json")["deskew"] == report_of("whole/report.json")["deskew"]
    assert shell("verify merged").code == 0


def test_a_resumed_run_gives_the_same_bytes(
    shell: Shell, drive: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its first scans are not decoded again, but registered."""
    line = f"{words(drive)} --deskew constant-velocity --end +2.5"
    assert shell(f"{line} -o whole").code == 0
    encode = npz.NpzEncoder.encode

    def ending(encoder: npz.NpzEncoder, scan: Scan) -> list[Bytes]:
        if scan.index == 20:
            raise KeyboardInterrupt
        return encode(encoder, scan)

    monkeypatch.setattr(npz.NpzEncoder, "encode", ending)
    assert shell(f"{line} -o part").code == 130
    monkeypatch.setattr(npz.NpzEncoder, "encode", encode)
    assert "resumed after" in shell(f"{line.replace(' -q', '')} -o part --resume").err
    assert names("part") == names("whole")
    for name in names("part"):
        assert Path("part", name).read_bytes() == Path("whole", name).read_bytes()
    assert report_of("part/report.json")["deskew"] == report_of("whole/report.json")["deskew"]


def test_slices_have_the_motion_of_their_window(shell: Shell, drive: Recorded) -> None:
    """Points of slices, moved to its start, are those of the window at the start of the slice."""
    line = f"{words(drive)} --slices 4 --end +2.5"
    own = f"{line} --deskew constant-velocity"
    assert shell(f"{own} -o one").code == 0
    assert shell(f"{own} -o jobs --jobs 3").code == 0
    assert shell(f"{line} -o true --deskew {drive.truth}").code == 0
    assert shell(f"{line} -o none").code == 0
    for name in names("one"):
        assert Path("one", name).read_bytes() == Path("jobs", name).read_bytes()
    left, without = distance_m("true", "one"), distance_m("true", "none")
    moving = slice(4 * (AT_REST + 5), None)
    assert np.median(left[moving]) < 0.2 * np.median(without[moving])
    assert shell("verify one").code == 0


def test_in_a_corridor_nothing_is_moved_and_a_warning_says_so(shell: Shell, tmp_path: Path) -> None:
    text = scenario_text(SENSORS, scene=CORRIDOR, motion=STRAIGHT, duration=3.0)
    drive = record(tmp_path, text, "mcap")
    assert shell(f"{words(drive)} -o none").code == 0
    done = shell(f"convert {drive.path} --rig {drive.rig} -o own --deskew constant-velocity")
    assert done.code == 0
    assert "no_velocity" in done.err
    assert "0 % of the columns moved" in done.out
    motion = report_of("own/report.json")["deskew"]
    assert motion["moved"] == 0
    assert motion["columns"] == motion["unmoved"]
    assert sum(motion["windows_unmoved"].values()) == len(names("own"))
    for name in names("own"):
        old, new = arrays(f"none/{name}")["xyz"], arrays(f"own/{name}")["xyz"]
        np.testing.assert_array_equal(old, new)
    assert shell("verify own").code == 0
