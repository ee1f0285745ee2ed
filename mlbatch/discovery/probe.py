"""A first look at a session: its first seconds, and the calibrations that lie beside it."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mlbatch import readers, sensors
from mlbatch.discovery.extrinsics import Knowledge
from mlbatch.discovery.sampler import Sampler, split_by_kind
from mlbatch.errors import MlbatchError, RigError
from mlbatch.frames.naming import nearest_topic
from mlbatch.lidar.interface import Calibration, Evidence, Lidar
from mlbatch.readers import holds_packets, merge
from mlbatch.rig.rig import Rig
from mlbatch.types import Message, PacketBatch, Recording, StreamTable, Topic
from mlbatch.units import NS_PER_S

LOOK_NS = 10 * NS_PER_S
_ASKED = 16
# Calibrations are searched beside the recording under these suffixes, and told by content.
SIDECAR_SUFFIXES = (".csv", ".dat", ".json", ".xml", ".yaml", ".yml")
METADATA_SUFFIX = ".json"
# No calibration of one sensor comes near; tables and documents of a dataset are not opened.
MAX_SIDECAR_BYTES = 2_000_000
BAG_METADATA = "metadata.yaml"


def with_clouds(
    recordings: Sequence[Recording], table: StreamTable, named: Collection[str]
) -> list[Recording]:
    """The recordings, with decoded clouds as packets: of the topics named (in the rig).

    Where nothing is named and the session holds no raw packets, all its clouds are taken.
    """
    topics = [topic for recording in recordings for topic in recording.topics]
    if not topics:
        return list(recordings)
    # Not loaded for captures.
    from mlbatch.clouds import CloudRecording, Layout, cloud_topics

    clouds = {topic.name: topic for topic in cloud_topics(topics)}
    # A capture has no topics, and nothing but packets.
    raw = any(not recording.topics for recording in recordings) or any(map(holds_packets, topics))
    chosen = [topic for name, topic in clouds.items() if name in named or (not raw and not named)]
    if not chosen:
        return list(recordings)
    layouts: dict[str, Layout] = {}
    return [CloudRecording(recording, table, chosen, layouts) for recording in recordings]


def is_without_packets(recording: Recording) -> bool:
    """Whether a recording can only hold messages beside the packets of others."""
    if not recording.topics or any(map(holds_packets, recording.topics)):
        return False
    # As above.
    from mlbatch.clouds import CloudRecording

    clouds = recording.topics_of_clouds if isinstance(recording, CloudRecording) else ()
    return not {topic.name for topic in clouds} & {topic.name for topic in recording.topics}


def look(recordings: Sequence[Recording], table: StreamTable) -> tuple[Sampler, Learner]:
    """Look at the first 10 s of a session: its packets, and the messages that tell of sensors."""
    sampler, learner = Sampler(table), Learner()
    listen(recordings)
    for batch in first_seconds(recordings):
        sampler.add(batch)
        learner.add(batch)
    for recording in recordings:
        recording.keep = frozenset()
    return sampler, learner


def first_seconds(recordings: Sequence[Recording]) -> Iterator[PacketBatch]:
    """The packets up to 10 s after the first lidar packet, whatever the size of the batches.

    A capture is often started long before the lidars are.
    """
    until_ns: int | None = None
    with contextlib.closing(merge(recordings)) as batches:
        for batch in batches:
            if until_ns is None:
                began_ns = _lidars_begin_ns(batch)
                until_ns = None if began_ns is None else began_ns + LOOK_NS
            if until_ns is None:
                yield batch
                continue
            over = np.flatnonzero(batch.host_ns > until_ns)
            if len(over):
                yield replace(batch.take(slice(0, int(over[0]))), messages=batch.messages)
                return
            yield batch


def _lidars_begin_ns(batch: PacketBatch) -> int | None:
    """Arrival of the first packet of a kind that looks like a lidar's.

    A few packets are asked: device packets may come first on the topic of the others.
    """
    begins_ns = []
    for (_, size), index in split_by_kind(batch):
        asked = batch.start[index[:_ASKED], None] + np.arange(size)
        text = sensors.describe(size, batch.data[asked])
        if text is not None and "lidar" in text:
            begins_ns.append(int(batch.host_ns[index[0]]))
    return min(begins_ns, default=None)


def calibrations_for(
    recordings: Sequence[Path], given: Sequence[Path]
) -> tuple[list[Calibration], list[Path]]:
    """Calibrations that were given, else those beside the recordings; and the files looked at."""
    if given:
        return [read_given(path) for path in given], list(given)
    looked: list[Path] = []
    found = []
    for folder in dict.fromkeys(map(_folder_of, recordings)):
        for path in sorted(path for path in folder.iterdir() if _may_be_calibration(path)):
            # A file beside the recording was never named by the user: a foreign one is no error.
            try:
                calibration = sensors.read_calibration(path)
            except RigError:
                looked.append(path)
                continue
            if calibration is not None:
                found.append(calibration)
            if calibration is not None or path.suffix.lower() == METADATA_SUFFIX:
                looked.append(path)
    return found, looked


def calibrations_besides(
    rig: Rig | None, recordings: Sequence[Path], given: Sequence[Path]
) -> tuple[list[Calibration], list[Path]]:
    """The same; nothing where the rig names the file of every sensor."""
    # All makers would be asked for all files beside the recordings.
    if rig is not None and not given and all(one.metadata for one in rig.sensors):
        return [], []
    return calibrations_for(recordings, given)


def fault_of(path: Path) -> str:
    """What is wrong with a calibration beside the recording that could not be used, or ""."""
    try:
        sensors.read_calibration(path)
    except RigError as err:
        return str(err)
    return ""


def _folder_of(recording: Path) -> Path:
    """Where calibrations of a recording lie: beside it, or beside the folder of a ROS 2 bag."""
    folder = recording.parent
    return folder.parent if (folder / BAG_METADATA).is_file() else folder


def _may_be_calibration(path: Path) -> bool:
    is_one = path.suffix.lower() in SIDECAR_SUFFIXES and path.name != BAG_METADATA
    return is_one and path.is_file() and path.stat().st_size <= MAX_SIDECAR_BYTES


def read_given(path: Path) -> Calibration:
    """The calibration in a file that the user named; RigError if it is none."""
    calibration = sensors.read_calibration(path)
    if calibration is None:
        raise RigError(
            f"{path}: wanted the metadata or calibration of a lidar, got another kind of file; "
            "give the file that the sensor's driver or recorder saved"
        )
    return calibration


# What the messages of a session teach about its sensors, before the first packet is converted.
#
# Facts: facts/messages.md section 2 (calibrations) and section 6 (transforms).

TRANSFORM_TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")
TEXT_TYPE = "std_msgs/String"
BYTES_TYPE = "std_msgs/UInt8MultiArray"
METADATA, DESCRIPTION, STATIC = "metadata", "robot_description", "tf_static"
# HESAI ROS_2.0 publishes the angle file of the lidar there.
CORRECTIONS = "lidar_corrections"
# A calibration that was recorded with the packets beats one that lies beside the recording.
_FITS_TOPIC = 10_000


def teaches(topic: Topic) -> bool:
    """Whether the messages of a topic say something of sensors."""
    if topic.type == TEXT_TYPE:
        return _tail(topic) in (METADATA, DESCRIPTION)
    if topic.type == BYTES_TYPE:
        return _tail(topic) == CORRECTIONS
    return topic.type in TRANSFORM_TYPES or readers.holds_corrections(topic)


def listen(recordings: Iterable[Recording]) -> None:
    """Have recordings hand over the messages that teach."""
    for recording in recordings:
        recording.keep = frozenset(topic.name for topic in recording.topics if teaches(topic))


class Learner:
    """Takes messages; then tells calibrations, transforms and what could not be understood."""

    def __init__(self) -> None:
        self.knowledge = Knowledge()
        self.faults: list[str] = []
        self._texts: dict[str, bytes] = {}

    def add(self, batch: PacketBatch) -> None:
        """Learn from the messages of a batch; one that cannot be read is a fault, told once."""
        for message in batch.messages:
            self._try(message)

    def _try(self, message: Message) -> None:
        try:
            self._learn(message)
        except MlbatchError as err:
            if str(err) not in self.faults:
                self.faults.append(str(err))

    def _learn(self, message: Message) -> None:
        topic = message.topic
        if topic.type in TRANSFORM_TYPES:
            stated = readers.decode_transforms(topic, message.data)
            self.knowledge.add_transforms("tf_static" if _tail(topic) == STATIC else "tf", stated)
        elif topic.type == TEXT_TYPE and _tail(topic) == METADATA:
            # Of several, the first: it is the one under which the recording began.
            self._texts.setdefault(topic.name, readers.decode_string(topic, message.data).encode())
        elif topic.type == BYTES_TYPE and _tail(topic) == CORRECTIONS:
            self._texts.setdefault(topic.name, readers.decode_bytes(topic, message.data))
        elif topic.type == readers.CORRECTION_TYPE:
            self._texts.setdefault(topic.name, message.data)
        elif topic.type == TEXT_TYPE and _tail(topic) == DESCRIPTION:
            self.knowledge.add_urdf(readers.decode_string(topic, message.data))

    @property
    def metadata_topics(self) -> tuple[str, ...]:
        """Topics of metadata that spoke."""
        return tuple(self._texts)

    def calibrations(self) -> list[Calibration]:
        """Calibrations in metadata topics; a text that is none is a fault."""
        found: list[Calibration] = []
        for topic, text in self._texts.items():
            try:
                calibration = sensors.parse_calibration(Path(topic), text)
            except MlbatchError as err:
                self.faults.append(str(err))
                continue
            if calibration is None:
                self.faults.append(f"{topic}: wanted the metadata of a lidar, got another text")
            else:
                found.append(TopicCalibration(calibration, topic, tuple(self._texts)))
        return found


class TopicCalibration:
    """A calibration that was recorded: of the packets in its own namespace, or of a capture."""

    def __init__(self, inner: Calibration, topic: str, others: Sequence[str]) -> None:
        self.path = inner.path
        self.model = inner.model
        self.serial = inner.serial
        self.is_shared = inner.is_shared
        self._inner = inner
        self._topic = topic
        self._others = others

    def fit(self, evidence: Evidence) -> int:
        """As the calibration itself; 0 for packets of another namespace."""
        topic = evidence.stream.topic
        if topic and nearest_topic(topic, self._others) != self._topic:
            return 0
        score = self._inner.fit(evidence)
        return score + _FITS_TOPIC if score and topic else score

    def lidar(self, options: Mapping[str, str], evidence: Evidence | None) -> Lidar:
        """The sensor."""
        return self._inner.lidar(options, evidence)


def _tail(topic: Topic) -> str:
    return topic.name.rsplit("/", 1)[-1]
