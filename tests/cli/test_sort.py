"""`--sort points`: points by time, then in the order of their columns."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import mlbatch
from mlbatch.errors import UsageError
from tests.builders.sessions import CAPTURE, REPOSITORY, RIG, Shell, arrays, names, report_of

WORDS = f"convert {CAPTURE} --rig {RIG} -q"
# Four vendors; columns last up to 55 us, so that points step back between lidars.
FOUR = REPOSITORY / "fixtures" / "four_makers"
MIXED = f"convert {FOUR / 'four_makers.pcap'} --rig {FOUR / 'rig.yaml'} -q"
POINT_KEYS = ("xyz", "intensity", "range_m", "time_ns", "ring", "return_type", "lidar_id")


@pytest.mark.parametrize("words", [WORDS, MIXED])
def test_the_same_points_by_time(shell: Shell, words: str) -> None:
    assert shell(f"{words} -o columns").code == 0
    assert shell(f"{words} -o points --sort points --jobs 2").code == 0
    steps_back = 0
    for name in names("columns"):
        old = arrays(f"columns/{name}")
        new = arrays(f"points/{name}")
        # Python's sort is stable: equal times stay in the order of columns.
        order = sorted(range(len(old["time_ns"])), key=old["time_ns"].tolist().__getitem__)
        for key in (*POINT_KEYS, "column"):
            np.testing.assert_array_equal(new[key], old[key][order], err_msg=key)
        for key in ("column_stamp_ns", "column_lidar_id", "fill", "complete"):
            np.testing.assert_array_equal(new[key], old[key])
        assert (str(old["sort"]), str(new["sort"])) == ("columns", "points")
        assert int(new["time_ns"][-1]) == int(old["time_ns"].max())
        steps_back += int((np.diff(old["time_ns"].astype(np.int64)) < 0).sum())
    assert (steps_back > 0) == (words == MIXED)
    assert report_of("points/report.json")["grid"]["sort"] == "points"
    assert shell("verify points").code == 0


@pytest.mark.parametrize(
    "output", ["out.mcap", "out --format ply", "out.bag", "out --format rosbag2", "out --split"]
)
def test_every_format_can_be_checked(shell: Shell, output: str) -> None:
    assert shell(f"{WORDS} -o {output} --sort points --slices 3").code == 0
    verified = shell(f"verify {output.split()[0]}")
    assert verified.code == 0, verified.out


def test_points_in_python_are_sorted_as_well() -> None:
    for scan in mlbatch.scans(CAPTURE, rig=RIG, sort="points"):
        assert (np.diff(scan.time_ns.astype(np.int64)) >= 0).all()
        stamps = scan.column_stamp_ns[scan.column] - scan.start_ns
        assert (scan.time_ns >= stamps).all()
    with pytest.raises(UsageError, match="sort: expected columns or points, found 'time'"):
        next(iter(mlbatch.scans(CAPTURE, sort="time")))


def test_unsorted_points_that_claim_to_be_sorted_are_found(shell: Shell) -> None:
    assert shell(f"{WORDS} -o out --sort points").code == 0
    scan = arrays("out/000002.npz")
    for key in (*POINT_KEYS, "column"):
        scan[key] = scan[key][::-1]
    values: dict[str, Any] = scan
    np.savez("out/000002.npz", **values)
    outcome = shell("verify out")
    assert (outcome.code, "points by time, then column, then ring" in outcome.out) == (1, True)
