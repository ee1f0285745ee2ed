"""A folder of sweeps as a recording of PointCloud2 messages.

Counts: a file that cannot be read is one frame, `truncated`; a file that can is counted as the
cloud that it becomes.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from mlbatch.errors import RecordingError
from mlbatch.readers.sweeps.files import SweepError, first_ns, read_sweep
from mlbatch.rig.rig import STAMP, RigSensor, Sweeps
from mlbatch.ros.point_times import ABSOLUTE, CONVENTION, UNITS_NS, PointRule
from mlbatch.types import CaptureCounts, Message, PacketBatch, Recording, Topic
from mlbatch.units import NS_PER_MS, NS_PER_S, NS_PER_US

CLOUD_TYPE = "sensor_msgs/PointCloud2"
# Unit of a whole number by its digits: those of times from 2001 to 2286.
_UNITS_NS = {10: NS_PER_S, 13: NS_PER_MS, 16: NS_PER_US, 19: 1}
# Seconds with decimals are exact to the nanosecond.
_SECONDS = re.compile(r"(\d{10})[._](\d{1,9})", re.ASCII)
_WHOLE = re.compile(r"\d+", re.ASCII)
_ISO = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d{1,9})?Z"
_LATEST_NS = 2**31 * NS_PER_S
# A batch ends with the file that exceeds this.
_BATCH_BYTES = 8 << 20
_MOST_NOTES = 100
# Files that are checked before all others are read.
_CHECKED = 8
_NONE = np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True)
class _SweepFile:
    """A file of a sensor; stamp_ns: of its name."""

    stamp_ns: int
    path: Path
    topic: Topic
    sweeps: Sweeps
    size_bytes: int


@dataclass(slots=True)
class SweepRecording(Recording):
    """The sweeps of all sensors of a rig in a folder, in the order of their times."""

    files: tuple[_SweepFile, ...] = ()

    @classmethod
    def of_folder(cls, folder: Path, sensors: Sequence[RigSensor]) -> SweepRecording | None:
        """The sweeps in a folder; None without any, RecordingError for names without a time."""
        found: list[_SweepFile] = []
        topics: list[Topic] = []
        for sensor in sensors:
            rule = sensor.points or CONVENTION
            files = [] if sensor.sweeps is None else _files(folder, sensor.sweeps, rule)
            if files:
                topics.append(files[0].topic)
                found += files
        if not found:
            return None
        found.sort(key=lambda file: file.stamp_ns)
        return cls(
            folder,
            "sweeps",
            sum(file.size_bytes for file in found),
            topics=tuple(topics),
            last_ns=found[-1].stamp_ns,
            files=tuple(found),
        )

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Yield the sweeps of kept topics as messages, in the order of their times."""
        self.counts = CaptureCounts()
        self.notes = []
        self.position_bytes = 0
        messages: list[Message] = []
        size = 0
        for file in self.files:
            self.position_bytes += file.size_bytes
            if file.topic.name not in self.keep:
                continue
            message = self._message(file)
            if message is not None:
                messages.append(message)
                size += len(message.data)
            if size >= _BATCH_BYTES:
                yield _batch(messages)
                messages = []
                size = 0
        if messages:
            yield _batch(messages)

    def _message(self, file: _SweepFile) -> Message | None:
        """The message of a file; None where it cannot be read, which is counted and noted."""
        try:
            data = read_sweep(file.path, file.sweeps, file.stamp_ns)
        except SweepError as err:
            self.counts.frames += 1
            self.counts.skip("truncated")
            if len(self.notes) < _MOST_NOTES:
                self.notes.append(str(err))
            return None
        return Message(file.topic, file.stamp_ns, data)


def _batch(messages: list[Message]) -> PacketBatch:
    return PacketBatch(np.zeros(0, np.uint8), _NONE, _NONE, _NONE, _NONE, tuple(messages))


def _files(folder: Path, sweeps: Sweeps, rule: PointRule) -> list[_SweepFile]:
    """The files of a sensor in the order of their times; RecordingError where these are unclear."""
    topic = Topic(sweeps.glob, CLOUD_TYPE, "ros1")
    found: dict[int, _SweepFile] = {}
    undated: list[Path] = []
    pattern = _name_pattern(sweeps.glob)
    unit_ns = 0
    for path in sorted(folder.glob(sweeps.paths)):
        if not path.is_file():
            continue
        match = pattern.fullmatch(path.relative_to(folder).as_posix())
        stamp_ns, own_unit_ns = _stamp_ns(match["stamp"] if match else "", sweeps.glob)
        is_of_points = rule.origin == ABSOLUTE and rule.unit_ns and "{stamp" not in sweeps.glob
        if not stamp_ns and is_of_points:
            stamp_ns, own_unit_ns = first_ns(path, sweeps, rule), 1
            if not stamp_ns:
                undated.append(path)
                continue
        if not 0 < stamp_ns < _LATEST_NS:
            raise RecordingError(
                f"{path}: expected the time of the sweep as its name (10 digits of s since 1970, "
                "13 of ms, 16 of us, 19 of ns, or s with decimals), found "
                f"{(match['stamp'] if match else path.name)!r}; rename the files by the dataset's "
                f"list of times, correct the pattern {sweeps.glob} ({sweeps.place}), or "
                "give `unit` of points with from: absolute"
            )
        if unit_ns not in (0, own_unit_ns):
            raise RecordingError(
                f"{path}: expected a time with the digits of {next(iter(found.values())).path.name}"
                f", found another unit; correct the pattern {sweeps.glob} ({sweeps.place})"
            )
        unit_ns = own_unit_ns
        other = found.get(stamp_ns)
        if other is not None:
            raise RecordingError(
                f"{path}: expected each time once, found that of {other.path} again; give each "
                f"lidar a sensor with a pattern of its own ({sweeps.place})"
            )
        found[stamp_ns] = _SweepFile(stamp_ns, path, topic, sweeps, path.stat().st_size)
    # What cannot be read, and files without points, are counted when their turn comes.
    begin_ns = min(found, default=len(undated) + 1)
    for stamp_ns, path in enumerate(undated, begin_ns - len(undated)):
        found[stamp_ns] = _SweepFile(stamp_ns, path, topic, sweeps, path.stat().st_size)
    files = sorted(found.values(), key=lambda file: file.stamp_ns)
    _check_first(files)
    return files


def _check_first(files: Sequence[_SweepFile]) -> None:
    """Refuse a description that less than half of the first files fit."""
    checked = files[:_CHECKED]
    faults = [fault for file in checked if (fault := _fault(file))]
    if len(faults) * 2 > len(checked):
        raise RecordingError(
            f"{faults[0]} ({len(faults)} of the first {len(checked)} files, "
            f"{checked[0].sweeps.place})"
        )


def _fault(file: _SweepFile) -> str:
    """Why a file cannot be read, or ""."""
    try:
        read_sweep(file.path, file.sweeps, file.stamp_ns)
    except SweepError as err:
        return str(err)
    return ""


def _name_pattern(glob: str) -> re.Pattern[str]:
    """Names of files that a pattern describes, with the time as a group: without one, the stem."""
    if "{stamp" not in glob:
        return re.compile(r"(?:.*/)?(?P<stamp>[^/]*?)(?:\.[^./]*)?", re.DOTALL)
    words = {"**/": "(?:.*/)?", "*": "[^/]*?", "?": "[^/]"}
    parts = []
    for part in re.split(r"(\{stamp[^}]*\}|\*\*/|\*|\?|\[[^]]*\])", glob):
        if part.startswith("{"):
            parts.append(rf"(?<!\d)(?P<stamp>{_ISO}|\d{{10}}[._]\d{{1,9}}|\d+)")
        elif part.startswith("["):
            parts.append(part.replace("[!", "[^"))
        else:
            parts.append(words.get(part, re.escape(part)))
    return re.compile("".join(parts), re.DOTALL)


def _stamp_ns(text: str, glob: str) -> tuple[int, int]:
    """The time of a name, and the unit of its digits, ns; 0 where it is none."""
    given = STAMP.search(glob)
    unit = given[1] if given else None
    if unit == "iso" and re.fullmatch(_ISO, text):
        whole_s = round(datetime.fromisoformat(f"{text[:19]}+00:00").timestamp())
        text, unit = f"{whole_s}.{text[20:-1] or 0}", "s"
    seconds = _SECONDS.fullmatch(text)
    if seconds and unit in ("s", None):
        whole, decimals = seconds.groups()
        return int(whole) * NS_PER_S + int(decimals.ljust(9, "0")), NS_PER_S
    if not _WHOLE.fullmatch(text):
        return 0, 0
    unit_ns = UNITS_NS.get(unit, 0) if unit else _UNITS_NS.get(len(text), 0)
    return int(text) * unit_ns, unit_ns
