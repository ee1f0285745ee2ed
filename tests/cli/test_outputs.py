"""What the options of `mlbatch convert` do to its output, its report and its ledger."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mlbatch
from tests.builders.mcaps import write_mcap
from tests.builders.run import command
from tests.builders.sessions import (
    FIX,
    FIXTURE,
    NS_PER_S,
    Report,
    Shell,
    Unit,
    arrays,
    report_of,
    twin,
    write_session,
)
from tests.builders.sessions_of_bags import unit_messages
from tests.builders.transcripts import transcripts

CASES = transcripts("outputs", FIX="fix/two_lidars.pcap --rig fix/rig.yaml")
POINTS = 27998


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the fixture, and its conversion."""
    folder = tmp_path_factory.mktemp("outputs")
    (folder / "fix").symlink_to(FIXTURE)
    assert command("convert", *FIX.split(), "-o", folder / "whole", "-q").code == 0
    return folder


@pytest.mark.parametrize("name", CASES)
def test_transcript(shell: Shell, place: Path, tmp_path: Path, name: str) -> None:
    CASES[name].check_with(place, shell, tmp_path)


def _ledger_balances(report: Report) -> None:
    """Every datagram is in a sensor's packets, its IMU packets or unassigned."""
    capture = report["capture"]
    assert capture["frames"] == capture["datagrams"] + sum(capture["skipped"].values())
    unassigned = sum(row["packets"] for row in report["unassigned"])
    own = sum(s["packets"]["read"] + s["imu_packets"] for s in report["sensors"])
    assert capture["datagrams"] == own + unassigned
    for sensor in report["sensors"]:
        packets = sensor["packets"]
        columns = sensor["columns"]
        points = sensor["points"]
        assert packets["read"] == packets["accepted"] + sum(packets["rejected"].values())
        assert columns["decoded"] == columns["written"] + sum(columns["dropped"].values())
        assert points["slots"] == sum(points.values()) - points["slots"]


def test_an_end_stops_the_reading(shell: Shell, tmp_path: Path) -> None:
    """Of 90 s in two files the end is in the first, whose buffer has some 30 s."""
    first = Unit(turns=450)
    second = replace(first, begin_ns=first.begin_ns + 45 * NS_PER_S, first_frame=455)
    one, two = write_session(tmp_path / "1", first), write_session(tmp_path / "2", second)
    report = shell.dry(f"{one} {two} --end +0.2")
    assert report["scans"]["written"] == 2
    assert 0 < report["capture"]["frames"] < 450 * 32
    _ledger_balances(report)


def test_an_end_balances_with_recordings_side_by_side(shell: Shell, tmp_path: Path) -> None:
    one = write_session(tmp_path / "1", Unit(turns=300))
    two = write_session(tmp_path / "2", twin(Unit(turns=450), 222))
    report = shell.dry(f"{one} {two} --end +0.2 --identity-extrinsics")
    assert report["scans"]["written"] == 2
    _ledger_balances(report)


def test_range_limits(shell: Shell) -> None:
    shell(f"convert {FIX} -o all")
    shell(f"convert {FIX} -o near --min-range 3 --max-range 6.5")
    whole, near = arrays("all/000003.npz"), arrays("near/000003.npz")
    inside = (whole["range_m"] >= 3) & (whole["range_m"] <= 6.5)
    assert 0 < np.count_nonzero(inside) < POINTS
    for key in ("xyz", "range_m", "intensity", "time_ns", "ring"):
        np.testing.assert_array_equal(near[key], whole[key][inside])
    before, after = report_of("all/report.json"), report_of("near/report.json")
    for old, new in zip(before["sensors"], after["sensors"], strict=True):
        fates = ("range", "box", "written")
        assert sum(new["points"][fate] for fate in fates) == sum(
            old["points"][fate] for fate in fates
        )
        assert (old["points"]["range"], new["points"]["slots"]) == (0, old["points"]["slots"])


def test_boxes_add_to_those_of_the_rig(shell: Shell) -> None:
    shell(f"convert {FIX} -o all")
    shell(f"convert {FIX} -o cut --exclude-box=0,-8,-1,20,8,9 --exclude-box=-20,0,-1,0,8,9")
    whole = arrays("all/000000.npz")["xyz"]
    cut = arrays("cut/000000.npz")["xyz"]
    x = whole[:, 0]
    y = whole[:, 1]
    np.testing.assert_array_equal(cut, whole[(x < 0) & (y < 0)])
    first, second = (report_of(f"{name}/report.json") for name in ("all", "cut"))
    # 763 returns of `left` a window hit the machine, none of `right` (SOURCE.md).
    assert [sensor["points"]["box"] for sensor in first["sensors"]] == [7 * 763, 0]
    assert all(sensor["points"]["box"] > 7 * 763 for sensor in second["sensors"])


def test_a_terminal_obeys_no_topic(shell: Shell, tmp_path: Path) -> None:
    write_mcap(tmp_path / "drive.mcap", unit_messages(Unit(turns=3), "a\x1b[31m\x07\n"))
    outcome = shell("convert drive.mcap -o out -v")
    assert outcome.code == 0, outcome.err
    assert outcome.out.startswith("ouster_111: ")
    assert r"calibration /a\x1b[31m\x07\n/ouster/metadata" in outcome.out


@pytest.mark.parametrize("suffix", ["ply", "npz", "pcd", "las"])
def test_the_only_scan_is_a_file(shell: Shell, place: Path, tmp_path: Path, suffix: str) -> None:
    one = tmp_path / f"one.{suffix}"
    line = f"convert {FIX} --start +0.2 --end +0.3 -o {one}"
    done = shell(line)
    assert done.code == 0
    assert done.out.splitlines()[-1].endswith(f"mlbatch view {one} plays the scans")
    files = {f"{one.name}{end}" for end in ("", ".report.json", ".scans.csv")}
    assert {path.name for path in tmp_path.iterdir()} == files
    (scan,) = mlbatch.read(one)
    third = list(mlbatch.read(place / "whole"))[2]
    assert (scan.index, scan.start_ns, scan.point_count) == (2, third.start_ns, third.point_count)
    # LAS stores whole tenths of a millimetre.
    np.testing.assert_allclose(scan.xyz, third.xyz, rtol=0, atol=0.51e-4)
    assert mlbatch.verify(one).ok
    assert (shell(line).code, shell(f"{line} --overwrite -q").out) == (1, "")
    again = mlbatch.convert(one, tmp_path / "again.mcap")
    assert again.report.scans.points == third.point_count
