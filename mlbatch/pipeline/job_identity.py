"""The identity of a job: options, versions and the content of its inputs, as texts.

An interrupted run is resumed only by a job of the same identity. The content of recordings is
sampled here, since they may have many gigabytes; `Files.take` compares what is read of them.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import mlbatch
from mlbatch.bounded import open_file, parse_json, read_bytes, read_text
from mlbatch.errors import RecordingError
from mlbatch.pipeline.job import Job
from mlbatch.writers.base import WriterOptions

if TYPE_CHECKING:
    from mlbatch.pipeline.conversion import Conversion
    from mlbatch.pipeline.sensor import Sensor

# Fields of a job that are not part of its identity: digests of files and sensors replace them, or
# the output does not depend on them.
_NOT_IDENTITY = frozenset(
    {"recordings", "selection", "segment", "extras", "record", "fault_begin_ns", "jobs"}
)
# Fields of a `Lidar` that decoding uses, apart from `beams`.
_CALIBRATED = (
    "model",
    "mode",
    "serial",
    "channels",
    "returns",
    "return_types",
    "typed_by",
    "packet_size",
    "columns_per_packet",
    "records",
    "pixels",
    "channel",
    "firing_ns",
    "beams",
    "timestamp_mode",
)
_DIGITS = 12
# A complete output of another version stays one.
_VERSIONS = frozenset({"mlbatch", "numpy"})
# In `_size_and_time`.
_TIME_OF_CHANGE = re.compile(r", changed at -?\d+ ns")

# A file of a recording is sampled at its start, at its end and at blocks between, at equal
# distances; small ones are read as a whole. A session has so many blocks, for any size.
_WHOLE_BYTES = 1 << 20
_END_BYTES = 1 << 16
_BLOCK_BYTES = 1 << 14
_BLOCKS = 64


def job_identity(job: Job, name: str, options: WriterOptions) -> dict[str, str]:
    """Options of a job by name, as texts; name: of the format."""
    found = {"mlbatch": mlbatch.__version__, "numpy": np.__version__, "format": name}
    found["point layout"] = options.point_layout
    found["compression"] = options.compression
    if name == "ply":
        found["ply style"] = options.ply_style
    for holder in (job, job.selection):
        for one in fields(holder):
            if one.name not in _NOT_IDENTITY:
                found[one.name.replace("_", " ")] = _text(getattr(holder, one.name))
    return found


def input_identity(run: Conversion) -> dict[str, str]:
    """Sizes, times and samples of the recordings, digests of calibrations and poses."""
    found = {}
    recordings = [files_of(path) for path in run.job.recordings]
    total = sum(file.stat().st_size for files in recordings for file in files)
    for number, (path, files) in enumerate(zip(run.job.recordings, recordings, strict=True), 1):
        size_and_time = _size_and_time(files)
        content = content_of(files, total)
        found[f"recording {number}"] = f"{path.name} ({size_and_time}, content {content})"
    for path in run.job.selection.metadata:
        found[f"metadata {path.name}"] = whole_content(path)
    if run.job.deskew and Path(run.job.deskew).is_file():
        found["trajectory"] = whole_content(Path(run.job.deskew))
    for sensor in run.sensors:
        found[f"calibration of {sensor.name}"] = _calibration(sensor)
        pose = (sensor.body_from_sensor, sensor.clock.offset_ns)
        found[f"pose of {sensor.name}"] = _digest(pose)
    found["rig"] = _digest(run.session.setup.rig)
    found["sensors"] = ", ".join(sensor.name for sensor in run.sensors)
    return found


def identity_of_parts(identity: Mapping[str, str]) -> dict[str, str]:
    """The identity that all shards of a conversion share; it is kept in the report.

    Recordings may be copies, which have other times.
    """
    return {key: _TIME_OF_CHANGE.sub("", text) for key, text in identity.items() if key != "shard"}


def identity_of(job: Job, name: str, options: WriterOptions) -> dict[str, str]:
    """Identity of the output that a job would make; reads the first seconds of its recordings."""
    from mlbatch.pipeline.conversion import Conversion

    return identity_of_parts(job_identity(job, name, options) | input_identity(Conversion(job)))


def read_identity(path: Path) -> dict[str, str]:
    """Identity in the report or shard.json of an output; empty where it has none."""
    try:
        content = parse_json(read_text(path))
    except (OSError, ValueError):
        return {}
    identity = content.get("identity") if isinstance(content, dict) else None
    if not isinstance(identity, dict):
        return {}
    shard = content.get("shard")
    if isinstance(shard, dict):
        identity |= {"shard": f"{shard.get('number')}/{shard.get('count')}"}
    return {str(key): str(text) for key, text in identity.items()}


def difference_of_outputs(old: Mapping[str, str], new: Mapping[str, str]) -> str:
    """Return `difference`, but ignore the versions that made the outputs."""
    first, second = (
        {key: text for key, text in one.items() if key not in _VERSIONS} for one in (old, new)
    )
    return difference(first, second)


def difference(old: Mapping[str, str], new: Mapping[str, str]) -> str:
    """First difference between two identities, as text; "" if they are equal."""
    for key in (*old, *new):
        before = old.get(key, "none")
        now = new.get(key, "none")
        if before != now:
            return f"{key} {now or 'not given'!r} instead of {before or 'not given'!r}"
    return ""


def _text(value: object) -> str:
    """A value as a user would write it, the same in every process."""
    if value is None or value == () or value == {}:
        return ""
    if isinstance(value, Mapping):
        return ", ".join(f"{key}={_text(value[key])}" for key in sorted(value))
    if isinstance(value, tuple):
        return ", ".join(map(_text, value))
    return str(value)


# -- files ------------------------------------------------------------------------------------


def files_of(path: Path) -> list[Path]:
    """A recording, or all files of its folder."""
    return sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]


def _size_and_time(files: Sequence[Path]) -> str:
    """Size and last modification of files."""
    stats = [file.stat() for file in files]
    size = sum(one.st_size for one in stats)
    return f"{size} bytes, changed at {max((one.st_mtime_ns for one in stats), default=0)} ns"


def content_of(files: Sequence[Path], session_bytes: int = 0) -> str:
    """Digest of samples of files; session_bytes: of all files that share the samples."""
    digest = hashlib.sha256()
    for file in files:
        for sample in _samples(file, session_bytes):
            digest.update(sample)
    return digest.hexdigest()[:_DIGITS]


def whole_content(file: Path) -> str:
    """Digest of a file that is read as a whole anyway: any byte of it may change points."""
    try:
        return hashlib.sha256(read_bytes(file)).hexdigest()[:_DIGITS]
    except OSError as err:
        raise _unreadable(file, err) from err


def _unreadable(file: Path, err: OSError) -> RecordingError:
    return RecordingError(
        f"{file}: expected an input, could not read it ({err.strerror}); check the disk"
    )


def _samples(file: Path, session_bytes: int) -> Iterator[bytes]:
    """Samples of the content of a file."""
    try:
        with open_file(file) as opened:
            descriptor = opened.fileno()
            size = os.fstat(descriptor).st_size
            for begin, count in _sampled(size, session_bytes):
                yield os.pread(descriptor, count, begin)
    except OSError as err:
        raise _unreadable(file, err) from err


def _sampled(size: int, session_bytes: int) -> Iterator[tuple[int, int]]:
    """Begin and length of the samples of a file of `size` bytes."""
    if size <= _WHOLE_BYTES:
        yield 0, size
        return
    yield 0, _END_BYTES
    blocks = -(-_BLOCKS * size // max(size, session_bytes))
    for number in range(blocks):
        yield (2 * number + 1) * size // (2 * blocks), _BLOCK_BYTES
    yield size - _END_BYTES, _END_BYTES


# -- values -----------------------------------------------------------------------------------


def _calibration(sensor: Sensor) -> str:
    """Digest of a sensor's calibration: its file, if there is one, and what is made of it."""
    lidar = sensor.lidar
    path = Path(lidar.calibration)
    content = whole_content(path) if path.is_file() else ""
    # Copies in other folders are the same calibration.
    name = path.name if content else lidar.calibration
    return _digest((content, name, *(getattr(lidar, one) for one in _CALIBRATED)))


def _digest(value: object) -> str:
    digest = hashlib.sha256()
    for piece in _pieces(value):
        digest.update(piece)
    return digest.hexdigest()[:_DIGITS]


def _pieces(value: object) -> Iterator[bytes]:
    """A value as bytes that are the same in every process."""
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif is_dataclass(value) and not isinstance(value, type):
        for one in fields(value):
            yield one.name.encode()
            yield from _pieces(getattr(value, one.name))
    elif isinstance(value, Path):
        # The content of calibrations is part of the identity of their sensors.
        yield value.name.encode("utf-8", "surrogateescape")
    elif isinstance(value, Mapping):
        for key in sorted(value, key=str):
            yield str(key).encode()
            yield from _pieces(value[key])
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _pieces(item)
    else:
        yield f"{value!r};".encode()
