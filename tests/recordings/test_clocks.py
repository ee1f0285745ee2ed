"""Clock estimates on real recordings, against what is known of their clocks.

Figures: recordings/MANIFEST.md (last column); docs/sources/hesai.md section 4 and
docs/sources/velodyne.md section 7 (receive time minus stamp, measured with other programs). Ouster
stamps are those of columns, which a receive time follows by up to the length of a packet, 1.6 ms.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from mlbatch.batching.intake import NEVER, extremes
from mlbatch.clocks.compare import SYNCHRONISED, UNSYNCHRONISED, compare
from mlbatch.clocks.watch import ClockEstimate, ClockWatch
from mlbatch.discovery.calibrations import find_calibrations
from mlbatch.discovery.first_seconds import FirstSeconds
from mlbatch.discovery.match import match
from mlbatch.discovery.sampler import split_by_kind
from mlbatch.readers import merge, open_recording
from mlbatch.types import StreamTable
from tests.recordings import RECORDINGS

FIXTURES = Path(__file__).resolve().parents[2] / "fixtures"
NS_PER_S = 10**9
HOUR_NS = 3600 * NS_PER_S


@dataclass(frozen=True, slots=True)
class Case:
    """A recording; domain and stamp minus receive time, s, of its sensor: None if not stated."""

    path: str
    domain: str
    offset_s: float | None
    within_s: float = 0.003
    packets: int = 0


HESAI = (
    Case("pandar40p/1673400149412331409", "wrong_year", -168685362.42959, packets=1439),
    Case("pandar64/1673403880599376836", "wrong_year", -80317350.51931, packets=2400),
    Case("pandar64_all-points/all_points", "wrong_year", -80317350.51931, packets=2400),
    Case("pandarqt64/1673401195788312575", "wrong_year", -168692912.86951, packets=1200),
    Case("pandarxt16/1732848127890747768", "wrong_year", -168820178.59049, packets=1626),
    Case("pandarxt32/1673400677802009732", "wrong_year", -109375908.08108, packets=2000),
)
VELODYNE = (
    Case("vlp16_ros2_dual/1673400471837873222", "top_of_hour", -1531.18, 0.01, 603),
    Case("vlp32c_ros2/1713492677464078412", "top_of_hour", -51.7, 0.05, 379),
    Case("vlp16_gps/sample_velodyne_vlp16_gps.pcap", "utc", -0.368, packets=293),
    Case("hdl32e_named-vlp32/velodyne_vlp32.pcap", "utc", -0.9, 0.05, 91),
    Case("vlp16_wrong-product-byte/velodyne_vlp16.pcap", "top_of_hour", None, packets=84),
)
OUSTER = (
    Case("os0-128_v2.3.0_rng15/OS-0-128-U1_v2.3.0_1024x10.pcap", "uptime", None, packets=64),
    Case("os0-32_v2.2.0_rng19-dual/OS-0-32-U1_v2.2.0_1024x10.pcap", "uptime", None, packets=64),
    Case(
        "os0-32_v2.2.0_single-packet/OS-0-32-U1_v2.2.0_1024x10-single-packet.pcap",
        *("uptime", None),
        packets=1,
    ),
    Case(
        "os1-128_v2.3.0_rng15_3frames/OS-1-128_v2.3.0_1024x10_lb_n3.pcap",
        *("uptime", None),
        packets=192,
    ),
    Case("os1-32-g_v2.1.1_legacy/OS-1-32-G_v2.1.1_1024x10.pcap", "uptime", None, packets=64),
    Case(
        "os1-64_fw2.0_legacy_reduced-config/OS-1-64_1024x10_fw20.pcap",
        *("uptime", None),
        packets=64,
    ),
    Case("os1-64_fw1_legacy_broadcast/ouster_example.pcap", "utc", 0.454, packets=100),
    Case("os0-128_512x10_crc/crc_test.pcap", "uptime", None, packets=34),
    Case("os2-128_duplicate-ip-id/duplicate_id.pcap", "unknown", 540.79, 0.01, packets=1),
    Case("os0-128_windowed/windowed_frame1.pcap", "uptime", None, packets=17),
)
CASES = tuple(
    (vendor, case)
    for vendor, cases in (("hesai", HESAI), ("velodyne", VELODYNE), ("ouster", OUSTER))
    for case in cases
)
EMPTY = (
    *("ouster/empty-pcap/empty_pcap.pcap", "ouster/os0-128_imu-zone-no-lidar/imu_zm_no_lidar.pcap"),
    *(
        "other/lslidar-1212-byte-lookalike/VLI-16-one-packet.pcap",
        "other/sick-tcp_pcapng/test.pcapng",
    ),
)
# Uptimes of the two sensors at the same instant by the manifest, s.
PAIRS = (
    ("ouster/two-sensors_same-ports_nonlegacy/same_ports_nonlegacy.pcap", (11088, 16011)),
    ("ouster/two-sensors_same-ports_legacy/same_ports_legacy.pcap", None),
)


def estimates(path: Path, period_ns: int = 0) -> dict[str, ClockEstimate]:
    """Clocks of the sensors of a recording, found as the program finds them."""
    if path.is_dir():
        (path,) = path.glob("*.db3")
    table = StreamTable()
    recordings = [open_recording(path, table)]
    first = FirstSeconds(recordings, table)
    calibrations, _ = find_calibrations([path], ())
    sensors = match(first.sampler, [*calibrations, *first.metadata.calibrations()], {}).sensors
    watches = {sensor.name: ClockWatch(period_ns=period_ns) for sensor in sensors}
    for batch in merge(recordings):
        for kind, index in split_by_kind(batch):
            for sensor in sensors:
                if kind not in sensor.kinds:
                    continue
                lidar = sensor.lidar
                packets = batch.data[batch.start[index, None] + np.arange(lidar.packet_size)]
                good = lidar.sent_by_me(packets) & (lidar.faults(packets) == 0)
                host_ns = batch.host_ns[index[good]]
                _, newest_ns = extremes(lidar.column_headers(packets[good], host_ns))
                known = newest_ns > NEVER
                watches[sensor.name].add(newest_ns[known], host_ns[known])
    found = {name: watch.estimate() for name, watch in watches.items()}
    return {name: estimate for name, estimate in found.items() if estimate is not None}


@pytest.mark.parametrize(("vendor", "case"), CASES, ids=lambda value: getattr(value, "path", value))
def test_the_clock_of_a_recording(vendor: str, case: Case) -> None:
    period_ns = HOUR_NS if vendor == "velodyne" else 0
    (estimate,) = estimates(RECORDINGS / vendor / case.path, period_ns).values()
    assert estimate.domain == case.domain
    assert (estimate.packets, estimate.damaged, estimate.jumps) == (case.packets, 0, ())
    if case.offset_s is not None:
        assert estimate.offset_ns / NS_PER_S == pytest.approx(case.offset_s, abs=case.within_s)
    # All are shorter than a second, which is too short for a rate.
    assert estimate.drift_ppm is None


@pytest.mark.parametrize("path", EMPTY)
def test_nothing_is_said_where_no_lidar_is(path: str) -> None:
    assert estimates(RECORDINGS / path) == {}


@pytest.mark.parametrize(("path", "uptimes_s"), PAIRS, ids=[path for path, _ in PAIRS])
def test_two_sensors_that_count_from_power_on(path: str, uptimes_s: tuple[int, int] | None) -> None:
    """A packet each: apart by hours, which is sure; how far exactly is not."""
    found = estimates(RECORDINGS / path)
    assert [estimate.domain for estimate in found.values()] == ["uptime", "uptime"]
    if uptimes_s is not None:
        stated_s = sorted(one.segments[0].first_stamp_ns / NS_PER_S for one in found.values())
        assert stated_s == pytest.approx(uptimes_s, abs=0.5)
    comparison = compare(list(found.items()))
    assert comparison.verdict == UNSYNCHRONISED
    assert comparison.pairs[0].why.startswith("apart, and too few packets")
    assert len(comparison.apart(NS_PER_S)) == 1


@pytest.mark.parametrize("name", ["two_lidars/two_lidars.pcap", "four_makers/four_makers.pcap"])
def test_sensors_of_the_fixtures_are_synchronised(name: str) -> None:
    """Their SOURCE.md: UTC for all, packets on the way for about a millisecond."""
    comparison = compare(list(estimates(FIXTURES / name, HOUR_NS * ("four" in name)).items()))
    assert comparison.verdict == SYNCHRONISED
    assert {estimate.domain for _, estimate in comparison.estimates} == {"utc"}
