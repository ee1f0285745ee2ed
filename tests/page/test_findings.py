"""Findings of runs, made by hand."""

from __future__ import annotations

from typing import Any

import pytest

from mlbatch.page.findings import Level, findings, percent, verdict
from mlbatch.page.windows import read_windows
from mlbatch.reports.report import RunReport
from tests.page.runs import report, sensor, table


def found(document: dict[str, Any], columns: list[list[int]] | None = None) -> list[str]:
    """Level and text of each finding."""
    windows = None
    if columns is not None:
        windows = read_windows(table(("left", "right"), columns, 512), 1)
    return [
        f"{one.level.name}: {one.text}" for one in findings(RunReport.from_json(document), windows)
    ]


def _verdict(document: dict[str, Any]) -> tuple[Level, str, str]:
    read = RunReport.from_json(document)
    return verdict(findings(read, None), read)


def test_a_clean_run_has_no_finding() -> None:
    document = report(sensor("left"), sensor("right", 1))
    assert found(document, [[512, 512]] * 10) == []
    assert _verdict(document) == (
        Level.GOOD,
        "Packets, windows and clocks are fine; poses not checked",
        "",
    )
    document["sensors"][1]["model"] = "PointCloud2"
    assert _verdict(document)[1] == (
        "Windows are fine; clocks and times of decoded clouds not measured; poses not checked"
    )


@pytest.mark.parametrize(
    ("lost", "expected"),
    [
        (0, []),
        (1, ["WARNING: left lost 1 packet of 1,000, 0.10 %."]),
        (9, ["WARNING: left lost 9 packets of 1,000, 0.90 %."]),
        (10, ["PROBLEM: left lost 10 packets of 1,000, 1.0 %."]),
    ],
)
def test_loss_is_graded(lost: int, expected: list[str]) -> None:
    assert found(report(sensor("left", lost=lost))) == expected


@pytest.mark.parametrize(
    ("silent", "text"),
    [
        (range(3, 6), "right sent nothing from +0.3 s to +0.6 s: a stall of 3 scans."),
        (range(0, 2), "right sent nothing until +0.2 s (2 scans)."),
        (range(7, 10), "right sent nothing from +0.7 s to the end (3 scans)."),
        (range(0, 10), "right sent nothing: no column in any scan."),
        (range(4, 5), "right sent nothing from +0.4 s to +0.5 s: a stall of 1 scan."),
    ],
)
def test_a_silent_sensor_is_named_with_its_time(silent: range, text: str) -> None:
    columns = [[512, 0 if index in silent else 512] for index in range(10)]
    document = report(sensor("left"), sensor("right", 1))
    assert found(document, columns) == [f"PROBLEM: {text}"]


@pytest.mark.parametrize(
    ("right", "lost", "expected"),
    [
        (
            [30, 30, 25, 0, 0, 0, 25, 30, 30, 30],
            100,
            ["right sent nothing from +0.3 s to +0.6 s: a stall of 3 scans. All 100 lost packets"],
        ),
        (
            [30, 0, 30, 30, 30, 0, 0, 30, 30, 30],
            90,
            [
                "right sent nothing from +0.1 s to +0.2 s: a stall of 1 scan. All 90 lost packets "
                "of right are of its stalls.",
                "right sent nothing from +0.5 s to +0.7 s: a stall of 2 scans.",
            ],
        ),
        # 20 more in another scan.
        (
            [30, 30, 25, 0, 0, 0, 25, 10, 30, 30],
            120,
            ["right sent nothing from +0.3 s", "right lost 120 packets of 1,000, 12.0 %."],
        ),
    ],
)
def test_the_loss_of_a_stall_is_one_finding(
    right: list[int], lost: int, expected: list[str]
) -> None:
    """Windows of 30 columns, packets of one."""
    document = report(sensor("left"), sensor("right", 1, lost=lost))
    document["sensors"][1]["columns"]["decoded"] = 1000 - lost
    document["scans"]["incomplete"] = right.count(0)
    csv = table(("left", "right"), [[30, count] for count in right], 30)
    texts = [one.text for one in findings(RunReport.from_json(document), read_windows(csv, 1))]
    assert len(texts) == len(expected)
    assert all(text.startswith(words) for text, words in zip(texts, expected, strict=True))


def test_head_and_tail_are_partial_by_request() -> None:
    document = report(sensor("left"), sensor("right", 1))
    document["scans"]["incomplete"] = 3
    columns = [[100, 100], [512, 512], [512, 512], [512, 0]]
    text = table(("left", "right"), columns, 512, has_head=True)
    texts = [one.text for one in findings(RunReport.from_json(document), read_windows(text, 1))]
    assert "1 scan of 10 is incomplete: a sensor does not cover the window." in texts
    assert "Head and tail are incomplete, as requested by --keep-partial." in texts


@pytest.mark.parametrize("written", [1, 2])
def test_head_and_tail_alone_are_no_good_run(written: int) -> None:
    document = report(sensor("left"), sensor("right", 1))
    document["scans"] |= {"written": written, "incomplete": written}
    columns = [[100, 100], [50, 0]][:written]
    text = table(("left", "right"), columns, 512, has_head=True)
    found_texts = [
        one.text
        for one in findings(RunReport.from_json(document), read_windows(text, 1))
        if one.level is Level.WARNING
    ]
    assert found_texts[0].startswith("No window is whole")


def test_the_warning_of_a_loss_is_not_repeated() -> None:
    message = "left: 20 of 1000 packets lost (2 %)"
    warning = {"code": "loss", "sensor": "left", "message": message}
    document = report(sensor("left", lost=20), sensor("right", 1, lost=1), warnings=[warning])
    expected = [f"PROBLEM: {message}", "WARNING: right lost 1 packet of 1,000, 0.10 %."]
    assert found(document) == expected


def test_drifting_clocks_are_weighed_by_the_length_of_the_recording() -> None:
    sensors = (sensor("left", drift_ppm=10), sensor("right", 1, drift_ppm=-40))
    assert found(report(*sensors, timing={"recorded_s": 9.0})) == []
    (text,) = found(report(*sensors, timing={"recorded_s": 60.0}))
    assert text == "WARNING: The clocks of left and right drift apart by 50.0 ppm: 3.00 ms in 60 s."
    (text,) = found(report(*sensors, timing={"recorded_s": 3600.0}))
    assert text.startswith("PROBLEM: ")


def test_the_verdict_is_the_worst_finding() -> None:
    warning = {"code": "calibration", "sensor": "left", "message": "a note"}
    document = report(sensor("left", bad_size=50), sensor("right", 1, lost=2), warnings=[warning])
    level, heading, others = _verdict(document)
    assert level == Level.PROBLEM
    assert heading == "50 packets of left rejected (bad size 50)."
    assert others == "1 problem and 1 warning below."
    last = findings(RunReport.from_json(document), None)[-1]
    assert (last.level, last.code, last.text) == (Level.NOTE, "calibration", "a note")
    # One that contradicts the packets is no mere note.
    warning["message"] = "expected packets of 1024x20, found those of 1024x10"
    assert Level.WARNING in [
        one.level for one in findings(RunReport.from_json(document), None) if one.code
    ]


def test_a_run_without_a_scan_is_a_problem() -> None:
    assert found(report(sensor("left"), scans=0)) == ["PROBLEM: No scan was written."]


@pytest.mark.parametrize(
    ("part", "whole", "text"),
    [(0, 0, "0.00 %"), (1, 3, "33.3 %"), (1, 1000, "0.10 %"), (1, 100_000, "less than 0.01 %")],
)
def test_shares_have_the_digits_they_need(part: int, whole: int, text: str) -> None:
    assert percent(part, whole) == text


@pytest.mark.parametrize("value", [None, "x", 5, [], [1], {"sensors": "x", "scans": []}])
def test_a_damaged_report_gives_no_exception(value: Any) -> None:
    findings(RunReport.from_json(value), None)
    findings(
        RunReport.from_json({"sensors": [value], "warnings": [value], "faults": [value]}), None
    )
