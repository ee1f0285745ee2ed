"""ROS 2 bags in SQLite files: a folder, or one of its files, plain or compressed.

Source: facts/messages.md, section 5 (db schemas 3 and 4, metadata versions 4 to 9). What the files
hold decides; metadata.yaml is only asked which files there should be.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from mlbatch.readers._bag import BagRecording, Portion
from mlbatch.readers._db3 import BUFFER_BYTES, MAGIC, Damage, Database
from mlbatch.types import Recording, StreamTable, Topic

CONTAINER = "ROS 2 bag (sqlite3)"


def recognises(head: bytes) -> bool:
    """Whether a file that begins with `head` is a database."""
    return head.startswith(MAGIC)


def open_packets(path: Path, streams: StreamTable) -> Recording:
    """Open a single file; its payloads come from streams (topic)."""
    return open_folder(path, [path], streams)


def open_folder(
    folder: Path, files: Sequence[Path], streams: StreamTable, notes: Sequence[str] = ()
) -> Recording:
    """Open the files of a bag as one recording, in the order of their first messages."""
    databases = [Database(path) for path in files]
    # Files without a message come last; equal times keep the order of names.
    databases.sort(key=lambda one: (one.first_ns is None, one.first_ns or 0))
    topics: dict[Topic, None] = {}
    for database in databases:
        topics |= dict.fromkeys(database.topics.values())
    standing = [*notes, *(note for database in databases for note in database.notes)]
    return BagRecording(
        folder,
        CONTAINER,
        sum(database.size_bytes for database in databases),
        tuple(topics),
        streams,
        partial(_portions, databases),
        tuple(standing),
    )


def _portions(
    databases: Sequence[Database], recording: BagRecording
) -> Generator[Portion, None, None]:
    """One pass over all files."""
    buffer = np.zeros(BUFFER_BYTES, np.uint8)
    before = 0
    for database in databases:
        numbers = {
            number: recording.number(topic)
            for number, topic in database.topics.items()
            if recording.wants(topic)
        }
        damage, read = Damage(), 0
        for portion in database.pages(numbers, buffer, damage):
            read += int((portion.end - portion.begin).sum())
            recording.position_bytes = before + min(read, database.size_bytes)
            yield portion
        before += database.size_bytes
        recording.position_bytes = before
        for note in damage.notes:
            recording.notes.append(note)
        recording.counts.frames += damage.lost
        recording.counts.skip("truncated", damage.lost)
