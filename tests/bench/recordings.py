"""Makes a standard recording: packets of lidars, as a pcap capture with rig and metadata files.

Recordings of decoded clouds are MCAP files, made by clouds.py.

    python -m tests.bench.recordings dual-4 12 FOLDER

It runs in a process of its own, so that the measuring process does not import numpy. The packets
of one revolution are encoded once; later packets repeat its pixels with their own timestamps,
angles and counters. Ranges are waves with noise and no-return regions: about a fifth of the shots,
as outdoors.

Source of packets: docs/sources/ouster.md sections 1 to 3 and 8, docs/sources/velodyne.md sections 1
and 2, docs/sources/hesai.md sections 2, 3 and 6. Source of frames: RFC 791 (IPv4), RFC 768 (UDP; no
checksum: 0), draft-ietf-opsawg-pcap.
"""

from __future__ import annotations

import ipaddress
import json
import struct
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I64Array, U8Array
from mlbatch.types import Stream
from mlbatch.units import NS_PER_MS, NS_PER_S, NS_PER_US
from tests.bench.cases import (
    DIGEST,
    FULL,
    KINDS,
    LOW,
    PANDAR64,
    RECORDINGS,
    RIG,
    VLP16,
    VLS128,
    BenchRecording,
    BenchSensor,
    digest,
)
from tests.bench.clouds import write_clouds
from tests.bench.scene import EPOCH_NS, REVOLUTION_NS, scene

# -- packets --------------------------------------------------------------------------------------

# From the last shot of a packet to its capture.
_TRAVEL_NS: Final = 300 * NS_PER_US
_CDEG_PER_REVOLUTION: Final = 36_000


@dataclass(frozen=True, slots=True)
class PacketEncoder:
    """Encodes the packets of one lidar."""

    # (packets, bytes): the packets of one revolution.
    revolution: U8Array
    packet_ns: int
    # Writes timestamps, angles and counters into payloads (n, bytes), from the numbers (n,) of the
    # packets and the times (n,) of their first shots, ns.
    update: Callable[[U8Array, I64Array, I64Array], None]

    @classmethod
    def from_packets(
        cls,
        packets: npt.NDArray[np.void],
        packet_ns: int,
        update: Callable[[U8Array, I64Array, I64Array], None],
    ) -> PacketEncoder:
        """From the packets (n,) of one revolution as records."""
        return cls(packets.view(np.uint8).reshape(len(packets), -1), packet_ns, update)

    def packets(self, numbers: I64Array, phase_ns: int) -> tuple[I64Array, U8Array]:
        """Receive times (n,), ns, and payloads (n, bytes) of the packets with these numbers."""
        begin_ns = EPOCH_NS + phase_ns + numbers * self.packet_ns
        payloads = self.revolution[numbers % len(self.revolution)]
        self.update(payloads, numbers, begin_ns)
        return begin_ns + self.packet_ns + _TRAVEL_NS, payloads


_OUSTER_BEAMS: Final = 128
_OUSTER_COLUMNS: Final = 1024
_OUSTER_COLUMNS_PER_PACKET: Final = 16
_OUSTER_INIT_ID: Final = 7_109_750
_OUSTER_SIGNAL_PEAK: Final = 2000
_OUSTER_PIXEL: Final[Mapping[str, np.dtype[np.void]]] = {
    LOW: np.dtype([("range_8mm", "<u2"), ("reflectivity", "u1"), ("near_ir", "u1")]),
    FULL: np.dtype(
        [
            ("range_mm", "<u4"),
            ("reflectivity", "u1"),
            ("unused", "u1"),
            ("signal", "<u2"),
            ("near_ir", "<u2"),
            ("window", "<u2"),
        ]
    ),
}


def ouster(profile: str, serial: int) -> PacketEncoder:
    """An OS-1-128 at 1024x10."""
    range_mm, reflectivity = scene(_OUSTER_COLUMNS, _OUSTER_BEAMS)
    signal = _OUSTER_SIGNAL_PEAK * reflectivity // (1 + range_mm // 100)
    values = {
        "range_8mm": range_mm // 8,
        "range_mm": range_mm,
        "reflectivity": reflectivity,
        "signal": np.where(range_mm > 0, signal, 0),
        "near_ir": 40 + reflectivity // 4,
    }
    pixel = np.zeros(range_mm.shape, _OUSTER_PIXEL[profile])
    for name in set(values) & set(pixel.dtype.names or ()):
        pixel[name] = values[name]
    column = np.dtype(
        [
            ("stamp_ns", "<u8"),
            ("measurement_id", "<u2"),
            ("status", "<u2"),
            ("pixel", _OUSTER_PIXEL[profile], _OUSTER_BEAMS),
        ]
    )
    packet = np.dtype(
        [
            ("type", "<u2"),
            ("frame_id", "<u2"),
            ("init_id", "u1", 3),
            ("serial", "u1", 5),
            ("state", "u1", 20),
            ("column", column, _OUSTER_COLUMNS_PER_PACKET),
            ("footer", "u1", 32),
        ]
    )
    rows = (-1, _OUSTER_COLUMNS_PER_PACKET)
    packets = np.zeros(_OUSTER_COLUMNS // _OUSTER_COLUMNS_PER_PACKET, packet)
    packets["type"] = 1
    packets["init_id"] = np.frombuffer(_OUSTER_INIT_ID.to_bytes(3, "little"), np.uint8)
    packets["serial"] = np.frombuffer(serial.to_bytes(5, "little"), np.uint8)
    packets["column"]["status"] = 1
    packets["column"]["measurement_id"] = np.arange(_OUSTER_COLUMNS).reshape(rows)
    packets["column"]["pixel"] = pixel.reshape(*rows, _OUSTER_BEAMS)

    def update(payloads: U8Array, numbers: I64Array, begin_ns: I64Array) -> None:
        sent = payloads.view(packet)[:, 0]
        sent["frame_id"] = numbers // len(packets) % 2**16
        step_ns = np.arange(_OUSTER_COLUMNS_PER_PACKET) * REVOLUTION_NS // _OUSTER_COLUMNS
        sent["column"]["stamp_ns"] = begin_ns[:, None] + step_ns

    packet_ns = REVOLUTION_NS * _OUSTER_COLUMNS_PER_PACKET // _OUSTER_COLUMNS
    return PacketEncoder.from_packets(packets, packet_ns, update)


_IMU_NS: Final = 10 * NS_PER_MS
_IMU: Final = np.dtype(
    [
        ("system_ns", "<u8"),
        ("acceleration_ns", "<u8"),
        ("gyroscope_ns", "<u8"),
        ("acceleration_g", "<f4", 3),
        ("angular_velocity_deg", "<f4", 3),
    ]
)


def ouster_imu() -> PacketEncoder:
    """The IMU of an Ouster at rest."""
    packets = np.zeros(1, _IMU)
    packets["acceleration_g"] = [0, 0, 1]

    def update(payloads: U8Array, numbers: I64Array, begin_ns: I64Array) -> None:
        sent = payloads.view(_IMU)[:, 0]
        for name in ("system_ns", "acceleration_ns", "gyroscope_ns"):
            sent[name] = begin_ns + _IMU_NS

    return PacketEncoder.from_packets(packets, _IMU_NS, update)


# A reading of Velodyne and of HESAI; the range is in steps of the vendor.
_READING: Final = np.dtype([("range", "<u2"), ("reflectivity", "u1")])

_VLP16_CHANNELS: Final = 16
_VLP16_SEQUENCES_PER_BLOCK: Final = 2
_VLP16_BLOCKS: Final = 12
# Two firing sequences of 55.296 us.
_VLP16_BLOCK_NS: Final = 110_592
_VLP16_STEP_MM: Final = 2
_US_PER_HOUR: Final = 3_600_000_000


def vlp16(serial: int = 0) -> PacketEncoder:
    """A VLP-16 at 600 rpm with one return; its packets have no serial number."""
    block = np.dtype(
        [
            ("flag", "<u2"),
            ("azimuth_cdeg", "<u2"),
            ("reading", _READING, (_VLP16_SEQUENCES_PER_BLOCK, _VLP16_CHANNELS)),
        ]
    )
    packet = np.dtype(
        [
            ("block", block, _VLP16_BLOCKS),
            ("past_hour_us", "<u4"),
            ("mode", "u1"),
            ("product", "u1"),
        ]
    )
    packet_ns = _VLP16_BLOCK_NS * _VLP16_BLOCKS
    packets = np.zeros(REVOLUTION_NS // packet_ns, packet)
    packets["mode"] = 0x37
    packets["product"] = 0x22
    packets["block"]["flag"] = 0xEEFF
    _fill_readings(packets["block"]["reading"], _VLP16_CHANNELS, _VLP16_STEP_MM)

    def update(payloads: U8Array, numbers: I64Array, begin_ns: I64Array) -> None:
        sent = payloads.view(packet)[:, 0]
        sent["past_hour_us"] = begin_ns // NS_PER_US % _US_PER_HOUR
        shot_ns = begin_ns[:, None] + np.arange(_VLP16_BLOCKS) * _VLP16_BLOCK_NS
        sent["block"]["azimuth_cdeg"] = _azimuth_cdeg(shot_ns)

    return PacketEncoder.from_packets(packets, packet_ns, update)


# A firing sequence takes 55.277 us; its 128 channels are four blocks of one azimuth.
_VLS128_BANKS: Final = (0xEEFF, 0xDDFF, 0xCCFF, 0xBBFF)
_VLS128_BANK_CHANNELS: Final = 32
_VLS128_SEQUENCES: Final = 3
_VLS128_SEQUENCE_NS: Final = 55_277
_VLS128_STEP_MM: Final = 4


def vls128(serial: int = 0) -> PacketEncoder:
    """A VLS-128 at 600 rpm with one return; its packets have no serial number."""
    shape = (_VLS128_SEQUENCES, len(_VLS128_BANKS))
    block = np.dtype(
        [
            ("flag", "<u2"),
            ("azimuth_cdeg", "<u2"),
            ("reading", _READING, _VLS128_BANK_CHANNELS),
        ]
    )
    packet = np.dtype(
        [
            ("block", block, shape),
            ("past_hour_us", "<u4"),
            ("mode", "u1"),
            ("product", "u1"),
        ]
    )
    packet_ns = _VLS128_SEQUENCE_NS * _VLS128_SEQUENCES
    packets = np.zeros(REVOLUTION_NS // packet_ns, packet)
    packets["mode"] = 0x37
    packets["product"] = 0xA1
    packets["block"]["flag"] = _VLS128_BANKS
    channels = len(_VLS128_BANKS) * _VLS128_BANK_CHANNELS
    _fill_readings(packets["block"]["reading"], channels, _VLS128_STEP_MM)

    def update(payloads: U8Array, numbers: I64Array, begin_ns: I64Array) -> None:
        sent = payloads.view(packet)[:, 0]
        sent["past_hour_us"] = begin_ns // NS_PER_US % _US_PER_HOUR
        shot_ns = begin_ns[:, None] + np.arange(_VLS128_SEQUENCES) * _VLS128_SEQUENCE_NS
        sent["block"]["azimuth_cdeg"] = _azimuth_cdeg(shot_ns)[:, :, None]

    return PacketEncoder.from_packets(packets, packet_ns, update)


_PANDAR64_CHANNELS: Final = 64
_PANDAR64_BLOCKS: Final = 6
_PANDAR64_BLOCK_NS: Final = 55_560
_PANDAR64_STEP_MM: Final = 4


def pandar64(serial: int = 0) -> PacketEncoder:
    """A Pandar64 at 600 rpm with one return; its packets have no serial number."""
    block = np.dtype([("azimuth_cdeg", "<u2"), ("reading", _READING, _PANDAR64_CHANNELS)])
    packet = np.dtype(
        [
            ("head", "u1", 8),
            ("block", block, _PANDAR64_BLOCKS),
            ("reserved", "u1", 8),
            ("speed_rpm", "<u2"),
            ("micros", "<u4"),
            ("mode", "u1"),
            ("factory", "u1"),
            ("date", "u1", 6),
            ("sequence", "<u4"),
        ]
    )
    packet_ns = _PANDAR64_BLOCK_NS * _PANDAR64_BLOCKS
    packets = np.zeros(REVOLUTION_NS // packet_ns, packet)
    packets["head"] = [0xEE, 0xFF, _PANDAR64_CHANNELS, _PANDAR64_BLOCKS, 0, 4, 0, 0]
    packets["speed_rpm"] = 600
    packets["mode"] = 0x37
    packets["factory"] = 0x42
    _fill_readings(packets["block"]["reading"], _PANDAR64_CHANNELS, _PANDAR64_STEP_MM)

    def update(payloads: U8Array, numbers: I64Array, begin_ns: I64Array) -> None:
        sent = payloads.view(packet)[:, 0]
        sent["micros"] = begin_ns // NS_PER_US % (NS_PER_S // NS_PER_US)
        sent["sequence"] = numbers
        shot_ns = begin_ns[:, None] + np.arange(_PANDAR64_BLOCKS) * _PANDAR64_BLOCK_NS
        sent["block"]["azimuth_cdeg"] = _azimuth_cdeg(shot_ns)
        seconds, index = np.unique(begin_ns // NS_PER_S, return_inverse=True)
        sent["date"] = np.array([_date(epoch_s) for epoch_s in seconds.tolist()], np.uint8)[index]

    return PacketEncoder.from_packets(packets, packet_ns, update)


def _fill_readings(readings: npt.NDArray[np.void], channels: int, step_mm: int) -> None:
    """Write the scene into the readings (..., channels) of one revolution."""
    range_mm, reflectivity = scene(readings.size // channels, channels)
    readings["range"] = (range_mm // step_mm).reshape(readings.shape)
    readings["reflectivity"] = reflectivity.reshape(readings.shape)


def _azimuth_cdeg(shot_ns: I64Array) -> I64Array:
    """Rotor angle at these times, 1/100 deg."""
    return shot_ns % REVOLUTION_NS * _CDEG_PER_REVOLUTION // REVOLUTION_NS


def _date(epoch_s: int) -> list[int]:
    """Year since 1900, month, day, hour, minute, second (UTC)."""
    date = time.gmtime(epoch_s)
    return [
        date.tm_year - 1900,
        date.tm_mon,
        date.tm_mday,
        date.tm_hour,
        date.tm_min,
        date.tm_sec,
    ]


# By sensor kind; the argument is the serial number.
ENCODERS: Final[Mapping[str, Callable[[int], PacketEncoder]]] = {
    LOW: partial(ouster, LOW),
    FULL: partial(ouster, FULL),
    VLP16: vlp16,
    VLS128: vls128,
    PANDAR64: pandar64,
}

# -- captures -------------------------------------------------------------------------------------

ETHERNET_MTU: Final = 1500
JUMBO_MTU: Final = 65535
_FILE_HEADER: Final = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
_RECORD_HEADER: Final = np.dtype([("s", "<u4"), ("us", "<u4"), ("kept", "<u4"), ("length", "<u4")])
_ETHERNET: Final = np.frombuffer(bytes(12) + b"\x08\x00", np.uint8)
_IP: Final = struct.Struct(">BBHHHBBH4s4s")
_IP_ID_AT: Final = 4
_IP_CHECKSUM_AT: Final = 10
_UDP: Final = struct.Struct(">HHHH")
_RECEIVER: Final = ipaddress.IPv4Address("192.168.7.2").packed
_MORE_FRAGMENTS: Final = 0x2000
# Time of a full frame on 1 Gbit/s Ethernet, between fragments of a packet.
_FRAGMENT_STEP_NS: Final = 12 * NS_PER_US
_IMU_FIRST_IDENT: Final = 1 << 15
# Packets are made for this much time at once, which bounds memory.
CHUNK_NS: Final = 500 * NS_PER_MS

# Receive time, ns, and bytes of a pcap record.
CaptureRecord: TypeAlias = tuple[int, U8Array]


@dataclass(frozen=True, slots=True)
class Source:
    """A lidar, or its IMU, on the network; phase_ns: delay of its rotor.

    first_ident: IP identification of its first packet.
    """

    encoder: PacketEncoder
    stream: Stream
    phase_ns: int
    first_ident: int = 0


def write_capture(path: Path, sources: Sequence[Source], seconds: float, mtu: int) -> None:
    """Write a pcap with the packets of all sources in the order of their receive times."""
    end_ns = EPOCH_NS + round(seconds * NS_PER_S)
    waiting: list[CaptureRecord] = []
    sent = [0] * len(sources)
    with path.open("wb") as file:
        file.write(_FILE_HEADER)
        for chunk_end_ns in (*range(EPOCH_NS + CHUNK_NS, end_ns, CHUNK_NS), end_ns):
            for number, source in enumerate(sources):
                sending_ns = chunk_end_ns - EPOCH_NS - source.phase_ns
                count = sending_ns // source.encoder.packet_ns
                packet_numbers = np.arange(sent[number], max(sent[number], count))
                sent[number] += len(packet_numbers)
                waiting += capture_records(source, packet_numbers, mtu)
            waiting.sort(key=itemgetter(0))
            # Records received later can be preceded by packets of the next chunk.
            ready = sum(receive_ns < chunk_end_ns for receive_ns, _ in waiting)
            file.writelines(record.data for _, record in waiting[:ready])
            del waiting[:ready]
        file.writelines(record.data for _, record in waiting)


def capture_records(source: Source, numbers: I64Array, mtu: int) -> Iterator[CaptureRecord]:
    """The records of the packets with these numbers, in fragments where they exceed the MTU."""
    if not len(numbers):
        return
    receive_ns, payloads = source.encoder.packets(numbers, source.phase_ns)
    port = source.stream.port
    size = payloads.shape[1] + _UDP.size
    udp = np.frombuffer(_UDP.pack(port, port, size, 0), np.uint8)
    datagrams = np.concatenate([np.broadcast_to(udp, (len(numbers), _UDP.size)), payloads], 1)
    step = (mtu - _IP.size) // 8 * 8
    idents = (source.first_ident + numbers) & 0xFFFF
    for fragment, offset in enumerate(range(0, size, step)):
        part = datagrams[:, offset : offset + step]
        flags = offset // 8 | (_MORE_FRAGMENTS if offset + step < size else 0)
        ip = _ip_headers(source.stream.source_ip, idents, flags, part.shape[1])
        at_ns = receive_ns + fragment * _FRAGMENT_STEP_NS
        yield from zip(at_ns.tolist(), _pcap_records(at_ns, ip, part), strict=True)


def _pcap_records(at_ns: I64Array, ip: U8Array, part: U8Array) -> U8Array:
    """Pcap records (n, bytes) of IP headers (n, 20) and their data (n, bytes)."""
    seconds, rest_ns = np.divmod(at_ns, NS_PER_S)
    length = len(_ETHERNET) + _IP.size + part.shape[1]
    header = np.zeros(len(part), _RECORD_HEADER)
    header["s"] = seconds
    header["us"] = rest_ns // NS_PER_US
    header["kept"] = length
    header["length"] = length
    ethernet = np.broadcast_to(_ETHERNET, (len(part), len(_ETHERNET)))
    return np.concatenate([header.view(np.uint8).reshape(len(part), -1), ethernet, ip, part], 1)


def _ip_headers(source_ip: str, ids: I64Array, flags: int, size: int) -> U8Array:
    """IPv4 headers (n, 20) with their checksums; size: bytes of data."""
    sender = ipaddress.IPv4Address(source_ip).packed
    header = _IP.pack(0x45, 0, _IP.size + size, 0, flags, 64, 17, 0, sender, _RECEIVER)
    total = sum(struct.unpack(">10H", header)) + ids
    folded = (total & 0xFFFF) + (total >> 16)
    checksum = ~((folded & 0xFFFF) + (folded >> 16)) & 0xFFFF
    headers = np.tile(np.frombuffer(header, np.uint8), (len(ids), 1))
    for at, words in ((_IP_ID_AT, ids), (_IP_CHECKSUM_AT, checksum)):
        headers[:, at] = words >> 8
        headers[:, at + 1] = words & 0xFF
    return headers


# -- recordings -----------------------------------------------------------------------------------


def make(recording: BenchRecording, seconds: float, folder: Path) -> None:
    """Write recording, rig and the files that its sensors need into an existing folder."""
    for sensor in recording.sensors:
        if sensor.file:
            text = _FILES[KINDS[sensor.kind].suffix](sensor)
            (folder / sensor.file).write_text(text, encoding="utf-8")
    (folder / RIG).write_text(_rig(recording.sensors), encoding="utf-8")
    # Renamed when complete: a recording that exists is complete.
    partial_path = folder / f"{recording.file}.partial"
    if recording.is_bag:
        write_clouds(partial_path, recording.sensors, seconds)
    else:
        mtu = ETHERNET_MTU if recording.fragments else JUMBO_MTU
        sources = [_source(one) for one in recording.sensors]
        if recording.imu:
            sources += [_imu(one) for one in recording.sensors if KINDS[one.kind].imu_per_s]
        write_capture(partial_path, sources, seconds, mtu)
    partial_path.replace(folder / recording.file)
    (folder / DIGEST).write_text(digest(), encoding="utf-8")


def _source(sensor: BenchSensor) -> Source:
    encoder = ENCODERS[sensor.kind](sensor.serial)
    return Source(encoder, Stream(sensor.source_ip, sensor.port), sensor.phase_ns)


def _imu(sensor: BenchSensor) -> Source:
    """The IMU of an Ouster, which sends to the next port."""
    stream = Stream(sensor.source_ip, sensor.port + 1)
    return Source(ouster_imu(), stream, sensor.phase_ns, _IMU_FIRST_IDENT)


def _rig(sensors: Sequence[BenchSensor]) -> str:
    """The rig file."""
    lines = ["body_frame: base_link", "rate_hz: 10", "sensors:"]
    for sensor in sensors:
        x, y, z = sensor.translation_m
        lines += [
            f"  - name: {sensor.name}",
            f"    stream: {_selector(sensor)}",
            f"    extrinsics: {{translation_m: [{x}, {y}, {z}],"
            f" rotation_rpy_deg: [0, 0, {sensor.yaw_deg}]}}",
        ]
        if sensor.file:
            lines.append(f"    metadata: {sensor.file}")
    return "\n".join(lines) + "\n"


def _selector(sensor: BenchSensor) -> str:
    """How the rig names the stream of a sensor."""
    if sensor.topic:
        return f"{{topic: {sensor.topic}}}"
    return f"{{source_ip: {sensor.source_ip}, port: {sensor.port}}}"


def _evenly_spaced(first_deg: float, last_deg: float, count: int) -> list[float]:
    step_deg = (last_deg - first_deg) / (count - 1)
    return [round(first_deg + step_deg * beam, 3) for beam in range(count)]


def _pandar64_angles(sensor: BenchSensor) -> str:
    """The angle file of a Pandar64."""
    elevations_deg = _evenly_spaced(15, -25, _PANDAR64_CHANNELS)
    lines = [f"{number},{deg},0\n" for number, deg in enumerate(elevations_deg, 1)]
    return "".join(["Laser id,Elevation,Azimuth\n", *lines])


def _ouster_metadata(sensor: BenchSensor) -> str:
    """The metadata of an OS-1-128."""
    beams = _OUSTER_BEAMS
    document = {
        "beam_intrinsics": {
            "beam_altitude_angles": _evenly_spaced(21, -21, beams),
            "beam_azimuth_angles": [(4.2, 1.4, -1.4, -4.2)[beam % 4] for beam in range(beams)],
            "beam_to_lidar_transform": [1, 0, 0, 15.806, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
            "lidar_origin_to_beam_origin_mm": 15.806,
        },
        "lidar_intrinsics": {
            "lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1]
        },
        "imu_intrinsics": {
            "imu_to_sensor_transform": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
        },
        "sensor_info": {
            "prod_line": f"OS-1-{beams}",
            "prod_sn": str(sensor.serial),
            "initialization_id": _OUSTER_INIT_ID,
            "build_rev": "v2.5.2",
            "image_rev": "ousteros-image-prod-aries-v2.5.2",
            "status": "RUNNING",
        },
        "calibration_status": {"reflectivity": {"valid": True, "timestamp": ""}},
        "lidar_data_format": {
            "pixels_per_column": beams,
            "columns_per_packet": _OUSTER_COLUMNS_PER_PACKET,
            "columns_per_frame": _OUSTER_COLUMNS,
            "column_window": [0, _OUSTER_COLUMNS - 1],
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
            "columns_per_packet": _OUSTER_COLUMNS_PER_PACKET,
        },
    }
    return json.dumps(document, indent=1)


# By suffix of the file.
_FILES: Final[Mapping[str, Callable[[BenchSensor], str]]] = {
    ".json": _ouster_metadata,
    ".csv": _pandar64_angles,
}


if __name__ == "__main__":
    make(RECORDINGS[sys.argv[1]], float(sys.argv[2]), Path(sys.argv[3]))
