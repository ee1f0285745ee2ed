"""The report and the metadata of a run: every damage is found, and named with its path."""

from __future__ import annotations

from pathlib import Path

import pytest

from mlbatch.outputs.damage import CheckLog
from mlbatch.outputs.metadata import metadata_of_grid
from mlbatch.verification import VerifyError, verify
from tests.builders.verify_outputs import (
    PERIOD_NS,
    Case,
    both,
    cases,
    check_case,
    copied,
    report,
)

REPORT: dict[str, Case] = {
    "frames of the report": (report("capture", "frames", to=1), "ledger", "capture.frames"),
    "packets of the report": (
        report("sensors", 0, "packets", "accepted", to=1),
        "ledger",
        "sensors.0.packets.read",
    ),
    "columns of the report": (
        report("sensors", 1, "columns", "dropped", "head", to=1),
        "ledger",
        "sensors.1.columns.decoded",
    ),
    "slots of the report": (
        report("sensors", 0, "points", "no_return", to=1),
        "ledger",
        "sensors.0.points.slots",
    ),
    "balanced, but not so in the file": (
        both(
            report("sensors", 0, "points", "written", to=lambda n: n + 5),
            report("sensors", 0, "points", "no_return", to=lambda n: n - 5),
        ),
        "report",
        "sensors.0.points.written",
    ),
    "more clipped points than written": (
        report("sensors", 0, "points", "clipped", to=10**9),
        "ledger",
        "sensors.0.points.clipped",
    ),
    "clipped points without 8 bits": (
        report("sensors", 0, "points", "clipped", to=1),
        "report",
        "sensors.points.clipped, all",
    ),
    "columns that are not there": (
        both(
            report("sensors", 0, "columns", "written", to=lambda n: n + 5),
            report("sensors", 0, "columns", "decoded", to=lambda n: n + 5),
        ),
        "report",
        "sensors.0.columns.written",
    ),
    "scans of the report": (report("scans", "written", to=9), "report", "scans.written"),
    "points of the report": (report("scans", "points", to=9), "report", "scans.points"),
    "incomplete of the report": (report("scans", "incomplete", to=3), "report", "incomplete"),
    "span of the report": (report("scans", "span_ms", "max", to=101.0), "report", "span_ms.max"),
    "period of the report": (report("scans", "period_ms", "p50", to=99.0), "report", "p50"),
    "start of the report": (report("grid", "t_init_ns", to=7), "t_init", "t_init_ns"),
    "start by a period": (
        report("grid", "t_init_ns", to=lambda n: n + PERIOD_NS),
        "index",
        "head.npz index, slice",
    ),
    "rate of the report": (report("grid", "rate_hz", to="20"), "metadata", "report.json rate"),
    "period of the grid": (report("grid", "period_ns", to="1"), "grid", "grid.period_ns"),
    "slices of the report": (report("grid", "slices", to=2), "metadata", "report.json slices"),
    "sensor of the report": (report("sensors", 0, "name", to="x"), "metadata", "sensors"),
    "number of a sensor": (report("sensors", 1, "lidar_id", to=0), "ledger", "1.lidar_id"),
    "report of others": (report("schema", to="x"), "ledger", "report.json schema"),
    "count that is none": (report("capture", "frames", to="many"), "ledger", "capture.frames"),
    "sensor far away": (
        report("sensors", 0, "extrinsics", "body_from_sensor", 0, 3, to=40.0),
        "geometry",
        "000000.npz point",
    ),
    "extrinsics that are none": (
        report("sensors", 0, "extrinsics", "body_from_sensor", to=[[1, 0], [0, 1]]),
        "report",
        "body_from_sensor",
    ),
    "median beyond floats": (
        report("scans", "span_ms", "p50", to=10**400),
        "report",
        "span_ms.p50",
    ),
    "extrinsics beyond floats": (
        report("sensors", 0, "extrinsics", "body_from_sensor", 0, 0, to=10**400),
        "report",
        "body_from_sensor",
    ),
}


@pytest.mark.parametrize(("kind", "case"), cases({"npz": REPORT}))
def test_damage_is_found(kind: str, case: Case, tmp_path: Path) -> None:
    check_case(kind, case, tmp_path)


@pytest.mark.parametrize("slices", [0, 2_000_000, 10**19])
def test_impossible_numbers_of_slices_are_refused(slices: int, tmp_path: Path) -> None:
    path = copied("scans.bag", tmp_path)
    report("grid", "slices", to=slices)(path)
    with pytest.raises(VerifyError, match="expected 1 to 1000000 slices a window, found"):
        verify(path)


def test_numbers_that_python_refuses_are_none() -> None:
    log = CheckLog()
    metadata = metadata_of_grid(log, "out.mcap", {"slices": "9" * 5000, "t_init_ns": "9" * 19})
    assert (metadata.slices, metadata.t_init_ns) == (None, 10**19 - 1)
    assert "out.mcap mlbatch.grid slices" in [one.where for one in log.violations]
