"""`mlbatch convert --fault`: IMU packets, seeds, warnings; every kind of fault: `tests/matrix`."""

from __future__ import annotations

from typing import Any

from tests.builders.sessions import FIX, Report, Shell

IMU = 85


def _report(shell: Shell, *faults: str, more: str = "") -> Report:
    options = " ".join(f"--fault {fault}" for fault in faults)
    return shell.dry(f"{FIX} {options} {more}")


def _packets(report: Report) -> list[dict[str, Any]]:
    return [sensor["packets"] for sensor in report["sensors"]]


def test_without_faults_the_report_has_none(shell: Shell) -> None:
    assert "faults" not in _report(shell)


def test_copies_are_rejected_as_duplicates(shell: Shell) -> None:
    plain, report = _report(shell), _report(shell, "dup:*:20%")
    (fault,) = report["faults"]
    copies = sum(one["imu_packets"] - IMU for one in report["sensors"])
    again = [one["imu_samples"]["dropped"].get("duplicate", 0) for one in report["sensors"]]
    assert sum(again) == copies > 5
    copies += sum(one["rejected"]["duplicate"] for one in _packets(report))
    assert copies == fault["packets"] > 50
    assert report["scans"] == plain["scans"]
    assert report["warnings"] == []


def test_the_seed_chooses_the_packets(shell: Shell) -> None:
    first, second = (_report(shell, "drop:*:30%", more=f"--fault-seed {n}") for n in (0, 1))
    again = _report(shell, "drop:*:30%")
    assert _packets(first) == _packets(again) != _packets(second)


def test_many_late_columns_give_a_warning(shell: Shell) -> None:
    report = _report(shell, "delay:left:300ms", more="--max-wait 0.1")
    left, right = report["sensors"]
    late = left["columns"]["dropped"]["late"]
    decoded = left["columns"]["decoded"]
    assert late > decoded / 2
    (warning,) = [one for one in report["warnings"] if one["code"] == "late"]
    assert warning["message"].startswith(f"left: {late} of {decoded} columns")
    assert "late" not in right["columns"]["dropped"]
