"""Chosen scans of an output, read by their place in it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from mlbatch.outputs.cloud_messages import CLOUD, read_cloud, stored_scan
from mlbatch.outputs.containers import BoundedFile, Message, library_errors
from mlbatch.outputs.damage import CheckLog, DamageError, VerifyError
from mlbatch.outputs.encoding import MessageCursor
from mlbatch.outputs.folders import scan_files
from mlbatch.outputs.kinds import FileFormat, kind_of
from mlbatch.outputs.run_files import mcaps_of
from mlbatch.outputs.stored_scan import StoredScan
from mlbatch.page.points import PageCloud, Place, page_cloud
from mlbatch.page.windows import Windows

# Characters of the scans of a page; of scans that were asked for, what browsers open.
MOST_CHARS = 3_000_000
_MOST_CHARS_ASKED = 160_000_000
# Of a point, where many are asked for.
_CHARS_PER_POINT = 4
# First, middle and worst.
_LEAST_SCANS = 3
# Scans in memory.
_AT_ONCE = 8
# Opcode and length.
_RECORD_HEAD_BYTES = 9


def chosen_clouds(output: Path, windows: Windows, scans: int | None) -> list[PageCloud]:
    """The scans of an output to show, in order; every nth column of all where a limit demands it.

    scans: number, 0 for all; None: as many as the page has room for, three at least. Raises
    VerifyError if the output cannot be read.
    """
    places = choose_places(windows, _LEAST_SCANS if scans is None else scans)
    if scans is None:
        places = [place for place in places if place.title]
    most = MOST_CHARS if scans is None else _MOST_CHARS_ASKED
    stride = 1
    if scans is not None:
        points = int(windows.points[[one.row for one in places]].sum())
        stride = max(1, -(-points * _CHARS_PER_POINT // most))
    clouds = read_clouds(output, places, windows, stride)
    chars = [one.chars for one in clouds]
    if sum(chars) > most:
        return read_clouds(output, places, windows, -(-stride * sum(chars) // most))
    # Other scans may have more points than these, which may be empty.
    per_point = max((one.chars / max(1, one.total) for one in clouds), default=1.0)
    room = int((most - sum(chars)) / (per_point * max(1, int(windows.points.max()))))
    if scans is None and room:
        more = choose_places(windows, len(places) + room)
        clouds += read_clouds(output, [one for one in more if one not in places], windows)
    return sorted(clouds, key=lambda one: one.place.row)


def choose_places(windows: Windows, scans: int) -> list[Place]:
    """The worst, first and middle window, and others at equal distances, in order.

    scans: number, 0 for all.
    """
    worst_row = windows.worst()
    is_whole = windows.fill[worst_row].min() >= 1.0
    first_row = int(windows.has_head and len(windows) > 1)
    named = (
        ("fewest points" if is_whole else "worst", worst_row),
        ("first", first_row),
        ("middle", len(windows) // 2),
    )
    rows = list(range(len(windows)))
    titles: dict[int, list[str]] = {row: [] for row in rows}
    for title, row in named[1:] + named[:1]:
        titles[row].append(title)
    if scans and scans < len(rows):
        kept = list(dict.fromkeys(row for _, row in named))[:scans]
        others = [row for row in rows[first_row:] if row not in kept]
        spread = np.linspace(0, len(others) - 1, min(len(others), scans - len(kept)))
        rows = sorted(kept + [others[i] for i in np.rint(spread).astype(int).tolist()])
    return [
        Place(
            " and ".join(titles[row]),
            row,
            int(windows.index[row]),
            int(windows.slice[row]),
            int(windows.start_ns[row]),
        )
        for row in rows
    ]


def read_clouds(
    output: Path, places: list[Place], windows: Windows, stride: int = 1
) -> list[PageCloud]:
    """The scans of an output at some places; stride: every nth column of them.

    Raises VerifyError if the output cannot be read.
    """
    clouds: list[PageCloud] = []
    for begin in range(0, len(places), _AT_ONCE):
        some = places[begin : begin + _AT_ONCE]
        parts: dict[int, list[StoredScan]] = {}
        try:
            for scan in _scans(output, some, windows.sensors):
                parts.setdefault(scan.start_ns, []).append(scan)
        except DamageError as err:
            raise VerifyError(f"{output}: {err}") from err
        clouds += [
            page_cloud(place, parts[place.start_ns], windows, stride)
            for place in some
            if place.start_ns in parts
        ]
    return clouds


# -- containers -------------------------------------------------------------------------------


def _scans(output: Path, places: list[Place], sensors: tuple[str, ...]) -> Iterator[StoredScan]:
    kind = kind_of(output)
    topics = {"/points": None} | {f"/{name}/points": i for i, name in enumerate(sensors)}
    if kind.form is not None:
        yield from _of_files(output, kind.form, places)
    elif kind.name == "rosbag1":
        yield from _of_messages(_bag_messages(output, places, list(topics)), topics)
    elif not kind.name:
        raise VerifyError(f"{output}: expected an output of mlbatch, found {kind.found}")
    for file in mcaps_of(output):
        yield from _of_messages(_mcap_messages(file, places, list(topics)), topics)


def _of_files(folder: Path, form: FileFormat, places: list[Place]) -> Iterator[StoredScan]:
    log = CheckLog()
    keys = {(place.index, place.slice) for place in places}
    files = scan_files(log, folder, form.suffix)
    if files:
        reader = form.reader(log)
        reader.begin(files[0])
        yield from reader.scans([one for one in files if (one.index, one.slice or 0) in keys])


def _of_messages(
    messages: Iterator[Message], topics: dict[str, int | None]
) -> Iterator[StoredScan]:
    for message in messages:
        if message.type == CLOUD:
            cloud = read_cloud(MessageCursor.of_message(message.data, message.encoding))
            yield stored_scan(cloud, message.where, topics[message.topic])


def _mcap_messages(file: Path, places: list[Place], topics: list[str]) -> Iterator[Message]:
    """Messages at the start of each place, from the chunks that contain it.

    The names of the time limits of `iter_messages` differ between versions of the library.
    """
    from mcap.data_stream import ReadDataStream
    from mcap.reader import make_reader
    from mcap.records import Chunk
    from mcap.records import Message as Record
    from mcap.stream_reader import breakup_chunk

    from mlbatch.outputs.mcap_file import unpacked

    starts = {place.start_ns for place in places}
    with library_errors("an MCAP file with an index"), BoundedFile(file) as stream:
        summary = make_reader(stream).get_summary()
        if summary is None:
            raise DamageError("a summary", "none")
        for index in summary.chunk_indexes:
            first_ns = index.message_start_time
            if not any(first_ns <= start <= index.message_end_time for start in starts):
                continue
            stream.seek(index.chunk_start_offset + _RECORD_HEAD_BYTES)
            chunk = Chunk.read(ReadDataStream(stream))
            # The library unpacks to any size.
            data = unpacked(chunk.compression, chunk.data, chunk.uncompressed_size)
            for record in breakup_chunk(replace(chunk, compression="", data=data)):
                if not isinstance(record, Record) or record.log_time not in starts:
                    continue
                channel = summary.channels[record.channel_id]
                if channel.topic in topics:
                    yield Message(
                        where=f"{file.name} {channel.topic}",
                        topic=channel.topic,
                        type=summary.schemas[channel.schema_id].name.replace("/msg/", "/"),
                        encoding=channel.message_encoding,
                        log_ns=record.log_time,
                        publish_ns=record.publish_time,
                        data=record.data,
                    )


def _bag_messages(file: Path, places: list[Place], topics: list[str]) -> Iterator[Message]:
    from rosbags.rosbag1 import Reader

    with library_errors("a bag with an index"), Reader(file) as reader:
        connections = [one for one in reader.connections if one.topic in topics]
        for place in places:
            if not connections:
                return
            found = reader.messages(connections, place.start_ns, place.start_ns + 1)
            for connection, stamp_ns, data in found:
                yield Message(
                    where=f"{file.name} {connection.topic}",
                    topic=connection.topic,
                    type=connection.msgtype.replace("/msg/", "/"),
                    encoding="ros1",
                    log_ns=stamp_ns,
                    publish_ns=stamp_ns,
                    data=data,
                )
