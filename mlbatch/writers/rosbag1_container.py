"""The container of ROS 1 bags: connections and messages, by `rosbags`."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, cast

from mlbatch.errors import ExportError
from mlbatch.types import Message, Summary, Topic
from mlbatch.writers.message_writer import PendingChunk

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

# Not among the types of `rosbags`.
_TF = "tf2_msgs/msg/TFMessage"
_TF_TEXT = "geometry_msgs/TransformStamped[] transforms\n"


class _OpenPath:
    """Acts as the path of an open file: `rosbags` opens its path, and only to create a file."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def open(self, mode: str) -> BinaryIO:
        return self._file


class Rosbag1Container:
    """Connections and messages of one bag; `rosbags` writes each chunk when it is complete."""

    def __init__(self, path: Path) -> None:
        from rosbags.rosbag1 import Writer
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._types = get_typestore(Stores.ROS1_NOETIC)
        self._types.register(get_types_from_msg(_TF_TEXT, _TF))
        self._connections: dict[str | Topic, Connection] = {}
        self._file = path.open("wb")
        # The library refuses a path that exists: it gets one below a file, which cannot exist.
        self._bag = Writer(path / path.name)
        self._bag.path = cast(Path, _OpenPath(self._file))
        self._bag.open()
        self._written_bytes = self._file.tell()

    def take_chunks(self) -> Sequence[PendingChunk]:
        """Return nothing: chunks are written at once."""
        return ()

    def send(
        self,
        topic: str,
        kind: str,
        log_ns: int,
        message: bytes | memoryview,
        latched: bool = False,
        crc: int | None = None,
    ) -> None:
        """Append a message of type `kind`, package/Type; the first one creates the topic."""
        connection = self._connections.get(topic)
        if connection is None:
            connection = self._connections[topic] = self._bag.add_connection(
                topic,
                kind.replace("/", "/msg/"),
                typestore=self._types,
                latching=1 if latched else None,
            )
        self._write(connection, log_ns, message)

    def forward(self, message: Message) -> None:
        """Append a recorded message unchanged."""
        connection = self._connections.get(message.topic)
        if connection is None:
            connection = self._connections[message.topic] = self._forwarded(message.topic)
        self._write(connection, message.host_ns, message.data)

    def finish(self, summary: Summary, grid: dict[str, str]) -> None:
        """Complete and close the file; a bag has no place for metadata."""
        self.close()

    def close(self) -> None:
        """Complete and close the file."""
        self._bag.close()

    def abandon(self) -> None:
        """Close the incomplete file."""
        # Closing flushes again, perhaps to the disk that has just failed.
        with contextlib.suppress(OSError):
            self._file.close()

    def _write(self, connection: Connection, log_ns: int, message: bytes | memoryview) -> None:
        self._bag.write(connection, log_ns, message)
        # The library collects messages in memory: the file grows when a chunk is complete.
        if self._file.tell() > self._written_bytes:
            self._written_bytes = self._file.tell()
            self._forget_places()

    def _forget_places(self) -> None:
        """Replace the times and offsets of messages in written chunks: only their number is used.

        The library keeps all of them to the end.
        """
        written = self._bag.chunks[-2].connections
        for number, places in written.items():
            written[number] = cast("list[tuple[int, int]]", range(len(places)))

    def _forwarded(self, topic: Topic) -> Connection:
        """Return a new connection with the type that the recording has for a topic."""
        if topic.encoding != "ros1":
            raise ExportError(
                f"{topic.name}: expected messages of ROS 1 for a ROS 1 bag, found "
                f"{topic.encoding!r}; do not pass the topic, or write a .mcap, which takes both"
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
    """Return the MD5 by which ROS 1 identifies a definition."""
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

    types = get_typestore(Stores.EMPTY)
    try:
        types.register(get_types_from_msg(topic.definition, name))
        return types.generate_msgdef(name)[1]
    except TypesysError as err:
        raise ExportError(
            f"{topic.name}: expected a definition of {topic.type}, found one that cannot be read "
            f"({err}); do not pass the topic, or write a .mcap"
        ) from err
