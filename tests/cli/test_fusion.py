"""`--batching` and `--stamp`: frame-level fusion as output, and the stamps of messages."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

import mlbatch
from mlbatch.comparison.compare import compare
from mlbatch.pipeline.job import Job
from tests.builders.phases import write_case
from tests.builders.sessions import CAPTURE, RIG, Shell, arrays, names, report_of

WORDS = f"convert {CAPTURE} --rig {RIG} -q"
POLICIES = {
    "latest": "latest sweeps",
    "approximate": "approximate time",
    "collate": "timeout collate",
}
NS = 10**9


# -- frame-level fusion ---------------------------------------------------------------------------


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("case", ["10 Hz, 37 ms apart", "10 Hz with 20 Hz"])
def test_sets_are_those_of_compare(shell: Shell, policy: str, case: str) -> None:
    """`compare` measures the sets that `convert` writes."""
    capture = write_case(Path("case"), case)
    words = f"convert {capture} --identity-extrinsics -q --report report.json"
    assert shell(f"{words} --batching {policy} -o sets").code == 0
    own = next(one for one in compare(Job((capture,))).reports if one.name == POLICIES[policy])
    found = [arrays(f"sets/{name}") for name in names("sets")]
    assert len(found) == own.sets
    spans_ms = [np.ptp(one["column_stamp_ns"]) / 1e6 for one in found]
    assert max(spans_ms) == pytest.approx(own.span.max)
    assert min(spans_ms) == pytest.approx(own.span.min)
    used: list[tuple[int, int]] = []
    for one in found:
        used += zip(one["column_lidar_id"].tolist(), one["column_stamp_ns"].tolist(), strict=True)
    assert len(used) - len(set(used)) == own.used_twice


def test_own_times_count_from_the_first_column_of_a_sensor(shell: Shell) -> None:
    """As drivers give them; all else is as with common times."""
    for times in ("common", "own"):
        line = f"{WORDS} --batching latest --batching-times {times} -o {times}"
        assert shell(line).code == 0
    late = 0
    for name in names("common"):
        common = arrays(f"common/{name}")
        own = arrays(f"own/{name}")
        for key in ("xyz", "ring", "column_stamp_ns", "start_ns", "end_ns", "column"):
            np.testing.assert_array_equal(common[key], own[key], err_msg=key)
        for sensor in range(2):
            columns = common["column_stamp_ns"][common["column_lidar_id"] == sensor]
            begins_ns = int(columns.min()) - int(common["start_ns"])
            points = common["lidar_id"] == sensor
            np.testing.assert_array_equal(
                own["time_ns"][points].astype(np.int64),
                common["time_ns"][points].astype(np.int64) - begins_ns,
            )
            late += begins_ns
        assert int(common["start_ns"]) == int(common["column_stamp_ns"].min())
    assert late > 0


@pytest.mark.parametrize("times", ["common", "own"])
@pytest.mark.parametrize(
    "output",
    [
        *("out.mcap", "out.bag", "out --format rosbag2 --point-layout hesai", "out --format npz"),
        *("out --format ply", "out --format pcd", "out --format las", "out --layout organized"),
        *("out.mcap --layout organized", "out --sort points", "out.mcap --stamp end --sort points"),
        "out.mcap --point-layout autoware",
    ],
)
def test_sets_can_be_checked_and_read(shell: Shell, output: str, times: str) -> None:
    line = f"{WORDS} --batching latest --batching-times {times} -o {output} --fault drop:left:10%"
    assert shell(line).code == 0
    path = output.split()[0]
    verified = shell(f"verify {path} --json")
    assert verified.code == 0, verified.out
    checks = {one["name"]: one for one in json.loads(verified.out)["checks"]}
    for name in ("grid", "t_init"):
        assert checks[name]["outcome"] == "not checkable"
        assert "on no grid" in checks[name]["limit"]
    scans = list(mlbatch.read(path))
    assert [scan.index for scan in scans] == list(range(len(scans)))
    assert len(scans) > 3
    for before, scan in pairwise(scans):
        assert before.end_ns < scan.end_ns
        assert scan.end_ns > scan.start_ns


def test_reused_columns_are_counted(shell: Shell) -> None:
    """The slower one repeats a sweep once in 20 s, seen from the faster one."""
    capture = write_case(Path("case"), "10.00 Hz with 9.95 Hz")
    assert shell(f"convert {capture} --identity-extrinsics --batching latest -o out -q").code == 0
    left, right = report_of("out/report.json")["sensors"]
    assert left["columns"].get("reused", 0) == 0
    assert right["columns"]["reused"] > 0
    assert right["columns"]["reused"] % 512 == 0
    assert shell("verify out").code == 0


# -- stamps ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stamp", "after_ns"), [("start", 0), ("middle", NS // 20), ("end", NS // 10)]
)
@pytest.mark.parametrize("output", ["out.mcap", "out.bag"])
def test_stamps_of_messages(shell: Shell, output: str, stamp: str, after_ns: int) -> None:
    """10 Hz: windows begin at whole tenths of a second; times still count from there."""
    assert shell(f"{WORDS} -o usual.mcap").code == 0
    assert shell(f"{WORDS} -o {output} --stamp {stamp} --overwrite").code == 0
    verified = shell(f"verify {output}")
    assert verified.code == 0, verified.out
    for usual, scan in zip(mlbatch.read("usual.mcap"), mlbatch.read(output), strict=True):
        assert (scan.index, scan.start_ns, scan.end_ns) == (
            *(usual.index, usual.start_ns, usual.end_ns),
        )
        np.testing.assert_array_equal(scan.xyz, usual.xyz)
        np.testing.assert_array_equal(scan.time_ns, usual.time_ns)
    if output == "out.mcap":
        with Path(output).open("rb") as file:
            clouds = [message for _, _, message in make_reader(file).iter_messages(["/points"])]
        for cloud in clouds:
            second, rest = np.frombuffer(cloud.data[4:12], "<u4").tolist()
            assert cloud.log_time == second * NS + rest
            assert (cloud.log_time - after_ns) % (NS // 10) == 0


def test_verify_finds_a_stamp_of_another_instant(shell: Shell) -> None:
    """Middle of the window instead of its end: other bytes than the metadata say."""
    assert shell(f"{WORDS} -o out.mcap --stamp middle").code == 0
    data = Path("out.mcap").read_bytes()
    assert data.count(b"stamp\x06\x00\x00\x00middle") == 1
    report = Path("out.mcap.report.json")
    report.write_text(report.read_text().replace('"stamp": "middle"', '"stamp": "end"'))
    verified = shell("verify out.mcap")
    assert verified.code == 1
    assert "grid.stamp" in verified.out + verified.err
