"""What the messages of a session teach about its sensors, before the first packet is converted.

Facts: facts/messages.md section 2 (calibrations) and section 6 (transforms).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from mlbatch import readers, ros, sensors
from mlbatch.errors import MlbatchError
from mlbatch.frames import nearest_topic
from mlbatch.knowledge import Knowledge
from mlbatch.lidar import Calibration, Evidence, Lidar
from mlbatch.types import Message, PacketBatch, Recording, Topic

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
    return topic.type in TRANSFORM_TYPES or readers.has_corrections(topic)


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
            stated = ros.decode_transforms(topic, message.data)
            self.knowledge.add_transforms("tf_static" if _tail(topic) == STATIC else "tf", stated)
        elif topic.type == TEXT_TYPE and _tail(topic) == METADATA:
            # Of several, the first: it is the one under which the recording began.
            self._texts.setdefault(topic.name, ros.decode_string(topic, message.data).encode())
        elif topic.type == BYTES_TYPE and _tail(topic) == CORRECTIONS:
            self._texts.setdefault(topic.name, ros.decode_bytes(topic, message.data))
        elif topic.type == readers.CORRECTION_TYPE:
            self._texts.setdefault(topic.name, message.data)
        elif topic.type == TEXT_TYPE and _tail(topic) == DESCRIPTION:
            self.knowledge.add_urdf(ros.decode_string(topic, message.data))

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
