"""Folders of LAS and LAZ files: every damage is found, and named with its place."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.builders.verify_outputs import Case, Edit, cases, check_case, raw, renamed, text

laspy = pytest.importorskip("laspy")
pytest.importorskip("lazrs")


def dimension(name: str, field: str, place: int, value: float) -> Edit:
    """Put a value into a point, by laspy."""

    def edit(folder: Path) -> None:
        las: Any = laspy.read(folder / name)
        values = las[field].copy()
        values[place] = value
        las[field] = values
        las.write(folder / name)

    return edit


def scaled(name: str) -> Edit:
    """Other steps of the coordinates."""

    def edit(folder: Path) -> None:
        las: Any = laspy.read(folder / name)
        las.change_scaling(scales=[0.001] * 3)
        las.write(folder / name)

    return edit


def without_comments(name: str) -> Edit:
    """Remove the record of mlbatch."""

    def edit(folder: Path) -> None:
        las: Any = laspy.read(folder / name)
        kept = [vlr for vlr in las.header.vlrs if vlr.user_id != "mlbatch"]
        las.header.vlrs = laspy.vlrs.vlrlist.VLRList(kept)
        las.write(folder / name)

    return edit


def of(suffix: str) -> dict[str, Case]:
    """The cases of a format."""
    one = f"000001.{suffix}"

    def change(field: str, place: int, value: float) -> Edit:
        return dimension(one, field, place, value)

    return {
        "start": (text(one, "200000000\nend", "200000007\nend"), "grid", "start_ns"),
        "index": (text(one, "index 1", "index 2"), "index", f"{one} index"),
        "name": (renamed(one, f"000007.{suffix}"), "names", f"000007.{suffix}"),
        "incomplete": (text(one, "complete true", "complete yess"), "container", one),
        "rate": (text(one, "rate_hz 10", "rate_hz 20"), "metadata", f"{one} rate"),
        "no comments": (without_comments(one), "container", one),
        "scale": (scaled(one), "container", one),
        "cut off": (raw(one, lambda data: data[: len(data) // 2]), "container", one),
        "empty": (raw(one, lambda data: b""), "container", one),
        "time": (change("time_ns", 8, 101_200_000), "times", "gps_time of point 8"),
        "gps time": (change("gps_time", 8, 0.5), "times", "gps_time of point 8"),
        "time that steps back": (change("time_ns", -1, 50_000_000), "order", f"{one} point"),
        "ring that is none": (change("ring", 8, 90), "rings", f"{one} point"),
        "return type": (change("return_type", 8, 99), "returns", f"{one} point 8"),
        "return number": (change("return_number", 8, 3), "returns", "return_number of point 8"),
        "returns": (change("number_of_returns", 8, 3), "returns", "number_of_returns of point 8"),
        "sensor": (change("point_source_id", 8, 6), "sensors", f"{one} point 8"),
        "no sensor": (change("point_source_id", 8, 0), "sensors", "point_source_id of point 8"),
        "intensity": (change("intensity", 8, 65000), "layout", "intensity of point 8"),
    }


@pytest.mark.parametrize(("kind", "case"), cases({"las": of("las"), "laz": {}}))
def test_damage_is_found(kind: str, case: Case, tmp_path: Path) -> None:
    check_case(kind, case, tmp_path)


# Bytes in the middle of a compressed file are no text: only what stays readable.
LAZ = {name: of("laz")[name] for name in ("start", "name", "rate", "cut off", "gps time", "sensor")}


@pytest.mark.parametrize(("kind", "case"), cases({"laz": LAZ}))
def test_damage_of_compressed_files_is_found(kind: str, case: Case, tmp_path: Path) -> None:
    check_case(kind, case, tmp_path)
