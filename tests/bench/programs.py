"""Programs that are measured for comparison, each in a process of its own.

    python -c TEXT start RESULT
    python -c TEXT write RESULT BYTES
    python -c TEXT ouster-sdk|ouster-sdk-lean RESULT RECORDING METADATA,X,Y,Z,YAW_DEG...
    python -c TEXT velodyne-decoder|velodyne-decoder-lean RESULT RECORDING MODEL...

The first two do work that no conversion avoids; a peer is another program that does a part of the
same work. TEXT is that of this file, which the interpreter that has a peer gets. RESULT is a JSON
file: CPU time without start and imports, and what was read. This file imports only the standard
library at the top, and nothing of mlbatch: imports count in what is measured.

Source: the APIs of ouster-sdk 1.0 and velodyne-decoder 3.1 (both BSD-3-Clause).
"""

from __future__ import annotations

import importlib
import json
import struct
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol, TypeAlias

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

BLOCK_BYTES: Final = 8 << 20
# Slots of a packet of a single return: 12 blocks of 32 readings.
_VELODYNE_SLOTS: Final = 384
# Names in velodyne-decoder, by model.
_VELODYNE_MODELS: Final = {"VLP-16": "VLP16", "VLS-128": "VLS128"}
# In a capture: header of the file, header of a record, and in a record of Ethernet and IPv4 the
# sender and the payload.
_FILE_HEADER_BYTES: Final = 24
_RECORD_HEADER: Final = struct.Struct("<IIII")
_SENDER_AT: Final = 14 + 12
_PAYLOAD_AT: Final = 14 + 20 + 8
# Fields that mlbatch decodes, by profile.
_LEAN_FIELDS: Final = {
    "RNG15_RFL8_NIR8": ["RANGE", "REFLECTIVITY"],
    "RNG19_RFL8_SIG16_NIR16": ["RANGE", "REFLECTIVITY", "SIGNAL"],
}

Counts: TypeAlias = "dict[str, float]"

# -- floors ---------------------------------------------------------------------------------------


def write(size: str) -> Counts:
    """Write bytes to a new file in large blocks; like mlbatch, without fsync."""
    began_s = time.process_time()
    block = memoryview(bytes(range(256)) * (BLOCK_BYTES // 256))
    with Path("floor.bin").open("wb", buffering=0) as file:
        for at in range(0, int(size), BLOCK_BYTES):
            file.write(block[: min(BLOCK_BYTES, int(size) - at)])
    return {"own_cpu_s": time.process_time() - began_s}


def start() -> Counts:
    """Import numpy, as every conversion does."""
    importlib.import_module("numpy")
    return {"own_cpu_s": 0.0}


# -- peers ----------------------------------------------------------------------------------------


def _body_from_sensor(x: float, y: float, z: float, yaw_deg: float) -> npt.NDArray[np.float64]:
    """Pose as (4, 4), metres, from a translation and a yaw angle."""
    import numpy as np

    cosine = np.cos(np.radians(yaw_deg))
    sine = np.sin(np.radians(yaw_deg))
    return np.array([[cosine, -sine, 0, x], [sine, cosine, 0, y], [0, 0, 1, z], [0, 0, 0, 1]])


def ouster_sdk(recording: str, *sensors: str, lean: bool) -> Counts:
    """Collate the frames of all sensors and project them into the body frame.

    By default all fields and `XYZLut` (float64) with extrinsics, as the SDK does; lean: only the
    fields that mlbatch decodes, and `XYZLutFloat`.
    """
    import numpy as np

    # Imported by name: type checks run where the SDK is not installed.
    sdk = importlib.import_module("ouster.sdk")
    core = importlib.import_module("ouster.sdk.core")
    began_s = time.process_time()
    metadata = [sensor.split(",")[0] for sensor in sensors]
    poses = [_body_from_sensor(*map(float, sensor.split(",")[1:])) for sensor in sensors]
    settings: dict[str, object] = {"meta": metadata, "extrinsics": poses}
    table_type = core.XYZLut
    if lean:
        sensor_format = json.loads(Path(metadata[0]).read_text(encoding="utf-8"))
        profile = sensor_format["lidar_data_format"]["udp_profile_lidar"]
        settings["field_names"] = _LEAN_FIELDS[profile]
        table_type = core.XYZLutFloat
    source = sdk.open_source(recording, **settings)
    tables = [table_type(info, use_extrinsics=True) for info in source.sensor_info]
    slots = 0
    points = 0
    scans = 0
    for frames in source:
        scans += 1
        for number, frame in enumerate(frames):
            if frame is not None:
                slots += tables[number](frame).size // 3
                points += int(np.count_nonzero(frame.field("RANGE")))
    own_cpu_s = time.process_time() - began_s
    return {"slots": slots, "points": points, "scans": scans, "own_cpu_s": own_cpu_s}


class _SweepDecoder(Protocol):
    """`velodyne_decoder.StreamDecoder`: decodes one sensor; a sweep is its time and its points."""

    def decode(self, stamp: float, packet: bytes) -> tuple[float, list[object]] | None:
        """Add a packet; returns the sweep that it completes, if any."""
        ...

    def finish(self) -> tuple[float, list[object]] | None:
        """Return the last sweep, if any."""
        ...


# Receive time, s, sender and payload of a packet.
_VelodynePacket: TypeAlias = "tuple[float, bytes, bytes]"


def _packets_by_dpkt(recording: str) -> Iterator[_VelodynePacket]:
    """Packets as the decoder's `read_pcap` reads them."""
    pcap = importlib.import_module("dpkt.pcap")
    ethernet = importlib.import_module("dpkt.ethernet")
    with Path(recording).open("rb") as file:
        for stamp, frame in pcap.Reader(file):
            packet = ethernet.Ethernet(frame).data
            yield stamp, packet.src, packet.data.data


def _packets_at_offsets(recording: str) -> Iterator[_VelodynePacket]:
    """Packets of a capture without any check, the least that a reader can do."""
    data = Path(recording).read_bytes()
    at = _FILE_HEADER_BYTES
    while at < len(data):
        seconds, micros, kept, _ = _RECORD_HEADER.unpack_from(data, at)
        at += _RECORD_HEADER.size
        sender = data[at + _SENDER_AT : at + _SENDER_AT + 4]
        yield seconds + micros * 1e-6, sender, data[at + _PAYLOAD_AT : at + kept]
        at += kept


def velodyne_decoder(recording: str, *models: str, lean: bool) -> Counts:
    """Decode the sweeps of each sensor in its own frame, without merging sensors.

    Packets come from dpkt, as in the decoder's `read_pcap`, which supports one sensor per file;
    lean: from a bare loop. All sensors are of the first model.
    """
    decoder = importlib.import_module("velodyne_decoder")
    read = _packets_at_offsets if lean else _packets_by_dpkt
    model = getattr(decoder.Model, _VELODYNE_MODELS[models[0]])
    began_s = time.process_time()
    streams: dict[bytes, _SweepDecoder] = {}
    sweeps = []
    slots = 0
    for stamp, sender, packet in read(recording):
        if sender not in streams:
            streams[sender] = decoder.StreamDecoder(decoder.Config(model=model))
        sweep = streams[sender].decode(stamp, packet)
        slots += _VELODYNE_SLOTS
        if sweep is not None:
            sweeps.append(len(sweep[1]))
    for stream in streams.values():
        sweep = stream.finish()
        if sweep is not None:
            sweeps.append(len(sweep[1]))
    own_cpu_s = time.process_time() - began_s
    return {"slots": slots, "points": sum(sweeps), "scans": len(sweeps), "own_cpu_s": own_cpu_s}


PROGRAMS: Final[Mapping[str, Callable[..., Counts]]] = {
    "start": start,
    "write": write,
    "ouster-sdk": partial(ouster_sdk, lean=False),
    "ouster-sdk-lean": partial(ouster_sdk, lean=True),
    "velodyne-decoder": partial(velodyne_decoder, lean=False),
    "velodyne-decoder-lean": partial(velodyne_decoder, lean=True),
}


def main(name: str, result: str, *arguments: str) -> None:
    """Run a program and write its times and counts to the file `result` (JSON)."""
    found = PROGRAMS[name](*arguments)
    Path(result).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
