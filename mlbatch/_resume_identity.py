"""What an output is made of and how: only the same job may continue it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np

import mlbatch
from mlbatch.job import Job
from mlbatch.pipeline import Conversion
from mlbatch.writers import WriterOptions

# Said by the files themselves, by the sensors, or not by options; or outputs do not depend on it.
_ELSEWHERE = frozenset(
    {"recordings", "wishes", "part", "extras", "fault_begin_ns", "jobs", "engine"}
)
_DIGITS = 12


def of_job(job: Job, name: str, options: WriterOptions) -> dict[str, str]:
    """Label and text of what a job says; name: of the format."""
    found = {"mlbatch": mlbatch.__version__, "numpy": np.__version__, "format": name}
    found["point layout"] = options.point_layout
    found["compression"] = options.compression
    for key, value in _options(job):
        found[key.replace("_", " ")] = _text(value)
    return found


def of_inputs(run: Conversion) -> dict[str, str]:
    """What the recordings are, and digests of what points are made with."""
    found = {}
    for number, path in enumerate(run.job.recordings):
        found[f"recording {number + 1}"] = f"{path.name} ({_size_and_time(path)})"
    for sensor in run.setup.sensors:
        lidar = sensor.found.lidar
        what = (lidar.model, lidar.mode, lidar.beams, lidar.firing_ns, lidar.channel)
        found[f"calibration of {sensor.name}"] = _digest(what)
        found[f"pose of {sensor.name}"] = _digest((sensor.body_from_sensor, sensor.offset_ns))
    found["rig"] = _digest(run.setup.rig)
    found["sensors"] = ", ".join(sensor.name for sensor in run.setup.sensors)
    return found


def difference(old: Mapping[str, str], new: Mapping[str, str]) -> str:
    """What differs, in words; "" if nothing does."""
    for key in (*old, *new):
        before, now = old.get(key, "none"), new.get(key, "none")
        if before != now:
            return f"{key} {now or 'not given'!r} instead of {before or 'not given'!r}"
    return ""


def _options(job: Job) -> Iterator[tuple[str, object]]:
    for holder in (job, job.wishes):
        for field in fields(holder):
            if field.name not in _ELSEWHERE:
                yield field.name, getattr(holder, field.name)


def _text(value: object) -> str:
    """A value as a user would know it again, the same in every process."""
    if value is None or value == () or value == {}:
        return ""
    if isinstance(value, Mapping):
        return ", ".join(f"{key}={_text(value[key])}" for key in sorted(value))
    if isinstance(value, tuple):
        return ", ".join(map(_text, value))
    return str(value)


def _size_and_time(path: Path) -> str:
    """Bytes and time of the last change of a recording, or of all files of its folder."""
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    stats = [file.stat() for file in files]
    size = sum(one.st_size for one in stats)
    return f"{size} bytes, changed at {max((one.st_mtime_ns for one in stats), default=0)} ns"


def _digest(value: object) -> str:
    import hashlib

    digest = hashlib.sha256()
    for piece in _pieces(value):
        digest.update(piece)
    return digest.hexdigest()[:_DIGITS]


def _pieces(value: object) -> Iterator[bytes]:
    """All of a value as bytes that do not depend on the process."""
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield field.name.encode()
            yield from _pieces(getattr(value, field.name))
    elif isinstance(value, Mapping):
        for key in sorted(value, key=str):
            yield str(key).encode()
            yield from _pieces(value[key])
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _pieces(item)
    else:
        yield f"{value!r};".encode()
