"""Clocks on the command line: reports and alignment."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from tests.builders.sessions import FIX, NS_PER_S, Report, Shell, Unit, twin, write_session


def _codes(report: Report) -> list[str]:
    return [warning["code"] for warning in report["warnings"]]


def test_synchronised_clocks_need_no_warning(shell: Shell) -> None:
    report = shell.dry(FIX)
    assert _codes(report) == []
    for sensor in report["sensors"]:
        assert sensor["clock"]["epoch"] == "utc"
        assert abs(sensor["clock"]["offset_to_host_ms"]) < 5


def test_drift_is_told(shell: Shell, tmp_path: Path) -> None:
    write_session(tmp_path, Unit(turns=100))
    report = shell.dry("drive.pcap --fault drift:*:40ppm")
    (sensor,) = report["sensors"]
    assert sensor["clock"]["drift_ppm"] == pytest.approx(40, abs=3)


def test_clocks_apart_are_reported_with_the_remedy(shell: Shell) -> None:
    report = shell.dry(f"{FIX} --fault jump:right:0.3s@0s")
    # On its own clock `left` ends 0.3 s before `right`: the last scans lack it.
    assert _codes(report) == ["loss", "clocks"]
    warning = report["warnings"][1]
    assert "correctable" in warning["message"]
    # A packet is stamped by its last column, which comes 0.3 ms after the fixture's first.
    said = re.search(r"clock: \{offset_s: (-0\.\d+)\}", warning["message"])
    assert said is not None
    assert float(said[1]) == pytest.approx(-0.3, abs=0.003)


def test_an_epoch_in_the_rig_makes_them_comparable(shell: Shell, tmp_path: Path) -> None:
    one = Unit()
    tai = twin(one.ahead(37 * NS_PER_S), 222)
    write_session(tmp_path, one, tai)
    assert shell("convert drive.pcap --dry-run --identity-extrinsics").code == 1
    here = "extrinsics: {translation_m: [0, 0, 0]}"
    (tmp_path / "rig.yaml").write_text(
        "sensors:\n"
        f'- {{name: left, stream: {{serial: "111"}}, metadata: 111.json, {here}}}\n'
        f'- {{name: right, stream: {{serial: "222"}}, metadata: 222.json, {here}, '
        "clock: {epoch: tai}}\n"
    )
    report = shell.dry("drive.pcap --rig rig.yaml")
    assert report["timescale"] == "utc"
    assert [sensor["columns"]["written"] for sensor in report["sensors"]] == [1024, 1024]


def _stamps(folder: Path, sensor: int) -> I64Array:
    """Stamps of the last columns of a sensor; how many come before depends on the first window."""
    stamps: list[I64Array] = []
    for path in sorted(folder.glob("[0-9]*.npz")):
        with np.load(path) as scan:
            own = scan["column_lidar_id"] == sensor
            stamps.append(scan["column_stamp_ns"][own])
    return np.concatenate(stamps)[-58 * 512 :]


@pytest.mark.parametrize("to", ["host", "first"])
def test_aligned_clocks_give_the_scans_of_synchronised_ones(
    shell: Shell, tmp_path: Path, to: str
) -> None:
    """A clock 37 s off that drifts, and one that jumps: both come out where the columns were."""
    write_session(tmp_path, Unit(turns=60), twin(Unit(turns=60), 222))
    plain = "convert drive.pcap --identity-extrinsics --keep-partial"
    faults = "--fault jump:ouster_222:37s@0s --fault drift:ouster_222:30ppm"
    if to == "host":
        faults += " --fault jump:ouster_111:-5s@3s"
    assert shell(f"{plain} -o true").code == 0
    outcome = shell(f"{plain} -o mapped --align-clocks --align-to {to} {faults}")
    assert outcome.code == 0, outcome.err
    away = [
        _stamps(tmp_path / "mapped", sensor) - _stamps(tmp_path / "true", sensor)
        for sensor in (0, 1)
    ]
    # On the capture host's clock, later than the columns by the packet's transport (1 ms) and its
    # length (0.2 ms), the same for both; on the first sensor's clock, unchanged.
    expected = 1_200_000 if to == "host" else 0
    for one in away:
        assert np.abs(one - expected).max() < 500_000
    report = json.loads((tmp_path / "mapped" / "report.json").read_text())
    assert any("aligned to" in note for note in report["sensors"][1]["clock"]["notes"])
