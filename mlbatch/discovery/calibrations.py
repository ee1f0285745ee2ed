"""The calibrations in and around the recordings of a session.

Sources: docs/sources/messages.md sections 2 (calibrations) and 6 (transforms).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from mlbatch import readers, sensors
from mlbatch.discovery.extrinsics import ExtrinsicsSources
from mlbatch.errors import MlbatchError, RigError
from mlbatch.frames.naming import nearest_topic
from mlbatch.lidar.interface import Calibration, Evidence, Lidar
from mlbatch.readers.datasets import BAG_METADATA
from mlbatch.types import Message, PacketBatch, Recording, Topic

# Suffixes of calibration files in the recording's directory; vendors recognise them by content.
CALIBRATION_SUFFIXES = (".csv", ".dat", ".json", ".xml", ".yaml", ".yml")
METADATA_SUFFIX = ".json"
# Well above any calibration of one sensor; larger tables of a dataset are not opened.
MAX_CALIBRATION_FILE_BYTES = 2_000_000
# Documents of mlbatch: manifests, reports, golden files.
_DOCUMENT = re.compile(rb"schema\W{1,5}mlbatch\.")
_HEAD_BYTES = 256

TRANSFORM_TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")
TEXT_TYPE = "std_msgs/String"
BYTES_TYPE = "std_msgs/UInt8MultiArray"
# Last parts of topics.
METADATA = "metadata"
DESCRIPTION = "robot_description"
STATIC = "tf_static"
# Angle file of the lidar, published by HESAI ROS_2.0.
CORRECTIONS = "lidar_corrections"
# Added to scores: a calibration recorded with the packets is preferred to a file.
_RECORDED_SCORE = 10_000


# -- calibration files ----------------------------------------------------------------------------


def find_calibrations(
    recordings: Sequence[Path], given: Sequence[Path]
) -> tuple[list[Calibration], list[Path]]:
    """Calibrations in the files given, else in the recordings' directories; and files examined."""
    if given:
        return [read_given(path) for path in given], list(given)
    found: list[Calibration] = []
    examined: list[Path] = []
    for folder in dict.fromkeys(map(_calibration_folder, recordings)):
        for path in sorted(path for path in folder.iterdir() if may_be_calibration(path)):
            # The user did not name this file, so that an unusable one is no error.
            try:
                calibration = sensors.read_calibration(path)
            except RigError:
                examined.append(path)
                continue
            if calibration is not None:
                found.append(calibration)
            if calibration is not None or path.suffix.lower() == METADATA_SUFFIX:
                examined.append(path)
    return found, examined


def fault_of(path: Path) -> str:
    """Why a file in the recording's directory is no usable calibration, or ""."""
    try:
        sensors.read_calibration(path)
    except RigError as err:
        return str(err)
    return ""


def read_given(path: Path) -> Calibration:
    """The calibration in a file that the user named; RigError for another kind of file."""
    calibration = sensors.read_calibration(path)
    if calibration is None:
        raise RigError(
            f"{path}: expected the metadata or calibration of a lidar, found another kind of file; "
            "give the file that the sensor's driver or recording software saved"
        )
    return calibration


def _calibration_folder(recording: Path) -> Path:
    """Directory of a recording; of a file inside a ROS 2 bag, that of the bag."""
    folder = recording.parent
    return folder.parent if (folder / BAG_METADATA).is_file() else folder


def may_be_calibration(path: Path) -> bool:
    """Whether a file next to a recording may be a calibration, by name, size and first bytes."""
    if path.suffix.lower() not in CALIBRATION_SUFFIXES or path.name == BAG_METADATA:
        return False
    if not path.is_file() or path.stat().st_size > MAX_CALIBRATION_FILE_BYTES:
        return False
    with path.open("rb") as file:
        return not _DOCUMENT.search(file.read(_HEAD_BYTES))


# -- metadata messages ----------------------------------------------------------------------------


def is_metadata(topic: Topic) -> bool:
    """True for topics with calibrations, transforms or a robot description."""
    if topic.type == TEXT_TYPE:
        return _last_part(topic) in (METADATA, DESCRIPTION)
    if topic.type == BYTES_TYPE:
        return _last_part(topic) == CORRECTIONS
    return topic.type in TRANSFORM_TYPES or readers.has_corrections(topic)


def subscribe(recordings: Iterable[Recording]) -> None:
    """Have recordings deliver their metadata messages."""
    for recording in recordings:
        recording.keep = frozenset(topic.name for topic in recording.topics if is_metadata(topic))


class MetadataCollector:
    """Collects calibrations and extrinsics from messages.

    extrinsics: transforms and robot descriptions; faults: why messages could not be read;
    calibration_texts: by topic.
    """

    def __init__(self) -> None:
        self.extrinsics = ExtrinsicsSources()
        self.faults: list[str] = []
        self.calibration_texts: dict[str, bytes] = {}

    def add(self, batch: PacketBatch) -> None:
        """Add the messages of a batch; each fault is noted once."""
        for message in batch.messages:
            self._add(message)

    def _add(self, message: Message) -> None:
        try:
            self._read(message)
        except MlbatchError as err:
            if str(err) not in self.faults:
                self.faults.append(str(err))

    def _read(self, message: Message) -> None:
        # Not loaded for captures.
        from mlbatch.ros.messages import decode_bytes, decode_string, decode_transforms

        topic = message.topic
        data = bytes(message.data)
        last_part = _last_part(topic)
        if topic.type in TRANSFORM_TYPES:
            transforms = decode_transforms(topic, data)
            self.extrinsics.add_transforms("tf_static" if last_part == STATIC else "tf", transforms)
        elif topic.type == TEXT_TYPE and last_part == METADATA:
            self._add_text(topic, decode_string(topic, data).encode())
        elif topic.type == BYTES_TYPE and last_part == CORRECTIONS:
            self._add_text(topic, decode_bytes(topic, data))
        elif topic.type == readers.CORRECTION_TYPE:
            self._add_text(topic, data)
        elif topic.type == TEXT_TYPE and last_part == DESCRIPTION:
            self.extrinsics.add_urdf(decode_string(topic, data))

    def _add_text(self, topic: Topic, text: bytes) -> None:
        """Keep the first text of a topic: the settings at the start of the recording."""
        self.calibration_texts.setdefault(topic.name, text)

    @property
    def calibration_topics(self) -> tuple[str, ...]:
        """Topics with a text that should be a calibration."""
        return tuple(self.calibration_texts)

    def calibrations(self) -> list[Calibration]:
        """Calibrations in messages; a text that is none is noted as a fault."""
        found: list[Calibration] = []
        for topic, text in self.calibration_texts.items():
            try:
                calibration = sensors.parse_calibration(Path(topic), text)
            except MlbatchError as err:
                self.faults.append(str(err))
                continue
            if calibration is None:
                self.faults.append(f"{topic}: expected the metadata of a lidar, found another text")
            else:
                found.append(TopicCalibration(calibration, topic, self.calibration_topics))
        return found


class TopicCalibration(Calibration):
    """A recorded calibration: of the packets in its topic's namespace, or of a capture."""

    def __init__(self, inner: Calibration, topic: str, topics: Sequence[str]) -> None:
        """topics: all topics with calibrations."""
        self.path = inner.path
        self.model = inner.model
        self.serial = inner.serial
        self.is_shared = inner.is_shared
        self._inner = inner
        self._topic = topic
        self._topics = topics

    def match_score(self, evidence: Evidence) -> int:
        """Score of the calibration itself; 0 for packets of another namespace."""
        topic = evidence.stream.topic
        if topic and nearest_topic(topic, self._topics) != self._topic:
            return 0
        score = self._inner.match_score(evidence)
        return score + _RECORDED_SCORE if score and topic else score

    def lidar(self, options: Mapping[str, str], evidence: Evidence | None) -> Lidar:
        """Decoder of the sensor."""
        return self._inner.lidar(options, evidence)


def _last_part(topic: Topic) -> str:
    return topic.name.rsplit("/", 1)[-1]
