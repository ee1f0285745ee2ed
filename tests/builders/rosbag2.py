"""ROS 2 bags in SQLite files from messages: db schemas 3 and 4, folders, compression."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml
import zstandard

from tests.builders.bags import Recorded, definition

QOS = {False: "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 2\n"}
QOS[True] = QOS[False].replace("durability: 2", "durability: 1")


@dataclass(frozen=True, slots=True)
class Form:
    """How a file is made; first_topic, row_step: numbers that the file gives to its rows."""

    schema: int = 3
    serialization: str = "cdr"
    zstd_messages: bool = False
    index: bool = True
    first_topic: int = 1
    row_step: int = 1


def write_rosbag2(path: Path, messages: Sequence[Recorded], form: Form | None = None) -> Path:
    """One file."""
    form = form or Form()
    with sqlite3.connect(path) as connection:
        # A test need not wait for the disk; the file is the same.
        connection.execute("PRAGMA synchronous = OFF")
        connection.execute("PRAGMA journal_mode = MEMORY")
        _tables(connection, form)
        numbers: dict[str, int] = {}
        for place, message in enumerate(messages):
            if message.topic not in numbers:
                numbers[message.topic] = len(numbers) + form.first_topic
                _topic(connection, numbers[message.topic], message, form)
            data = message.data
            if form.zstd_messages:
                data = zstandard.ZstdCompressor().compress(data)
            row = (1 + place * form.row_step, numbers[message.topic], message.log_ns, data)
            connection.execute("INSERT INTO messages VALUES (?, ?, ?, ?)", row)
    connection.close()
    return path


def write_folder(
    folder: Path, parts: Sequence[Sequence[Recorded]], form: Form | None = None
) -> Path:
    """A bag, split into files, with its metadata.yaml."""
    folder.mkdir()
    names = [f"{folder.name}_{number}.db3" for number in range(len(parts))]
    for name, part in zip(names, parts, strict=True):
        write_rosbag2(folder / name, part, form)
    about = {
        "version": 5,
        "storage_identifier": "sqlite3",
        "message_count": sum(len(part) for part in parts),
        "relative_file_paths": names,
    }
    text = yaml.safe_dump({"rosbag2_bagfile_information": about})
    (folder / "metadata.yaml").write_text(text, encoding="utf-8")
    return folder


def _tables(connection: sqlite3.Connection, form: Form) -> None:
    hashed = ", type_description_hash TEXT NOT NULL" if form.schema == 4 else ""
    connection.execute("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT)")
    connection.execute("INSERT INTO schema VALUES (?, '')", (form.schema,))
    connection.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
        f"serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL{hashed})"
    )
    connection.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, "
        "timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
    )
    if form.index:
        connection.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
    if form.schema == 4:
        connection.execute(
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, "
            "encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL, "
            "type_description_hash TEXT NOT NULL)"
        )


def _topic(connection: sqlite3.Connection, number: int, message: Recorded, form: Form) -> None:
    name = message.type.replace("/", "/msg/")
    row: tuple[object, ...] = (
        number,
        message.topic,
        name,
        form.serialization,
        QOS[message.latched],
    )
    if form.schema == 4:
        row = (*row, "RIHS01_0")
        text = definition(message.type, "cdr")
        connection.execute(
            "INSERT INTO message_definitions(topic_type, encoding, encoded_message_definition, "
            "type_description_hash) VALUES (?, 'ros2msg', ?, 'RIHS01_0')",
            (name, text),
        )
    marks = ", ".join("?" * len(row))
    connection.execute(f"INSERT INTO topics VALUES ({marks})", row)
