"""The 3-frame capture that benchmarks replay, and the two sensors it is replayed as.

Source: `ouster/os1-128_v2.3.0_rng15_3frames` of the shared recordings; places of the fields that
change from replay to replay by facts/ouster.md sections 2 and 8.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from mlbatch.units import NS_PER_MS, NS_PER_S, NS_PER_US

CAPTURE: Final = (
    Path(__file__).resolve().parents[2]
    / ".."
    / "shared"
    / "recordings"
    / "ouster"
    / "os1-128_v2.3.0_rng15_3frames"
)
PCAP_NAME: Final = "OS-1-128_v2.3.0_1024x10_lb_n3.pcap"
METADATA_NAME: Final = "OS-1-128_v2.3.0_1024x10.json"

FRAMES_PER_CYCLE: Final = 3
COLUMNS_PER_FRAME: Final = 1024
CHANNELS: Final = 128
LIDAR_BYTES: Final = 8448
COLUMNS_PER_PACKET: Final = 16
COLUMN_BYTES: Final = 12 + 4 * CHANNELS
HEADER_BYTES: Final = 32
FRAME_ID_AT: Final = 2
SERIAL_AT: Final = 7
LAST_COLUMN_AT: Final = HEADER_BYTES + (COLUMNS_PER_PACKET - 1) * COLUMN_BYTES
COLUMN_STAMPS_AT: Final = tuple(
    HEADER_BYTES + column * COLUMN_BYTES for column in range(COLUMNS_PER_PACKET)
)
IMU_STAMPS_AT: Final = (0, 8, 16)

PCAP_HEADER: Final = struct.Struct("<IHHiIII")
RECORD: Final = struct.Struct("<IIII")
UDP_HEADER: Final = struct.Struct(">HHHH")
# Ethernet, IPv4 without options, UDP.
HEADERS_BYTES: Final = 14 + 20 + UDP_HEADER.size
# Between the last column of a packet and its capture.
TRANSPORT_NS: Final = NS_PER_MS // 2


@dataclass(frozen=True, slots=True)
class Replica:
    """One of the two sensors: who it is, and how far (ns) it runs behind the capture."""

    name: str
    serial: int
    source_ip: str
    lidar_port: int
    imu_port: int
    phase_ns: int
    translation_m: tuple[float, float, float]
    yaw_deg: float


# Ports differ because the peer refuses two sensors with headerless IMU packets on one port.
REPLICAS: Final = (
    Replica("a", 122201000998, "192.168.7.11", 7502, 7503, 0, (0.0, 0.6, 1.8), 0.0),
    Replica("b", 122201000999, "192.168.7.12", 7504, 7505, 37_100_000, (0.0, -0.6, 1.8), 90.0),
)


@dataclass(frozen=True, slots=True)
class Recorded:
    """The packets of the 3-frame capture, in order; times in ns."""

    payloads: tuple[bytes, ...]
    host_ns: tuple[int, ...]
    period_ns: int
    epoch_offset_ns: int


def read_capture(folder: Path = CAPTURE) -> Recorded:
    """Read the 3-frame capture; raises FileNotFoundError where the recordings are absent."""
    raw = (folder / PCAP_NAME).read_bytes()
    payloads, times = [], []
    at = PCAP_HEADER.size
    while at < len(raw):
        seconds, micros, size, _ = RECORD.unpack_from(raw, at)
        at += RECORD.size
        payloads.append(raw[at + HEADERS_BYTES : at + size])
        times.append(seconds * NS_PER_S + micros * NS_PER_US)
        at += size
    lidar = [payload for payload in payloads if len(payload) == LIDAR_BYTES]
    packets_per_frame = COLUMNS_PER_FRAME // COLUMNS_PER_PACKET
    first_ns = u64(lidar[0], HEADER_BYTES)
    last_frame_ns = u64(lidar[-packets_per_frame], HEADER_BYTES)
    # Three frames last as long as 3/2 of the way from the first frame's start to the third's.
    period_ns = (last_frame_ns - first_ns) * FRAMES_PER_CYCLE // (FRAMES_PER_CYCLE - 1)
    offset_ns = times[0] - TRANSPORT_NS - u64(lidar[0], LAST_COLUMN_AT)
    return Recorded(tuple(payloads), tuple(times), period_ns, offset_ns)


def datagram(replica: Replica, payload: bytes) -> bytes:
    """The UDP datagram; its checksum is 0, none, since stamps are rewritten."""
    port = replica.imu_port
    if len(payload) == LIDAR_BYTES:
        port = replica.lidar_port
        serial = replica.serial.to_bytes(5, "little")
        payload = payload[:SERIAL_AT] + serial + payload[SERIAL_AT + 5 :]
    return UDP_HEADER.pack(port, port, UDP_HEADER.size + len(payload), 0) + payload


def write_rig(folder: Path) -> None:
    """Write `sensor_a.json`, `sensor_b.json` and `rig.yaml`."""
    rows = ["body_frame: base_link", "rate_hz: 10", "sensors:"]
    for replica in REPLICAS:
        name = f"sensor_{replica.name}.json"
        metadata = json.loads((CAPTURE / METADATA_NAME).read_text(encoding="utf-8"))
        metadata["prod_sn"] = str(replica.serial)
        metadata["udp_port_lidar"] = replica.lidar_port
        metadata["udp_port_imu"] = replica.imu_port
        (folder / name).write_text(json.dumps(metadata, indent=1), encoding="utf-8")
        translation = ", ".join(f"{value:g}" for value in replica.translation_m)
        rows += [
            f"  - name: {replica.name}",
            f'    stream: {{serial: "{replica.serial}"}}',
            f"    metadata: {name}",
            f"    extrinsics: {{translation_m: [{translation}],"
            f" rotation_rpy_deg: [0, 0, {replica.yaw_deg:g}]}}",
        ]
    (folder / "rig.yaml").write_text("\n".join(rows) + "\n", encoding="utf-8")


def u16(payload: bytes, at: int) -> int:
    """Little-endian number of two bytes at `at`."""
    return int.from_bytes(payload[at : at + 2], "little")


def u64(payload: bytes, at: int) -> int:
    """Little-endian number of eight bytes at `at`."""
    return int.from_bytes(payload[at : at + 8], "little")
