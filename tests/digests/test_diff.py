"""`mlbatch diff`: the first difference, how large differences are, scans of one output only."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import mlbatch
from mlbatch.digests.diff import diff
from tests.builders.run import ROOT, command
from tests.digests.test_digest import FORMATS, MOVED, convert, other_rig
from tests.verification.edits import edit_of

# All points but that of number 100.
WITHOUT_100 = '"v[[*range(100),*range(101,len(v))]]"'
POINTS = (
    *("xyz", "intensity", "reflectivity", "range_m", "time_ns", "ring", "return_type"),
    *("lidar_id", "column"),
)


def changed(folder: Path, edit: str) -> tuple[Path, Path]:
    """An output, and a copy with an edit (tests/verification/edits.py)."""
    a = convert(folder / "a", "npz")
    b = folder / "b"
    shutil.copytree(a, b)
    edit_of(edit)(b)
    return a, b


@pytest.mark.parametrize("kind", FORMATS)
def test_an_output_is_the_same_as_itself(kind: str, tmp_path: Path) -> None:
    output = convert(tmp_path, kind)
    found = diff(output, output)
    assert found.same
    # The tail has 354 of 512 columns (SOURCE.md): its first half is a slice.
    assert found.compared == {"split": 14, "mcap split": 2 * (2 * 7 + 1)}.get(kind, 7)


def test_formats_are_compared_in_what_both_store(tmp_path: Path) -> None:
    npz = convert(tmp_path / "a", "npz")
    mcap = convert(tmp_path / "b", "mcap")
    found = diff(npz, mcap)
    # float32 seconds are up to 8 ns early: docs/python.md.
    assert list(found.fields) == ["time_ns"]
    assert found.fields["time_ns"].by is not None
    assert 0 < found.fields["time_ns"].by <= 8
    assert {one.where.split(".")[-1] for one in found.run} <= {"no_place", "dropped", "written"}


def test_scans_of_sensors_meet_in_folders_and_files(tmp_path: Path) -> None:
    folder = convert(tmp_path / "a", "split")
    file = convert(tmp_path / "b", "mcap", "--split")
    found = diff(folder, file)
    assert (found.compared, found.only_in_a, found.only_in_b) == (14, [], [])
    assert list(found.fields) == ["time_ns"]


def test_the_first_difference_and_the_largest(tmp_path: Path) -> None:
    edits = (
        "add 000002.npz xyz (5,1) 0.5; add 000002.npz ring 7 3",
        "add 000004.npz xyz (2,2) 2.0; add 000004.npz xyz (3,2) 2.0",
    )
    a, b = changed(tmp_path, "; ".join(edits))
    found = diff(a, b)
    assert (found.run, found.only_in_a, found.only_in_b, found.compared) == ([], [], [], 7)
    first = found.first
    assert first is not None
    assert (first.scan, first.field, first.point) == ("000002", "xyz", 5)
    assert first.by == pytest.approx(2.0, abs=1e-6)
    assert (first.scans, first.values) == (2, 3)
    ring = found.fields["ring"]
    assert (ring.point, ring.by, ring.scans, ring.values) == (7, 3.0, 1, 1)
    assert isinstance(ring.a, int)
    assert isinstance(ring.b, int)
    assert ring.b - ring.a == 3
    # Of integers there is no tolerance.
    assert list(diff(a, b, tolerance=3).fields) == ["ring"]


@pytest.mark.parametrize(("tolerance", "is_found"), [(0.4, True), (0.6, False)])
def test_a_tolerance_holds_for_each_point(tolerance: float, is_found: bool, tmp_path: Path) -> None:
    """A point moved by 0.5 m, and a pair whose sum is 0."""
    pair = "add 000004.npz xyz (6000,2) 0.5; add 000004.npz xyz (6001,2) -0.5"
    a, b = changed(tmp_path, f"add 000002.npz xyz (5000,2) 0.5; {pair}")
    words = ("diff", a, b, "--tolerance", str(tolerance))
    assert command(*words).code == int(is_found)
    found = diff(a, b, tolerance)
    assert {name: one.values for name, one in found.fields.items()} == (
        {"xyz": 3} if is_found else {}
    )


def test_stamps_are_compared_to_the_nanosecond(tmp_path: Path) -> None:
    a, b = changed(tmp_path, "add 000000.npz column_stamp_ns 9 1")
    found = diff(a, b)
    assert [(one.field, one.point, one.by) for one in found.fields.values()] == [
        ("column_stamp_ns", 9, 1.0)
    ]


def test_a_missing_point_is_the_first_difference(tmp_path: Path) -> None:
    a, b = changed(tmp_path, "; ".join(f"be 000003.npz {n} {WITHOUT_100}" for n in POINTS))
    found = diff(a, b).fields
    assert set(found) == {*POINTS}
    first = found["intensity"]
    assert (first.scan, first.a, first.b, first.by) == ("000003", [27998], [27997], None)
    assert first.point is not None
    with np.load(a / "000003.npz") as scan:
        values = scan["intensity"]
    # The first of equal neighbours cannot be distinguished from the next.
    assert first.point >= 100
    assert (values[100 : first.point + 1] == values[100]).all()
    assert values[first.point + 1] != values[100]


@pytest.mark.parametrize("kind", ["npz", "mcap"])
def test_scans_of_one_output_only(kind: str, tmp_path: Path) -> None:
    whole = convert(tmp_path / "a", kind)
    part = convert(tmp_path / "b", kind, "--start", "+0.3")
    found = diff(whole, part)
    assert found.only_in_a == ["000000", "000001", "000002"]
    assert (found.only_in_b, found.compared, found.fields) == ([], 4, {})
    assert diff(part, whole).only_in_b == found.only_in_a


def test_the_command_prints_what_differs(tmp_path: Path) -> None:
    a = convert(tmp_path / "a", "mcap")
    b = convert(tmp_path / "b", "mcap", rig=other_rig(tmp_path, MOVED))
    found = command("diff", a, b)
    assert found.code == 1
    lines = found.out.splitlines()
    assert lines[0] == "sensors[0].body_from_sensor[1][3]: 0.95 in A, 0.9501 in B"
    assert lines[1].startswith("first difference: scan 000000, xyz, point ")
    assert lines[-1].split()[:2] == ["xyz", "7"]
    assert float(lines[-1].split()[-1]) == pytest.approx(0.0001, abs=2e-6)
    assert len(found.err.splitlines()) == 1
    assert command("diff", a, a).out == "the same: 7 scans\n"


def test_stamps_of_messages_are_compared(tmp_path: Path) -> None:
    """The same points at other header stamps are other messages."""
    usual = convert(tmp_path / "a", "mcap")
    late = convert(tmp_path / "b", "mcap", "--stamp", "end")
    found = diff(usual, late)
    assert [(one.where, one.expected, one.found) for one in found.run] == [
        ("grid.stamp", None, "end"),
    ]
    assert not found.same


def test_windows_meet_whatever_their_numbers(tmp_path: Path) -> None:
    """A piece of a recording has the scans of the whole one, numbered from its own start."""
    fixture = ROOT / "fixtures" / "two_lidars"
    rig = fixture / "rig.yaml"
    recording = fixture / "two_lidars.pcap"
    piece = tmp_path / "piece.pcap"
    mlbatch.extract(recording, piece, rig=rig, start="+0.2s", duration=0.4)
    for name, source in (("whole", recording), ("part", piece)):
        mlbatch.convert(source, tmp_path / name, rig=rig, rate=20)
    found = diff(tmp_path / "whole", tmp_path / "part")
    count = len(list(mlbatch.read(tmp_path / "part")))
    assert count > 4
    assert (found.compared, found.only_in_b, found.fields) == (count, [], {})
    total = len(list(mlbatch.read(tmp_path / "whole")))
    assert len(found.only_in_a) == total - count
