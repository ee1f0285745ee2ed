"""The standard cases: which recordings are converted to what, and what runs beside them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Final

from mlbatch.bench.results import COPY, DRY_RUN, LIBRARY, START, WRITE
from mlbatch.units import NS_PER_MS

CAPTURE, RIG = "capture.pcap", "rig.yaml"
# Beside a capture: of what makes it, so that one that another version made is made anew.
DIGEST: Final = "made-by.sha256"
_MAKERS: Final = ("cases.py", "recordings.py")
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


AUTO, NUMPY, NUMBA = "auto", "numpy", "numba"


@dataclass(frozen=True, slots=True)
class Conversion:
    """A conversion as it is measured.

    output: suffix of a file, or a format of a folder; empty: a dry run. base: another program of
    the case, which this one extends.
    """

    name: str
    recording: str
    engine: str = AUTO
    output: str = ""
    options: tuple[str, ...] = ()
    base: str = ""


@dataclass(frozen=True, slots=True)
class Case:
    """Programs that run in turn: conversions, floors, and peers of the first recording.

    variants: conversions of their own kind, instead of those that follow from the output.
    """

    name: str
    recordings: tuple[str, ...]
    output: str = ""
    floors: tuple[str, ...] = (START, COPY)
    variants: tuple[Conversion, ...] = ()

    @property
    def first(self) -> Recording:
        """The recording that its peers get."""
        return RECORDINGS[self.recordings[0]]

    def conversions(self, engines: Sequence[str]) -> list[Conversion]:
        """What is converted: each recording by each engine, or to the output."""
        if self.variants:
            return list(self.variants)
        if self.output:
            (recording,) = self.recordings
            dry = Conversion(DRY_RUN, recording)
            return [dry, Conversion(self.output, recording, output=self.output, base=DRY_RUN)]
        return [
            Conversion(
                engine if number == 0 else f"{engine}, fragments",
                recording,
                engine,
                base="" if number == 0 else engine,
            )
            for number, recording in enumerate(self.recordings)
            for engine in engines
        ]


_DUAL: Final = "dual-4"


def _by_jobs(*options: str) -> tuple[Conversion, ...]:
    """The same output by one and by two jobs."""
    one = Conversion("jobs 1", _DUAL, output="mcap", options=(*options, "--jobs", "1"))
    two = (*options, "--jobs", "2")
    return one, replace(one, name="jobs 2", options=two, base=one.name)


CASES: Final = (
    Case("dual-4", (_DUAL, "dual-4-fragments")),
    Case("dual-12", ("dual-12", "dual-12-fragments")),
    Case("three-vlp16", ("three-vlp16",)),
    Case("pandar64", ("pandar64",)),
    Case("mixed", ("mixed",)),
    Case("dual-4-mcap", (_DUAL,), "mcap", (COPY, WRITE, LIBRARY)),
    Case("dual-4-npz", (_DUAL,), "npz", (COPY, WRITE)),
    Case("dual-4-ply", (_DUAL,), "ply", (COPY, WRITE)),
    Case("mixed-mcap", ("mixed",), "mcap", (COPY, WRITE)),
    Case("dual-4-jobs", (_DUAL,), "mcap", (), _by_jobs()),
    Case("dual-4-zstd", (_DUAL,), "mcap", (), _by_jobs("--compression", "zstd")),
)
# What a point takes in the largest output, in bytes, and what floors and peers write beside it.
MOST_POINT_BYTES: Final = 48


def disk_bytes(cases: Sequence[Case], seconds: float) -> int:
    """Most that the recordings and one output at a time take."""
    names = {name for case in cases for name in case.recordings}
    recorded = sum(RECORDINGS[name].bytes_a_second for name in names)
    written = [case.first.slots_a_second * MOST_POINT_BYTES for case in cases if case.output]
    return round(seconds * (recorded + max(written, default=0)))
