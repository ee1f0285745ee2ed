"""A ROS 1 bag, written by `rosbags` (facts/outputs.md, section 4).

Types come with their MD5 and full definition, as `rosbag play` wants them; /tf_static is latched.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from mlbatch.errors import ExportError
from mlbatch.ros.encoding import Ros1
from mlbatch.types import Message, RunInfo, Summary, Topic
from mlbatch.writers._atomic import prepare
from mlbatch.writers._bag_writer import BagWriter, Sink, extras_of, layout_of
from mlbatch.writers._chunk import Chunk
from mlbatch.writers._kept import open_output
from mlbatch.writers._options import ScanWriter, WriterOptions

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

FORMAT = "rosbag1"
SUFFIX: str | None = ".bag"
COMPRESSES = False

# Not among the types that `rosbags` brings along.
_TF = "tf2_msgs/msg/TFMessage"
_TF_TEXT = "geometry_msgs/TransformStamped[] transforms\n"


def extras(options: WriterOptions) -> frozenset[str]:
    """What the fields of the point layout are made of, IMU samples and messages."""
    return extras_of(options, "ros1")


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a ROS 1 bag."""
    layout_of(options)
    output = prepare(target, options.overwrite, folder=False, keep=options.kept_bytes is not None)
    return BagWriter(output, info, options, Ros1, _sink)


def _sink(path: Path, kept_bytes: int | None) -> Sink:
    if kept_bytes is None:
        # It creates the file itself, and only where none is.
        path.unlink()
    return _Rosbag1Sink(path, kept_bytes)


class _Rosbag1Sink:
    """Connections and messages of one bag."""

    def __init__(self, path: Path, kept_bytes: int | None) -> None:
        from rosbags.rosbag1 import Writer
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._types = get_typestore(Stores.ROS1_NOETIC)
        self._types.register(get_types_from_msg(_TF_TEXT, _TF))
        self._connections: dict[str | Topic, Connection] = {}
        self._safe = (0, 0)
        if kept_bytes is None:
            self._bag = Writer(path)
            self._bag.open()
            return
        # The library only begins new bags: the head of one, made elsewhere, is written again.
        with tempfile.TemporaryDirectory() as folder:
            self._bag = Writer(Path(folder) / path.name)
            self._bag.open()
            self._file.close()
            head = self._bag.path.read_bytes()
        self._bag.path, self._bag.bio = path, open_output(path, kept_bytes)
        self._bag.bio.write(head)

    @property
    def ended(self) -> int:
        """Chunks that are complete; the library's last one is open."""
        return len(self._bag.chunks) - 1

    def safe(self) -> tuple[int, int]:
        """Chunks that the system has, and the bytes up to their end."""
        return self._safe

    def take(self) -> list[Chunk]:
        """None, as they are written already."""
        return []

    def seal(self, chunks: Sequence[Chunk]) -> None:
        """Nothing to do."""

    def put(self, chunks: Sequence[Chunk]) -> None:
        """Nothing to do."""

    def send(
        self, topic: str, kind: str, log_ns: int, message: bytes | memoryview, latched: bool = False
    ) -> None:
        """Append a message of type `kind`, package/Type; a topic is made at its first message."""
        connection = self._connections.get(topic)
        if connection is None:
            name = kind.replace("/", "/msg/")
            latching = 1 if latched else None
            connection = self._bag.add_connection(
                topic, name, typestore=self._types, latching=latching
            )
            self._connections[topic] = connection
        self._write(connection, log_ns, message)

    def forward(self, message: Message) -> None:
        """Append a message as it was recorded."""
        connection = self._connections.get(message.topic)
        if connection is None:
            connection = self._connections[message.topic] = self._adopt(message.topic)
        self._write(connection, message.host_ns, message.data)

    def _write(self, connection: Connection, log_ns: int, message: bytes | memoryview) -> None:
        self._bag.write(connection, log_ns, message)
        if self.ended > self._safe[0]:
            # Noted here and not when it is asked: then another scan may be under way.
            self._file.flush()
            self._safe = (self.ended, self._file.tell())

    def finish(self, summary: Summary, grid: dict[str, str]) -> None:
        """Complete and close the file; a bag has no place for what tells of the run."""
        self._bag.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        # Closing flushes once more, onto the disk that has just refused.
        with contextlib.suppress(OSError):
            if self._bag.bio is not None:
                self._bag.bio.close()

    @property
    def _file(self) -> BinaryIO:
        if self._bag.bio is None:
            raise ExportError(f"{self._bag.path}: wanted an open bag, got a closed one; report it")
        return self._bag.bio

    def _adopt(self, topic: Topic) -> Connection:
        """A connection that says of a topic what its recording said."""
        if topic.encoding != "ros1":
            raise ExportError(
                f"{topic.name}: wanted messages of ROS 1 to pass on to a ROS 1 bag, got "
                f"{topic.encoding!r}; leave the topic out, or write a .mcap, which holds both"
            )
        name = topic.type.replace("/", "/msg/")
        return self._bag.add_connection(
            topic.name,
            name,
            msgdef=topic.definition,
            md5sum=_md5(topic, name),
            latching=1 if topic.latched else None,
        )


def _md5(topic: Topic, name: str) -> str:
    """The number by which ROS 1 knows a definition."""
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

    types = get_typestore(Stores.EMPTY)
    try:
        types.register(get_types_from_msg(topic.definition, name))
        return types.generate_msgdef(name)[1]
    except TypesysError as err:
        raise ExportError(
            f"{topic.name}: wanted the definition of {topic.type} to pass it on, got one that "
            f"cannot be read ({err}); leave the topic out, or write a .mcap"
        ) from err
