"""A rig of four vendors, converted by one command: against the paper's loop, its scene and itself.

Nothing expected comes from a decoder: stamps, ranges and firing times are those that the encoders
put into the packets (`tests/builders/seen.py`); windows are those of `tests/reference/batching.py`.
Organized scans, repeated returns and types: test_literal.py, tests/sensors/test_round_trip.py.
Times within a packet are whole ns for these models; what Velodyne and ROBOSENSE packets say of
themselves is cut to whole us, and that is the time that counts.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mlbatch.arrays import F64Array, I64Array
from tests.builders.four_makers import FOLDER, HOUR_NS, PLACES, VELODYNE, arrivals, main, seen
from tests.builders.run import Cloud, command, load, scan_files
from tests.builders.scene import hall
from tests.builders.seen import ASIDE_PER_M, Seen
from tests.builders.seen_points import Expected, Points
from tests.reference.batching import FeedPacket, Outcome, Settings, Window, reference_scans

PCAP = FOLDER / "four_makers.pcap"
RIG = FOLDER / "rig.yaml"
NAMES = [place.name for place in PLACES]
ROOF = PLACES.index(VELODYNE)
# Half a step of the azimuth, 0.01 degrees, is 8.7e-5 m per metre: as much only along the normal.
OFF_PER_M = 1e-4
FLOAT32_AT_20_M = 1e-5


@cache
def sensors() -> list[Seen]:
    """What each sent, in the order of the rig."""
    return [seen()[place.name] for place in PLACES]


@dataclass(frozen=True, slots=True)
class Run:
    """A conversion and what the loop makes of the same packets."""

    folder: Path
    outcome: Outcome

    @property
    def report(self) -> Any:
        """What the command says of itself."""
        return json.loads((self.folder / "report.json").read_text(encoding="utf-8"))


def reference(rate: str, slices: int, *, keep_partial: bool) -> Outcome:
    """The paper's loop over the packets in the order of their arrival."""
    feed = []
    for host_ns, name, number in arrivals():
        stamps = tuple(seen()[name].packet_stamps[number].tolist())
        valid = (True,) * len(stamps)
        feed.append(FeedPacket(NAMES.index(name), host_ns, -1, stamps, valid))
    return reference_scans(
        feed, Settings(Fraction(rate), len(NAMES), slices, keep_partial=keep_partial)
    )


def run(folder: Path, rate: str, slices: int, *words: str) -> Run:
    """`mlbatch convert`, to compare with the loop."""
    said = ["--rig", str(RIG), "--rate", rate, "--slices", str(slices), "--quiet", *words]
    outcome = command("convert", PCAP, "-o", folder, *said)
    assert (outcome.code, outcome.err) == (0, "")
    return Run(folder, reference(rate, slices, keep_partial="--keep-partial" in words))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Everything in the recording, at 20 Hz."""
    return run(tmp_path_factory.mktemp("vendors") / "out", "20", 1, "--keep-partial")


def columns_of(window: Window) -> tuple[I64Array, I64Array]:
    """Sensor of each column of a window, and its number among the sensor's."""
    sensor, packet, column = np.array(window.columns, np.int64).T
    per_packet = np.array([sight.columns_per_packet for sight in sensors()])
    return sensor, packet * per_packet[sensor] + column


def check_windows(converted: Run) -> None:
    files = scan_files(converted.folder)
    windows = converted.outcome.windows
    assert len(files) == len(windows)
    for path, window in zip(files, windows, strict=True):
        scan, (sensor, column) = load(path), columns_of(window)
        for key in ("index", "slice", "start_ns", "end_ns", "complete"):
            assert scan[key] == getattr(window, key), key
        stamps = np.choose(
            sensor, [sight.stamp_ns[column % len(sight.stamp_ns)] for sight in sensors()]
        )
        assert np.array_equal(scan["column_lidar_id"], sensor)
        assert np.array_equal(scan["column_stamp_ns"], stamps)


def check_points(converted: Run) -> None:
    """What each point is, when it was measured, where it lies, and the order of points."""
    expected = Expected(sensors())
    for path, window in zip(scan_files(converted.folder), converted.outcome.windows, strict=True):
        cloud = Cloud.of(path)
        expected_points = expected.points(*columns_of(window))
        check_cloud(cloud, expected_points)
        # On the very ray, but for the azimuth.
        away_m: F64Array = np.linalg.norm(cloud.xyz - expected_points.xyz_m, axis=1)
        assert (away_m < ASIDE_PER_M * expected_points.range_m + FLOAT32_AT_20_M).all()


def check_cloud(cloud: Cloud, expected_points: Points) -> None:
    assert np.array_equal(cloud.column, expected_points.column)
    assert np.array_equal(cloud.lidar_id, expected_points.lidar_id)
    assert np.array_equal(cloud.ring, expected_points.ring)
    assert np.array_equal(cloud.at_ns, expected_points.at_ns)
    assert np.array_equal(cloud.intensity, expected_points.level)
    np.testing.assert_array_max_ulp(cloud.range_m, expected_points.range_m.astype(np.float32), 1)


def check_places(cloud: Cloud) -> None:
    """Every point is finite, lies on a surface, and as far away as measured, but for the lens."""
    assert np.isfinite(cloud.xyz).all()
    assert np.isfinite(cloud.intensity).all()
    for number, (place, sight) in enumerate(zip(PLACES, sensors(), strict=True)):
        own = cloud.of_sensor(number)
        xyz_m = own.xyz.astype(np.float64)
        range_m = own.range_m.astype(np.float64)
        allowed_m = sight.unit_m / 2 + OFF_PER_M * range_m + FLOAT32_AT_20_M
        assert (hall().distance_to_surfaces(xyz_m) - allowed_m).max() < 0, place.name
        straight_m: F64Array = np.linalg.norm(xyz_m - place.body_from_sensor[:3, 3], axis=1)
        assert np.abs(straight_m - range_m).max() < 0.06, place.name


@pytest.mark.parametrize("words", [(), ("--keep-partial",)], ids=["whole", "partial"])
@pytest.mark.parametrize("slices", [1, 3])
@pytest.mark.parametrize("rate", ["10", "20", "15"])
def test_scans_are_those_of_the_loop(
    rate: str, slices: int, words: tuple[str, ...], tmp_path: Path
) -> None:
    converted = run(tmp_path / "out", rate, slices, *words)
    check_windows(converted)
    check_points(converted)
    report = converted.report
    columns = [sensor["columns"] for sensor in report["sensors"]]
    outcome = converted.outcome
    assert [one["written"] for one in columns] == outcome.written
    assert [one["dropped"] for one in columns] == outcome.dropped
    assert report["scans"]["written"] == len(outcome.windows)
    assert report["scans"]["incomplete"] == outcome.incomplete
    assert int(report["grid"]["t_init_ns"]) == outcome.t_init_ns


def test_windows_close_with_the_packets_of_the_loop(whole: Run) -> None:
    lines = (whole.folder / "scans.csv").read_text(encoding="utf-8").splitlines()
    place = lines[0].split(",").index("ready_host_ns")
    ready = [int(line.split(",")[place]) for line in lines[1:]]
    assert ready == [window.ready_host_ns for window in whole.outcome.windows]


def test_every_point_lies_on_a_surface_of_the_scene(whole: Run) -> None:
    check_places(Cloud.of_all(whole.folder))


def test_the_hour_passes_within_the_recording(whole: Run) -> None:
    for sight in sensors():
        assert sight.stamp_ns[0] < HOUR_NS < sight.stamp_ns[-1]
    stamps = Cloud.of_all(whole.folder).column_stamp_ns
    assert (np.diff(stamps) >= 0).all()
    assert int(stamps[-1] - stamps[0]) < 300_000_000


def test_streams_are_recognised_without_a_rig() -> None:
    outcome = command("inspect", PCAP, "--json")
    assert outcome.code == 0, outcome.err
    streams = json.loads(outcome.out)["streams"]
    models = {one["stream"]: one["model"] for one in streams if one["sensor"]}
    assert models == {f"{place.ip} > port {place.port}": place.model for place in PLACES}


def test_fixture_is_made_again_to_the_byte(tmp_path: Path) -> None:
    main(tmp_path)
    for path in sorted(tmp_path.iterdir()):
        made = path.read_bytes()
        kept = (FOLDER / path.name).read_bytes()
        assert hashlib.sha256(made).hexdigest() == hashlib.sha256(kept).hexdigest(), path.name
