"""MCAP files from messages, by the reference library: ROS 2 and ROS 1, chunks of every kind."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from mcap.writer import CompressionType, IndexType, Writer

from tests.builders.bags import Recorded, definition

NONE = CompressionType.NONE
LZ4 = CompressionType.LZ4
ZSTD = CompressionType.ZSTD
_DATA_END = 0x0F
_QOS = {True: "- durability: transient_local", False: "- durability: volatile"}


@dataclass(frozen=True, slots=True)
class Form:
    """How a file is made; without a summary it ends at its last record, and then `tail`.

    repeat: schemas and channels that the summary names as well.
    """

    encoding: str = "cdr"
    compression: CompressionType = NONE
    chunked: bool = True
    summary: bool = True
    tail: bytes = b""
    chunk_bytes: int = 200_000
    repeat: bool = True
    index: IndexType = IndexType.ALL


FORMS = {
    "none": Form(),
    "lz4": Form(compression=LZ4),
    "zstd": Form(compression=ZSTD),
    "unchunked": Form(chunked=False),
    "no summary": Form(summary=False),
    "no summary, zstd": Form(compression=ZSTD, summary=False),
    "no index": Form(index=IndexType.NONE, repeat=False),
    "ROS 1": Form("ros1"),
    "ROS 1, lz4": Form("ros1", LZ4),
}


def write_mcap(path: Path, messages: Iterable[Recorded], form: Form | None = None) -> Path:
    """Write messages in the order given."""
    form = form or Form()
    ros = "ros1" if form.encoding == "ros1" else "ros2"
    with path.open("wb") as file:
        writer = Writer(
            file,
            chunk_size=form.chunk_bytes,
            compression=form.compression,
            use_chunking=form.chunked,
            index_types=form.index,
            repeat_channels=form.repeat,
            repeat_schemas=form.repeat,
        )
        writer.start(ros)
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for message in messages:
            if message.type not in schemas:
                name = message.type if ros == "ros1" else message.type.replace("/", "/msg/")
                text = definition(message.type, form.encoding).encode()
                schemas[message.type] = writer.register_schema(name, f"{ros}msg", text)
            if message.topic not in channels:
                about = {"offered_qos_profiles": _QOS[message.latched]} if ros == "ros2" else {}
                if message.latched and ros == "ros1":
                    about = {"latching": "1"}
                channels[message.topic] = writer.register_channel(
                    message.topic, form.encoding, schemas[message.type], about
                )
            at_ns = message.log_ns
            writer.add_message(channels[message.topic], at_ns, message.data, at_ns)
        end: Callable[[], None] = writer.finish
        end()
    if not form.summary:
        os.truncate(path, _data_end(path.read_bytes()))
    with path.open("ab") as file:
        file.write(form.tail)
    return path


def _data_end(data: bytes) -> int:
    """Where the last record before the end of the data ends."""
    at = 8
    while data[at] != _DATA_END:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    return at
