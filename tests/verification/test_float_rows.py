"""Folders of kitti and nuscenes: damage is found as far as rows without a header show it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mlbatch.verification import verify
from tests.builders.verify_outputs import (
    Case,
    Edit,
    cases,
    check_case,
    copied,
    raw,
    removed,
    renamed,
    row,
    text,
)


def value(name: str, columns: int, place: tuple[int, int], number: float) -> Edit:
    """Put a number into a row."""

    def change(data: bytearray) -> bytearray:
        np.frombuffer(data, "<f4").reshape(-1, columns)[place] = number
        return data

    return raw(name, change)


BIN = "000001.bin"
KITTI: dict[str, Case] = {
    "name": (renamed(BIN, "000007.bin"), "index", "000007.bin index"),
    "name that is none": (renamed(BIN, "x.bin"), "names", "x.bin"),
    "start": (text("times.txt", "100000000\n", "100000001\n"), "grid", "start_ns"),
    "times of another number": (raw("times.txt", lambda data: data[:-21]), "container", BIN),
    "cut off": (raw(BIN, lambda data: data[:-7]), "container", BIN),
    "no number": (value(BIN, 4, (8, 0), np.nan), "finite", "000001.bin point 8"),
    "points of a line": (row(2, "points", 1), "table", "line 4 points"),
    "point missing": (raw(BIN, lambda data: data[:-16]), "table", "points"),
}
SPLIT: dict[str, Case] = {
    "folder": (renamed("left", "other"), "names", "other/"),
    "slice": (renamed("right/000001-1.bin", "right/000001-7.bin"), "index", "000001-7.bin index"),
}
SWEEP = "000001.pcd.bin"
TIMES = "000001.time.bin"
NUSCENES: dict[str, Case] = {
    "name": (renamed(SWEEP, "000007.pcd.bin"), "container", "000007.pcd.bin"),
    "no times": (removed(TIMES), "container", SWEEP),
    "times cut off": (raw(TIMES, lambda data: data[:-8]), "container", SWEEP),
    "cut off": (raw(SWEEP, lambda data: data[:-7]), "container", SWEEP),
    "no number": (value(SWEEP, 5, (8, 2), np.inf), "finite", "000001.pcd.bin point 8"),
    "ring that is no whole number": (value(SWEEP, 5, (8, 4), 0.5), "rings", "point 8"),
    "ring that is none": (value(SWEEP, 5, (8, 4), 90), "rings", "000001.pcd.bin point"),
    "time that is none": (value(TIMES, 2, (8, 0), np.nan), "times", "000001.pcd.bin point 8"),
    "time past the scan": (value(TIMES, 2, (8, 0), 0.1011), "times", "000001.pcd.bin point 8"),
    "time that steps back": (value(TIMES, 2, (-1, 0), 0.05), "order", "000001.pcd.bin point"),
    "sensor": (value(TIMES, 2, (8, 1), 5), "sensors", "000001.pcd.bin point 8"),
    "sensor that is no whole number": (value(TIMES, 2, (8, 1), -1), "sensors", "point 8"),
}


@pytest.mark.parametrize(
    ("kind", "case"), cases({"kitti": KITTI, "kitti-split": SPLIT, "nuscenes": NUSCENES})
)
def test_damage_is_found(kind: str, case: Case, tmp_path: Path) -> None:
    check_case(kind, case, tmp_path)


@pytest.mark.parametrize("kind", ["kitti", "nuscenes"])
def test_without_a_report_the_grid_is_unknown(kind: str, tmp_path: Path) -> None:
    folder = copied(kind, tmp_path)
    (folder / "report.json").unlink()
    verdict = verify(folder)
    assert verdict.ok
    outcomes = {check.name: check.outcome for check in verdict.checks}
    assert outcomes["grid"] == outcomes["report"] == "not checkable"
