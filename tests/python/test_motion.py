"""Deskewing, frame-level fusion and stamps from Python: the same as by the command."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mlbatch
from mlbatch.errors import UsageError
from tests.builders.run import ROOT, command

FOLDER = ROOT / "fixtures" / "two_lidars"
CAPTURE, RIG = FOLDER / "two_lidars.pcap", FOLDER / "rig.yaml"
# 08:00 UTC of the recording, a drive at 10 m/s along x.
TUM = "".join(
    f"{1_777_881_600 + hundredth // 100}.{hundredth % 100:02} {hundredth / 10} 0 0 0 0 0 1\n"
    for hundredth in range(-100, 300)
)


@pytest.fixture
def trajectory(tmp_path: Path) -> Path:
    path = tmp_path / "drive.tum"
    path.write_text(TUM, encoding="utf-8")
    return path


def test_points_move_with_the_machine(trajectory: Path) -> None:
    still = list(mlbatch.scans(CAPTURE, rig=RIG))
    rec = mlbatch.open(CAPTURE, rig=RIG)
    for instant, after_s in (("start", 0.0), ("middle", 0.05), ("end", 0.1)):
        moved = list(rec.scans(deskew=trajectory, deskew_to=instant))
        assert len(moved) == len(still) == 7
        for one, other in zip(still, moved, strict=True):
            # A point at a later time was measured from a place farther ahead.
            ahead_m = 10.0 * (one.time_s - after_s)
            np.testing.assert_allclose(other.xyz[:, 0], one.xyz[:, 0] + ahead_m, atol=2e-3)
            np.testing.assert_allclose(other.xyz[:, 1:], one.xyz[:, 1:], atol=1e-5)
            np.testing.assert_array_equal(other.time_s, one.time_s)


@pytest.mark.parametrize(
    "options",
    [
        {"deskew": "drive.tum", "deskew_to": "end"},
        {"batching": "latest", "batching_times": "own"},
        {"stamp": "middle"},
    ],
)
def test_outputs_are_those_of_the_command(
    options: dict[str, Any], trajectory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(trajectory.parent)
    words = [word for name, value in options.items() for word in (_option(name), value)]
    done = command("convert", CAPTURE, "--rig", RIG, "--quiet", "-o", "command.mcap", *words)
    assert done.code == 0, done.err
    mlbatch.convert(CAPTURE, "python.mcap", rig=RIG, **options)
    assert Path("python.mcap").read_bytes() == Path("command.mcap").read_bytes()


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


@pytest.mark.parametrize(
    "options",
    [
        {"deskew": "constant-velocity", "start": "+1"},
        {"deskew": "missing.tum"},
        {"deskew_to": "end"},
        {"deskew": "imu", "deskew_to": "later"},
        {"batching": "newest"},
        {"batching_times": "own"},
    ],
)
def test_mistakes_are_errors(options: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="expected"):
        next(mlbatch.scans(CAPTURE, rig=RIG, **options))


def test_files_have_no_stamp_but_their_start(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--stamp: expected start for npz"):
        mlbatch.convert(CAPTURE, tmp_path / "out", rig=RIG, stamp="end")
