"""The standard recordings and the benchmark cases, as data.

The measuring process loads this module, so it imports no numpy; recordings.py encodes the packets.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Final

from mlbatch.units import NS_PER_MS
from tests.bench.results import COPY, DRY_RUN, LIBRARY, START, WRITE

# -- recordings -----------------------------------------------------------------------------------

CAPTURE: Final = "capture.pcap"
BAG: Final = "clouds.mcap"
RIG: Final = "rig.yaml"
# File in a recording's folder: digest of the modules that made the recording.
DIGEST: Final = "made-by.sha256"

# Sensor kinds: an Ouster profile, or a model of another vendor.
LOW: Final = "RNG15_RFL8_NIR8"
FULL: Final = "RNG19_RFL8_SIG16_NIR16"
VLP16: Final = "VLP-16"
VLS128: Final = "VLS-128"
PANDAR64: Final = "Pandar64"
# Kinds of decoded clouds, by the order of their points.
BY_RING: Final = "clouds by ring"
BY_COLUMN: Final = "clouds by column"
CLOUD_RINGS: Final = 64
CLOUD_COLUMNS: Final = 2048
_CLOUD_POINTS: Final = CLOUD_RINGS * CLOUD_COLUMNS

# Ethernet, IPv4 and UDP headers, and the header of a pcap record.
_HEADERS_BYTES: Final = 14 + 20 + 8 + 16
# A legacy IMU packet of Ouster.
IMU_BYTES: Final = 48


@dataclass(frozen=True, slots=True)
class SensorKind:
    """Packet rate and size of a sensor kind; of clouds, those of messages."""

    packets_per_s: int
    packet_bytes: int
    slots_per_s: int
    # Suffix of the metadata or calibration file it needs; empty: none.
    suffix: str
    # Packets of its IMU, of IMU_BYTES.
    imu_per_s: int = 0


KINDS: Final[Mapping[str, SensorKind]] = {
    LOW: SensorKind(640, 8448, 10_240 * 128, ".json", imu_per_s=100),
    FULL: SensorKind(640, 24832, 10_240 * 128, ".json", imu_per_s=100),
    VLP16: SensorKind(754, 1206, 18_084 * 16, ""),
    VLS128: SensorKind(6030, 1206, 18_090 * 128, ""),
    PANDAR64: SensorKind(3000, 1198, 18_000 * 64, ".csv"),
    BY_RING: SensorKind(10, 32 * _CLOUD_POINTS, 10 * _CLOUD_POINTS, ""),
    BY_COLUMN: SensorKind(10, 32 * _CLOUD_POINTS, 10 * _CLOUD_POINTS, ""),
}


@dataclass(frozen=True, slots=True)
class BenchSensor:
    """A sensor of a standard recording; kind: a key of KINDS; phase_ns: delay of its rotor.

    topic: of its clouds; empty: it sends packets.
    """

    name: str
    kind: str
    source_ip: str
    port: int
    phase_ns: int
    translation_m: tuple[float, float, float]
    yaw_deg: float
    serial: int = 0
    topic: str = ""

    @property
    def file(self) -> str:
        """Name of its metadata or calibration file; empty: none."""
        suffix = KINDS[self.kind].suffix
        return f"{self.name}{suffix}" if suffix else ""


@dataclass(frozen=True, slots=True)
class BenchRecording:
    """A standard recording; fragments: packets are sent in IPv4 fragments of 1500 bytes.

    imu: lidars with an IMU send its packets, too.
    """

    name: str
    sensors: tuple[BenchSensor, ...]
    fragments: bool = False
    imu: bool = True

    @property
    def is_bag(self) -> bool:
        """Whether it is a bag of decoded clouds, not a capture of packets."""
        return any(sensor.topic for sensor in self.sensors)

    @property
    def file(self) -> str:
        """Name of the recording itself in its folder."""
        return BAG if self.is_bag else CAPTURE

    @property
    def bytes_per_s(self) -> int:
        """Approximate size of the recording per second."""
        kinds = [KINDS[sensor.kind] for sensor in self.sensors]
        lidars = sum(kind.packets_per_s * (kind.packet_bytes + _HEADERS_BYTES) for kind in kinds)
        imus = sum(kind.imu_per_s for kind in kinds) if self.imu else 0
        return lidars + imus * (IMU_BYTES + _HEADERS_BYTES)

    @property
    def slots_per_s(self) -> int:
        """Slots per second of all sensors: the upper limit of its points."""
        return sum(KINDS[sensor.kind].slots_per_s for sensor in self.sensors)


def _ouster(
    number: int, profile: str, phase_ns: int, translation_m: tuple[float, float, float], yaw: float
) -> BenchSensor:
    """An OS-1-128 with an address of its own."""
    name = "abcdefgh"[number]
    port = 7502 + 2 * number
    serial = 122201000998 + number
    source_ip = f"192.168.7.{11 + number}"
    return BenchSensor(name, profile, source_ip, port, phase_ns, translation_m, yaw, serial)


def _dual(profile: str) -> tuple[BenchSensor, ...]:
    """Two OS-1-128."""
    left = _ouster(0, profile, 0, (0.0, 0.6, 1.8), 0.0)
    return left, _ouster(1, profile, 37_100_000, (0.0, -0.6, 1.8), 90.0)


def _eight(profile: str) -> tuple[BenchSensor, ...]:
    """Eight OS-1-128 around a vehicle."""
    return tuple(
        _ouster(
            number,
            profile,
            number * 12_300_000,
            (1.4 - 0.4 * number, 0.6 * (-1) ** number, 1.8),
            45.0 * number,
        )
        for number in range(8)
    )


def _clouds(kind: str) -> tuple[BenchSensor, ...]:
    """Two lidars of 64 rings, decoded by their drivers."""
    left = BenchSensor("a", kind, "", 0, 0, (0.0, 0.6, 1.8), 0.0, topic="/a/points")
    right = replace(
        left,
        name="b",
        phase_ns=37_100_000,
        translation_m=(0.0, -0.6, 1.8),
        yaw_deg=90.0,
        topic="/b/points",
    )
    return left, right


_ROOF: Final = BenchSensor("roof", VLP16, "192.168.7.21", 2368, 0, (0.0, 0.0, 2.0), 0.0)
_LEFT: Final = BenchSensor(
    "left", VLP16, "192.168.7.22", 2368, 23 * NS_PER_MS, (0.0, 0.8, 1.6), 60.0
)
_RIGHT: Final = BenchSensor(
    "right", VLP16, "192.168.7.23", 2368, 61 * NS_PER_MS, (0.0, -0.8, 1.6), -60.0
)
_TOP: Final = BenchSensor("top", VLS128, "192.168.7.41", 2368, 0, (0.0, 0.0, 2.1), 0.0)
_REAR: Final = BenchSensor("rear", PANDAR64, "192.168.7.31", 2370, 0, (-1.0, 0.0, 1.8), 180.0)

RECORDINGS: Final[Mapping[str, BenchRecording]] = {
    recording.name: recording
    for recording in (
        BenchRecording("dual-4", _dual(LOW)),
        BenchRecording("dual-4-fragments", _dual(LOW), fragments=True),
        BenchRecording("dual-4-no-imu", _dual(LOW), imu=False),
        BenchRecording("dual-12", _dual(FULL)),
        BenchRecording("dual-12-fragments", _dual(FULL), fragments=True),
        BenchRecording("eight-4", _eight(LOW)),
        BenchRecording("vls128", (_TOP,)),
        BenchRecording("three-vlp16", (_ROOF, _LEFT, _RIGHT)),
        BenchRecording("pandar64", (_REAR,)),
        BenchRecording("mixed", (_dual(LOW)[0], _ROOF, _REAR)),
        BenchRecording("clouds-by-ring", _clouds(BY_RING)),
        BenchRecording("clouds-by-column", _clouds(BY_COLUMN)),
    )
}


@lru_cache(maxsize=1)
def digest() -> str:
    """SHA-256 of the modules that determine the bytes of recordings."""
    here = Path(__file__)
    encoders = (here.parents[2] / "mlbatch" / "simulate").rglob("*.py")
    sources = [here, here.with_name("recordings.py"), *sorted(encoders)]
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


def is_current(folder: Path, recording: BenchRecording) -> bool:
    """Whether a folder contains a complete recording made by the modules of this version."""
    made_by = folder / DIGEST
    if not (folder / recording.file).is_file() or not made_by.is_file():
        return False
    return made_by.read_text(encoding="utf-8") == digest()


# -- cases ----------------------------------------------------------------------------------------

OWN: Final = "mlbatch"


@dataclass(frozen=True, slots=True)
class Conversion:
    """A conversion to measure."""

    name: str
    recording: str
    # Suffix of a file, or format of a folder; empty: a dry run.
    output: str = ""
    options: tuple[str, ...] = ()
    # Another program of the case to compare with; empty: none.
    base: str = ""


@dataclass(frozen=True, slots=True)
class Case:
    """Programs that run alternately: conversions, floors, and peers on the first recording."""

    name: str
    recordings: tuple[str, ...]
    output: str = ""
    floors: tuple[str, ...] = (START, COPY)
    # Replace the conversions that follow from `recordings` and `output`.
    variants: tuple[Conversion, ...] = ()

    @property
    def first(self) -> BenchRecording:
        """The recording that peers read."""
        return RECORDINGS[self.recordings[0]]

    def conversions(self) -> list[Conversion]:
        """Dry runs of each recording, or a dry run and an output."""
        if self.variants:
            return list(self.variants)
        if self.output:
            (recording,) = self.recordings
            dry = Conversion(DRY_RUN, recording)
            return [dry, Conversion(self.output, recording, output=self.output, base=DRY_RUN)]
        plain, *fragments = self.recordings
        return [
            Conversion(OWN, plain),
            *(Conversion(f"{OWN}, fragments", one, base=OWN) for one in fragments),
        ]


def _by_jobs(*options: str) -> tuple[Conversion, ...]:
    """The same output by one and by two jobs."""
    one = Conversion("jobs 1", "dual-4", output="mcap", options=(*options, "--jobs", "1"))
    two = replace(one, name="jobs 2", options=(*options, "--jobs", "2"), base=one.name)
    return one, two


def _by_windows() -> tuple[Conversion, ...]:
    """Dry runs with other windows and layouts than ten dense scans a second."""
    plain = Conversion("10 Hz", "dual-4")
    others = {
        "100 Hz": ("--rate", "100"),
        "10 slices": ("--slices", "10"),
        "organized": ("--layout", "organized"),
    }
    return plain, *(
        replace(plain, name=name, options=options, base=plain.name)
        for name, options in others.items()
    )


def _by_imu() -> tuple[Conversion, ...]:
    """Dry runs without and with packets of IMUs."""
    plain = Conversion("no IMU", "dual-4-no-imu")
    often = replace(plain, name="no IMU, 100 Hz", options=("--rate", "100"))
    return (
        plain,
        replace(plain, name="IMU", recording="dual-4", base=plain.name),
        often,
        replace(often, name="IMU, 100 Hz", recording="dual-4", base=often.name),
    )


CASES: Final = (
    Case("dual-4", ("dual-4", "dual-4-fragments")),
    Case("dual-4-windows", ("dual-4",), variants=_by_windows()),
    Case("dual-4-imu", ("dual-4-no-imu", "dual-4"), variants=_by_imu()),
    Case("dual-12", ("dual-12", "dual-12-fragments")),
    Case("eight-4", ("eight-4",)),
    Case("three-vlp16", ("three-vlp16",)),
    Case("vls128", ("vls128",)),
    Case("pandar64", ("pandar64",)),
    Case("mixed", ("mixed",)),
    Case("clouds-by-ring", ("clouds-by-ring",)),
    Case("clouds-by-column", ("clouds-by-column",)),
    Case("dual-4-mcap", ("dual-4",), "mcap", (COPY, WRITE, LIBRARY)),
    Case("dual-4-npz", ("dual-4",), "npz", (COPY, WRITE)),
    Case("dual-4-ply", ("dual-4",), "ply", (COPY, WRITE)),
    Case("mixed-mcap", ("mixed",), "mcap", (COPY, WRITE)),
    Case("dual-4-jobs", ("dual-4",), "mcap", (), _by_jobs()),
    Case("dual-4-zstd", ("dual-4",), "mcap", (), _by_jobs("--compression", "zstd")),
)
# Upper limit of an output, per point.
_MAX_POINT_BYTES: Final = 48


def disk_bytes(cases: Sequence[Case], seconds: float) -> int:
    """Upper limit of disk space: all recordings, and one output at a time."""
    names = {name for case in cases for name in case.recordings}
    recorded = sum(RECORDINGS[name].bytes_per_s for name in names)
    written = [case.first.slots_per_s * _MAX_POINT_BYTES for case in cases if case.output]
    return round(seconds * (recorded + max(written, default=0)))
