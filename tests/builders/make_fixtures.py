"""Make `fixtures/two_lidars`: a pcap of two lidars in the hall, their metadata and the rig.

    python -m tests.builders.make_fixtures [FOLDER]

The same bytes every time; `SOURCE.md` there describes them.
"""

from __future__ import annotations

import json
import sys
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from tests.builders.captures import ipv4_packet, link_frame, udp_frame, write_pcap
from tests.builders.scene import MACHINE_HIGH_M, MACHINE_LOW_M, hall
from tests.builders.two_lidars import (
    COLUMNS_PER_PACKET,
    LEFT,
    RIGHT,
    FixtureLidar,
    column_stamps,
    imu_packet,
    metadata,
    packets,
    turn_fields,
)

FOLDER = Path(__file__).resolve().parents[2] / "fixtures" / "two_lidars"
HOST_IP = "10.5.5.1"
OTHER_IP = "10.5.5.20"
NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000
SECOND_NS = int(datetime(2026, 5, 4, 8, 0, 0, tzinfo=timezone.utc).timestamp()) * NS_PER_S
# The recording is from 20 ms to 870 ms after the full second.
START_NS = SECOND_NS + 20 * NS_PER_MS
END_NS = SECOND_NS + 870 * NS_PER_MS
TURNS = 10
MTU = 1500
# A full frame takes 120 us at 100 Mbit/s.
WIRE_NS = 120 * NS_PER_US
# From a packet's last column to its first frame at the capture host; chosen so that the frames of
# the two lidars interleave.
LATENCY_NS = {LEFT.name: 300 * NS_PER_US, RIGHT.name: 950 * NS_PER_US}
IMU_STEP_NS = 10 * NS_PER_MS
# The IP identification wraps within the recording.
FIRST_IDENT = 65_400

Records = list[tuple[int, bytes]]

RIG = """\
# A machine with two tilted lidars; see SOURCE.md.
body_frame: base_link
rate_hz: 10
sensors:
{sensors}# The machine's own body, with 0.1 m around.
exclude_boxes_m: [[{box}]]
"""
RIG_SENSOR = """\
  - name: {name}
    stream: {{serial: "{serial}"}}
    metadata: {name}.json
    extrinsics: {{translation_m: [{translation}], rotation_rpy_deg: [{rotation}]}}
"""


def main(folder: Path) -> None:
    """Write the pcap, the metadata files and the rig."""
    folder.mkdir(parents=True, exist_ok=True)
    records = foreign_frames()
    for lidar in (LEFT, RIGHT):
        records += lidar_frames(lidar)
        document = json.dumps(metadata(lidar), indent=2)
        (folder / f"{lidar.name}.json").write_bytes(document.encode() + b"\n")
    records.sort(key=lambda record: record[0])
    write_pcap(folder / "two_lidars.pcap", records, ns=False)
    (folder / "rig.yaml").write_bytes(rig_text().encode())


def lidar_frames(lidar: FixtureLidar) -> Records:
    """Receive time and bytes of every frame that a lidar sends, lidar and IMU packets."""
    stamps = column_stamps(lidar, SECOND_NS, TURNS)
    raw = packets(lidar, turn_fields(lidar, hall()), stamps)
    bounds = stamps.reshape(-1, COLUMNS_PER_PACKET)[:, [0, -1]]
    kept = np.flatnonzero((bounds[:, 0] >= START_NS) & (bounds[:, 1] < END_NS))
    # The network's delay varies by up to 0.1 ms.
    payloads = [
        (int(bounds[i, 1]) + LATENCY_NS[lidar.name] + int(i) * 37 % 11 * 10_000, 7502, raw[i])
        for i in kept
    ]
    first_imu_ns = START_NS + lidar.zero_ms * NS_PER_MS % IMU_STEP_NS
    payloads += [
        (stamp_ns + 150 * NS_PER_US, 7503, imu_packet(lidar, stamp_ns))
        for stamp_ns in range(first_imu_ns, END_NS, IMU_STEP_NS)
    ]
    records = []
    for number, (host_ns, port, payload) in enumerate(sorted(payloads)):
        ident = (FIRST_IDENT + number) % 65536
        frames = udp_frame(payload, lidar.ip, HOST_IP, port, port, ident=ident, mtu=MTU)
        records += [(host_ns + i * WIRE_NS, frame) for i, frame in enumerate(frames)]
    return records


def foreign_frames() -> Records:
    """What else is on such a network: ARP, TCP, and datagrams of no lidar (multicast DNS)."""
    arp = bytes(12) + b"\x08\x06" + bytes.fromhex("0001080006040001") + bytes(38)
    tcp = link_frame(ipv4_packet(bytes(20), OTHER_IP, HOST_IP, protocol=6))
    dns = udp_frame(bytes(12), OTHER_IP, "224.0.0.251", 5353, 5353)[0]
    plan = [(arp, 31), (tcp, 120), (tcp, 121), (dns, 250), (arp, 402), (dns, 650), (arp, 777)]
    return [(SECOND_NS + at_ms * NS_PER_MS + 7_000, frame) for frame, at_ms in plan]


def rig_text() -> str:
    """The rig (docs/rig.md)."""
    sensors = [
        RIG_SENSOR.format(
            name=lidar.name,
            serial=lidar.serial,
            translation=", ".join(map(str, lidar.translation_m)),
            rotation=", ".join(map(str, lidar.rpy_deg)),
        )
        for lidar in (LEFT, RIGHT)
    ]
    low = [round(edge - 0.1, 3) for edge in MACHINE_LOW_M]
    high = [round(edge + 0.1, 3) for edge in MACHINE_HIGH_M]
    return RIG.format(sensors="".join(sensors), box=", ".join(map(str, low + high)))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
