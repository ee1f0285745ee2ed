"""Short sessions of lidars of all vendors, as records of a capture or messages of a bag.

Every lidar sees walls at one distance; all begin at the same time by their clocks.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mlbatch.simulate.hesai.encode import angles_csv
from mlbatch.simulate.spinning import SpinningSpec
from tests.builders import livox
from tests.builders.bags import Recorded
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.lidar_packets import Payloads, even
from tests.builders.messages import Unit as Sender
from tests.builders.messages import messages
from tests.builders.sessions import Records, Unit

# 800 s past the full hour.
BEGIN_NS = 1_700_000_000 * 10**9
BEGIN_US = 800_000_000.0
RAW_RANGE = 2000
LEVEL = 50


def lidar_payloads(spec: SpinningSpec, packets: int) -> Payloads:
    """(receive time, payload) of packets with points."""
    return even(spec, packets, RAW_RANGE, LEVEL)


def livox_payloads(spec: livox.LivoxSpec, packets: int) -> Payloads:
    """(receive time, payload) of point packets."""
    points = packets * spec.points
    coordinates = np.full((points, spec.returns, 3), RAW_RANGE)
    return livox.point_packets(spec, coordinates, np.full((points, spec.returns), LEVEL))


def framed(payloads: Payloads, ip: str, port: int) -> Records:
    """Payloads as frames of a capture; none is too large for one."""
    return [(host_ns, udp_frame(payload, ip, dport=port)[0]) for host_ns, payload in payloads]


def write_capture(folder: Path, *records: Records) -> Path:
    """`drive.pcap` in a folder of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    every = [record for some in records for record in some]
    return write_pcap(folder / "drive.pcap", sorted(every, key=lambda record: record[0]))


def hesai_csv(path: Path, channels: int, lowest_deg: float = -15.0) -> None:
    """An angle file of a unit whose beams are spread evenly from 15 degrees on downward."""
    elevation = np.linspace(15.0, lowest_deg, channels).round(3).tolist()
    path.write_bytes(angles_csv(elevation, [0.0] * channels))


def robosense_csv(path: Path, channels: int) -> None:
    """An angle file of the vendor."""
    path.write_text("".join(f"{n - 8}.0,0.5\n" for n in range(channels)), encoding="utf-8")


def rslidar_messages(payloads: Payloads, topic: str = "/rslidar_packets") -> list[Recorded]:
    """Point and device packets on one topic, as the vendor's driver publishes them."""
    return messages(Sender("robosense", topic, sorted(payloads)), "cdr")


def ouster(turns: int = 3) -> Unit:
    """An Ouster that begins with the others."""
    return Unit(begin_ns=BEGIN_NS, turns=turns)


def write_rig(path: Path, *sensors: str) -> None:
    """A rig; sensors: text in braces of each."""
    lines = [f"- {{{sensor}}}\n" for sensor in sensors]
    path.write_text("sensors:\n" + "".join(lines), encoding="utf-8")
