"""The files of an output: each is whole or absent, and is made by one run.

A file here is what can be made without the others: that of a scan (some formats: two), one file of
a bag (`--max-bag-duration`), or one of so many windows (webdataset). A run reads and batches
everything, since scans depend on packets only and this is the fast part; it decodes and writes the
files that are due: of its shard (`--shard`), and not finished by an interrupted run (`--resume`).
An output in one file is made from the start.

`files.jsonl` in the folder under construction names the job, then each file once it is whole: its
checksums, and what the report needs of its scans. A line has a checksum and depends on no other.
What it says counts if the file has those bytes; a file without a valid line, or with other bytes,
is made again. Nothing else is needed after a kill, a full disk or a power cut.
"""

from __future__ import annotations

import io
import json
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, TypeVar

import numpy as np
from isal.isal_zlib import crc32

from mlbatch.bounded import MOST_TABLE_BYTES, parse_json, read_text
from mlbatch.errors import ExportError, UsageError
from mlbatch.outputs.table import read_table
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.job_identity import difference, input_identity, job_identity
from mlbatch.reports.json_records import from_json, to_json
from mlbatch.reports.ledger import POINT_COUNTERS
from mlbatch.types import ImuSamples, Message, Scan
from mlbatch.writers import has_several_files, plugin
from mlbatch.writers.atomic import (
    FILES_JSONL,
    METADATA,
    SCANS_CSV,
    discard,
    export_errors,
    locked,
    partial_path,
)
from mlbatch.writers.base import WriterOptions, windows_per_file
from mlbatch.writers.formats import file_suffixes, windows_of_format
from mlbatch.writers.output_file import file_crc, write_all
from mlbatch.writers.scan_folder import name_of_windows, scan_name

if TYPE_CHECKING:
    from mlbatch.pipeline.conversion import Conversion
    from mlbatch.pipeline.decode_pool import DecodeTask, Outcomes

SCHEMA = "mlbatch.files/1"
_MOST_HEAD_BYTES = 1 << 20
Record = TypeVar("Record", bound=NamedTuple)
# Number of a file, and with `--split` the index of its sensor.
Unit: TypeAlias = tuple[int, int | None]


class FinishedScan(NamedTuple):
    """A scan in a file that is whole.

    window: its index; sensor: with `--split`; content: checksum of what was read for it and before
    it, see `Files.take`; checksum: see `ScanJob`; outcomes: slots by outcome, one list per sensor,
    see `ledger.POINT_COUNTERS`.
    """

    window: int
    slice: int
    sensor: int | None
    content: int
    checksum: int | None
    outcomes: list[list[int]]


class FileRecord(NamedTuple):
    """A line of `files.jsonl`; crcs: CRC-32 by name in the folder."""

    unit: Unit
    crcs: dict[str, int]
    scans: list[FinishedScan]


class Head(NamedTuple):
    """The first line: the job, and its segment of the session as text."""

    schema: str
    identity: dict[str, str]
    segment: str


# By window, slice and sensor.
Scans: TypeAlias = Mapping[tuple[int, int, int | None], FinishedScan]


# -- files.jsonl ------------------------------------------------------------------------------


def records(path: Path) -> Iterator[tuple[int, FileRecord]]:
    """Yield the valid lines after the first, each with its position in bytes."""
    with path.open("rb") as file:
        position = len(file.readline())
        for line in file:
            record = _parsed(FileRecord, line)
            if record is not None:
                yield position, record
            position += len(line)


def _line(record: NamedTuple) -> bytes:
    text = json.dumps(to_json(record), separators=(",", ":")).encode()
    return b"%08x %b\n" % (crc32(text, 0), text)


def _parsed(kind: type[Record], line: bytes) -> Record | None:
    """The record in a line; None if that is cut off or damaged."""
    crc, _, text = line[:-1].partition(b" ")
    if not line.endswith(b"\n") or crc != b"%08x" % crc32(text, 0):
        return None
    try:
        found: Record = from_json(kind, parse_json(text))
    except ValueError:
        return None
    return found


class EarlierRun:
    """The files that an interrupted run has finished.

    scans: in them; names: of all; changed: a line for each file that is another one now.
    """

    def __init__(self, folder: Path, head: Head) -> None:
        self.head = head
        self.scans = 0
        self.names: set[str] = set()
        self.changed: list[str] = []
        self._folder = folder
        self._positions: dict[Unit, int] = {}
        self._whole: set[Unit] = set()
        self._last: tuple[Unit, Scans] | None = None
        for position, record in records(folder / FILES_JSONL):
            # A file that was made again has two lines.
            self.scans += 0 if record.unit in self._positions else len(record.scans)
            self._positions[record.unit] = position
            self.names.update(record.crcs)

    @property
    def unused(self) -> int:
        """Number of files that the run did not ask for."""
        return len(self._positions) - len(self._whole)

    def finished(self, unit: Unit) -> Scans | None:
        """The scans in a file; None if it is not whole. Any thread."""
        last = self._last
        if last is not None and last[0] == unit:
            return last[1]
        position = self._positions.get(unit)
        if position is None:
            return None
        path = self._folder / FILES_JSONL
        with export_errors(path), path.open("rb") as file:
            file.seek(position)
            record = _parsed(FileRecord, file.readline())
        if record is None:
            return None
        if unit not in self._whole and (change := self._change(record)):
            # Once, also where two threads ask.
            if self._positions.pop(unit, None) is not None:
                self.changed.append(change)
                self.scans -= len(record.scans)
            return None
        self._whole.add(unit)
        scans = {one[:3]: one for one in record.scans}
        self._last = unit, scans
        return scans

    def _change(self, record: FileRecord) -> str:
        """How a file differs from its line, "" if it is whole."""
        for name, crc in record.crcs.items():
            path = self._folder / name
            try:
                found = "" if file_crc(path) == crc else "others"
            except OSError as err:
                found = repr(err.strerror)
            if found:
                return (
                    f"{path}: expected the bytes that the interrupted run has written, found "
                    f"{found}; made again"
                )
        return ""


def find(target: Path) -> EarlierRun | None:
    """Find the files that an interrupted run finished; ExportError while another run writes."""
    folder = partial_path(target)
    path = folder / FILES_JSONL
    if not path.is_file():
        return None
    with export_errors(path), locked(target, path) as file:
        file.seek(0)
        head = _parsed(Head, file.readline(_MOST_HEAD_BYTES))
        earlier = None if head is None or head.schema != SCHEMA else EarlierRun(folder, head)
    return earlier if earlier is not None and earlier.names else None


def missing(target: Path, job: Job, name: str, options: WriterOptions) -> list[str]:
    """Files that a complete output should have and has not, sorted; name: of the format.

    Those of a shard are in its `files.jsonl`, those of a bag in its metadata.yaml; scans.csv has a
    row for each scan. Raises RecordingError for a damaged table or list.
    """
    if plugin(name).SUFFIX is not None:
        return []
    present = {path.relative_to(target).as_posix() for path in target.rglob("*")}
    if job.shard is not None:
        expected = {SCANS_CSV, FILES_JSONL}
        if FILES_JSONL in present:
            expected |= {one for _, found in records(target / FILES_JSONL) for one in found.crcs}
    elif has_several_files(name, options) and not job.max_bag_s:
        expected = {SCANS_CSV, *_files_of_scans(target, job, name)}
    else:
        expected = {SCANS_CSV, METADATA}
        if METADATA in present:
            from mlbatch.outputs.rosbag2 import listed_files

            expected |= set(listed_files(target))
    return sorted(expected - present)


def _files_of_scans(folder: Path, job: Job, name: str) -> Iterator[str]:
    """The files of the scans in scans.csv, none without one."""
    path = folder / SCANS_CSV
    if not path.is_file():
        return
    with export_errors(path):
        rows = read_table(read_text(path, MOST_TABLE_BYTES), str(path))
    prefix = "columns_"
    windows = windows_of_format(name)
    sensors = [one.removeprefix(prefix) for one in rows.dtype.names or () if one.startswith(prefix)]
    for row in rows:
        if windows:
            stem = name_of_windows(int(row["index"]), windows)
        else:
            stem = scan_name(int(row["index"]), int(row["slice"]), job.slices)
        # A sensor without a column in a window has no file of it.
        folders = [f"{one}/" for one in sensors if row[prefix + one]] if job.split else [""]
        for suffix in file_suffixes(name) or (name,):
            yield from (f"{one}{stem}.{suffix}" for one in folders)


# -- the run ----------------------------------------------------------------------------------


class Files:
    """The files of one output; see `writers.FileSet`.

    identity: of the job and, once it runs, of its inputs; run: that makes them, once it has begun;
    scans: those in files that are whole; total: those of the run so far, of all shards; content:
    checksum of what was read for them.
    """

    def __init__(
        self, target: Path, job: Job, name: str, options: WriterOptions, earlier: EarlierRun | None
    ) -> None:
        """name: of the format; earlier: the run to continue, None: start over."""
        self.identity = job_identity(job, name, options)
        self.total = 0
        self.content = 0
        # In a file; 0: each scan has files of its own.
        self.windows = windows_of_format(name)
        self._segment = str(job.segment)
        self._job = job
        self._target = target
        self._has_several = has_several_files(name, options)
        if earlier is not None and earlier.head.segment != self._segment:
            # The end of the segment was not known then: its last scans may be other ones now.
            earlier = None
        self._earlier = earlier if self._has_several else None
        self.scans = 0 if self._earlier is None else self._earlier.scans
        self.run: Conversion | None = None
        self._journal: io.FileIO | None = None
        # Digests of the input of scans that are not yet in the journal, in order; then the scans of
        # files that are not whole.
        self._contents: deque[int] = deque()
        self._unfinished: dict[Unit, list[FinishedScan]] = {}

    @property
    def is_continued(self) -> bool:
        """Whether an interrupted run has finished some."""
        return self._earlier is not None

    @property
    def is_journaled(self) -> bool:
        """Whether what is made is noted for other runs."""
        return self._journal is not None

    @property
    def is_shard(self) -> bool:
        """Whether other files of the output are made by other shards."""
        return self._job.shard is not None

    @property
    def is_resumable(self) -> bool:
        """Whether another run can continue."""
        return self.scans > 0 and partial_path(self._target).exists()

    @property
    def changed(self) -> Sequence[str]:
        """A line for each file of the interrupted run that is made again."""
        return () if self._earlier is None else self._earlier.changed

    def join(self, run: Conversion) -> None:
        """Know the run that makes them; UsageError if it is another job than the interrupted."""
        self.run = run
        self.identity |= input_identity(run)
        if not self._has_several:
            return
        if self._job.max_bag_s:
            self.windows = windows_per_file(self._job.max_bag_s, run.grid.rate)
        for sensor in run.sensors:
            sensor.source.ring.keep_sums()
        if self._earlier is None:
            return
        changed = difference(self._earlier.head.identity, self.identity)
        if changed:
            raise UsageError(
                f"{partial_path(self._target)}: expected the job of the interrupted run, found "
                f"{changed}; give the same, or leave out --resume to start over"
            )

    def begin(self) -> None:
        """Open the journal in the folder that the writer has locked."""
        folder = partial_path(self._target)
        path = folder / FILES_JSONL
        head = _line(Head(SCHEMA, self.identity, self._segment))
        with export_errors(path):
            self._journal = path.open("r+b", buffering=0)
            if self._earlier is None:
                self._journal.write(head)
                return
            if self._journal.read(len(head)) != head:
                raise ExportError(
                    f"{self._target}: expected the interrupted run that was found, found that of "
                    "another job; give the same command again"
                )
            # A kill may have cut off the last line.
            self._journal.seek(-1, io.SEEK_END)
            if self._journal.read(1) != b"\n":
                self._journal.write(b"\n")
            # Begun files may be of scans that are others now.
            for one in sorted(folder.rglob("*")):
                name = one.relative_to(folder).as_posix()
                if one.is_file() and name not in self._earlier.names and one != path:
                    one.unlink()

    def take(
        self, before: Sequence[ImuSamples | Message], task: DecodeTask | None
    ) -> FinishedScan | None:
        """Count what is written next; returns the scan if it is not to be made here.

        before: what is forwarded before the scan; task: of the scan, None without one. UsageError
        if the interrupted run has made the scan from something else.
        """
        if self.run is None or not self.is_journaled:
            return None
        for item in before:
            self.content = _forwarded_content(item, self.content)
        if task is None:
            return None
        self.content = self.run.pool.content(task, self.content)
        self.total += 1
        place = (task.window.index, task.window.slice, task.only)
        if self.is_due(*place):
            self._contents.append(self.content)
            return None
        # Of a scan of another shard nothing is known.
        nothing = [[0] * len(POINT_COUNTERS) for _ in self.run.sensors]
        scan = FinishedScan(*place, self.content, None, nothing)
        if self._is_own(*place[:2]) and self._earlier is not None:
            kept = (self._earlier.finished(self._unit(*place)) or {}).get(place)
            if kept is None or kept.content != self.content:
                raise UsageError(
                    f"{partial_path(self._target)}: expected the packets of the interrupted run, "
                    f"found others for a finished scan, that of window {place[0]}: a recording was "
                    "changed; restore it, or leave out --resume to start over"
                )
            scan = kept
        task.outcomes = scan.outcomes
        return scan

    def note(
        self, scan: Scan, sensor: int | None, outcomes: Outcomes, checksum: int | None
    ) -> None:
        """Note a scan that was made; call in order, before the writer commits it."""
        if not self.is_journaled:
            return
        unit = self._unit(scan.index, scan.slice, sensor)
        counts = [list(one) for one in outcomes]
        content = self._contents.popleft()
        self._unfinished.setdefault(unit, []).append(
            FinishedScan(scan.index, scan.slice, sensor, content, checksum, counts)
        )

    def is_listed(self, scan: Scan) -> bool:
        """Whether a scan is in a file of this output, and not of another shard."""
        return self._is_own(scan.index, scan.slice)

    def complete(self) -> None:
        """Raise UsageError if the interrupted run finished files that this run does not make."""
        if self._earlier is not None and self._earlier.unused:
            raise UsageError(
                f"{partial_path(self._target)}: expected the files of the interrupted run again, "
                f"found {self._earlier.unused} more; leave out --resume to start over"
            )

    def discard(self) -> None:
        """Remove the output under construction: without a scan there is nothing to resume."""
        self.close()
        discard(self._target)

    def close(self) -> None:
        """Close the journal."""
        if self._journal is not None:
            self._journal.close()

    # -- for the writer -----------------------------------------------------------------------

    def is_due(self, index: int, slice_: int = 0, sensor: int | None = None) -> bool:
        """Whether this run is to make a file."""
        if not self._is_own(index, slice_):
            return False
        unit = self._unit(index, slice_, sensor)
        return self._earlier is None or self._earlier.finished(unit) is None

    def made(
        self, crcs: Mapping[str, int], index: int, slice_: int = 0, sensor: int | None = None
    ) -> None:
        """Note a file that is whole; crcs: CRC-32 by name."""
        if self._journal is None:
            return
        unit = self._unit(index, slice_, sensor)
        scans = self._unfinished.pop(unit, [])
        path = partial_path(self._target) / FILES_JSONL
        with export_errors(path):
            write_all(self._journal, [_line(FileRecord(unit, dict(crcs), scans))])
        self.scans += len(scans)

    # -- places -------------------------------------------------------------------------------

    def _number(self, index: int, slice_: int) -> int:
        """Number of the file of a scan; the head is in the first file of several windows.

        It depends on time alone: not on how packets are read.
        """
        if self.windows:
            return max(index, 0) // self.windows
        return index * self._job.slices + slice_

    def _unit(self, index: int, slice_: int, sensor: int | None) -> Unit:
        # A bag has all sensors in one file.
        return self._number(index, slice_), None if self._job.max_bag_s else sensor

    def _is_own(self, index: int, slice_: int) -> bool:
        shard = self._job.shard
        return shard is None or shard.has(self._number(index, slice_))


def _forwarded_content(item: ImuSamples | Message, before: int) -> int:
    """Checksum of what is forwarded, and of what precedes it."""
    if isinstance(item, Message):
        return crc32(item.data, crc32(f"{item.topic.name} {item.host_ns} ".encode(), before))
    for values in (item.stamp_ns, item.acceleration, item.angular_velocity):
        before = crc32(np.ascontiguousarray(values).tobytes(), before)
    return crc32(bytes([item.sensor & 0xFF]), before)
