"""Chosen scans of an output, read by their place in it, and thinned for the page."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mlbatch.arrays import BoolArray, F32Array, F64Array, U8Array, U16Array
from mlbatch.outputs.cloud_messages import CLOUD, read_cloud, stored_scan
from mlbatch.outputs.containers import BoundedFile, Message, library_errors
from mlbatch.outputs.damage import CheckLog, DamageError, VerifyError
from mlbatch.outputs.encoding import MessageCursor
from mlbatch.outputs.folders import scan_files
from mlbatch.outputs.kinds import FileFormat, kind_of
from mlbatch.outputs.run_files import mcaps_of
from mlbatch.outputs.stored_scan import StoredScan
from mlbatch.page.windows import Windows
from mlbatch.units import NS_PER_S

# Points of all scans on a page: 9 bytes each, 12 in base64.
MOST_POINTS = 54_000
# Opcode and length.
_RECORD_HEAD_BYTES = 9
_BYTE = 255
_WORD = 65535
# Shares of the points that the range of a colour covers: single bright points are no scale.
_LOW, _HIGH = 0.02, 0.98
# Share of the points of a lidar inside the first view.
_IN_VIEW = 0.97
_SEED = 0


@dataclass(frozen=True, slots=True)
class Place:
    """A window to show."""

    title: str
    row: int  # of the table
    index: int
    slice: int
    start_ns: int


@dataclass(frozen=True, slots=True)
class PageCloud:
    """A scan as the page stores it."""

    place: Place
    total: int  # points of the scan
    low_m: tuple[float, float, float]
    size_m: float  # of the cube that the coordinates divide
    xyz: U16Array  # (p, 3)
    lidar: U8Array
    time: U8Array  # of the window
    intensity: U8Array
    height_m: tuple[float, float]  # range of the colours
    centre_m: tuple[float, float, float]  # of the first view
    view_m: float  # radius around the centre that contains most points of every lidar
    has_lidar: bool
    has_time: bool
    has_intensity: bool


def choose_places(windows: Windows) -> list[Place]:
    """The first, middle and worst window; each once."""
    titles: dict[int, list[str]] = {}
    row = windows.worst()
    is_whole = windows.fill[row].min() >= 1.0
    worst = "fewest points" if is_whole else "worst"
    first = int(windows.has_head and len(windows) > 1)
    chosen = (("first", first), ("middle", len(windows) // 2), (worst, row))
    for title, row in chosen:
        titles.setdefault(row, []).append(title)
    return [
        Place(
            " and ".join(names),
            row,
            int(windows.index[row]),
            int(windows.slice[row]),
            int(windows.start_ns[row]),
        )
        for row, names in titles.items()
    ]


def read_clouds(output: Path, places: list[Place], sensors: tuple[str, ...]) -> list[PageCloud]:
    """The scans of an output at some places. Raises VerifyError if it cannot be read."""
    parts: dict[int, list[StoredScan]] = {}
    try:
        for scan in _scans(output, places, sensors):
            parts.setdefault(scan.start_ns, []).append(scan)
    except DamageError as err:
        raise VerifyError(f"{output}: {err}") from err
    most = MOST_POINTS // max(1, len(places))
    return [
        _thinned(place, parts[place.start_ns], most) for place in places if place.start_ns in parts
    ]


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


# -- points -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Points:
    """Valid points of one stored scan."""

    xyz: F32Array
    lidar: U8Array | None
    time_ns: F64Array | None
    intensity: F64Array | None


def _valid(scan: StoredScan) -> _Points:
    finite: BoolArray = np.isfinite(scan.xyz)
    valid = np.asarray(finite.all(axis=-1))
    count = int(np.count_nonzero(valid))
    lidar: U8Array | None = None
    if scan.sensor is not None:
        lidar = np.full(count, scan.sensor, dtype=np.uint8)
    elif scan.lidar_id is not None:
        # In an organized scan, of the columns.
        ids = scan.lidar_id if scan.lidar_id.ndim == valid.ndim else scan.lidar_id[:, None]
        lidar = np.broadcast_to(ids, valid.shape)[valid]
    bright = scan.intensity if scan.intensity is not None else scan.byte_intensity
    return _Points(
        scan.xyz[valid],
        lidar,
        None if scan.time_ns is None else scan.time_ns[valid].astype(np.float64),
        None if bright is None else bright[valid].astype(np.float64),
    )


def _thinned(place: Place, scans: list[StoredScan], most: int) -> PageCloud:
    """Join the scans of a window and keep at most `most` points, drawn at random."""
    parts = [_valid(scan) for scan in scans]
    xyz: F64Array = np.concatenate([part.xyz for part in parts]).astype(np.float64)
    total = len(xyz)
    kept = np.arange(total)
    if total > most:
        # Every nth point would miss whole channels.
        kept = np.sort(np.random.default_rng(_SEED).choice(total, most, replace=False))
    lidars = [part.lidar for part in parts if part.lidar is not None]
    times = [part.time_ns for part in parts if part.time_ns is not None]
    bright = [part.intensity for part in parts if part.intensity is not None]
    none = np.zeros(total)
    has_lidar = len(lidars) == len(parts)
    has_time = len(times) == len(parts)
    has_intensity = len(bright) == len(parts)
    lidar: U8Array = np.concatenate(lidars) if has_lidar else none.astype(np.uint8)
    time_ns: F64Array = np.concatenate(times) if has_time else none
    intensity: F64Array = np.concatenate(bright) if has_intensity else none
    xyz = xyz[kept]
    low_m: F64Array = xyz.min(axis=0) if len(xyz) else np.zeros(3)
    high_m: F64Array = xyz.max(axis=0) if len(xyz) else np.zeros(3)
    size_m = max(float((high_m - low_m).max()), 1e-3)
    centre_m, view_m = _view(xyz, lidar[kept])
    return PageCloud(
        place=place,
        total=total,
        low_m=(float(low_m[0]), float(low_m[1]), float(low_m[2])),
        size_m=size_m,
        xyz=np.rint((xyz - low_m) / size_m * _WORD).astype(np.uint16),
        lidar=lidar[kept],
        time=_byte(time_ns[kept], 0.0, float(time_ns.max(initial=0.0))),
        intensity=_byte(intensity[kept], *_span(intensity[kept])),
        height_m=_span(xyz[:, 2]),
        centre_m=(float(centre_m[0]), float(centre_m[1]), float(centre_m[2])),
        view_m=view_m,
        has_lidar=has_lidar,
        has_time=has_time,
        has_intensity=has_intensity,
    )


def _view(xyz: F64Array, lidar: U8Array) -> tuple[F64Array, float]:
    """Centre (3,) and radius of a view, m, that has most points of every lidar.

    The centre is the body; where the cloud is farther away than it is large, it is that of the
    cloud.
    """
    parts = [xyz[lidar == number] for number in np.unique(lidar)]
    if not parts:
        return np.zeros(3), 1.0
    boxes = np.array([[_span(part[:, axis]) for axis in range(3)] for part in parts])
    low_m = boxes[:, :, 0].min(axis=0)
    high_m = boxes[:, :, 1].max(axis=0)
    centre_m: F64Array = (low_m + high_m) / 2
    if np.linalg.norm(centre_m) <= np.linalg.norm(high_m - low_m):
        centre_m = np.zeros(3)
    away_m = [np.linalg.norm(part[:, :2] - centre_m[:2], axis=1) for part in parts]
    return centre_m, max(1.0, *(_quantile(away, _IN_VIEW) for away in away_m))


def _quantile(values: F64Array, share: float) -> float:
    """A value of the array by nearest rank; 0 without one."""
    if not len(values):
        return 0.0
    return float(np.sort(values)[int(share * (len(values) - 1))])


def _span(values: F64Array) -> tuple[float, float]:
    return _quantile(values, _LOW), _quantile(values, _HIGH)


def _byte(values: F64Array, low: float, high: float) -> U8Array:
    width = high - low if high > low else 1.0
    return np.rint(np.clip((values - low) / width, 0.0, 1.0) * _BYTE).astype(np.uint8)


def window_ms(windows: Windows, place: Place) -> float:
    """Length of a window, ms."""
    return int(windows.end_ns[place.row] - windows.start_ns[place.row]) / NS_PER_S * 1000.0
