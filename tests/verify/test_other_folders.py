"""Organized scans, slices, and folders of single sensors: what breaks a rule is found."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.builders.outputs import (
    Edit,
    Values,
    arrays,
    at,
    both,
    forget,
    found,
    npz,
    plus,
    removed,
    renamed,
    spoiled_places,
)

ONE = "000001.npz"
PERIOD_NS = 100_000_000


@pytest.fixture(scope="module", autouse=True)
def _clean() -> Iterator[None]:
    yield
    forget()


def empty_slot(key: str, value: float) -> Edit:
    """A value where an organized scan has no point."""

    def change(scan: dict[str, Values]) -> None:
        empty = np.isnan(scan["xyz"]).all(axis=2)
        place = tuple(np.argwhere(empty)[5])
        scan[key][place] = value

    return arrays(ONE, change)


def valid_slot(key: str, value: float) -> Edit:
    """A value where an organized scan has a point."""

    def change(scan: dict[str, Values]) -> None:
        place = tuple(np.argwhere(np.isfinite(scan["range_m"]))[5])
        scan[key][place] = value

    return arrays(ONE, change)


def half_a_place(scan: dict[str, Values]) -> None:
    column, slot = np.argwhere(np.isfinite(scan["range_m"]))[5]
    scan["xyz"][column, slot, 1] = np.nan


ORGANIZED: dict[str, tuple[Edit, str, str]] = {
    "range in an empty slot": (empty_slot("range_m", 1.0), "finite", "slot"),
    "intensity in an empty slot": (empty_slot("intensity", 1.0), "finite", "slot"),
    "time in an empty slot": (empty_slot("time_ns", 1), "finite", "slot"),
    "ring in an empty slot": (empty_slot("ring", 1), "finite", "slot"),
    "return in an empty slot": (empty_slot("return_type", 1), "finite", "slot"),
    "no place": (valid_slot("xyz", np.nan), "finite", "slot"),
    "half a place": (arrays(ONE, half_a_place), "finite", "slot"),
    "no range": (valid_slot("range_m", np.nan), "finite", "slot"),
    "sensor of a slot": (empty_slot("lidar_id", 1), "sensors", "slot"),
    "time of a slot": (valid_slot("time_ns", 50_000_000), "times", "slot"),
    "rows missing": (npz(ONE, "ring", lambda v: v[:-1]), "layout", "ring"),
    "column past the window": (
        npz(ONE, "column_stamp_ns", plus(-1, PERIOD_NS)),
        "columns",
        "column 1023",
    ),
}


@pytest.mark.parametrize("name", ORGANIZED)
def test_organized(name: str, tmp_path: Path) -> None:
    edit, check, where = ORGANIZED[name]
    places = spoiled_places("npz-organized", tmp_path, edit)
    found(places, check, where)


def moved_to_other_sensor(folder: Path) -> None:
    (folder / "left" / ONE).rename(folder / "left" / "x.npz")
    shutil.copy(folder / "right" / ONE, folder / "left" / ONE)
    (folder / "left" / "x.npz").unlink()


SPLIT: dict[str, tuple[Edit, str, str]] = {
    "scan of the other sensor": (moved_to_other_sensor, "sensors", "left/000001.npz"),
    "folder of no sensor": (renamed("left", "middle"), "names", "middle/"),
    "scan missing": (removed(f"left/{ONE}"), "table", "line 4 points"),
    "scan outside the folders": (renamed(f"left/{ONE}", ONE), "names", "left/"),
}


@pytest.mark.parametrize("name", SPLIT)
def test_split(name: str, tmp_path: Path) -> None:
    edit, check, where = SPLIT[name]
    found(spoiled_places("npz-split", tmp_path, edit), check, where)


SLICES: dict[str, tuple[Edit, str, str]] = {
    "slice missing": (removed("000001-1.npz"), "table", "scan"),
    "slices swapped": (
        both(
            renamed("000001-1.npz", "x"),
            renamed("000001-2.npz", "000001-1.npz"),
            renamed("x", "000001-2.npz"),
        ),
        "names",
        "000001-",
    ),
    "slice past the window": (npz("000001-2.npz", "slice", at((), 3)), "index", "000001-2.npz"),
    "bound of a slice": (npz("000001-1.npz", "start_ns", plus((), 1)), "grid", "000001-1.npz"),
}


@pytest.mark.parametrize("name", SLICES)
def test_slices(name: str, tmp_path: Path) -> None:
    edit, check, where = SLICES[name]
    found(spoiled_places("npz-slices", tmp_path, edit), check, where)
