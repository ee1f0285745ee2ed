"""The standard recordings and the benchmark cases, as data.

The measuring process loads this module, so it imports no numpy; recordings.py encodes the packets.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

from mlbatch.units import NS_PER_MS

# -- recordings -----------------------------------------------------------------------------------

RIG: Final = "rig.yaml"

# Sensor kinds: a profile of an Ouster OS1-128, or a model of another vendor.
LOW: Final = "RNG15_RFL8_NIR8"
FULL: Final = "RNG19_RFL8_SIG16_NIR16"
VLP16: Final = "VLP-16"
VLS128: Final = "VLS-128"
# Kinds of decoded clouds, by the order of their points.
BY_RING: Final = "clouds by ring"
BY_COLUMN: Final = "clouds by column"
OUSTER: Final = (LOW, FULL)
CLOUDS: Final = (BY_RING, BY_COLUMN)


@dataclass(frozen=True, slots=True)
class BenchSensor:
    """A sensor of a standard recording; kind: see above; phase_ns: delay of its rotor."""

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
        """Name of its metadata file; empty: none."""
        return f"{self.name}.json" if self.kind in OUSTER else ""

    @property
    def topic(self) -> str:
        """Topic of its clouds; empty: it sends packets."""
        return f"/{self.name}/points" if self.kind in CLOUDS else ""


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
    def file(self) -> str:
        """Name of the recording itself in its folder."""
        return "clouds.mcap" if self.sensors[0].topic else "capture.pcap"


def _dual(kind: str) -> tuple[BenchSensor, ...]:
    """Two lidars of a kind: OS1-128, or 64 rings decoded by their drivers."""
    left = BenchSensor(
        "a", kind, "192.168.7.11", 7502, 0, (0.0, 0.6, 1.8), 0.0, serial=122201000998
    )
    right = BenchSensor(
        "b", kind, "192.168.7.12", 7504, 37_100_000, (0.0, -0.6, 1.8), 90.0, serial=122201000999
    )
    return left, right


# Eight OS1-128 around a vehicle.
_EIGHT: Final = tuple(
    replace(
        _dual(LOW)[0],
        name="abcdefgh"[number],
        source_ip=f"192.168.7.{11 + number}",
        port=7502 + 2 * number,
        phase_ns=number * 12_300_000,
        translation_m=(1.4 - 0.4 * number, 0.6 * (-1) ** number, 1.8),
        yaw_deg=45.0 * number,
        serial=122201000998 + number,
    )
    for number in range(8)
)
_TOP: Final = BenchSensor("top", VLS128, "192.168.7.41", 2368, 0, (0.0, 0.0, 2.1), 0.0)
_THREE: Final = (
    BenchSensor("roof", VLP16, "192.168.7.21", 2368, 0, (0.0, 0.0, 2.0), 0.0),
    BenchSensor("left", VLP16, "192.168.7.22", 2368, 23 * NS_PER_MS, (0.0, 0.8, 1.6), 60.0),
    BenchSensor("right", VLP16, "192.168.7.23", 2368, 61 * NS_PER_MS, (0.0, -0.8, 1.6), -60.0),
)

RECORDINGS: Final[Mapping[str, BenchRecording]] = {
    recording.name: recording
    for recording in (
        BenchRecording("dual-4", _dual(LOW)),
        BenchRecording("dual-4-fragments", _dual(LOW), fragments=True),
        BenchRecording("dual-4-no-imu", _dual(LOW), imu=False),
        BenchRecording("dual-12", _dual(FULL)),
        BenchRecording("dual-12-fragments", _dual(FULL), fragments=True),
        BenchRecording("eight-4", _EIGHT),
        BenchRecording("vls128", (_TOP,)),
        BenchRecording("three-vlp16", _THREE),
        BenchRecording("clouds-by-ring", _dual(BY_RING)),
        BenchRecording("clouds-by-column", _dual(BY_COLUMN)),
    )
}

# -- cases ----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Conversion:
    """A conversion to measure; output: `mcap`, `npz` or `ply`; empty: a dry run."""

    name: str
    recording: str
    options: tuple[str, ...] = ()
    output: str = ""


# Programs of each case run alternately and are compared with the first one. After the conversions
# run the peers that decode the sensors of a dry run, or a program that only writes as many bytes.
CASES: Final[Mapping[str, tuple[Conversion, ...]]] = {
    "dual-4": (Conversion("whole packets", "dual-4"), Conversion("fragments", "dual-4-fragments")),
    "dual-4-windows": (
        Conversion("10 Hz", "dual-4"),
        Conversion("100 Hz", "dual-4", ("--rate", "100")),
        Conversion("10 slices", "dual-4", ("--slices", "10")),
        Conversion("organized", "dual-4", ("--layout", "organized")),
    ),
    "dual-4-imu": (Conversion("no IMU", "dual-4-no-imu"), Conversion("IMU", "dual-4")),
    "dual-12": (
        Conversion("whole packets", "dual-12"),
        Conversion("fragments", "dual-12-fragments"),
    ),
    **{
        name: (Conversion("dry run", name),)
        for name in ("eight-4", "three-vlp16", "vls128", "clouds-by-ring", "clouds-by-column")
    },
    **{
        f"dual-4-{output}": (
            Conversion(output, "dual-4", output=output),
            Conversion("dry run", "dual-4"),
        )
        for output in ("mcap", "npz", "ply")
    },
}
# Peers of programs.py, by the kind of all sensors.
PEERS: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(OUSTER, ("ouster-sdk", "ouster-sdk-lean")),
    **dict.fromkeys((VLP16, VLS128), ("velodyne-decoder", "velodyne-decoder-lean")),
}
