"""Make `fixtures/four_makers`: a rig of four vendors in the hall, recorded over the full hour.

    python -m tests.builders.four_makers [FOLDER]

The same bytes every time; `SOURCE.md` there describes them.
"""

from __future__ import annotations

import functools
import json
import sys
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.simulate.hesai import encode as hesai
from mlbatch.simulate.hesai.angles import Angles, angles_csv
from mlbatch.simulate.robosense import encode as robosense
from mlbatch.simulate.velodyne import encode as velodyne
from tests.builders import two_lidars
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.lidar_packets import listed
from tests.builders.scene import hall
from tests.builders.seen import (
    Eye,
    Seen,
    hesai_sees,
    ouster_sees,
    robosense_sees,
    velodyne_sees,
)
from tests.builders.two_lidars import pose

FOLDER = Path(__file__).resolve().parents[2] / "fixtures" / "four_makers"
HOST_IP = "192.168.1.10"
NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000
HOUR_NS = int(datetime(2026, 5, 4, 8, 0, 0, tzinfo=timezone.utc).timestamp()) * NS_PER_S
# The sensors measure from here on, each from another ms, until the recording ends.
START_NS = HOUR_NS - 170 * NS_PER_MS
END_NS = HOUR_NS + 130 * NS_PER_MS
MTU = 1500
# A switch of 1 Gbit/s; the capture host receives one frame after the other.
NS_PER_BYTE = 8
DIFOP_STEP_NS = 100 * NS_PER_MS
POSITION_STEP_NS = 100 * NS_PER_MS

Records = list[tuple[int, bytes]]


@dataclass(frozen=True, slots=True)
class Place:
    """How a lidar is mounted and connected; port: of its data; delay_ns: of its network."""

    name: str
    model: str
    ip: str
    port: int
    translation_m: tuple[float, float, float]
    rpy_deg: tuple[float, float, float]
    delay_ns: int
    metadata: str = ""

    @property
    def body_from_sensor(self) -> F64Array:
        """Extrinsics (4, 4), metres."""
        return pose(self.translation_m, self.rpy_deg)

    @property
    def eye(self) -> Eye:
        """What it looks at."""
        return Eye(hall(), self.body_from_sensor)


# In the order of the rig. The mounts keep the machine out of most of the view.
OUSTER = Place(
    name="left",
    model="OS-1-32-U1",
    ip="192.168.1.87",
    port=7502,
    translation_m=(0.3, 0.95, 2.45),
    rpy_deg=(0.4, 22.0, 80.0),
    delay_ns=210_000,
    metadata="left.json",
)
VELODYNE = Place(
    name="roof",
    model="VLP-16",
    ip="192.168.1.201",
    port=2368,
    translation_m=(-0.1, 0.05, 2.6),
    rpy_deg=(0.3, 4.0, -1.5),
    delay_ns=130_000,
)
HESAI = Place(
    name="right",
    model="PandarXT-16",
    ip="192.168.1.202",
    port=2368,
    translation_m=(0.28, -0.9, 2.4),
    rpy_deg=(-20.5, 1.2, -150.0),
    delay_ns=260_000,
    metadata="right.csv",
)
ROBOSENSE = Place(
    name="rear",
    model="Helios 16",
    ip="192.168.1.200",
    port=6699,
    translation_m=(-1.5, 0.1, 2.2),
    rpy_deg=(0.0, -6.0, 178.0),
    delay_ns=90_000,
)
PLACES = (OUSTER, VELODYNE, HESAI, ROBOSENSE)
POSITION_PORT = 8308
DIFOP_PORT = 7788

OUSTER_LIDAR = replace(
    two_lidars.RIGHT,
    name=OUSTER.name,
    ip=OUSTER.ip,
    zero_ms=-170,
    translation_m=OUSTER.translation_m,
    rpy_deg=OUSTER.rpy_deg,
)
# Past 07:00: its stamps begin anew at 08:00, within the recording.
VELODYNE_SPEC = velodyne.VelodyneSpec(
    "VLP-16",
    "dual",
    rpm=600.0,
    start_azimuth_deg=211.37,
    start_us=(3600 * NS_PER_MS * 1000 - 166_303_000) / 1000,
    hour=HOUR_NS // NS_PER_S // 3600 - 1,
)
HESAI_SPEC = hesai.HesaiSpec(
    "PandarXT-16", rpm=750, start_deg=83.21, start_ns=START_NS + 1_640_000, sequence=2**32 - 300
)
HESAI_ANGLES = Angles(
    [round(15.0 - 2 * beam + 0.013 * (beam * 5 % 7 - 3), 3) for beam in range(16)],
    [round(0.9 * (beam % 2) - 0.45 + 0.017 * (beam * 3 % 5), 3) for beam in range(16)],
)
ROBOSENSE_SPEC = robosense.RobosenseSpec(
    "Helios 16", rpm=597, start_deg=301.66, start_ns=START_NS + 6_200_500, first_counter=41
)
ROBOSENSE_ANGLES = robosense.fan(ROBOSENSE_SPEC)

RIG = """\
# A machine with lidars of four makers; see SOURCE.md.
body_frame: base_link
rate_hz: 20
sensors:
"""
RIG_SENSOR = """\
  - name: {name}
    stream: {{source_ip: {ip}, port: {port}}}
    extrinsics: {{translation_m: {translation}, rotation_rpy_deg: {rotation}}}
"""


@functools.cache
def seen() -> dict[str, Seen]:
    """What each sensor sent during the recording, by its name in the rig."""
    sights = {
        OUSTER.name: ouster_sees(OUSTER_LIDAR, OUSTER.eye, HOUR_NS, 4),
        VELODYNE.name: velodyne_sees(VELODYNE_SPEC, VELODYNE.eye, 470),
        HESAI.name: hesai_sees(HESAI_SPEC, HESAI_ANGLES, HESAI.eye, 760),
        ROBOSENSE.name: robosense_sees(ROBOSENSE_SPEC, ROBOSENSE_ANGLES, ROBOSENSE.eye, 230),
    }
    return {name: _recorded(sight) for name, sight in sights.items()}


def arrivals() -> list[tuple[int, str, int]]:
    """Receive time (of its last frame), sensor and number of every lidar packet, as recorded."""
    return [(sent.last_ns, sent.name, sent.number) for sent in _network() if sent.number >= 0]


def main(folder: Path) -> None:
    """Write the pcap, the calibration files and the rig."""
    folder.mkdir(parents=True, exist_ok=True)
    records = [record for sent in _network() for record in sent.records]
    write_pcap(folder / "four_makers.pcap", records)
    document = json.dumps(two_lidars.metadata(OUSTER_LIDAR), indent=2)
    (folder / OUSTER.metadata).write_bytes(document.encode() + b"\n")
    csv = angles_csv(HESAI_ANGLES.elevation_deg, HESAI_ANGLES.azimuth_deg)
    (folder / HESAI.metadata).write_bytes(csv)
    (folder / "rig.yaml").write_bytes(rig_text().encode())


def rig_text() -> str:
    """The rig (docs/rig.md)."""
    text = RIG
    for place in PLACES:
        text += RIG_SENSOR.format(
            name=place.name,
            ip=place.ip,
            port=place.port,
            translation=list(place.translation_m),
            rotation=list(place.rpy_deg),
        )
        text += f"    metadata: {place.metadata}\n" if place.metadata else ""
    return text


def _recorded(sight: Seen) -> Seen:
    """Whole packets that were measured before the end of the recording."""
    packets = int((sight.packet_stamps[:, -1] < END_NS).sum())
    columns = packets * sight.columns_per_packet
    if packets == len(sight.payloads):
        raise ValueError(
            "expected packets until the end of the recording, found fewer; encode more"
        )
    return replace(
        sight,
        stamp_ns=sight.stamp_ns[:columns],
        firing_ns=sight.firing_ns[:columns],
        counts=sight.counts[:columns],
        level=sight.level[:columns],
        xyz_m=sight.xyz_m[:columns],
        payloads=sight.payloads[:packets],
    )


@dataclass(frozen=True, slots=True)
class _Datagram:
    """number: of a lidar packet in its stream, -1 for other packets."""

    ready_ns: int
    name: str
    number: int
    frames: list[bytes]


@dataclass(frozen=True, slots=True)
class _Sent:
    name: str
    number: int
    records: Records

    @property
    def last_ns(self) -> int:
        """Receive time of the frame that completes it."""
        return self.records[-1][0]


@functools.cache
def _network() -> tuple[_Sent, ...]:
    """All datagrams in the order in which the switch lets them through."""
    waiting = [one for place in PLACES for one in _datagrams(place)]
    waiting.sort(key=lambda one: (one.ready_ns, one.name, one.number))
    sent = []
    free_ns = 0
    for one in waiting:
        records = []
        for frame in one.frames:
            free_ns = max(free_ns, one.ready_ns) + len(frame) * NS_PER_BYTE
            records.append((free_ns, frame))
        sent.append(_Sent(one.name, one.number, records))
    return tuple(sent)


def _datagrams(place: Place) -> list[_Datagram]:
    lidar = [
        (ready_ns, place.port, number, payload)
        for number, (ready_ns, payload) in enumerate(seen()[place.name].payloads)
    ]
    others = [(ready_ns, port, -1, payload) for ready_ns, port, payload in _others(place)]
    found = []
    before_ns = 0
    for ident, (ready_ns, port, number, payload) in enumerate(sorted(lidar + others)):
        # The network's delay varies by up to 0.1 ms, but packets of a sensor stay in order.
        before_ns = max(before_ns, ready_ns + place.delay_ns + ident * 37 % 11 * 10_000)
        frames = udp_frame(payload, place.ip, HOST_IP, port, port, ident=ident, mtu=MTU)
        found.append(_Datagram(before_ns, place.name, number, frames))
    return found


def _others(place: Place) -> list[tuple[int, int, bytes]]:
    """Receive time, port and payload of packets without points."""
    if place is VELODYNE:
        end_us = (END_NS - START_NS) // 1000 - 5_000
        step_us = 1e-3 * POSITION_STEP_NS
        times_us = np.arange(2_000, end_us, step_us, dtype=np.float64)
        sent = velodyne.position_packets(VELODYNE_SPEC, times_us)
        return [(at, POSITION_PORT, row) for at, row in listed(sent)]
    if place is ROBOSENSE:
        times_ns = range(START_NS + 9 * NS_PER_MS, END_NS, DIFOP_STEP_NS)
        return [
            (
                time_ns,
                DIFOP_PORT,
                robosense.difop(ROBOSENSE_SPEC, ROBOSENSE_ANGLES, time_ns=time_ns),
            )
            for time_ns in times_ns
        ]
    return []


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
