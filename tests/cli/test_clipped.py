"""Intensities of 8 bits: reflectivity where a sensor has it, and an account of what is clipped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from mlbatch.outputs.cloud_messages import read_cloud
from mlbatch.outputs.encoding import MessageCursor
from mlbatch.simulate.ouster.encode import IntLike, OusterSpec, encode_packets
from mlbatch.types import Scan
from mlbatch.writers.message_writer import CloudMessage
from mlbatch.writers.point_layouts import CLOUD_LAYOUTS, clipped_points
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.mcaps import write_mcap
from tests.builders.points import OUSTER, STAMP_NS, cloud_message, write_points
from tests.builders.scans import dense_scan
from tests.builders.sessions import (
    EPOCH_NS,
    NS_PER_MS,
    Records,
    Shell,
    report_of,
    write_metadata,
)

SPEC = OusterSpec(profile="RNG19_RFL8_SIG16_NIR16", beams=16, columns_per_frame=512, serial=111)
COLUMN_NS = 100 * NS_PER_MS // 512


def _ouster(folder: Path, turns: int = 4) -> None:
    """A lidar with signal 300 + beam and reflectivity 10 * beam, 4 m all around."""
    columns = np.arange(512 * turns)
    stamps_ns = EPOCH_NS + 20 * NS_PER_MS + columns * COLUMN_NS
    ones = np.ones((len(columns), 16), np.int64)
    beam = np.arange(16)
    fields: dict[str, IntLike] = {
        "RANGE": 4000 * ones,
        "SIGNAL": ones * (300 + beam),
        "REFLECTIVITY": ones * 10 * beam,
    }
    payloads = encode_packets(SPEC, stamps_ns, columns % 512, 5 + columns // 512, fields)
    records: Records = [
        (
            int(stamps_ns[16 * number + 15]) + NS_PER_MS,
            udp_frame(payload, "10.0.0.1", dport=7502)[0],
        )
        for number, payload in enumerate(payloads)
    ]
    write_metadata(folder / "111.json", SPEC)
    write_pcap(folder / "drive.pcap", records)


def _clouds(folder: Path, intensities: list[float]) -> None:
    """Ten sweeps of 100 ms of a driver; each has a point of every intensity, in turn."""
    sweeps = []
    for number in range(10):
        points = [
            (3.0, 1.0, 0.5, value, at * 100_000_000 // len(intensities), at % 4)
            for at, value in enumerate(intensities)
        ]
        sweeps.append(cloud_message(OUSTER, points, STAMP_NS + number * 100_000_000))
    write_mcap(folder / "drive.mcap", write_points("/cloud", sweeps))


def _intensities(path: Path) -> list[int]:
    values: list[int] = []
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            if channel.topic.endswith("/points"):
                cloud = read_cloud(MessageCursor.of_message(message.data, "cdr"))
                values += cloud.records["intensity"].reshape(-1).tolist()
    return values


@pytest.mark.parametrize("jobs", [1, 3])
def test_reflectivity_is_the_intensity_of_8_bits(shell: Shell, tmp_path: Path, jobs: int) -> None:
    _ouster(tmp_path)
    outcome = shell(
        f"convert drive.pcap -o out.mcap --point-layout autoware --jobs {jobs} --strict"
    )
    assert (outcome.code, outcome.warnings) == (0, []), outcome.err
    values = _intensities(tmp_path / "out.mcap")
    # Every beam, in every column; none is the signal, which is 300 or more.
    assert sorted(set(values)) == list(range(0, 160, 10))
    assert len(values) % 16 == 0
    report = report_of("out.mcap.report.json")
    assert report["sensors"][0]["points"]["clipped"] == 0
    assert shell("verify out.mcap").code == 0


def test_a_resumed_run_counts_those_of_the_scans_before(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _clouds(tmp_path, [float(at % 300) for at in range(36_000)])
    words = "convert drive.mcap --point-layout autoware --keep-partial"
    words += " --format rosbag2 --max-bag-duration 0.1"
    assert shell(f"{words} -o whole").code == 0
    message = CloudMessage.message
    calls = []

    def failing(self: CloudMessage, scan: Scan, stamp_ns: int, dense: bool) -> memoryview:
        calls.append(stamp_ns)
        if len(calls) == 6:
            raise KeyboardInterrupt
        return message(self, scan, stamp_ns, dense)

    monkeypatch.setattr(CloudMessage, "message", failing)
    assert shell(f"{words} -o out").code == 130
    outcome = shell(f"{words} -o out --resume")
    assert (outcome.code, "resumed after 4 scans" in outcome.err) == (0, True), outcome.err
    # 44 of every 300 intensities are above 255.
    (sensor,) = report_of("out/report.json")["sensors"]
    assert sensor["points"]["clipped"] == 10 * 120 * 44
    files = sorted(Path("whole").glob("*.mcap"))
    assert len(files) > 6
    for path in files:
        found = Path("out", path.name.replace("whole", "out"))
        assert found.read_bytes() == path.read_bytes()


def test_a_mixed_rig_takes_what_each_sensor_has() -> None:
    scan = dense_scan(points=4)
    left, right = scan.info.sensors
    info = scan.info._replace(sensors=(replace(left, has_reflectivity=True), right))
    scan = replace(
        scan,
        info=info,
        lidar_id=np.array([0, 1, 0, 1], np.uint8),
        intensity=np.array([300, 300, 7, 8], np.float32),
        reflectivity=np.array([40, 0, 256, 0], np.uint16),
    )
    records = np.zeros(4, CLOUD_LAYOUTS["autoware"].dtype)
    CLOUD_LAYOUTS["autoware"].pack(scan, records)
    assert records["intensity"].tolist() == [40, 255, 255, 8]
    assert clipped_points(scan) == [1, 1]
