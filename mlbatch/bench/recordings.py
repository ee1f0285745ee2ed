"""The standard recordings: which lidars, how they are mounted, and the files beside a capture.

    python -m mlbatch.bench.recordings dual-4 12 FOLDER

makes one of them in a process of its own, so that the measuring process stays small.
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
from typing import Final

import numpy as np

from mlbatch.arrays import I64Array, U8Array
from mlbatch.bench.cases import (
    CAPTURE,
    DIGEST,
    FULL,
    INIT_ID,
    KINDS,
    LOW,
    PANDAR64,
    RECORDINGS,
    RIG,
    VLP16,
    Mounted,
    Recording,
    digest,
)
from mlbatch.types import Stream
from mlbatch.units import NS_PER_MS, NS_PER_S, NS_PER_US

EPOCH_NS: Final = 1_700_000_000 * NS_PER_S
TURN_NS: Final = 100 * NS_PER_MS
# A packet arrives so long after its last shot.
_TRAVEL_NS: Final = 300 * NS_PER_US
_CDEG_PER_TURN: Final = 36_000
_SIGNAL_PEAK: Final = 2000


@dataclass(frozen=True, slots=True)
class Lidar:
    """Packets of one turn, (packets, bytes), how long one lasts, and what changes in the next.

    fill: writes stamps, angles and counters of packets (n,) with their first shots (n,), ns.
    """

    turn: U8Array
    packet_ns: int
    fill: Callable[[U8Array, I64Array, I64Array], None]

    @property
    def packet_bytes(self) -> int:
        """Bytes of a packet."""
        return int(self.turn.shape[1])

    def packets(self, numbers: I64Array, phase_ns: int) -> tuple[I64Array, U8Array]:
        """Arrival (n,) in ns and payloads (n, bytes) of these packets."""
        begin_ns = EPOCH_NS + phase_ns + numbers * self.packet_ns
        payloads = self.turn[numbers % len(self.turn)]
        self.fill(payloads, numbers, begin_ns)
        return begin_ns + self.packet_ns + _TRAVEL_NS, payloads


def seen(columns: int, channels: int) -> tuple[I64Array, I64Array]:
    """Ranges in mm, 0 for none, and levels 0 to 255 of a turn: (columns, channels) each."""
    chance = np.random.default_rng(columns * channels)
    column = np.arange(columns)[:, None] * (2 * np.pi / columns)
    channel = np.arange(channels) * (8 / channels)
    wave = np.sin(3 * column + channel) + 0.3 * np.sin(11 * column - channel)
    range_mm = np.rint(14_000 + 9_000 * wave + chance.normal(0, 15, wave.shape)).astype(np.int64)
    # Sky, and shots that miss here and there.
    range_mm[(np.cos(5 * column + 2 * channel) > 0.85) | (chance.random(wave.shape) < 0.03)] = 0
    level = np.rint(90 + 60 * wave + chance.normal(0, 10, wave.shape)).astype(np.int64)
    return range_mm, np.where(range_mm > 0, level.clip(1, 255), 0)


OUSTER_BEAMS, OUSTER_COLUMNS, OUSTER_PER_PACKET = 128, 1024, 16
_PIXEL: Final[Mapping[str, np.dtype[np.void]]] = {
    LOW: np.dtype([("range_8mm", "<u2"), ("reflectivity", "u1"), ("near_ir", "u1")]),
    FULL: np.dtype(
        [
            *(("range_mm", "<u4"), ("reflectivity", "u1"), ("unused", "u1")),
            *(("signal", "<u2"), ("near_ir", "<u2"), ("window", "<u2")),
        ]
    ),
}


def ouster(profile: str, serial: int) -> Lidar:
    """An OS-1-128 at 1024x10."""
    range_mm, level = seen(OUSTER_COLUMNS, OUSTER_BEAMS)
    pixel = np.zeros(range_mm.shape, _PIXEL[profile])
    values = {
        "range_8mm": range_mm // 8,
        "range_mm": range_mm,
        "reflectivity": level,
        "signal": np.where(range_mm > 0, _SIGNAL_PEAK * level // (1 + range_mm // 100), 0),
        "near_ir": 40 + level // 4,
    }
    for name in set(values) & set(pixel.dtype.names or ()):
        pixel[name] = values[name]
    column = np.dtype(
        [
            *(("stamp_ns", "<u8"), ("measurement_id", "<u2"), ("status", "<u2")),
            ("pixel", _PIXEL[profile], OUSTER_BEAMS),
        ]
    )
    packet = np.dtype(
        [
            *(("type", "<u2"), ("frame_id", "<u2"), ("init_id", "u1", 3), ("serial", "u1", 5)),
            *(("state", "u1", 20), ("column", column, OUSTER_PER_PACKET), ("footer", "u1", 32)),
        ]
    )
    turn = np.zeros(OUSTER_COLUMNS // OUSTER_PER_PACKET, packet)
    turn["type"] = 1
    turn["init_id"] = np.frombuffer(INIT_ID.to_bytes(3, "little"), np.uint8)
    turn["serial"] = np.frombuffer(serial.to_bytes(5, "little"), np.uint8)
    turn["column"]["status"] = 1
    turn["column"]["measurement_id"] = np.arange(OUSTER_COLUMNS).reshape(-1, OUSTER_PER_PACKET)
    turn["column"]["pixel"] = pixel.reshape(-1, OUSTER_PER_PACKET, OUSTER_BEAMS)

    def fill(payloads: U8Array, numbers: I64Array, begin_ns: I64Array) -> None:
        now = payloads.view(packet)[:, 0]
        now["frame_id"] = numbers // len(turn) % 2**16
        step = np.arange(OUSTER_PER_PACKET) * TURN_NS // OUSTER_COLUMNS
        now["column"]["stamp_ns"] = begin_ns[:, None] + step

    packet_ns = TURN_NS * OUSTER_PER_PACKET // OUSTER_COLUMNS
    return Lidar(turn.view(np.uint8).reshape(len(turn), -1), packet_ns, fill)


# A range in the makers' steps and a level, of both Velodyne and HESAI.
_READING: Final = np.dtype([("range", "<u2"), ("level", "u1")])
VLP16_CHANNELS, _VLP16_PER_BLOCK, _VLP16_BLOCKS = 16, 2, 12
# Two sequences of 55.296 us.
_VLP16_BLOCK_NS: Final = 110_592
_US_PER_HOUR: Final = 3_600_000_000


def vlp16(serial: int = 0) -> Lidar:
    """A VLP-16 at 600 rpm with one return; steps of 2 mm; its packets hold no serial number."""
    block = np.dtype(
        [
            *(("flag", "<u2"), ("azimuth_cdeg", "<u2")),
            ("reading", _READING, (_VLP16_PER_BLOCK, VLP16_CHANNELS)),
        ]
    )
    packet = np.dtype(
        [
            ("block", block, _VLP16_BLOCKS),
            *(("past_hour_us", "<u4"), ("mode", "u1"), ("product", "u1")),
        ]
    )
    packet_ns = _VLP16_BLOCK_NS * _VLP16_BLOCKS
    turn = np.zeros(TURN_NS // packet_ns, packet)
    turn["mode"], turn["product"] = 0x37, 0x22
    turn["block"]["flag"] = 0xEEFF
    columns = len(turn) * _VLP16_BLOCKS * _VLP16_PER_BLOCK
    for name, values in _steps(columns, VLP16_CHANNELS, 2).items():
        turn["block"]["reading"][name] = values.reshape(turn["block"]["reading"].shape)

    def fill(payloads: U8Array, numbers: I64Array, begin_ns: I64Array) -> None:
        now = payloads.view(packet)[:, 0]
        now["past_hour_us"] = begin_ns // NS_PER_US % _US_PER_HOUR
        shot_ns = begin_ns[:, None] + np.arange(_VLP16_BLOCKS) * _VLP16_BLOCK_NS
        now["block"]["azimuth_cdeg"] = _cdeg(shot_ns)

    return Lidar(turn.view(np.uint8).reshape(len(turn), -1), packet_ns, fill)


PANDAR64_CHANNELS, _PANDAR64_BLOCKS, _PANDAR64_BLOCK_NS = 64, 6, 55_560


def pandar64(serial: int = 0) -> Lidar:
    """A Pandar64 at 600 rpm with one return; steps of 4 mm; packets hold no serial number."""
    block = np.dtype([("azimuth_cdeg", "<u2"), ("reading", _READING, PANDAR64_CHANNELS)])
    packet = np.dtype(
        [
            *(("head", "u1", 8), ("block", block, _PANDAR64_BLOCKS), ("reserved", "u1", 8)),
            *(("speed_rpm", "<u2"), ("micros", "<u4"), ("mode", "u1"), ("factory", "u1")),
            *(("date", "u1", 6), ("sequence", "<u4")),
        ]
    )
    packet_ns = _PANDAR64_BLOCK_NS * _PANDAR64_BLOCKS
    turn = np.zeros(TURN_NS // packet_ns, packet)
    turn["head"] = [0xEE, 0xFF, PANDAR64_CHANNELS, _PANDAR64_BLOCKS, 0, 4, 0, 0]
    turn["speed_rpm"], turn["mode"], turn["factory"] = 600, 0x37, 0x42
    columns = len(turn) * _PANDAR64_BLOCKS
    for name, values in _steps(columns, PANDAR64_CHANNELS, 4).items():
        turn["block"]["reading"][name] = values.reshape(turn["block"]["reading"].shape)

    def fill(payloads: U8Array, numbers: I64Array, begin_ns: I64Array) -> None:
        now = payloads.view(packet)[:, 0]
        now["micros"] = begin_ns // NS_PER_US % (NS_PER_S // NS_PER_US)
        now["sequence"] = numbers
        shot_ns = begin_ns[:, None] + np.arange(_PANDAR64_BLOCKS) * _PANDAR64_BLOCK_NS
        now["block"]["azimuth_cdeg"] = _cdeg(shot_ns)
        second, which = np.unique(begin_ns // NS_PER_S, return_inverse=True)
        now["date"] = np.array([_date(one) for one in second.tolist()], np.uint8)[which]

    return Lidar(turn.view(np.uint8).reshape(len(turn), -1), packet_ns, fill)


def _steps(columns: int, channels: int, step_mm: int) -> dict[str, I64Array]:
    range_mm, level = seen(columns, channels)
    return {"range": range_mm // step_mm, "level": level}


def _cdeg(shot_ns: I64Array) -> I64Array:
    """Where the rotor is, 1/100 deg."""
    return shot_ns % TURN_NS * _CDEG_PER_TURN // TURN_NS


def _date(epoch_s: int) -> list[int]:
    """Year since 1900, month, day, hour, minute, second (UTC)."""
    now = time.gmtime(epoch_s)
    return [now.tm_year - 1900, now.tm_mon, now.tm_mday, now.tm_hour, now.tm_min, now.tm_sec]


# By kind of recordings.py; given the serial number, where packets carry one.
MAKERS: Final[Mapping[str, Callable[[int], Lidar]]] = {
    LOW: partial(ouster, LOW),
    FULL: partial(ouster, FULL),
    VLP16: vlp16,
    PANDAR64: pandar64,
}


ETHERNET_MTU, JUMBO_MTU = 1500, 65535
_FILE_HEAD: Final = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
_RECORD: Final = np.dtype([("s", "<u4"), ("us", "<u4"), ("kept", "<u4"), ("length", "<u4")])
_ETHERNET: Final = np.frombuffer(bytes(12) + b"\x08\x00", np.uint8)
_IP: Final = struct.Struct(">BBHHHBBH4s4s")
_IP_ID_AT, _IP_CHECK_AT = 4, 10
_UDP: Final = struct.Struct(">HHHH")
_RECEIVER: Final = ipaddress.IPv4Address("192.168.7.2").packed
_MORE_FRAGMENTS: Final = 0x2000
# A full frame takes this long on 1 Gbit/s Ethernet; fragments of a packet arrive so far apart.
_FRAGMENT_STEP_NS: Final = 12 * NS_PER_US
_PIECE_NS: Final = 500 * NS_PER_MS
Row = tuple[int, U8Array]


@dataclass(frozen=True, slots=True)
class Source:
    """A lidar on the network, and how far (ns) its rotor runs behind."""

    lidar: Lidar
    stream: Stream
    phase_ns: int


def write_capture(path: Path, sources: Sequence[Source], seconds: float, mtu: int) -> None:
    """Write so many seconds of all sources, a piece of time after the other."""
    end_ns = EPOCH_NS + round(seconds * NS_PER_S)
    waiting: list[Row] = []
    sent = [0] * len(sources)
    with path.open("wb") as file:
        file.write(_FILE_HEAD)
        for edge_ns in (*range(EPOCH_NS + _PIECE_NS, end_ns, _PIECE_NS), end_ns):
            for number, source in enumerate(sources):
                lidar = source.lidar
                count = (edge_ns - EPOCH_NS - source.phase_ns) // lidar.packet_ns
                numbers = np.arange(sent[number], max(sent[number], count))
                sent[number] += len(numbers)
                waiting += rows(source, numbers, mtu)
            waiting.sort(key=itemgetter(0))
            # What arrives later may still be overtaken by packets of the next piece.
            whole = sum(arrival_ns < edge_ns for arrival_ns, _ in waiting)
            file.writelines(row.data for _, row in waiting[:whole])
            del waiting[:whole]
        file.writelines(row.data for _, row in waiting)


def rows(source: Source, numbers: I64Array, mtu: int) -> Iterator[Row]:
    """Arrival and bytes of all records that carry these packets."""
    if not len(numbers):
        return
    arrival_ns, payloads = source.lidar.packets(numbers, source.phase_ns)
    port, size = source.stream.port, payloads.shape[1] + _UDP.size
    udp = np.frombuffer(_UDP.pack(port, port, size, 0), np.uint8)
    datagrams = np.concatenate([np.broadcast_to(udp, (len(numbers), _UDP.size)), payloads], 1)
    step = (mtu - _IP.size) // 8 * 8
    for place, offset in enumerate(range(0, size, step)):
        part = datagrams[:, offset : offset + step]
        flags = offset // 8 | (_MORE_FRAGMENTS if offset + step < size else 0)
        ip = _ip_headers(source.stream.source_ip, numbers & 0xFFFF, flags, part.shape[1])
        at_ns = arrival_ns + place * _FRAGMENT_STEP_NS
        yield from zip(at_ns.tolist(), _records(at_ns, ip, part), strict=True)


def _records(at_ns: I64Array, ip: U8Array, part: U8Array) -> U8Array:
    """(n, bytes) pcap records."""
    head = np.zeros(len(part), _RECORD)
    head["s"], rest_ns = np.divmod(at_ns, NS_PER_S)
    head["us"] = rest_ns // NS_PER_US
    head["kept"] = head["length"] = len(_ETHERNET) + _IP.size + part.shape[1]
    ethernet = np.broadcast_to(_ETHERNET, (len(part), len(_ETHERNET)))
    return np.concatenate([head.view(np.uint8).reshape(len(part), -1), ethernet, ip, part], 1)


def _ip_headers(source_ip: str, ids: I64Array, flags: int, size: int) -> U8Array:
    """(n, 20) headers with their checksums."""
    sender = ipaddress.IPv4Address(source_ip).packed
    head = _IP.pack(0x45, 0, _IP.size + size, 0, flags, 64, 17, 0, sender, _RECEIVER)
    total = sum(struct.unpack(">10H", head)) + ids
    folded = (total & 0xFFFF) + (total >> 16)
    check = ~((folded & 0xFFFF) + (folded >> 16)) & 0xFFFF
    headers = np.tile(np.frombuffer(head, np.uint8), (len(ids), 1))
    for at, words in ((_IP_ID_AT, ids), (_IP_CHECK_AT, check)):
        headers[:, at], headers[:, at + 1] = words >> 8, words & 0xFF
    return headers


def make(recording: Recording, seconds: float, folder: Path) -> None:
    """Write capture, rig and what the sensors need into an existing folder."""
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
