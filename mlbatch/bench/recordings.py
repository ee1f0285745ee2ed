"""The standard recordings: which lidars, how they are mounted, and the files beside a capture.

    python -m mlbatch.bench.recordings dual-4 12 FOLDER

makes one of them in a process of its own, so that the measuring process stays small.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

from mlbatch.units import NS_PER_MS

CAPTURE, RIG = "capture.pcap", "rig.yaml"
# Beside a capture: of what makes it, so that one that another version made is made anew.
DIGEST: Final = "made-by.sha256"
_MAKERS: Final = ("recordings.py", "captures.py", "lidars.py")
LOW, FULL = "RNG15_RFL8_NIR8", "RNG19_RFL8_SIG16_NIR16"
VLP16, PANDAR64 = "VLP-16", "Pandar64"
INIT_ID: Final = 7_109_750
# Ethernet, IPv4 and UDP headers, and that of a pcap record.
_HEADERS_BYTES: Final = 14 + 20 + 8 + 16


@dataclass(frozen=True, slots=True)
class Kind:
    """What a lidar sends in a second, and the suffix of the file it needs (empty: none)."""

    packets: int
    packet_bytes: int
    slots: int
    suffix: str


# An Ouster profile, or a model of another maker.
KINDS: Final[Mapping[str, Kind]] = {
    LOW: Kind(640, 8448, 10_240 * 128, ".json"),
    FULL: Kind(640, 24832, 10_240 * 128, ".json"),
    VLP16: Kind(754, 1206, 18_084 * 16, ""),
    PANDAR64: Kind(3000, 1198, 18_000 * 64, ".csv"),
}


@dataclass(frozen=True, slots=True)
class Mounted:
    """A sensor of a rig; kind: a key of KINDS."""

    name: str
    kind: str
    source_ip: str
    port: int
    phase_ns: int
    translation_m: tuple[float, float, float]
    yaw_deg: float
    serial: int = 0

    @property
    def file(self) -> str:
        """What lies beside the recording for it; empty: nothing."""
        suffix = KINDS[self.kind].suffix
        return f"{self.name}{suffix}" if suffix else ""


@dataclass(frozen=True, slots=True)
class Recording:
    """A standard recording."""

    name: str
    what: str
    sensors: tuple[Mounted, ...]
    fragments: bool = False

    @property
    def bytes_a_second(self) -> int:
        """About what its capture takes."""
        kinds = [KINDS[sensor.kind] for sensor in self.sensors]
        return sum(kind.packets * (kind.packet_bytes + _HEADERS_BYTES) for kind in kinds)

    @property
    def slots_a_second(self) -> int:
        """Most points that can come out of it."""
        return sum(KINDS[sensor.kind].slots for sensor in self.sensors)


def _dual(profile: str) -> tuple[Mounted, ...]:
    behind_ns = 37_100_000
    return (
        Mounted("a", profile, "192.168.7.11", 7502, 0, (0.0, 0.6, 1.8), 0.0, 122201000998),
        Mounted(
            "b", profile, "192.168.7.12", 7504, behind_ns, (0.0, -0.6, 1.8), 90.0, 122201000999
        ),
    )


_ROOF: Final = Mounted("roof", VLP16, "192.168.7.21", 2368, 0, (0.0, 0.0, 2.0), 0.0)
_REAR: Final = Mounted("rear", PANDAR64, "192.168.7.31", 2370, 0, (-1.0, 0.0, 1.8), 180.0)
_TRIPLE: Final = (
    _ROOF,
    Mounted("left", VLP16, "192.168.7.22", 2368, 23 * NS_PER_MS, (0.0, 0.8, 1.6), 60.0),
    Mounted("right", VLP16, "192.168.7.23", 2368, 61 * NS_PER_MS, (0.0, -0.8, 1.6), -60.0),
)
RECORDINGS: Final[Mapping[str, Recording]] = {
    recording.name: recording
    for recording in (
        Recording("dual-4", "two OS-1-128, 4 bytes a pixel", _dual(LOW)),
        Recording("dual-4-fragments", "the same in 1500-byte fragments", _dual(LOW), True),
        Recording("dual-12", "two OS-1-128, 12 bytes a pixel", _dual(FULL)),
        Recording("dual-12-fragments", "the same in 1500-byte fragments", _dual(FULL), True),
        Recording("three-vlp16", "three VLP-16, one return", _TRIPLE),
        Recording("pandar64", "a HESAI Pandar64, one return", (_REAR,)),
        Recording("mixed", "an OS-1-128, a VLP-16, a Pandar64", (_dual(LOW)[0], _ROOF, _REAR)),
    )
}


@lru_cache(maxsize=1)
def digest() -> str:
    """Of the sources that make recordings."""
    folder = Path(__file__).parent
    return hashlib.sha256(b"".join((folder / name).read_bytes() for name in _MAKERS)).hexdigest()


def is_made(folder: Path) -> bool:
    """Whether a recording stands in a folder as it would be made now."""
    made = folder / DIGEST
    is_whole = (folder / CAPTURE).is_file() and made.is_file()
    return is_whole and made.read_text(encoding="utf-8") == digest()


def make(recording: Recording, seconds: float, folder: Path) -> None:
    """Write capture, rig and what the sensors need into an existing folder."""
    from mlbatch.bench.captures import ETHERNET_MTU, JUMBO_MTU, Source, write_capture
    from mlbatch.bench.lidars import MAKERS
    from mlbatch.types import Stream

    sources = []
    for sensor in recording.sensors:
        if sensor.file:
            text = _FILES[KINDS[sensor.kind].suffix](sensor)
            (folder / sensor.file).write_text(text, encoding="utf-8")
        lidar = MAKERS[sensor.kind](sensor.serial)
        stream = Stream(sensor.source_ip, sensor.port)
        sources.append(Source(lidar, stream, sensor.phase_ns))
    (folder / RIG).write_text(_rig(recording.sensors), encoding="utf-8")
    mtu = ETHERNET_MTU if recording.fragments else JUMBO_MTU
    # A capture that is there is whole.
    partial = folder / f"{CAPTURE}.partial"
    write_capture(partial, sources, seconds, mtu)
    partial.replace(folder / CAPTURE)
    (folder / DIGEST).write_text(digest(), encoding="utf-8")


def _rig(sensors: Sequence[Mounted]) -> str:
    lines = ["body_frame: base_link", "rate_hz: 10", "sensors:"]
    for sensor in sensors:
        x, y, z = sensor.translation_m
        lines += [
            f"  - name: {sensor.name}",
            f"    stream: {{source_ip: {sensor.source_ip}, port: {sensor.port}}}",
            f"    extrinsics: {{translation_m: [{x}, {y}, {z}],"
            f" rotation_rpy_deg: [0, 0, {sensor.yaw_deg}]}}",
            *([f"    metadata: {sensor.file}"] if sensor.file else []),
        ]
    return "\n".join(lines) + "\n"


def _even(first_deg: float, last_deg: float, count: int) -> list[float]:
    step = (last_deg - first_deg) / (count - 1)
    return [round(first_deg + step * beam, 3) for beam in range(count)]


def _angles(sensor: Mounted) -> str:
    """The angle file of a Pandar64 (facts/hesai.md section 6)."""
    lines = [f"{number},{deg},0\n" for number, deg in enumerate(_even(15, -25, 64), 1)]
    return "".join(["Laser id,Elevation,Azimuth\n", *lines])


def _metadata(sensor: Mounted) -> str:
    """What an OS-1-128 tells of itself (facts/ouster.md section 1)."""
    beams = 128
    turned = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1]
    document = {
        "beam_intrinsics": {
            "beam_altitude_angles": _even(21, -21, beams),
            "beam_azimuth_angles": [(4.2, 1.4, -1.4, -4.2)[beam % 4] for beam in range(beams)],
            "beam_to_lidar_transform": [1, 0, 0, 15.806, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
            "lidar_origin_to_beam_origin_mm": 15.806,
        },
        "lidar_intrinsics": {"lidar_to_sensor_transform": turned},
        "imu_intrinsics": {
            "imu_to_sensor_transform": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
        },
        "sensor_info": {
            "prod_line": f"OS-1-{beams}",
            "prod_sn": str(sensor.serial),
            "initialization_id": INIT_ID,
            "build_rev": "v2.5.2",
            "image_rev": "ousteros-image-prod-aries-v2.5.2",
            "status": "RUNNING",
        },
        "calibration_status": {"reflectivity": {"valid": True, "timestamp": ""}},
        "lidar_data_format": {
            "pixels_per_column": beams,
            "columns_per_packet": 16,
            "columns_per_frame": 1024,
            "column_window": [0, 1023],
            "pixel_shift_by_row": [(24, 16, 8, 0)[beam % 4] for beam in range(beams)],
            "udp_profile_lidar": sensor.kind,
            "udp_profile_imu": "LEGACY",
            "fps": 10,
        },
        "config_params": {
            "lidar_mode": "1024x10",
            "timestamp_mode": "TIME_FROM_PTP_1588",
            "udp_port_lidar": sensor.port,
            "udp_port_imu": sensor.port + 1,
            "udp_profile_lidar": sensor.kind,
            "columns_per_packet": 16,
        },
    }
    return json.dumps(document, indent=1)


_FILES: Final[Mapping[str, Callable[[Mounted], str]]] = {".json": _metadata, ".csv": _angles}


if __name__ == "__main__":
    make(RECORDINGS[sys.argv[1]], float(sys.argv[2]), Path(sys.argv[3]))
