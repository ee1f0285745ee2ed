"""`mlbatch calibrate`: the tables, the rig and the page that it writes, and mistakes.

Truth: the rig of `fixtures/moving`, which its scenario gives.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import mlbatch
from mlbatch.discovery.discover import SensorSelection
from mlbatch.discovery.gravity import ups
from mlbatch.pipeline.conversion import Conversion
from mlbatch.pipeline.job import Job
from mlbatch.poses.calibration import Calibration
from mlbatch.rig.rig import read_rig
from tests.builders.sessions import REPOSITORY, Shell

FOLDER = REPOSITORY / "fixtures" / "moving"
DRIVE = FOLDER / "moving.mcap"
TRUE = FOLDER / "moving.rig.yaml"
# Of the right lidar: 0.3 m and 14 degrees off.
GUESS = """\
sensors:
  - name: left
    stream: {topic: /left/lidar_packets}
    extrinsics: {translation_m: [0.1, 0.3, 0.6], rotation_rpy_deg: [0, 10, 80]}
  - name: right
    stream: {topic: /right/lidar_packets}
    extrinsics: EXTRINSICS
"""
ROUGH = "{translation_m: [0.0, -0.5, 0.8], rotation_rpy_deg: [0, 0, -90]}"


def _guess(extrinsics: str = ROUGH) -> None:
    Path("guess.yaml").write_text(GUESS.replace("EXTRINSICS", extrinsics), encoding="utf-8")


def test_a_rig_and_a_page(shell: Shell) -> None:
    _guess()
    words = f"calibrate {DRIVE} --rig guess.yaml -o rig.yaml --html page.html"
    outcome = shell(words)
    assert outcome.code == 0
    # A log shows that it lives.
    assert outcome.err.splitlines() == [
        "mlbatch: calibrate: reading for places that several lidars see",
        "mlbatch: calibrate: solving for the poses of 2 lidars in 4 places",
        "mlbatch: calibrate: measuring the poses in 2 places that were left out",
    ]
    lines = outcome.out.splitlines()
    assert lines[1].split("  ")[0] == "lidar"
    assert lines[2].split()[:7] == [
        *("left", "0.1000,", "0.3000,", "0.6000", "0.000,", "10.000,", "80.000")
    ]
    assert lines[-2:] == ["wrote rig.yaml", "wrote page.html"]
    found, true = (read_rig(Path(path)).sensors[1].extrinsics for path in ("rig.yaml", TRUE))
    assert isinstance(found, np.ndarray)
    assert isinstance(true, np.ndarray)
    assert np.abs(found - true)[:3, 3].max() < 0.005
    assert np.abs(found - true)[:3, :3].max() < np.deg2rad(0.1)
    page = Path("page.html").read_text(encoding="utf-8")
    assert page.count("<svg") == page.count("</figcaption><svg") == 6
    assert "Surfaces of left and right are " in page
    # What it wrote can be used, and is not replaced by accident.
    assert shell(f"convert {DRIVE} --rig rig.yaml -o scans.mcap").code == 0
    refused = shell(words)
    assert (refused.code, refused.out) == (1, "")
    assert "rig.yaml: expected a new rig file, found an existing one" in refused.err
    assert sorted(path.name for path in Path().iterdir() if path.suffix == ".partial") == []


def test_json_and_python_say_the_same(shell: Shell) -> None:
    outcome = shell(f"calibrate {DRIVE} --rig {TRUE} --json --quiet")
    assert (outcome.code, outcome.err) == (0, "")
    found = json.loads(outcome.out)
    assert found["schema"] == "mlbatch.calibration/1"
    assert [lidar["is_fixed"] for lidar in found["lidars"]] == [True, False]
    calibration = mlbatch.calibrate(DRIVE, TRUE)
    assert isinstance(calibration, Calibration)
    assert calibration.as_json() == found
    # 35 windows in 3.5 s, the first and the last of which are partial.
    assert found["windows"] == 33


MISTAKES = {
    "an unknown pose": (
        "--rig guess.yaml",
        "guess.yaml:7: sensors[1].extrinsics: expected a guess of the pose of right, within 20 "
        "degrees and 1 m, found unknown; ",
    ),
    "no folder": (f"--rig {TRUE} -o no/rig.yaml", "found no folder no"),
    "a folder": (f"--rig {TRUE} -o .", "expected the name of a new output, found a folder"),
    "aligned clocks have no offset": (
        f"--rig {TRUE} --align-clocks --time-offset",
        "--time-offset: expected clocks as recorded",
    ),
    "too short": (
        f"--rig {TRUE} --end +0.15s",
        "calibrate: expected two places or more, each two windows that follow each other with "
        "points of every lidar, found 1 in 2 windows; ",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes(shell: Shell, name: str) -> None:
    _guess("unknown")
    words, message = MISTAKES[name]
    outcome = shell(f"calibrate {DRIVE} {words} -q")
    assert (outcome.code > 0, outcome.out) == (True, "")
    assert message in outcome.err
    assert outcome.err.count("\n") == 1


def test_the_imu_of_the_first_lidar_says_that_it_is_not_level(shell: Shell) -> None:
    """Both poses are tilted by 10 degrees about y of the body; the trolley stands at first."""
    cosine, sine = np.cos(np.deg2rad(10.0)), np.sin(np.deg2rad(10.0))
    tilt = np.array([[cosine, 0, sine, 0], [0, 1, 0, 0], [-sine, 0, cosine, 0], [0, 0, 0, 1]])
    text = GUESS.replace("{translation_m: [0.1, 0.3, 0.6], rotation_rpy_deg: [0, 10, 80]}", "LEFT")
    for word, sensor in zip(("LEFT", "EXTRINSICS"), read_rig(TRUE).sensors, strict=True):
        assert isinstance(sensor.extrinsics, np.ndarray)
        rows = (tilt @ sensor.extrinsics).tolist()
        text = text.replace(word, f"{{matrix: {rows}}}")
    Path("guess.yaml").write_text(text, encoding="utf-8")
    outcome = shell(f"calibrate {DRIVE} --rig guess.yaml --json")
    assert outcome.code == 0
    found = re.search(
        r"left: its IMU finds the vertical ([\d.]+) degrees off .*rotation_rpy_deg: \[(.*)\]",
        json.loads(outcome.out)["level"],
    )
    assert found
    assert float(found[1]) == pytest.approx(10.0, abs=0.5)
    # Its IMU is off by 0.3 degrees.
    assert [float(angle) for angle in found[2].split(",")] == pytest.approx([0, 10, 80], abs=0.5)
    _guess()
    assert json.loads(shell(f"calibrate {DRIVE} --rig guess.yaml --json").out)["level"] == ""


def test_an_imu_says_how_its_lidar_lies_where_no_pose_is_known() -> None:
    """As in a calibration by motion: the pitch of 10 degrees is seen at the body's origin."""
    job = Job((DRIVE,), SensorSelection(identity_extrinsics=True))
    setup = Conversion(job).session.setup
    seen = {one.name: up for one, up in ups(setup.sampler, setup.router, setup.sensors)}
    (up,) = (up for name, up in seen.items() if "left" in name)
    pitch_deg = np.rad2deg(np.arctan2(-up[0], up[2]))
    assert pitch_deg == pytest.approx(10.0, abs=0.5)
