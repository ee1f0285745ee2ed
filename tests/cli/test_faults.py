"""`mlbatch convert --fault`: what a fault does to a whole conversion."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.builders.sessions import FIXTURE, Shell

Report = dict[str, Any]
RECORDING = f"{FIXTURE / 'two_lidars.pcap'} --rig {FIXTURE / 'rig.yaml'}"
# Packets of the fixture (SOURCE.md).
LEFT = 271
RIGHT = 271
IMU = 85


def _report(shell: Shell, *faults: str, more: str = "") -> Report:
    options = " ".join(f"--fault {fault}" for fault in faults)
    outcome = shell(f"convert {RECORDING} --dry-run {options} {more}")
    assert outcome.code == 0, outcome.err
    report: Report = json.loads(outcome.out)
    return report


def _packets(report: Report) -> list[dict[str, Any]]:
    return [sensor["packets"] for sensor in report["sensors"]]


def test_without_faults_the_report_has_none(shell: Shell) -> None:
    assert "faults" not in _report(shell)


def test_dropped_packets_are_counted_as_lost(shell: Shell) -> None:
    report = _report(shell, "drop:left:10%")
    (fault,) = report["faults"]
    assert fault["fault"] == "drop:left:10%"
    left, right = _packets(report)
    lost = LEFT - left["read"]
    assert lost + IMU - report["sensors"][0]["imu_packets"] == fault["packets"]
    # Loss at the very begin and end is not detectable.
    assert lost - 2 <= left["lost"] <= lost > 10
    assert (right["read"], right["lost"]) == (RIGHT, 0)


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


def test_delay_and_reordering_change_no_scan(shell: Shell) -> None:
    plain = _report(shell)
    for faults in (
        ["delay:left:60ms"],
        ["reorder:*:10%"],
        ["delay:right:400ms", "reorder:left:5%"],
    ):
        report = _report(shell, *faults)
        assert report["scans"] == plain["scans"]
        for one, other in zip(report["sensors"], plain["sensors"], strict=True):
            assert (one["columns"], one["points"]) == (other["columns"], other["points"])


def test_a_dropout_does_not_affect_the_other_sensor(shell: Shell) -> None:
    plain, report = _report(shell), _report(shell, "stall:left:0.2s-0.4s")
    assert report["sensors"][1]["columns"] == plain["sensors"][1]["columns"]
    left = report["sensors"][0]
    silent = left["packets"]["lost"] + IMU - left["imu_packets"]
    assert silent == report["faults"][0]["packets"] == 84  # 0.2 s of 320 and 100 packets per second


def test_a_clock_step_is_an_error_or_splits(shell: Shell, tmp_path: Path) -> None:
    jump = "--fault jump:*:37s@0.4s"
    outcome = shell(f"convert {RECORDING} --dry-run {jump}")
    assert outcome.code == 1
    assert "clock jump within the recording" in outcome.err
    outcome = shell(f"convert {RECORDING} -o out --on-jump split --keep-partial {jump}")
    assert outcome.code == 0, outcome.err
    reports = [
        json.loads(path.read_text()) for path in sorted(tmp_path.glob("out.seg*/report.json"))
    ]
    assert len(reports) == 2
    read = [sum(one["read"] for one in _packets(report)) for report in reports]
    assert sum(read) == LEFT + RIGHT
    begin, later = (report["grid"]["t_init_ns"] for report in reports)
    assert later - begin in (37_300_000_000, 37_400_000_000, 37_500_000_000)


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
