"""Messages by sensor, as images, in other presets and in bags: what breaks a rule is found."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mlbatch.verify import verify
from mlbatch.verify.report_checks import metadata_of_grid
from mlbatch.verify.verdict import CheckLog, VerifyError
from tests.builders.outputs import (
    Edit,
    at,
    copied,
    forget,
    found,
    npz,
    report,
    row,
    spoiled_places,
    text,
)
from tests.builders.rewritten import (
    Change,
    Records,
    bag,
    gone,
    later,
    mcap,
    on,
    only,
    points,
    put,
)


@pytest.fixture(scope="module", autouse=True)
def _clean() -> Iterator[None]:
    yield
    forget()


OTHERS: dict[str, tuple[str, Edit, str, str]] = {
    "point of another sensor": (
        "split.mcap",
        mcap(only("/left/points", 1, put("standard", "lidar_id", 3, 1))),
        "sensors",
        "/left/points message 1 point 3",
    ),
    "scan of another sensor": (
        "split.mcap",
        mcap(only("/left/points", 1, on("/right/points"))),
        "sensors",
        "/right/points",
    ),
    "azimuth": (
        "autoware.mcap",
        mcap(only("/left/points", 1, put("autoware", "azimuth", 3, 9.0))),
        "geometry",
        "/left/points message 1 point 3",
    ),
    "elevation": (
        "autoware.mcap",
        mcap(only("/left/points", 1, put("autoware", "elevation", 3, 1.5))),
        "geometry",
        "point 3",
    ),
    "distance": (
        "autoware.mcap",
        mcap(only("/left/points", 1, put("autoware", "distance", 3, 1.5))),
        "geometry",
        "point 3",
    ),
    "return type": (
        "autoware.mcap",
        mcap(only("/left/points", 1, put("autoware", "return_type", 3, 88))),
        "returns",
        "point 3",
    ),
    "ns": (
        "autoware.mcap",
        mcap(only("/left/points", 1, put("autoware", "time_stamp", 3, 4e9))),
        "times",
        "point 3",
    ),
    "range in mm": (
        "ouster.mcap",
        mcap(only("/left/points", 1, put("ouster", "range", 3, 60_000))),
        "geometry",
        "point 3",
    ),
    "place": (
        "minimal.mcap",
        mcap(only("/points", 1, put("minimal", "x", 3, np.inf))),
        "finite",
        "point 3",
    ),
    "count of metadata.yaml": (
        "bag2",
        text("metadata.yaml", "message_count: ", "message_count: 1"),
        "metadata",
        "metadata.yaml",
    ),
    "file of metadata.yaml": (
        "bag2",
        text("metadata.yaml", "bag2_0.mcap", "other.mcap"),
        "names",
        "relative_file_paths",
    ),
    "start of metadata.yaml": (
        "bag2",
        text("metadata.yaml", "since_epoch: 1", "since_epoch: 2"),
        "metadata",
        "starting_time",
    ),
    "duration of metadata.yaml": (
        "bag2",
        text("metadata.yaml", "    nanoseconds: ", "    nanoseconds: 1"),
        "metadata",
        "duration",
    ),
    "scan of a bag folder": (
        "bag2",
        mcap(only("/points", 1, gone)),
        "metadata",
        "metadata.yaml",
    ),
    "log time in a bag": ("scans.bag", bag(only("/points", 1, later(7))), "stamps", "message 1"),
    "scan of a bag": ("scans.bag", bag(only("/points", 1, gone)), "table", "scan"),
    "value in a bag": (
        "scans.bag",
        bag(only("/points", 1, put("standard", "x", 3, np.nan))),
        "finite",
        "/points message 1 point 3",
    ),
    "IMU in a bag": ("scans.bag", bag(only("/left/imu", 3, gone)), "imu", "sensors.0"),
    "table beside a bag": ("scans.bag", row(1, "points", 1), "table", "line 3 points"),
    "sensors of the report beside a bag": (
        "scans.bag",
        report("sensors", to=[]),
        "metadata",
        "scans.csv sensors",
    ),
    "report beside a bag": ("scans.bag", report("scans", "points", to=1), "report", "points"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_formats(name: str, tmp_path: Path) -> None:
    kind, edit, check, where = OTHERS[name]
    found(spoiled_places(kind, tmp_path, edit), check, where)


def image(change: str) -> Change:
    """An organized scan, slots x columns, spoiled."""

    def spoil(records: Records) -> None:
        valid = np.flatnonzero(np.isfinite(records["x"]))
        empty = np.flatnonzero(~np.isfinite(records["x"]))
        if change == "half":
            records["y"][valid[7]] = np.nan
        elif change == "owner":
            records["lidar_id"][empty[7]] ^= 1
        elif change == "time":
            records["time"][valid[7]] += 0.05
        else:
            records["ring"][empty[7]] = 3

    return points("standard", spoil)


@pytest.mark.parametrize(
    ("change", "check"),
    [("half", "finite"), ("owner", "sensors"), ("time", "times"), ("ring", "finite")],
)
def test_organized(change: str, check: str, tmp_path: Path) -> None:
    edit = mcap(only("/points", 1, image(change)))
    found(spoiled_places("organized.mcap", tmp_path, edit), check, "/points message 1")


@pytest.mark.parametrize("kind", ["scans.mcap", "split.mcap", "organized.mcap", "bag2"])
def test_files_that_others_write_again_are_clean(kind: str, tmp_path: Path) -> None:
    path = copied(kind, tmp_path)
    mcap()(path)
    verdict = verify(path)
    assert verdict.ok, verdict.violations


def test_bags_that_others_write_again_are_clean(tmp_path: Path) -> None:
    path = copied("scans.bag", tmp_path)
    bag(lambda sent: [sent])(path)
    assert verify(path).ok


@pytest.mark.parametrize("slices", [0, 2_000_000, 10**19])
def test_slices_that_no_run_has_are_damage(slices: int, tmp_path: Path) -> None:
    path = copied("scans.bag", tmp_path)
    report("grid", "slices", to=slices)(path)
    with pytest.raises(VerifyError, match="expected 1 to 1000000 slices a window, found"):
        verify(path)


def test_numbers_that_python_refuses_to_read_are_none() -> None:
    log = CheckLog()
    metadata = metadata_of_grid(log, "out.mcap", {"slices": "9" * 5000, "t_init_ns": "9" * 19})
    assert (metadata.slices, metadata.t_init_ns) == (None, 10**19 - 1)
    assert "out.mcap mlbatch.grid slices" in [one.where for one in log.violations]


@pytest.mark.parametrize("ns", [2**63 - 1, -(2**63)])
def test_times_at_the_end_of_all_counting_are_told(ns: int, tmp_path: Path) -> None:
    """In the first scan, without a report that says where it should begin."""
    path = copied("npz", tmp_path)
    (path / "report.json").unlink()
    npz("head.npz", "start_ns", at((), ns))(path)
    assert "head.npz start_ns" in [one.where for one in verify(path).violations]
