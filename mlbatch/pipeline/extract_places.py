"""Where the raw packets of chosen lidars go in another container: addresses and ports, or topics.

Next to it are files with the calibrations and a rig, where the container lacks them.

Packets keep the address or topic that they were recorded with. Where they have none, those of the
vendor's drivers are used (`Recorded`), and an address of its own for each lidar.
"""

from __future__ import annotations

import ipaddress
import os
import re
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mlbatch import sensors
from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.discovery.calibrations import is_metadata
from mlbatch.discovery.discover import Discovery
from mlbatch.discovery.match import describe
from mlbatch.discovery.router import Role
from mlbatch.discovery.sampler import are_neighbours, split_by_kind
from mlbatch.discovery.types import DetectedSensor, PacketKind
from mlbatch.lidar.interface import Recorded
from mlbatch.readers import has_packets
from mlbatch.rig.rig import DEFAULT_BODY_FRAME, Rig, RigSensor, StreamSelector, UnknownExtrinsics
from mlbatch.rig.write import write_rig
from mlbatch.ros.definitions import definition_text
from mlbatch.ros.packet_writing import PacketMessages
from mlbatch.types import PacketBatch, Stream, Topic

# Options of a rig that the command has applied.
_APPLIED = ("only", "ignore", "pass")
# Of the first lidar that was recorded without one; the next ones follow.
FIRST_ADDRESS = ipaddress.IPv4Address("192.168.1.201")
_SAMPLE = 16


class Use(Enum):
    """Purpose of packets of a lidar."""

    LIDAR = "lidar"
    IMU = "imu"
    DEVICE = "device"


@dataclass(slots=True)
class ChosenLidar:
    """A lidar whose packets are extracted, and how many of them.

    sensor: None for a lidar without calibration; kinds: its lidar packets of the first seconds;
    recorded: how its drivers record packets, None: not known; place: address and port, or topic, of
    its own packets, once they are written.
    """

    name: str
    model: str
    sensor: DetectedSensor | None
    kinds: set[PacketKind]
    recorded: Recorded | None = None
    place: str = ""
    read: int = 0
    written: int = 0


@dataclass(slots=True)
class Place:
    """Destination of packets; stream: of the source; messages: None for captures.

    to: address and port, or topic; None: the container has no place for them.
    """

    stream: int
    to: Stream | None
    messages: PacketMessages | None = None


class Assigned(NamedTuple):
    """Of the packets of a batch, (n,): lidar, place (-1: not chosen), and whether of a device."""

    lidar: I64Array
    place: I64Array
    is_device: BoolArray


class Places:
    """Assigns packets to chosen lidars and their places; encodings: of messages, () of a capture.

    lidars: chosen by the selection of discovery; without rig and `--only` also those that lack a
    calibration.
    """

    def __init__(self, setup: Discovery, encodings: tuple[str, ...]) -> None:
        self.setup = setup
        self.encodings = encodings
        self.lidars: list[ChosenLidar] = []
        self.places: list[Place] = []
        self._known: dict[tuple[int, int, Use], int] = {}
        self._addresses: dict[int, str] = {}
        # Lidar of each kind without a sensor, and of other packets near a lidar.
        self._unmatched: dict[PacketKind, int] = {}
        self._near: dict[PacketKind, int] = {}
        # Lidar that has a new topic.
        self._new_topics: dict[str, int] = {}
        self._topics = {
            topic.name: topic
            for recording in reversed(setup.recordings)
            for topic in recording.topics
            if has_packets(topic)
        }
        for sensor in setup.sensors:
            self.lidars.append(ChosenLidar(sensor.name, sensor.lidar.model, sensor, sensor.kinds))
        streams: dict[int, int] = {}
        # With a rig, only its lidars.
        for kind in sorted(setup.noted if setup.rig is None else ()):
            if kind.stream not in streams:
                streams[kind.stream] = len(self.lidars)
                what = describe(setup.sampler, kind) or ""
                self.lidars.append(ChosenLidar(f"lidar{len(self.lidars)}", what, None, set()))
            self._unmatched[kind] = streams[kind.stream]
            self.lidars[streams[kind.stream]].kinds.add(kind)
        for lidar in self.lidars:
            for kind in sorted(lidar.kinds & setup.sampler.kinds.keys()):
                self._learn(lidar, kind.size, setup.sampler.kinds[kind].arrays()[0])

    def place(self, lidar: int, stream: int, use: Use) -> int:
        """Number of the place of packets of a stream."""
        key = lidar, stream, use
        if key not in self._known:
            source = self.setup.sampler.table.streams[stream]
            self._known[key] = len(self.places)
            if self.encodings:
                messages = self._messages(lidar, source, use)
                to = None if messages is None else Stream(topic=messages.topic.name)
                self.places.append(Place(stream, to, messages))
            else:
                self.places.append(Place(stream, self._address(lidar, source, use)))
        return self._known[key]

    def main_place(self, lidar: int) -> Place | None:
        """The place of a lidar's own packets; None before any packet of it."""
        kinds = self.lidars[lidar].kinds
        if not kinds:
            return None
        return self.places[self.place(lidar, min(kinds).stream, Use.LIDAR)]

    def selector(self, lidar: int) -> StreamSelector | None:
        """How a rig identifies the packets of a lidar in the new container; None: unknown yet."""
        sensor = self.lidars[lidar].sensor
        if sensor is not None and sensor.lidar.carries_serial:
            return StreamSelector(serial=sensor.lidar.serial)
        place = self.main_place(lidar)
        if place is None or place.to is None:
            return None
        return StreamSelector(place.to.source_ip, place.to.port, place.to.topic)

    # -- packets ------------------------------------------------------------------------------

    def assign(self, batch: PacketBatch) -> Assigned:
        """Assign the packets of a batch."""
        router = self.setup.router
        owner = router.owners(batch)
        place = np.full(len(batch), -1, np.int64)
        is_device = np.zeros(len(batch), np.bool_)
        for kind, index in split_by_kind(batch):
            role = router.route_of(kind, batch, int(index[0])).role
            left = index[owner[index] < 0]
            if len(left):
                owner[left] = self._owner_of_others(kind, batch, left)
                is_device[left] = kind not in self._unmatched
            for number in np.unique(owner[index]).tolist():
                rows = index[owner[index] == number]
                if number < 0:
                    continue
                lidar = self.lidars[number]
                self._learn(lidar, kind.size, _payloads(batch, rows[:_SAMPLE], kind.size))
                is_device[rows] |= _describes_device(lidar.recorded, kind, batch, rows)
                for of_device in (False, True):
                    use = Use.IMU if role is Role.IMU else Use.LIDAR
                    part = rows[is_device[rows] == of_device]
                    if len(part):
                        use = Use.DEVICE if of_device else use
                        place[part] = self.place(number, kind.stream, use)
        return Assigned(owner, place, is_device)

    def _owner_of_others(
        self, kind: PacketKind, batch: PacketBatch, rows: I64Array
    ) -> I64Array | int:
        """Chosen lidar (k,) of packets of no sensor: without calibration, or of the same device."""
        if kind in self._unmatched:
            return self._unmatched[kind]
        packets = _payloads(batch, rows, kind.size)
        near = self._nearest(kind, packets[:_SAMPLE])
        if near < 0:
            return -1
        stream = self.setup.sampler.table.streams[kind.stream]
        return np.where(self.setup.ignored.packets(stream, kind, packets), -1, near)

    def _nearest(self, kind: PacketKind, sample: U8Array) -> int:
        """Lidar from whose address or namespace packets come that are none of a lidar; or -1."""
        if kind in self._near:
            return self._near[kind]
        streams = self.setup.sampler.table.streams
        stream = streams[kind.stream]
        near = [
            number
            for number, lidar in enumerate(self.lidars)
            if any(are_neighbours(streams[one.stream], stream) for one in lidar.kinds)
        ]
        # A lidar may begin later. Of several, it is not known whose packets would be moved.
        if not near or (len(near) > 1 and not self._keeps(stream)):
            return -1
        is_lidar = "lidar" in (sensors.describe(kind.size, sample) or "")
        self._near[kind] = -1 if is_lidar else near[0]
        return self._near[kind]

    def _keeps(self, source: Stream) -> bool:
        """Whether packets keep their topic, or address and port."""
        topic = self._topics.get(source.topic)
        return not self.encodings if topic is None else topic.encoding in self.encodings

    def _learn(self, lidar: ChosenLidar, size: int, sample: U8Array) -> None:
        if lidar.recorded is None:
            lidar.recorded = sensors.recorded(size, sample)

    # -- destinations -------------------------------------------------------------------------

    def _address(self, lidar: int, source: Stream, use: Use) -> Stream | None:
        if not source.topic:
            return source
        recorded = self.lidars[lidar].recorded
        if recorded is None:
            return None
        if lidar not in self._addresses:
            taken = {one.source_ip for one in self.setup.sampler.table.streams}
            taken |= set(self._addresses.values())
            address = FIRST_ADDRESS
            while str(address) in taken:
                address += 1
            self._addresses[lidar] = str(address)
        sensor = self.lidars[lidar].sensor
        by_settings = (0, 0) if sensor is None else (sensor.lidar.lidar_port, sensor.lidar.imu_port)
        port = {
            Use.LIDAR: by_settings[0] or recorded.port,
            Use.IMU: by_settings[1] or recorded.imu_port,
            Use.DEVICE: recorded.device_port,
        }[use]
        return Stream(self._addresses[lidar], port)

    def _messages(self, lidar: int, source: Stream, use: Use) -> PacketMessages | None:
        one = self.lidars[lidar]
        topic = self._topics.get(source.topic)
        if topic is None or not self._keeps(source):
            if one.recorded is None:
                return None
            encoding = self.encodings[0]
            kind = one.recorded.message if encoding == "cdr" else one.recorded.message_ros1
            name = source.topic or self._new_topic(lidar, one.recorded, use)
            topic = Topic(name, kind, encoding, definition_text(kind, encoding))
        return PacketMessages(topic, one.name, of_device=use is Use.DEVICE)

    def _new_topic(self, lidar: int, recorded: Recorded, use: Use) -> str:
        """Name of a topic of one lidar, valid in ROS."""
        part = recorded.imu_topic if use is Use.IMU and recorded.imu_topic else recorded.topic
        word = re.sub(r"\W", "_", self.lidars[lidar].name, flags=re.ASCII)
        name = f"/{'lidar_' if word[:1].isdigit() else ''}{word}/{part}"
        while self._new_topics.setdefault(name, lidar) != lidar:
            name += "_"
        return name


def _payloads(batch: PacketBatch, rows: I64Array, size: int) -> U8Array:
    """Payloads (k, size) of packets."""
    found: U8Array = batch.data[batch.start[rows, None] + np.arange(size)]
    return found


def _describes_device(
    recorded: Recorded | None, kind: PacketKind, batch: PacketBatch, rows: I64Array
) -> BoolArray:
    """Which packets (k,) begin with the bytes of device packets."""
    magic = b"" if recorded is None else recorded.device_magic
    if not magic or kind.size < len(magic):
        return np.zeros(len(rows), np.bool_)
    same: BoolArray = (_payloads(batch, rows, len(magic)) == np.frombuffer(magic, np.uint8)).all(
        axis=1
    )
    return same


# -- files next to the recording -------------------------------------------------------------------


def side_files(
    places: Places, target: Path, topics: frozenset[Topic], *, selects: bool
) -> dict[Path, bytes]:
    """Calibrations and the rig by their paths; a calibration in the folder is not copied.

    topics: that are copied; selects: lidars are chosen by name, which a rig need not repeat.
    """
    setup = places.setup
    carried = {topic.name for topic in topics}
    recorded = setup.first.metadata.calibration_texts
    files: dict[Path, bytes] = {}
    # By where it comes from: lidars may share one.
    known: dict[str, Path] = {}
    metadata: dict[str, Path] = {}
    for sensor in setup.sensors:
        origin = sensor.lidar.calibration
        is_file = bool(origin) and Path(origin).is_file()
        if origin in carried or not (origin in recorded or is_file):
            continue
        if origin not in known:
            content = recorded[origin] if origin in recorded else Path(origin).read_bytes()
            suffix = _suffix(content) if origin in recorded else Path(origin).suffix
            known[origin] = target.with_name(f"{target.stem}.{sensor.name}{suffix}")
            if is_file and os.path.samefile(Path(origin).parent, target.parent):
                known[origin] = Path(origin)
            else:
                files[known[origin]] = content
        metadata[sensor.name] = known[origin]
    is_capture = not places.encodings
    lacks_frames = any(
        is_metadata(topic) and not has_packets(topic) and topic not in topics
        for recording in setup.recordings
        for topic in recording.topics
    )
    streams = setup.sampler.table.streams
    moves = any(bool(streams[one.stream].topic) == is_capture for one in setup.sampler.kinds)
    # Also where files are copied: with those of other extracts they may be ambiguous.
    if setup.sensors and (setup.rig is not None or lacks_frames or moves or files):
        rig = _rig(places, metadata, lacks_frames=lacks_frames, selects=selects)
        path = target.with_name(f"{target.stem}.rig.yaml")
        files[path] = write_rig(rig, target.parent).encode()
    # An earlier extract may share them.
    return {
        path: content
        for path, content in files.items()
        if not (path.is_file() and path.read_bytes() == content)
    }


def _suffix(content: bytes) -> str:
    """Suffix of a recorded calibration, by its content: JSON, angles as text or as bytes."""
    if content.lstrip().startswith(b"{"):
        return ".json"
    return ".csv" if content.isascii() else ".dat"


def _rig(places: Places, metadata: dict[str, Path], *, lacks_frames: bool, selects: bool) -> Rig:
    """The rig of the chosen lidars; lacks_frames: the new recording has no transforms."""
    setup = places.setup
    streams = setup.sampler.table.streams
    found = []
    for number, sensor in enumerate(setup.sensors):
        known = UnknownExtrinsics() if not sensor.pose.is_known else sensor.pose.body_from_sensor
        rig = sensor.rig or RigSensor(sensor.name, extrinsics=known)
        extrinsics = known if isinstance(rig.extrinsics, str) and lacks_frames else rig.extrinsics
        place = places.main_place(number)
        stream = rig.stream
        if place is not None and (sensor.rig is None or place.to != streams[place.stream]):
            stream = places.selector(number)
        path = metadata.get(sensor.name, rig.metadata)
        found.append(replace(rig, stream=stream, metadata=path, extrinsics=extrinsics))
    if setup.rig is not None:
        kept = tuple(
            option
            for option in setup.rig.options
            if option.name not in _APPLIED or (option.name != "pass" and not selects)
        )
        return replace(setup.rig, sensors=tuple(found), options=kept)
    names = {sensor.name for sensor in found}
    return Rig(tuple(found), DEFAULT_BODY_FRAME if setup.frame_id in names else setup.frame_id)
