"""Real recordings against the vendor's own decoder (MANIFEST.md of the recordings, reference A)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import BoolArray, F32Array, I64Array
from tests.builders.run import Cloud, command
from tests.recordings.ouster import CASES, OUSTER, PAIRS, Case, twins

TOLERANCE_M = 1e-4


def convert(*cases: Case) -> list[str | Path]:
    """The begin of a command on one sensor, or on both of a pair."""
    files = twins(cases[0].folder.rpartition("_")[2]) if cases[0].only else cases
    words: list[str | Path] = ["convert", cases[0].path]
    for case in files:
        words += ["--metadata", case.metadata_path]
    return words + (["--only", cases[0].only] if cases[0].only and len(cases) == 1 else [])


@dataclass(frozen=True, slots=True)
class Reference:
    """Valid pixels of the decoder's output in the order of our points; columns by stamp."""

    stamp_ns: I64Array
    ring: I64Array
    range_mm: I64Array
    reflectivity: I64Array
    signal: I64Array | None
    xyz_m: F32Array
    column_stamp_ns: I64Array

    @classmethod
    def of(cls, case: Case) -> Reference:
        """Pixels with a range, in columns that the sensor calls valid."""
        with np.load(OUSTER / case.folder / case.reference) as npz:
            valid: BoolArray = npz["valid"]
            stamp_ns = npz["timestamp_ns"].astype(np.int64)
            range_mm = npz["range_mm"].astype(np.int64)
            hit = (range_mm > 0) & valid[:, None, :, None]
            frame, row, column, which = np.nonzero(hit)
            at_ns = stamp_ns[frame, column]
            order = np.lexsort((which, row, at_ns))
            return cls(
                at_ns[order],
                row[order],
                range_mm[hit][order],
                npz["reflectivity"][hit].astype(np.int64)[order],
                npz["signal"][hit].astype(np.int64)[order] if "signal" in npz.files else None,
                npz["xyz_m"][hit][order],
                np.sort(stamp_ns[valid]),
            )


def compare(found: Cloud, expected: Reference, *, ring_base: int = 0) -> None:
    """Every pixel, in order, and nothing else; stamps aside."""
    assert len(found.range_m) == len(expected.range_mm)
    assert np.array_equal(found.ring, expected.ring + ring_base)
    # Whole millimetres in float32, exact to its last bit.
    assert np.array_equal(found.range_m, (expected.range_mm / 1000).astype(np.float32))
    reflectivity = found.intensity if found.reflectivity is None else found.reflectivity
    assert np.array_equal(reflectivity, expected.reflectivity)
    if expected.signal is not None:
        assert np.array_equal(found.intensity, expected.signal)
    error_m = np.abs(found.xyz.astype(np.float64) - expected.xyz_m).max(axis=1)
    assert error_m.max() <= TOLERANCE_M


@pytest.mark.parametrize("case", CASES, ids=str)
def test_every_pixel_of_a_sensor_alone(case: Case, tmp_path: Path) -> None:
    result = command(*convert(case), "-o", tmp_path / "scans", "--keep-partial")
    assert result.code == 0, result.err
    found, expected = Cloud.of_all(tmp_path / "scans"), Reference.of(case)
    assert np.array_equal(found.column_stamp_ns, expected.column_stamp_ns)
    assert np.array_equal(found.stamp_ns, expected.stamp_ns)
    assert np.array_equal(found.at_ns, expected.stamp_ns)
    compare(found, expected)


@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: pair[0].folder)
def test_clocks_thousands_of_seconds_apart_are_an_error(
    pair: tuple[Case, Case], tmp_path: Path
) -> None:
    result = command(*convert(*pair), "-o", tmp_path / "scans", "--identity-extrinsics")
    assert result.code == 1
    assert result.err.count("\n") == 1, result.err
    assert "--clock host" in result.err
    assert "clock.offset_s" in result.err
    for case in pair:
        assert f"ouster_{case.only}" in result.err
        assert f"{_offset_s(case):.3f}" in result.err
    assert not (tmp_path / "scans").exists()


def _offset_s(case: Case) -> float:
    """Newest stamp minus receive time of the fastest packet, as the decoder's output has them."""
    with np.load(OUSTER / case.folder / case.reference) as npz:
        receive_ns = npz["packet_timestamp_ns"].astype(np.int64)
        stamp_ns = np.where(npz["valid"], npz["timestamp_ns"].astype(np.int64), 0)
    newest_ns = stamp_ns.reshape(*receive_ns.shape, -1).max(axis=-1)
    known = (receive_ns > 0) & (newest_ns > 0)
    return float((newest_ns - receive_ns)[known].max()) / 1e9


@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: pair[0].folder)
def test_two_sensors_by_receive_time(pair: tuple[Case, Case], tmp_path: Path) -> None:
    result = command(
        *convert(*pair),
        *("-o", tmp_path / "scans", "--keep-partial", "--clock", "host", "--identity-extrinsics"),
    )
    assert result.code == 0, result.err
    cloud, total, ring_base = Cloud.of_all(tmp_path / "scans"), 0, 0
    # Sensors are ordered by serial number.
    for number, case in enumerate(sorted(pair, key=lambda case: case.only)):
        found, expected = cloud.of_sensor(number), Reference.of(case)
        compare(found, expected, ring_base=ring_base)
        # A single packet each, hence one constant.
        assert len(np.unique(found.stamp_ns - expected.stamp_ns)) == 1
        assert len(np.unique(found.column_stamp_ns - expected.column_stamp_ns)) == 1
        total += len(expected.range_mm)
        ring_base += _channels(case)
    assert len(cloud.range_m) == total


def _channels(case: Case) -> int:
    with np.load(OUSTER / case.folder / case.reference) as npz:
        return int(npz["range_mm"].shape[1])


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("empty-pcap/empty_pcap.pcap", ["no UDP packet"]),
        ("os0-128_imu-zone-no-lidar/imu_zm_no_lidar.pcap", ["IMU", "zone monitor", "7513", "7514"]),
    ],
)
def test_recordings_without_lidar_data_say_so(path: str, words: list[str], tmp_path: Path) -> None:
    result = command("convert", OUSTER / path, "-o", tmp_path / "scans", "--keep-partial")
    assert result.code == 1
    assert result.out == ""
    assert result.err.count("\n") == 1, result.err
    for word in ("no lidar packets", "expected", "found", path.split("/")[-1], *words):
        assert word in result.err
    assert not list(tmp_path.iterdir())
