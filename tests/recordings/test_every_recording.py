"""Every real recording: names of its packets, its clock, its loss, its points, its bytes.

A row is a recording. Figures: recordings/MANIFEST.md (last column); docs/sources/hesai.md section 4
and docs/sources/velodyne.md section 7 (receive time minus stamp, measured with other programs).
Ouster stamps are those of columns, which a receive time follows by up to the length of a packet,
1.6 ms. No packet is known to be missing: counts continue without a gap, the Pandar40P's and the
Velodynes' packets follow at their pace, and the silence of the VLP-32C for half of each revolution
"is normal, not loss".

`digests.json` holds the start of a SHA-256 of scans, table and report of each. To write it again,
after a change that is meant:

    python -m tests.recordings.test_every_recording --write
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from mlbatch import sensors
from mlbatch.batching.intake import NEVER, extremes
from mlbatch.clocks.compare import SYNCHRONISED, UNSYNCHRONISED, compare
from mlbatch.clocks.watch import ClockEstimate, ClockWatch
from mlbatch.discovery.calibrations import find_calibrations
from mlbatch.discovery.discover import SensorSelection
from mlbatch.discovery.first_seconds import FirstSeconds
from mlbatch.discovery.match import match
from mlbatch.discovery.sampler import Sampler, split_by_kind
from mlbatch.pipeline.job import Job
from mlbatch.readers import merge, open_recording
from mlbatch.types import StreamTable
from tests.builders.engines import check_conversion
from tests.builders.loss import Came
from tests.builders.run import command
from tests.builders.vendors import named
from tests.contract.tree import ROOT
from tests.golden.digest_outputs import Digests
from tests.recordings import RECORDINGS
from tests.recordings.references import assert_same_points, converted

NS_PER_S = 10**9


@dataclass(frozen=True, slots=True)
class Row:
    """A recording of a lidar.

    packets: of it, 0: of several lidars; domain: of its clock; offset_s: stamp minus receive time,
    None: not stated; name: of its packets, but those of Ouster; has_positions: packets of port
    8308; is_literal: the literal decoder takes some of its columns.
    """

    folder: str
    packets: int = 0
    domain: str = "uptime"
    offset_s: float | None = None
    within_s: float = 0.003
    name: str = ""
    has_positions: bool = False
    is_literal: bool = False

    def __str__(self) -> str:
        return self.folder

    @property
    def path(self) -> Path:
        """The capture, or the folder of the bag."""
        folder = RECORDINGS / self.folder
        (path,) = [*folder.glob("*.pcap"), *(one.parent for one in folder.rglob("*.db3"))]
        return path


def hesai(folder: str, packets: int, offset_s: float, name: str, *, literal: bool = True) -> Row:
    return Row(
        f"hesai/{folder}",
        *(packets, "wrong_year", offset_s),
        name=f"HESAI lidar {name}",
        is_literal=literal,
    )


DUAL = "dual return, last and strongest"
BELIED = "VLP-16 (its product byte says HDL-32E), strongest return"
ROWS = (
    hesai("pandar40p", 1439, -168685362.42959, f"Pandar40P or Pandar40M, {DUAL}"),
    hesai("pandar64", 2400, -80317350.51931, f"Pandar64, {DUAL}"),
    hesai("pandar64_all-points", 2400, -80317350.51931, f"Pandar64, {DUAL}", literal=False),
    hesai("pandarqt64", 1200, -168692912.86951, "PandarQT64, dual return, first and last"),
    hesai("pandarxt16", 1626, -168820178.59049, f"PandarXT-16, {DUAL}"),
    hesai("pandarxt32", 2000, -109375908.08108, f"PandarXT-32, {DUAL}"),
    Row("ouster/os0-128_512x10_crc", 34),
    Row("ouster/os0-128_v2.3.0_rng15", 64, is_literal=True),
    Row("ouster/os0-128_windowed", 17, is_literal=True),
    Row("ouster/os0-32_v2.2.0_rng19-dual", 64, is_literal=True),
    Row("ouster/os0-32_v2.2.0_single-packet", 1),
    Row("ouster/os1-128_v2.3.0_rng15_3frames", 192),
    Row("ouster/os1-32-g_v2.1.1_legacy", 64, is_literal=True),
    Row("ouster/os1-64_fw1_legacy_broadcast", 100, "utc", 0.454),
    Row("ouster/os1-64_fw2.0_legacy_reduced-config", 64),
    Row("ouster/os2-128_duplicate-ip-id", 1, "unknown", 540.79, 0.01),
    Row("ouster/two-sensors_same-ports_legacy"),
    Row("ouster/two-sensors_same-ports_nonlegacy"),
    Row(
        "velodyne/hdl32e_named-vlp32",
        *(91, "utc", -0.9, 0.05, "Velodyne lidar HDL-32E, strongest return"),
        has_positions=True,
    ),
    Row("velodyne/vlp16_azimuth-36000", name=f"Velodyne lidar {BELIED}", has_positions=True),
    Row(
        "velodyne/vlp16_gps",
        *(293, "utc", -0.368, 0.003, "Velodyne lidar VLP-16, strongest return"),
        has_positions=True,
        is_literal=True,
    ),
    Row(
        "velodyne/vlp16_ros2_dual",
        *(603, "top_of_hour", -1531.18, 0.01, "Velodyne lidar VLP-16, dual return"),
        is_literal=True,
    ),
    Row(
        "velodyne/vlp16_wrong-product-byte",
        *(84, "top_of_hour", None, 0, f"Velodyne lidar {BELIED}"),
        has_positions=True,
    ),
    Row(
        "velodyne/vlp32c_ros2",
        *(379, "top_of_hour", -51.7, 0.05, "Velodyne lidar VLP-32C, strongest return"),
        is_literal=True,
    ),
)
OTHERS = (
    *("ouster/empty-pcap/empty_pcap.pcap", "ouster/os0-128_imu-zone-no-lidar/imu_zm_no_lidar.pcap"),
    *(
        "other/lslidar-1212-byte-lookalike/VLI-16-one-packet.pcap",
        "other/sick-tcp_pcapng/test.pcapng",
    ),
)
# Fewer packets give no pace.
FEWEST = 17
every_named = pytest.mark.parametrize("row", [row for row in ROWS if row.name], ids=str)
every_one = pytest.mark.parametrize("row", [row for row in ROWS if row.packets], ids=str)
every_long = pytest.mark.parametrize("row", [row for row in ROWS if row.packets >= FEWEST], ids=str)
every_literal = pytest.mark.parametrize("row", [row for row in ROWS if row.is_literal], ids=str)


def test_every_recording_has_a_row() -> None:
    folders = {f"{path.parent.name}/{path.name}" for path in RECORDINGS.glob("*/*")}
    others = {path.rpartition("/")[0] for path in OTHERS}
    known = {row.folder for row in ROWS} | others
    known |= {f"{vendor}/calibration-without-recording" for vendor in ("hesai", "velodyne")}
    assert folders == known


# -- names ----------------------------------------------------------------------------------------


def _sampled(path: Path) -> Sampler:
    table = StreamTable()
    sampler = Sampler(table)
    for batch in open_recording(path, table).packets():
        sampler.add(batch)
    return sampler


@every_named
def test_names(row: Row) -> None:
    """Of points and positions; for Ouster see `test_ouster_match.py`."""
    sampler = _sampled(row.path)
    samples = [sampler.evidence(kind).sample for kind in sampler.kinds]
    found = {sample.shape[1]: sensors.describe(sample.shape[1], sample) for sample in samples}
    assert found.pop(512, "") == ("Velodyne position packet" if row.has_positions else "")
    assert list(found.values()) == [row.name]


def test_a_look_alike_is_named() -> None:
    (sample,) = (
        sampler.evidence(kind).sample
        for sampler in [_sampled(RECORDINGS / OTHERS[2])]
        for kind in sampler.kinds
    )
    assert sensors.describe(1212, sample) == "LSLIDAR-like, 1212 bytes: not supported"


def test_packets_of_ouster_are_unknown_to_others() -> None:
    checked = 0
    for path in sorted((RECORDINGS / "ouster").rglob("*.pcap")):
        sampler = _sampled(path)
        for kind in sampler.kinds:
            sample = sampler.evidence(kind).sample
            assert named(sample) is None
            assert all(named(packet[None]) is None for packet in sample)
            checked += len(sample)
    assert checked > 100


# -- clocks and loss ------------------------------------------------------------------------------


@lru_cache(maxsize=2)
def _read(path: Path) -> Mapping[str, Came]:
    """Packets of the lidars of a recording, found as the program finds them."""
    table = StreamTable()
    recordings = [open_recording(path, table)]
    first = FirstSeconds(recordings, table)
    calibrations, _ = find_calibrations([path], ())
    known = match(first.sampler, [*calibrations, *first.metadata.calibrations()], {}).sensors
    parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {one.name: [] for one in known}
    for batch in merge(recordings):
        for kind, index in split_by_kind(batch):
            for sensor in known:
                if kind not in sensor.kinds:
                    continue
                size = sensor.lidar.packet_size
                packets = batch.data[batch.start[index, None] + np.arange(size)]
                mine = sensor.lidar.sent_by_me(packets)
                parts[sensor.name].append((packets[mine], batch.host_ns[index[mine]]))
    found = {}
    for sensor in known:
        packets, host_ns = (np.concatenate(one) for one in zip(*parts[sensor.name], strict=True))
        lidar = sensor.lidar
        assert (lidar.faults(packets) == 0).all()
        headers = lidar.column_headers(packets, host_ns)
        found[sensor.name] = Came(lidar, lidar.sequence(packets), headers, host_ns)
    return found


def _only(row: Row) -> Came:
    (came,) = _read(row.path).values()
    return came


def _estimates(path: Path) -> dict[str, ClockEstimate]:
    """Clocks of the sensors of a recording."""
    found = {}
    for name, came in _read(path).items():
        watch = ClockWatch(period_ns=came.lidar.clock_period_ns)
        _, newest_ns = extremes(came.headers)
        known = newest_ns > NEVER
        watch.add(newest_ns[known], came.host_ns[known])
        estimate = watch.estimate()
        assert estimate is not None
        found[name] = estimate
    return found


@every_one
def test_the_clock(row: Row) -> None:
    (estimate,) = _estimates(row.path).values()
    assert estimate.domain == row.domain
    assert (estimate.packets, estimate.damaged, estimate.jumps) == (row.packets, 0, ())
    if row.offset_s is not None:
        assert estimate.offset_ns / NS_PER_S == pytest.approx(row.offset_s, abs=row.within_s)
    # All are shorter than a second, which is too short for a rate.
    assert estimate.drift_ppm is None


@pytest.mark.parametrize("path", OTHERS)
def test_nothing_is_said_where_no_lidar_is(path: str) -> None:
    assert _estimates(RECORDINGS / path) == {}


# Uptimes of the two sensors at the same instant by the manifest, s.
@pytest.mark.parametrize(("folder", "uptimes_s"), [("nonlegacy", (11088, 16011)), ("legacy", None)])
def test_two_sensors_that_count_from_power_on(
    folder: str, uptimes_s: tuple[int, int] | None
) -> None:
    """A packet each: apart by hours, which is sure; how far exactly is not."""
    found = _estimates(Row(f"ouster/two-sensors_same-ports_{folder}").path)
    assert [estimate.domain for estimate in found.values()] == ["uptime", "uptime"]
    if uptimes_s is not None:
        stated_s = sorted(one.segments[0].first_stamp_ns / NS_PER_S for one in found.values())
        assert stated_s == pytest.approx(uptimes_s, abs=0.5)
    comparison = compare(list(found.items()))
    assert comparison.verdict == UNSYNCHRONISED
    assert comparison.pairs[0].why.startswith("apart, and too few packets")
    assert comparison.pairs[0].least_ns > NS_PER_S


@pytest.mark.parametrize("name", ["two_lidars/two_lidars.pcap", "four_makers/four_makers.pcap"])
def test_sensors_of_the_fixtures_are_synchronised(name: str) -> None:
    """Their SOURCE.md: UTC for all, packets on the way for about a millisecond."""
    comparison = compare(list(_estimates(ROOT / "fixtures" / name).items()))
    assert comparison.verdict == SYNCHRONISED
    assert {estimate.domain for _, estimate in comparison.estimates} == {"utc"}


@every_one
def test_nothing_is_lost(row: Row) -> None:
    packets = _only(row)
    assert len(packets.host_ns) == row.packets
    assert packets.counted() == (0, 0)


@every_long
def test_what_is_taken_out_is_what_is_lost(row: Row) -> None:
    """All but the first and the last packet: the packets before are unknown."""
    packets = _only(row)
    for seed, share in enumerate((0.01, 0.2, 0.4)):
        came = np.random.default_rng(seed).random(row.packets) >= share
        came[[0, -1]] = True
        missing = int(np.count_nonzero(~came))
        assert packets.counted(came) == packets.counted(came, size=7) == (missing, 0)


# -- points and bytes -----------------------------------------------------------------------------


@every_literal
def test_points_are_those_of_the_literal_decoder(row: Row) -> None:
    check_conversion(Job((row.path,), SensorSelection(identity_extrinsics=True), keep_partial=True))


@pytest.mark.parametrize(
    "row", [row for row in ROWS if row.packets and not row.folder.startswith("ouster")], ids=str
)
def test_points_do_not_depend_on_the_windows(row: Row, tmp_path: Path) -> None:
    whole = converted(row.path, tmp_path / "whole", "--keep-repeated").cloud
    for number, words in enumerate((("--rate", "29.97"), ("--rate", "5", "--slices", "7"))):
        again = converted(row.path, tmp_path / str(number), "--keep-repeated", *words).cloud
        assert_same_points(again, whole)


_DIGESTS = Path(__file__).with_name("digests.json")
_WINDOWS: Mapping[str, tuple[str, ...]] = {
    "10 Hz": (),
    "100 Hz": ("--rate", "100"),
    "10 slices": ("--slices", "10"),
}


def _digests(row: Row, windows: str, folder: Path) -> dict[str, str]:
    """Digest of the scans, of scans.csv and of the report."""
    result = command(
        *("convert", row.path, "-o", folder / "out"),
        *("--identity-extrinsics", "--keep-partial", "--quiet", *_WINDOWS[windows]),
        # Clocks of two sensors count from power-on.
        *(() if row.packets or row.name else ("--align-clocks",)),
    )
    assert result.code == 0, result.err
    digests = Digests()
    digests.add_folder(folder)
    tables = {name for name in digests.product if name.endswith("scans.csv")}
    report = {key: value for key, value in digests.context.items() if not key.endswith(" inputs")}
    parts: dict[str, Mapping[str, str]] = {
        "scans": {key: digests.product[key] for key in digests.product.keys() - tables},
        "table": {key: digests.product[key] for key in tables},
        "report": report,
    }
    return {
        part: hashlib.sha256(json.dumps(sorted(values.items())).encode()).hexdigest()[:16]
        for part, values in parts.items()
    }


@pytest.mark.parametrize("windows", _WINDOWS)
@pytest.mark.parametrize("row", ROWS, ids=str)
def test_bytes_are_those_of_before(row: Row, windows: str, tmp_path: Path) -> None:
    """As npz, which has all that is decoded; the bytes of each format: tests/golden."""
    expected = json.loads(_DIGESTS.read_text("utf-8"))[f"{row} {windows}"]
    assert _digests(row, windows, tmp_path) == expected


def _write() -> None:
    found = {}
    for row in ROWS:
        for windows in _WINDOWS:
            with tempfile.TemporaryDirectory() as folder:
                found[f"{row} {windows}"] = _digests(row, windows, Path(folder))
    _DIGESTS.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n", "utf-8")


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--write", action="store_true", required=True)
    arguments.parse_args()
    _write()
