"""Payloads of the real Ouster recordings, read by dpkt: independent of the readers of mlbatch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import dpkt
import numpy as np
import numpy.typing as npt

from mlbatch.arrays import U8Array
from mlbatch.lidar.interface import Evidence
from mlbatch.types import Stream
from tests.builders.vendors import beside
from tests.recordings import RECORDINGS

OUSTER = RECORDINGS / "ouster"
Reference: TypeAlias = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Case:
    """A recording of a sensor, its metadata, what the vendor's decoder made of it.

    source, only: address and serial number of a sensor that is not alone.
    """

    folder: str
    capture: str
    metadata: str
    reference: str = "reference.npz"
    source: str = ""
    only: str = ""

    def __str__(self) -> str:
        return f"{self.folder} {self.only}".strip()

    @property
    def path(self) -> Path:
        return OUSTER / self.folder / self.capture

    @property
    def metadata_path(self) -> Path:
        return OUSTER / self.folder / self.metadata

    def arrays(self) -> Reference:
        with np.load(OUSTER / self.folder / self.reference) as archive:
            return {key: archive[key] for key in archive.files}

    def payloads(self, size: int) -> U8Array:
        """(n, size) payloads of this size, from the case's source."""
        found = [
            data
            for source, _port, data in datagrams(self.path)
            if len(data) == size and self.source in ("", source)
        ]
        return np.array([np.frombuffer(data, np.uint8) for data in found]).reshape(-1, size)


def named(folder: str, stem: str) -> Case:
    """A recording whose metadata have its name."""
    return Case(folder, f"{stem}.pcap", f"{stem}.json")


def twins(kind: str) -> tuple[Case, Case]:
    """The sensors of a recording of two: OS-0-128 and OS-1-64-AH."""
    first, second = (
        Case(
            f"two-sensors_same-ports_{kind}",
            f"same_ports_{kind}.pcap",
            f"same_ports_{kind}.{number}.json",
            *(f"reference.{number}.npz", source, serial),
        )
        for number, source, serial in (
            *((1, "169.254.92.158", "122247000785"), (2, "169.254.238.111", "122239000672")),
        )
    )
    return first, second


OS0_32 = "OS-0-32-U1_v2.2.0_1024x10"
SINGLES = (
    named("os0-128_512x10_crc", "crc_test"),
    named("os0-128_v2.3.0_rng15", "OS-0-128-U1_v2.3.0_1024x10"),
    Case("os0-128_windowed", "windowed_frame1.pcap", "windowed_frame1_0.json"),
    named("os0-32_v2.2.0_rng19-dual", OS0_32),
    Case("os0-32_v2.2.0_single-packet", f"{OS0_32}-single-packet.pcap", f"{OS0_32}.json"),
    Case(
        "os1-128_v2.3.0_rng15_3frames",
        "OS-1-128_v2.3.0_1024x10_lb_n3.pcap",
        "OS-1-128_v2.3.0_1024x10.json",
    ),
    named("os1-32-g_v2.1.1_legacy", "OS-1-32-G_v2.1.1_1024x10"),
    named("os1-64_fw1_legacy_broadcast", "ouster_example"),
    Case(
        "os1-64_fw2.0_legacy_reduced-config",
        "OS-1-64_1024x10_fw20.pcap",
        "OS-1-64_sensor_config_reduced.json",
    ),
    named("os2-128_duplicate-ip-id", "duplicate_id"),
)
PAIRS = (twins("legacy"), twins("nonlegacy"))
CASES = (*SINGLES, *(case for pair in PAIRS for case in pair))
# Its lidar is off.
ONLY_IMU = Case("os0-128_imu-zone-no-lidar", "imu_zm_no_lidar.pcap", "imu_zm_no_lidar_0.json")


def datagrams(capture: Path) -> Iterator[tuple[str, int, bytes]]:
    """(source address, destination port, payload) of every whole UDP datagram."""
    parts: dict[tuple[bytes, int], dict[int, bytes]] = {}
    with capture.open("rb") as file:
        for _time, frame in dpkt.pcap.Reader(file):
            ip = dpkt.ethernet.Ethernet(frame).data
            if not isinstance(ip, dpkt.ip.IP):
                continue
            body = bytes(ip.data)
            source = ".".join(map(str, ip.src))
            if ip.mf or ip.offset:
                key = (ip.src, ip.id)
                if ip.offset == 0:
                    parts[key] = {}
                parts.setdefault(key, {})[ip.offset] = body
                body = b"".join(parts[key][offset] for offset in sorted(parts[key]))
            if ip.p == dpkt.ip.IP_PROTO_UDP and len(body) >= 8:
                udp = dpkt.udp.UDP(body)
                if udp.ulen == len(body):
                    yield source, udp.dport, bytes(udp.data)


def evidence(capture: Path, size: int, source: str = "") -> Evidence:
    """What a discovery would gather on the payloads of one size."""
    found = [entry for entry in datagrams(capture) if source in ("", entry[0])]
    sample = [entry for entry in found if len(entry[2]) == size][:4]
    others = {(entry[0], entry[1], len(entry[2])): entry for entry in found}
    return Evidence(
        Stream(sample[0][0], sample[0][1]),
        size,
        np.array([np.frombuffer(data, np.uint8) for _, _, data in sample]),
        np.zeros(len(sample), np.int64),
        tuple(beside(Stream(ip, port), data) for (ip, port, _), (_, _, data) in others.items()),
    )
