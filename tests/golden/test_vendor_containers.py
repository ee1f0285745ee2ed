"""Velodyne and HESAI packets: every container, message, buffer and interleaving, the same scans."""

from __future__ import annotations

import functools
import re
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from mlbatch.discovery.discover import SensorSelection
from mlbatch.pipeline.job import Job
from mlbatch.simulate.hesai import encode as hesai
from mlbatch.simulate.hesai.angles import angles_csv
from mlbatch.simulate.velodyne import encode as velodyne
from tests.builders.encoded import Spec, encoded, shape
from tests.builders.run import Values, buffers_of, in_memory, prints
from tests.golden.vendor_messages import CONTAINERS, NS_PER_MS, Unit, unit_of

LENGTH_NS = 250 * NS_PER_MS


@functools.cache
def pair() -> tuple[Unit, Unit]:
    """A PandarXT-16 and a VLP-16 at the same time, both with two returns; readings at random."""
    rng = np.random.default_rng(11)
    xt16 = hesai.HesaiSpec("PandarXT-16", hesai.DUAL, start_deg=351.3)
    # The same second, as so many microseconds past its hour.
    vlp16 = velodyne.VelodyneSpec("VLP-16", "dual", start_azimuth_deg=93.0, start_us=800_000_417.0)
    lidars: list[tuple[str, Spec, int]] = [
        ("hesai", xt16, 200_000),
        ("velodyne", vlp16, 663_552),
    ]
    units = []
    for vendor, spec, packet_ns in lidars:
        size = shape(spec, LENGTH_NS // packet_ns)
        counts = rng.integers(0, 20_000, size)
        # Many single returns, sent twice.
        counts[..., 1] = np.where(rng.random(size[:2]) < 0.6, *np.moveaxis(counts, 2, 0))
        units.append(unit_of(vendor, tuple(encoded(spec, counts, rng.integers(0, 256, size)))))
    return units[0], units[1]


def angles(folder: Path) -> Path:
    """The angle file of the XT-16."""
    path = folder / "unit.csv"
    path.write_bytes(angles_csv([15.0 - 2 * row for row in range(16)], [0.0] * 16))
    return path


def job(metadata: Path, *recordings: Path) -> Job:
    """Everything in a session, at 20 Hz."""
    selection = SensorSelection(metadata=(metadata,), identity_extrinsics=True)
    return Job(recordings, selection, Fraction(20), keep_partial=True)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> list[Values]:
    """What the capture gives."""
    folder = tmp_path_factory.mktemp("plain")
    result = in_memory(job(angles(folder), CONTAINERS["pcap"](folder, pair())))
    ledgers = [sensor.ledger.points for sensor in result.report.sensors]
    assert len(ledgers) == 2
    assert min(points.written for points in ledgers) > 50_000
    assert min(points.repeated for points in ledgers) > 20_000
    return prints(result)


@pytest.mark.parametrize("name", CONTAINERS)
def test_scans_do_not_depend_on_the_container(
    name: str, plain: list[Values], tmp_path: Path
) -> None:
    path = CONTAINERS[name](tmp_path, pair())
    assert prints(in_memory(job(angles(tmp_path), path))) == plain


@pytest.mark.parametrize("size", [4_001, 65_537, 1 << 20])
def test_scans_do_not_depend_on_buffers(size: int, plain: list[Values], tmp_path: Path) -> None:
    path = CONTAINERS["pcap"](tmp_path, pair())
    with buffers_of(size):
        assert prints(in_memory(job(angles(tmp_path), path))) == plain


@pytest.mark.parametrize("late_ms", [(0, 180), (430, 0), (0, 900)])
@pytest.mark.parametrize("name", ["pcap", "db3", "MCAP", "ROS 1"])
def test_scans_do_not_depend_on_the_interleaving(
    late_ms: tuple[int, int], name: str, plain: list[Values], tmp_path: Path
) -> None:
    """The packets of one unit arrive later than they were sent."""
    units = tuple(unit.late(by_ms * NS_PER_MS) for unit, by_ms in zip(pair(), late_ms, strict=True))
    path = CONTAINERS[name](tmp_path, units)
    assert prints(in_memory(job(angles(tmp_path), path))) == plain


@pytest.mark.parametrize("first", [0, 1])
def test_scans_do_not_depend_on_the_files_of_a_session(
    first: int, plain: list[Values], tmp_path: Path
) -> None:
    """Two captures, each of one unit, in either order."""
    hesai_unit, velodyne_unit = pair()
    paths = [CONTAINERS["pcap"](tmp_path, (hesai_unit,))]
    paths.append(CONTAINERS["pcapng"](tmp_path, (velodyne_unit,)))
    found = in_memory(job(angles(tmp_path), paths[first], paths[1 - first]))
    assert prints(found) == plain


@pytest.mark.parametrize(("name", "codes"), [("pcap", []), ("db3", ["max_wait", "max_wait"])])
def test_a_message_that_is_longer_than_the_wait_is_warned_of(
    name: str, codes: list[str], tmp_path: Path
) -> None:
    """A message is a sweep of 100 ms, after which 50 ms are over."""
    short = replace(
        job(angles(tmp_path), CONTAINERS[name](tmp_path, pair())), max_wait_ns=50 * NS_PER_MS
    )
    warned = [one for one in in_memory(short).report.warnings if one.code == "max_wait"]
    assert [one.code for one in warned] == codes
    # Single packets are no messages, however short the wait is.
    shortest = in_memory(replace(short, max_wait_ns=10_000)).report.warnings
    assert [one.code for one in shortest if one.code == "max_wait"] == codes
    for one in warned:
        found = re.fullmatch(
            r"--max-wait 0\.05: expected more than a message of \S+, which holds (0\.\d+) s .*"
            r"; give at least (0\.\d+)",
            one.message,
        )
        assert found is not None, one.message
        # The sweeps of the builder are cut by receive time: 100 ms, and a packet.
        assert 0.09 < float(found[1]) <= 0.102
        assert float(found[2]) >= float(found[1]) + 0.01
