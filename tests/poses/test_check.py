"""The check of poses in a run: a rig with a known error, and what is said about it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import mlbatch
from mlbatch.reports.poses import (
    EXCHANGED,
    MEASURED,
    MISFIT,
    NOT_ASKED,
    NOT_CHECKED,
    OFF,
    ONE_LIDAR,
    RADIANS,
    PairFigures,
    PoseFigures,
)
from mlbatch.reports.report import RunReport
from tests.builders.run import command
from tests.contract.tree import ROOT

FIXTURE = ROOT / "fixtures" / "two_lidars"
RIG = FIXTURE / "rig.yaml"
CAPTURE = FIXTURE / "two_lidars.pcap"
Sensors = list[dict[str, Any]]


def rig_with(change: Callable[[Sensors], None], folder: Path) -> Path:
    """The true rig with other extrinsics."""
    rig = yaml.safe_load((RIG).read_text())
    for sensor in rig["sensors"]:
        sensor["metadata"] = str(FIXTURE / sensor["metadata"])
    change([sensor["extrinsics"] for sensor in rig["sensors"]])
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(rig))
    return path


def checked(rig: Path, **options: Any) -> tuple[PoseFigures, list[str]]:
    """Figures of a run, and the codes of its warnings."""
    report = mlbatch.convert(CAPTURE, None, rig=rig, **options).report
    assert report.content.poses is not None
    return report.content.poses, [one.code for one in report.content.warnings]


def moved(key: str, axis: int, by: float) -> Callable[[Sensors], None]:
    def change(extrinsics: Sensors) -> None:
        extrinsics[1][key][axis] += by

    return change


def test_a_true_rig_fits() -> None:
    poses, warnings = checked(RIG)
    (pair,) = poses.pairs
    assert (pair.lidars, pair.outcome, pair.undetermined) == (("left", "right"), MEASURED, ())
    assert pair.shift_mm is not None
    assert pair.shift_mm < 3
    assert pair.turn_deg is not None
    assert pair.turn_deg < 0.03
    assert warnings == []


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(
    ("key", "by", "shift_mm", "turn_deg"),
    [("translation_m", 0.05, 50, 0), ("rotation_rpy_deg", 0.5, 0, 0.5)],
)
def test_a_rig_that_is_off_is_found(
    key: str, by: float, shift_mm: float, turn_deg: float, axis: int, tmp_path: Path
) -> None:
    poses, warnings = checked(rig_with(moved(key, axis, by), tmp_path))
    (pair,) = poses.pairs
    assert (pair.outcome, warnings) == (OFF, ["pose"])
    assert pair.shift_mm == pytest.approx(shift_mm, abs=3)
    # Roll, pitch and yaw of the rig are each a turn by as much about some axis.
    assert pair.turn_deg == pytest.approx(turn_deg, abs=0.03)


def test_errors_below_the_limits_are_measured_without_a_warning(tmp_path: Path) -> None:
    poses, warnings = checked(rig_with(moved("translation_m", 1, 0.02), tmp_path))
    assert (poses.pairs[0].outcome, warnings) == (MEASURED, [])
    assert poses.pairs[0].shift_mm == pytest.approx(20, abs=3)


def swap(extrinsics: Sensors) -> None:
    left = dict(extrinsics[0])
    extrinsics[0] |= extrinsics[1]
    extrinsics[1] |= left


def millimetres(extrinsics: Sensors) -> None:
    for one in extrinsics:
        one["translation_m"] = [1000 * value for value in one["translation_m"]]


def radians(extrinsics: Sensors) -> None:
    for one in extrinsics:
        one["rotation_rpy_deg"] = np.round(np.deg2rad(one["rotation_rpy_deg"]), 5).tolist()


def identity(extrinsics: Sensors) -> None:
    for one in extrinsics:
        one |= {"translation_m": [0, 0, 0], "rotation_rpy_deg": [0, 0, 0]}


@pytest.mark.parametrize(
    ("mistake", "outcomes", "fits_with", "code", "words"),
    [
        (swap, (OFF, MISFIT), EXCHANGED, "pose", "names swapped?"),
        (radians, (OFF, MISFIT), RADIANS, "pose", "write degrees"),
        (millimetres, (NOT_CHECKED,), "", "far_pose", "as millimetres this would be"),
        (identity, (MISFIT,), "", "same_pose", "expected a pose of its own"),
    ],
)
def test_usual_mistakes_are_named(
    mistake: Callable[[Sensors], None],
    outcomes: tuple[str, ...],
    fits_with: str,
    code: str,
    words: str,
    tmp_path: Path,
) -> None:
    report = mlbatch.convert(CAPTURE, None, rig=rig_with(mistake, tmp_path)).report.content
    assert report.poses is not None
    (pair,) = report.poses.pairs
    assert pair.outcome in outcomes
    assert pair.fits_with == fits_with
    assert any(one.code == code and words in one.message for one in report.warnings)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"no_pose_check": True}, NOT_ASKED),
        ({"only": "left"}, ONE_LIDAR),
        ({"end": "+0.15s"}, "fewer than three windows"),
    ],
)
def test_the_reason_why_nothing_was_compared(options: dict[str, Any], reason: str) -> None:
    poses, warnings = checked(RIG, **options)
    assert (poses, warnings) == (PoseFigures(reason), [])
    assert poses.describe() == f"poses: not checked ({reason})"


def test_one_place_alone_proves_nothing(tmp_path: Path) -> None:
    poses, warnings = checked(rig_with(moved("translation_m", 1, 0.06), tmp_path), end="+0.3s")
    assert (poses.pairs[0].outcome, warnings) == (NOT_CHECKED, [])
    assert "one place alone" in poses.describe()


def test_lidars_without_common_surfaces_are_not_checked(tmp_path: Path) -> None:
    poses, warnings = checked(
        rig_with(lambda extrinsics: extrinsics[1]["translation_m"].__setitem__(0, 90.0), tmp_path)
    )
    assert poses.pairs[0].outcome == NOT_CHECKED
    assert warnings == ["far_pose"]
    assert poses.describe() == "poses: not checked, since the lidars see nothing in common"


@pytest.mark.parametrize("fault", ["drop:*:5%", "bitflip:*:1%", "reorder:*:3%", "dup:*:2%"])
def test_damage_is_no_wrong_pose(fault: str, tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    command("convert", CAPTURE, "--rig", RIG, "--dry-run", "--fault", fault, "--report", path)
    report = RunReport.from_json(json.loads(path.read_text()))
    assert report.poses is not None
    assert report.poses.pairs[0].outcome == MEASURED
    assert "pose" not in [one.code for one in report.warnings]


def test_the_check_is_that_of_the_recording(tmp_path: Path) -> None:
    """Of any number of jobs, of shards, and as read from the report."""
    expected, _ = checked(RIG, jobs=1)
    assert checked(RIG, jobs=2)[0] == expected
    words = ("convert", CAPTURE, "--rig", RIG, "--format", "npz", "-q")
    for number in (1, 2):
        command(*words, "-o", tmp_path / f"part{number}", "--shard", f"{number}/2")
    parts = (tmp_path / "part1", tmp_path / "part2")
    command("merge", *parts, "-o", tmp_path / "out", "-q")
    merged = RunReport.from_json(json.loads((tmp_path / "out" / "report.json").read_text()))
    assert merged.poses == expected


def test_slices_show_what_windows_show() -> None:
    whole, _ = checked(RIG)
    sliced, _ = checked(RIG, slices=3)
    assert sliced.pairs[0].outcome == MEASURED
    assert sliced.pairs[0].surfaces == pytest.approx(whole.pairs[0].surfaces, rel=0.1)


def test_fail_on_sees_the_check(tmp_path: Path) -> None:
    rig = rig_with(moved("translation_m", 1, 0.06), tmp_path)
    words = ("convert", CAPTURE, "--rig", rig, "--dry-run", "-q", "--report", tmp_path / "r.json")
    assert command(*words, "--fail-on", "pose>5cm").code == 3
    assert command(*words, "--fail-on", "pose>7cm").code == 0


PAIR = PairFigures(("left", "right"), MEASURED, "", 3, 90, 41.2, 100.0, 6.0, 1.0, 0.04, 0.005)


@pytest.mark.parametrize(
    ("pair", "text"),
    [
        (
            PAIR,
            "left and right have 41 % of their surfaces in common; they agree within 8 mm, "
            "0.05 degrees",
        ),
        (
            PAIR._replace(outcome=OFF, shift_mm=31.0, turn_deg=0.4),
            "left and right have 41 % of their surfaces in common; double walls: right is 31 mm / "
            "0.40 degrees off",
        ),
        (
            PAIR._replace(shift_mm=17.0, turn_deg=0.5, turn_deviation_deg=0.08),
            "left and right have 41 % of their surfaces in common; they are not "
            "significantly apart: 17 mm (standard deviation 1 mm) / 0.50 degrees "
            "(standard deviation 0.08)",
        ),
        (
            PAIR._replace(shift_mm=None, undetermined=("shift along x",)),
            "left and right have 41 % of their surfaces in common; they agree within 0.05 degrees "
            "(this check does not determine: shift along x)",
        ),
        (
            PairFigures(("left", "right"), NOT_CHECKED, "the lidars see nothing in common"),
            "left and right: not checked, since the lidars see nothing in common",
        ),
    ],
)
def test_a_pair_in_words(pair: PairFigures, text: str) -> None:
    assert pair.describe() == text


def test_a_verdict_says_what_it_covers() -> None:
    other = PairFigures(("left", "rear"), NOT_CHECKED, "the lidars see nothing in common")
    assert PoseFigures(pairs=(PAIR, other)).describe() == (
        "surfaces agree within 8 mm, 0.05 degrees, of 1 of 2 pairs of lidars"
    )
    open_pair = PAIR._replace(turn_deg=0.29)
    assert PoseFigures(pairs=(PAIR, open_pair)).describe() == (
        "surfaces agree within 8 mm, 0.30 degrees"
    )
    open_pair = PAIR._replace(turn_deg=0.3)
    assert PoseFigures(pairs=(PAIR, open_pair)).describe() == (
        "poses: neither confirmed nor refuted"
    )


def test_inspect_shows_the_check() -> None:
    shown = command("inspect", CAPTURE, "--rig", RIG, "--json")
    (pair,) = json.loads(shown.out)["poses"]["pairs"]
    assert pair["outcome"] == MEASURED
    text = command("inspect", CAPTURE, "--rig", RIG).out
    assert "\nposes: left and right have " in text
