"""Makes a standard recording: packets of simulated lidars as a capture, or decoded clouds as MCAP.

    python -m tests.bench.recordings dual-4 12 FOLDER

It runs in a process of its own, so that the measuring process does not import numpy. Every
revolution has the same ranges, waves with noise and no-return regions: about a fifth of the shots,
as outdoors. Packets and messages are those of `mlbatch simulate`; frames, of which only the tests
need fragments, those of the tests.

A cloud is a revolution of 64 rings and 2048 columns, 32 bytes a point. Shots without a return are
at zero, as Ouster's driver writes them. Clouds are by ring (64 rows of 2048 points) or by column
(one row of all points).
"""

from __future__ import annotations

import heapq
import itertools
import json
import struct
import sys
from collections.abc import Iterator, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Final

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.simulate.interface import LidarSettings, Sent, SimulatedLidar, simulated_lidar
from mlbatch.types import Message, Topic
from mlbatch.units import NS_PER_MS, NS_PER_S, NS_PER_US, STANDARD_GRAVITY
from mlbatch.writers.recordings import McapFile
from tests.bench.cases import (
    BY_RING,
    OUSTER,
    RECORDINGS,
    RIG,
    BenchRecording,
    BenchSensor,
)
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.points import CLOUD, Form, cloud_message
from tests.builders.points import OUSTER as OUSTER_POINTS

# Time of the first shot.
EPOCH_NS: Final = 1_700_000_000 * NS_PER_S
REVOLUTION_NS: Final = 100 * NS_PER_MS
# Legacy IMU packets of an Ouster.
IMU_PER_S: Final = 100
CLOUD_RINGS: Final = 64
CLOUD_COLUMNS: Final = 2048
ETHERNET_MTU: Final = 1500
_RECEIVER: Final = "192.168.7.2"
# From the last shot of a packet to its capture, and from the last point of a cloud to its message.
_TRAVEL_NS: Final = 300 * NS_PER_US
_CLOUD_TRAVEL_NS: Final = 5 * NS_PER_MS
# Time of a full frame on 1 Gbit/s Ethernet, between fragments of a packet.
_FRAGMENT_STEP_NS: Final = 12 * NS_PER_US
_IMU_FIRST_IDENT: Final = 1 << 15
_HIGHEST_DEG: Final = 21.0

# Receive time, ns, and frame.
Record = tuple[int, bytes]


def scene(columns: int, channels: int) -> tuple[F64Array, F64Array]:
    """Ranges in m (inf: none), reflectivities 0 to 255 of a revolution; (columns, channels)."""
    random = np.random.default_rng(columns * channels)
    column = np.arange(columns)[:, None] * (2 * np.pi / columns)
    channel = np.arange(channels) * (8 / channels)
    wave = np.sin(3 * column + channel) + 0.3 * np.sin(11 * column - channel)
    range_m = 14 + 9 * wave + random.normal(0, 0.015, wave.shape)
    # No-return regions, and single shots without a return.
    sky = np.cos(5 * column + 2 * channel) > 0.85
    range_m[sky | (random.random(wave.shape) < 0.03)] = np.inf
    return range_m, np.clip(90 + 60 * wave + random.normal(0, 10, wave.shape), 1, 255)


# -- captures -------------------------------------------------------------------------------------


def _lidar(sensor: BenchSensor) -> SimulatedLidar:
    """A lidar at 10 Hz with one return; Ouster: OS1-128 at 1024x10."""
    is_ouster = sensor.kind in OUSTER
    return simulated_lidar(
        LidarSettings(
            model="OS1-128" if is_ouster else sensor.kind,
            mode="single" if is_ouster else "strongest",
            rate_hz=10,
            profile=sensor.kind if is_ouster else "",
            columns=1024,
            phase_deg=0.0,
            start_ns=EPOCH_NS + sensor.phase_ns,
            serial=sensor.serial,
            imu=True,
        )
    )


def _lidar_packets(lidar: SimulatedLidar) -> Iterator[Sent]:
    """Packets of a lidar without end; devices' own packets are left out."""
    columns, channels = lidar.shots(0).direction.shape[:2]
    turn = round(columns * REVOLUTION_NS / NS_PER_S / lidar.chunk_s)
    range_m, reflectivity = scene(turn, channels)
    for chunk in itertools.count():
        rows = (chunk * columns + np.arange(columns)) % turn
        sent = lidar.packets(chunk, range_m[rows], reflectivity[rows])
        yield from (one for one in sent if one.port in lidar.topics)


def _imu_packets(lidar: SimulatedLidar, begin_ns: int) -> Iterator[Sent]:
    """Packets of an IMU at rest without end."""
    up = np.array([[0.0, 0.0, STANDARD_GRAVITY]])
    for number in itertools.count(1):
        at_ns = np.array([begin_ns + number * NS_PER_S // IMU_PER_S])
        yield from lidar.imu_packets(at_ns, up, np.zeros((1, 3)))


def _frames(
    packets: Iterator[Sent], source_ip: str, port: int, first_ident: int, mtu: int | None
) -> Iterator[Record]:
    """Frames of packets, in fragments where they exceed the MTU."""
    for ident, sent in enumerate(packets, first_ident):
        frames = udp_frame(sent.payload, source_ip, _RECEIVER, port, port, ident=ident, mtu=mtu)
        for number, frame in enumerate(frames):
            yield sent.time_ns + _TRAVEL_NS + number * _FRAGMENT_STEP_NS, frame


def write_capture(path: Path, recording: BenchRecording, seconds: float) -> None:
    """Write a pcap with the packets of all sensors in the order of their receive times."""
    end_ns = EPOCH_NS + round(seconds * NS_PER_S)
    mtu = ETHERNET_MTU if recording.fragments else None
    streams = []
    for sensor in recording.sensors:
        lidar = _lidar(sensor)
        sources = [(_lidar_packets(lidar), sensor.port, 0)]
        if recording.imu and sensor.kind in OUSTER:
            packets = _imu_packets(lidar, EPOCH_NS + sensor.phase_ns)
            # The IMU of an Ouster sends to the next port.
            sources.append((packets, sensor.port + 1, _IMU_FIRST_IDENT))
        for packets, port, first_ident in sources:
            sent = itertools.takewhile(lambda one: one.time_ns < end_ns, packets)
            streams.append(_frames(sent, sensor.source_ip, port, first_ident, mtu))
    write_pcap(path, heapq.merge(*streams, key=itemgetter(0)), ns=False)


# -- clouds ---------------------------------------------------------------------------------------


def write_clouds(path: Path, sensors: Sequence[BenchSensor], seconds: float) -> None:
    """Write the clouds of sensors, in the order of their log times."""
    file = McapFile(path)
    bodies = [bytearray(_cloud(one.kind == BY_RING, one.name)) for one in sensors]
    for number in range(int(seconds * NS_PER_S) // REVOLUTION_NS):
        for sensor, body in zip(sensors, bodies, strict=True):
            stamp_ns = EPOCH_NS + number * REVOLUTION_NS + sensor.phase_ns
            # The stamp follows the head of CDR.
            struct.pack_into("<II", body, 4, *divmod(stamp_ns, NS_PER_S))
            log_ns = stamp_ns + REVOLUTION_NS + _CLOUD_TRAVEL_NS
            file.forward(Message(Topic(sensor.topic, CLOUD, "cdr"), log_ns, bytes(body)))
    file.close()


def _cloud(by_ring: bool, frame: str) -> bytes:
    """The message of a revolution."""
    range_m, reflectivity = scene(CLOUD_COLUMNS, CLOUD_RINGS)
    reached_m = np.where(np.isfinite(range_m), range_m, 0.0)
    elevation = np.radians(np.linspace(_HIGHEST_DEG, -_HIGHEST_DEG, CLOUD_RINGS))
    azimuth = np.arange(CLOUD_COLUMNS)[:, None] * (2 * np.pi / CLOUD_COLUMNS)
    time_ns = np.arange(CLOUD_COLUMNS)[:, None] * REVOLUTION_NS // CLOUD_COLUMNS
    planes = [
        reached_m * np.cos(elevation) * np.cos(azimuth),
        -reached_m * np.cos(elevation) * np.sin(azimuth),
        reached_m * np.sin(elevation),
        np.where(reached_m > 0, np.rint(reflectivity), 0.0),
        np.broadcast_to(time_ns, range_m.shape),
        np.broadcast_to(np.arange(CLOUD_RINGS), range_m.shape),
    ]
    flat = [(plane.T if by_ring else plane).ravel().tolist() for plane in planes]
    form = Form(frame=frame, height=CLOUD_RINGS if by_ring else 1, gap=10)
    return cloud_message(OUSTER_POINTS, list(zip(*flat, strict=True)), 0, form)


# -- recordings -----------------------------------------------------------------------------------


def make(recording: BenchRecording, seconds: float, folder: Path) -> None:
    """Write recording, rig and the files that its sensors need into an existing folder."""
    for sensor in recording.sensors:
        if sensor.file:
            (folder / sensor.file).write_bytes(_metadata(sensor))
    (folder / RIG).write_text(_rig(recording.sensors), encoding="utf-8")
    # Renamed when complete: a recording that exists is complete.
    partial_path = folder / f"{recording.file}.partial"
    if recording.sensors[0].topic:
        write_clouds(partial_path, recording.sensors, seconds)
    else:
        write_capture(partial_path, recording, seconds)
    partial_path.replace(folder / recording.file)


def _metadata(sensor: BenchSensor) -> bytes:
    """Metadata of an Ouster, with the ports of the recording."""
    document = json.loads(_lidar(sensor).files.content)
    ports = {"udp_port_lidar": sensor.port, "udp_port_imu": sensor.port + 1}
    document["config_params"].update(ports)
    return json.dumps(document, indent=1).encode()


def _rig(sensors: Sequence[BenchSensor]) -> str:
    """The rig file."""
    lines = ["body_frame: base_link", "rate_hz: 10", "sensors:"]
    for sensor in sensors:
        x, y, z = sensor.translation_m
        stream = f"source_ip: {sensor.source_ip}, port: {sensor.port}"
        if sensor.topic:
            stream = f"topic: {sensor.topic}"
        lines += [
            f"  - name: {sensor.name}",
            f"    stream: {{{stream}}}",
            f"    extrinsics: {{translation_m: [{x}, {y}, {z}],"
            f" rotation_rpy_deg: [0, 0, {sensor.yaw_deg}]}}",
        ]
        if sensor.file:
            lines.append(f"    metadata: {sensor.file}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    make(RECORDINGS[sys.argv[1]], float(sys.argv[2]), Path(sys.argv[3]))
