"""A Helios 32 as it was recorded, in scans of sized packets, with the model in a rig.

Bytes 30 to 32 of its MSOP packets are 06 00 00, where rs_driver has the type; 600 rpm, strongest
return; 750 MSOP packets and one DIFOP in 5 messages. Points: `tests/sensors/test_round_trip.py`.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from mlbatch.discovery.discover import SensorSelection
from mlbatch.pipeline.job import Job
from mlbatch.simulate.robosense.encode import (
    Angles,
    RobosenseSpec,
    difop,
    msop,
)
from tests.builders.bags import Recorded
from tests.builders.lidar_packets import Payloads
from tests.builders.mcaps import write_mcap
from tests.builders.run import in_memory
from tests.builders.vendor_sessions import robosense_scan

UNIT = RobosenseSpec("Helios 32, early type", start_deg=17.3)
MESSAGES = 5
PACKETS = 750
COLUMNS = 12 * PACKETS
TOPIC = "/robosense_packets"
ANGLES = Angles(
    np.linspace(14.94, -53.7, 32).round(2), np.where(np.arange(32) % 2, 6.35, -6.35).astype(float)
)
RANGES = 400 + np.arange(COLUMNS * 32).reshape(COLUMNS, 32, 1) % 20_011
LEVELS = RANGES % 255 + 1


def payloads() -> Payloads:
    """The device packet arrives amid the fourth revolution."""
    sent = msop(UNIT, RANGES, LEVELS)
    return [*sent[:500], (sent[500][0], difop(UNIT, ANGLES)), *sent[500:]]


def messages(sent: Payloads) -> list[Recorded]:
    """A message a revolution, recorded after its last packet."""
    ends = np.linspace(0, len(sent), MESSAGES + 1).astype(int).tolist()
    parts = [sent[begin:end] for begin, end in pairwise(ends)]
    kind = "robosense_msgs/RobosenseScan"
    return [Recorded(TOPIC, kind, part[-1][0] + 1_000_000, robosense_scan(part)) for part in parts]


RIG = """\
sensors:
  - name: top
    model: {model}
    stream: {{topic: {topic}}}
    extrinsics: {{translation_m: [0, 0, 0], rotation_rpy_deg: [0, 0, 0]}}
"""


def _rig_job(folder: Path, types: str, model: str, decode: str = "") -> Job:
    """A job on its packets with other type bytes, with the model in a rig."""
    sent = [
        (host_ns, one if one[0] == 0xA5 else one[:30] + bytes.fromhex(types) + one[33:])
        for host_ns, one in payloads()
    ]
    path = write_mcap(folder / "a.mcap", messages(sent))
    rig = folder / "rig.yaml"
    rig.write_text(RIG.format(model=model, topic=TOPIC) + decode, encoding="utf-8")
    return Job((path,), SensorSelection(rig=rig), keep_partial=True)


@pytest.mark.parametrize("types", ["06 00 00", "00 00 00", "00 0a 0b"])
def test_a_rig_names_the_model(types: str, tmp_path: Path) -> None:
    """Also where the bytes name none: with a warning."""
    result = in_memory(_rig_job(tmp_path, types, "Helios 32"))
    (sensor,) = result.report.sensors
    assert (sensor.model, sensor.ledger.columns.written) == ("Helios 32", COLUMNS)
    notes = [warning.message for warning in result.report.warnings]
    if types == "06 00 00":
        assert notes == []
    else:
        (note,) = notes
        assert "read as Helios 32, which the rig names; it looks like ROBOSENSE lidar of un" in note


def test_a_rig_that_contradicts_the_packets_is_noted(tmp_path: Path) -> None:
    result = in_memory(_rig_job(tmp_path, "00 06 01", "Helios 16"))
    (sensor,) = result.report.sensors
    assert sensor.model == "Helios 16"
    notes = " ".join(warning.message for warning in result.report.warnings)
    assert "read as Helios 16, which the rig names; it looks like ROBOSENSE lidar Helios" in notes


def test_the_range_unit_of_a_rig_and_of_the_command_line(tmp_path: Path) -> None:
    job = _rig_job(tmp_path, "06 00 00", "Helios 32", "    decode: {range_unit: 5mm}\n")
    by_option = replace(
        job, selection=SensorSelection(decode={"range_unit": "5mm"}), layout="organized"
    )
    for one in (job, by_option):
        scan = in_memory(one).scans[0]
        assert scan.range_m is not None
        expected_m = (RANGES[: len(scan.column_stamp_ns)] * 0.005).astype(np.float32)
        np.testing.assert_array_equal(scan.range_m.ravel(), expected_m.ravel())
