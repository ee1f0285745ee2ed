"""The scans of an output, whatever its format: one after another, or each alone (`open_scans`).

Anything that the readers of a format report as damaged is an error here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.batching.grid import Grid
from mlbatch.errors import RecordingError, UsageError
from mlbatch.outputs.cloud_messages import CLOUD, read_cloud, stored_scan
from mlbatch.outputs.containers import Message, MessagePlace
from mlbatch.outputs.damage import CheckLog, DamageError
from mlbatch.outputs.encoding import MessageCursor
from mlbatch.outputs.folders import ScanFile, ScanReader
from mlbatch.outputs.kinds import FileFormat, Kind, format_of, kind_of
from mlbatch.outputs.metadata import RunMetadata, metadata_of_grid
from mlbatch.outputs.run_files import PIECES, RunFiles, inner_texts
from mlbatch.outputs.scan import Scan
from mlbatch.outputs.stored_scan import StoredScan
from mlbatch.outputs.table import UNKNOWN, ScanRow, TableOfRun, read_table
from mlbatch.reports.report import RunReport, report_of
from mlbatch.types import RunInfo, SensorInfo
from mlbatch.units import NS_PER_S, parse_rate

if TYPE_CHECKING:
    from mlbatch.outputs.mcap_file import McapFile
    from mlbatch.outputs.rosbag1 import BagFile

Array: TypeAlias = npt.NDArray[Any]
_PARTIAL = ".partial"
_COLUMN_ARRAYS = ("column", "column_stamp_ns", "column_lidar_id")
# Arrays of points, and their types.
_KINDS = {
    "intensity": "<f4",
    "reflectivity": "<u2",
    "range_m": "<f4",
    "time_ns": "<u4",
    "ring": "<u2",
    "return_type": "u1",
    "lidar_id": "u1",
}


def read(path: Path, *, by_window: bool = False) -> Iterator[Scan]:
    """Yield the scans of an output in its order, with `--split` those of each sensor.

    path: a .mcap or .bag file, a folder (files of scans, ROS 2 bag), or one file of a scan;
    by_window: by time also where sensors have folders. Raises RecordingError where the output is
    damaged, unfinished or of another program.
    """
    _refuse_partial(path)
    return _read(path, kind_of(path), by_window=by_window)


def _read(path: Path, kind: Kind, *, by_window: bool) -> Iterator[Scan]:
    log = CheckLog()
    if kind.name in ("mcap", "rosbag1", "rosbag2"):
        scans: MessageScans | None = None
        for file, source in _message_files(log, path, kind.name):
            scans = scans or MessageScans(path, _run_of_file(log, path, file, source))
            yield from _scans_of_messages(log, file, scans, source.messages())
    elif kind.form is not None:
        files = kind.form.files(log, path)
        if by_window:
            files.sort(key=lambda file: (file.index, file.slice or 0))
        yield from _scans_of_files(path, kind.form, files, log)
    else:
        yield from _scans_of_file(path, kind.found)


def _refuse_partial(path: Path) -> None:
    if path.name.endswith(_PARTIAL):
        raise RecordingError(
            f"{path}: expected a finished output, found that of an unfinished run; convert again, "
            "or continue it with --resume"
        )


def _refuse_damage(log: CheckLog, path: Path) -> None:
    """Raise RecordingError for what a reader of a format has found."""
    for violation in log.violations:
        raise RecordingError(
            f"{path}: {violation.where}: expected {violation.expected}, found {violation.found}; "
            "see `mlbatch verify`, and convert again"
        )


# -- messages -------------------------------------------------------------------------------------


def _message_files(
    log: CheckLog, output: Path, kind: str
) -> Iterator[tuple[Path, McapFile | BagFile]]:
    """Open the files of an output with messages, one after another."""
    if kind == "rosbag1":
        from mlbatch.outputs.rosbag1 import BagFile

        yield output, BagFile(log, output, output.name)
        return
    from mlbatch.outputs.mcap_file import McapFile

    names = {output: output.name}
    if kind == "rosbag2":
        from mlbatch.outputs.rosbag2 import open_bag

        bag, _ = open_bag(log, output)
        names = {file: f"{output.name}/{file.name}" for file in bag}
    _refuse_damage(log, output)
    for path, where in names.items():
        yield path, McapFile(log, path, where)


def _run_of_file(
    log: CheckLog, output: Path, path: Path, file: McapFile | BagFile, report: Path | None = None
) -> _Run:
    """The constants of a run by its first file; report: as of `open_scans`."""
    from mlbatch.outputs.rosbag1 import BagFile

    if isinstance(file, BagFile):
        files = RunFiles.of(path, report)
        return _Run(str(path), RunMetadata(), files.report_text(), files.table_text())
    return _run_of_mcap(log, output, path, file)


def _run_of_mcap(log: CheckLog, output: Path, path: Path, file: McapFile) -> _Run:
    """The constants of a run in its first file; report and table may be in the folder."""
    grid = file.metadata.get("mlbatch.grid")
    if grid is None:
        raise RecordingError(
            f"{path}: expected an MCAP file of mlbatch, with a metadata record mlbatch.grid, found "
            "another; name the output of `mlbatch convert`"
        )
    if PIECES in grid and not output.is_dir():
        raise RecordingError(
            f"{path}: expected a whole output, found one of the files of a bag; name its folder"
        )
    report, table = inner_texts(file)
    if PIECES in grid:
        files = RunFiles.of(output)
        report, table = files.report_text(), files.table_text()
    metadata = metadata_of_grid(log, path.name, grid)
    _refuse_damage(log, path)
    return _Run(str(path), metadata, report, table)


def _scans_of_messages(
    log: CheckLog, path: Path, scans: MessageScans, messages: Iterable[Message]
) -> Iterator[Scan]:
    for message in messages:
        _refuse_damage(log, path)
        scan = scans.scan(message)
        if scan is not None:
            yield scan
    _refuse_damage(log, path)


class MessageScans:
    """The scans in the messages of an output, which come in their order."""

    def __init__(self, path: Path, run: _Run) -> None:
        self._path = path
        self._run = run
        self._read = 0
        # Topics of scans, with the only sensor of each.
        self.topics: dict[str, int | None] = {"/points": None}
        self.topics |= {f"/{name}/points": i for i, name in enumerate(run.sensors)}

    def scan(self, message: Message, number: int | None = None) -> Scan | None:
        """The scan in a message, None for other messages; number: of the scan, None: the next."""
        if message.type != CLOUD or message.topic not in self.topics:
            return None
        if number is None:
            number = self._read
            self._read += 1
        try:
            cloud = read_cloud(MessageCursor.of_message(message.data, message.encoding))
            index, part, start_ns, end_ns = self._run.window_of_message(cloud.stamp_ns, number)
            cloud = replace(cloud, stamp_ns=start_ns)
            stored = stored_scan(cloud, message.where, self.topics[message.topic])
        except DamageError as err:
            raise RecordingError(f"{self._path}: {message.topic}: {err}; convert again") from err
        stored.index, stored.slice, stored.end_ns = index, part, end_ns
        return self._run.scan(stored, cloud.frame_id)


# -- a file for each scan -------------------------------------------------------------------------


def _scans_of_file(path: Path, found: str) -> Iterator[Scan]:
    """The scan of one file of a folder."""
    form = format_of([path])
    if form is not None and path.is_file():
        folder = path.parent
        # The files of a sensor are in a folder of their own.
        if not RunFiles.of(folder).report.exists() and RunFiles.of(folder.parent).report.exists():
            folder = folder.parent
        files = [one for one in form.files(CheckLog(), folder) if one.path == path]
        if files:
            yield from _scans_of_files(folder, form, files, CheckLog())
            return
    raise _no_output(path, found)


def _no_output(path: Path, found: str) -> RecordingError:
    return RecordingError(
        f"{path}: expected an output of `mlbatch convert` (a .mcap or .bag file, or a folder), "
        f"found {found}; name one"
    )


def _scans_of_files(
    folder: Path, form: FileFormat, files: list[ScanFile], log: CheckLog
) -> Iterator[Scan]:
    run, reader, frame_id = _run_of_files(folder, form, files, log)
    for stored in reader.scans(files):
        _refuse_damage(log, folder)
        yield run.scan(stored, frame_id)
    _refuse_damage(log, folder)


def _run_of_files(
    folder: Path,
    form: FileFormat,
    files: list[ScanFile],
    log: CheckLog,
    report: Path | None = None,
) -> tuple[_Run, ScanReader, str]:
    """The constants of a run, the reader of its files, and the frame of its points."""
    _refuse_damage(log, folder)
    reader = form.reader(log)
    try:
        metadata = reader.begin(files[0]) if files else RunMetadata()
    except DamageError as err:
        raise RecordingError(
            f"{files[0].path}: {err}; see `mlbatch verify`, and convert again"
        ) from err
    _refuse_damage(log, folder)
    texts = RunFiles.of(folder, report)
    run = _Run(str(folder), metadata, texts.report_text(), texts.table_text())
    reader.know(run.metadata)
    return run, reader, metadata.frame_id or ""


# -- scans by number ------------------------------------------------------------------------------


class ScanPlace(NamedTuple):
    """A scan of an output; sensor: with `--split`; points: -1 if no table has their number."""

    sensor: str
    window: int
    slice: int
    start_ns: int
    points: int
    path: str


class IndexedScans:
    """The scans of an output by number, in the order of `read`; files are closed between."""

    def __init__(self, path: Path, run: _Run) -> None:
        self.path = path
        self._run = run
        self.places: list[ScanPlace] = []

    def scan(self, number: int) -> Scan:
        """Read one scan; RecordingError where it is damaged."""
        raise NotImplementedError

    def _add(self, path: Path, index: int, part: int, sensor: int | None) -> None:
        start_ns, points = self._run.start_and_points(index, part, sensor)
        name = "" if sensor is None else self._run.sensors[sensor]
        self.places.append(ScanPlace(name, index, part, start_ns, points, str(path)))


class _IndexedMessages(IndexedScans):
    """An MCAP file, or a bag."""

    def __init__(self, path: Path, kind: str, report: Path | None) -> None:
        from mlbatch.outputs.mcap_file import McapFile

        log = CheckLog()
        self._files: list[McapFile | BagFile] = []
        # Number of the file.
        self._messages: list[tuple[int, MessagePlace]] = []
        for file, source in _message_files(log, path, kind):
            if not self._files:
                super().__init__(path, _run_of_file(log, path, file, source, report))
                self._scans = MessageScans(path, self._run)
            if isinstance(source, McapFile):
                # They have all rows of scans.csv.
                source.attachments.clear()
            topics = self._scans.topics
            try:
                found = source.places(topics)
            except DamageError as err:
                raise RecordingError(f"{file}: {err}; see `mlbatch verify`") from err
            _refuse_damage(log, path)
            for place in found:
                number = len(self._messages)
                index, part, _, _ = self._run.window_of_message(place.log_ns, number)
                self._add(file, index, part, topics[place.topic])
                self._messages.append((len(self._files), place))
            self._files.append(source)
        expected = self._run.rows
        windows = len({(place.window, place.slice) for place in self.places})
        if expected is not None and windows != expected:
            raise RecordingError(
                f"{path}: expected the {expected} windows of scans.csv in the index, found "
                f"{windows}; see `mlbatch verify`, and convert again"
            )

    def scan(self, number: int) -> Scan:
        log = CheckLog()
        file, place = self._messages[number]
        try:
            message = self._files[file].message_at(log, place)
        except (DamageError, OSError) as err:
            raise RecordingError(f"{self.path}: {err}; see `mlbatch verify`") from err
        _refuse_damage(log, self.path)
        scan = None if message is None else self._scans.scan(message, number)
        if scan is None:
            raise RecordingError(
                f"{self.path}: {place.topic}: expected {CLOUD}, found another message; see "
                "`mlbatch verify`"
            )
        return scan


class _IndexedFiles(IndexedScans):
    """A folder with a file for each scan."""

    def __init__(self, path: Path, form: FileFormat, report: Path | None) -> None:
        log = CheckLog()
        self._files = form.files(log, path)
        run, self._reader, self._frame_id = _run_of_files(path, form, self._files, log, report)
        super().__init__(path, run)
        for file in self._files:
            sensor = file.sensor_index(log, run.sensors)
            self._add(file.path, file.index, file.slice or 0, sensor)
        _refuse_damage(log, path)

    def scan(self, number: int) -> Scan:
        # Damage of one scan is none of the next.
        log = self._reader.log = CheckLog()
        stored = list(self._reader.scans([self._files[number]]))
        _refuse_damage(log, self.path)
        return self._run.scan(stored[0], self._frame_id)


def open_scans(path: Path, report: Path | None = None) -> IndexedScans:
    """The scans of an output of `convert`, each of which can be read alone.

    Only the indexes of the output are read; report: its path, None for the usual one.
    RecordingError for what is none, or unfinished.
    """
    _refuse_partial(path)
    kind = kind_of(path)
    if kind.form is not None:
        return _IndexedFiles(path, kind.form, report)
    if not kind.name:
        raise _no_output(path, "one file of a folder" if format_of([path]) else kind.found)
    return _IndexedMessages(path, kind.name, report)


# -- scans ----------------------------------------------------------------------------------------


class _Run:
    """The constants of a run, and what its report and scans.csv say of scans."""

    def __init__(
        self, where: str, metadata: RunMetadata, report: str | None, table: str | None
    ) -> None:
        """metadata: in the output itself; where: name of the output, for errors."""
        self._where = where
        known = None if report is None else report_of(where, report)
        if metadata.sensors is None or metadata.rate is None:
            if known is None or not (known.sensors and known.rate_hz):
                raise RecordingError(
                    f"{where}: expected the report of the run, which has rate and sensors, found "
                    "none; put it back where `convert` wrote it"
                )
            metadata = _metadata_of(known)
        self.metadata = metadata
        self.sensors = metadata.sensors or ()
        self._info = RunInfo(
            _sensors(where, self.sensors, known),
            "",
            metadata.rate or "",
            metadata.timescale or "unknown",
            1 if metadata.slices is None else metadata.slices,
            "dense",
            metadata.sort or "columns",
            variants=metadata.variants,
        )
        self._infos: dict[tuple[str, bool], RunInfo] = {}
        self._table = None
        if table is not None:
            self._table = TableOfRun(read_table(table, f"{where}: scans.csv"), self.sensors)
        try:
            self._grid = Grid(parse_rate(self._info.rate_hz), self._info.slices)
        except UsageError as err:
            raise RecordingError(f"{where}: {err}; convert again") from err
        # Number of the first slice.
        self._first = self._grid.index_of(metadata.t_init_ns or 0)

    def window_of_message(self, stamp_ns: int, number: int) -> tuple[int, int, int, int]:
        """Index, slice, start and end (ns) of a message, by its stamp and its number."""
        if self.metadata.batching is None:
            # The end of a window is the start of the next one.
            start_ns = self._grid.floor_bound(stamp_ns - (self.metadata.stamp == "end"))
            return *self._place(start_ns)[:2], start_ns, self._place(start_ns)[2]
        # Sets of sweeps have a line of scans.csv each.
        if self._table is None or number >= len(self._table.rows):
            return number, 0, 0, 0
        row = self._table.rows[number]
        return int(row["index"]), 0, int(row["start_ns"]), int(row["end_ns"])

    def _place(self, start_ns: int) -> tuple[int, int, int]:
        """Index, slice and end (ns) of the scan that starts at a time."""
        number = self._grid.index_of(start_ns)
        index, part = divmod(number - self._first, self._grid.slices)
        return index, part, self._grid.bound(number + 1)

    @property
    def rows(self) -> int | None:
        """Number of windows by the table; None without one."""
        return None if self._table is None else len(self._table.rows)

    def start_and_points(self, index: int, part: int, sensor: int | None) -> tuple[int, int]:
        """Start (ns) of a scan, and its number of points by the table; UNKNOWN: not in it."""
        row = None if self._table is None else self._table.number(index, part)
        if self._table is None or row is None:
            number = self._first + index * self._grid.slices + part
            return self._grid.bound(number), UNKNOWN
        found = self._table.rows[row]
        # With `--split` that of all sensors.
        return int(found["start_ns"]), int(found["points"]) if sensor is None else UNKNOWN

    def scan(self, stored: StoredScan, frame_id: str) -> Scan:
        """A scan as users get it."""
        if stored.end_ns is None:
            stored.index, stored.slice, stored.end_ns = self._place(stored.start_ns)
        place = (stored.index or 0, stored.slice or 0)
        row = None if self._table is None else self._table.row(*place, stored.sensor)
        if row is None and stored.complete is None:
            raise RecordingError(
                f"{self._where}: {stored.where}: expected a row of scan {place[0]} slice "
                f"{place[1]} in scans.csv, found none; put scans.csv back, or convert again"
            )
        arrays = point_arrays(stored)
        has_columns = stored.column_stamp_ns is not None
        absent = () if has_columns else (*(_KINDS.keys() - arrays.keys()), *_COLUMN_ARRAYS)
        owners = _copied(stored.column_lidar_id, "u1")
        row = row or ScanRow(
            bool(stored.complete),
            tuple(np.bincount(owners, minlength=len(self.sensors)).tolist()) if has_columns else (),
            fill=() if stored.fill is None else tuple(stored.fill.tolist()),
        )
        return Scan(
            info=self._info_of(frame_id, stored.organized),
            index=place[0],
            slice=place[1],
            start_ns=stored.start_ns,
            end_ns=stored.end_ns,
            complete=row.complete if stored.complete is None else stored.complete,
            ready_host_ns=row.ready_host_ns,
            xyz=_copied(stored.xyz, "<f4"),
            intensity=arrays.get("intensity", np.zeros(0, np.float32)),
            reflectivity=arrays.get("reflectivity"),
            range_m=arrays.get("range_m"),
            time_ns=arrays.get("time_ns", np.zeros(0, np.uint32)),
            ring=arrays.get("ring", np.zeros(0, np.uint16)),
            return_type=arrays.get("return_type", np.zeros(0, np.uint8)),
            lidar_id=arrays.get("lidar_id", np.zeros(0, np.uint8)),
            column=None if stored.column is None else _copied(stored.column, "<u4"),
            column_stamp_ns=_copied(stored.column_stamp_ns, "<i8"),
            column_lidar_id=owners,
            columns_per_sensor=row.columns,
            max_gap_ns=row.max_gap_ns,
            coverage=row.coverage,
            overlap=row.overlap,
            fill=np.array(row.fill, np.float32),
            absent=frozenset({*absent, "ring_base"}),
            sensor="" if stored.sensor is None else self.sensors[stored.sensor],
        )

    def _info_of(self, frame_id: str, organized: bool) -> RunInfo:
        """The description that all scans share, made once."""
        key = (frame_id, organized)
        if key not in self._infos:
            layout = "organized" if organized else "dense"
            self._infos[key] = self._info._replace(frame_id=frame_id, layout=layout)
        return self._infos[key]


def point_arrays(stored: StoredScan) -> dict[str, Array]:
    """The point arrays that a scan has, each of its own memory."""
    found: dict[str, Array | None] = {name: getattr(stored, name) for name in _KINDS}
    if found["intensity"] is None:
        found["intensity"] = stored.byte_intensity
    if stored.time_s is not None:
        # The product of a float32 and 10^9 has fewer bits than a float64: the smallest ns that
        # gives it, since float32 are rounded toward zero.
        time_ns = stored.time_s.astype(np.float64)
        time_ns *= NS_PER_S
        rounded = np.ceil if stored.time_s.itemsize == 4 else np.rint
        found["time_ns"] = rounded(time_ns, out=time_ns)
    if found["time_ns"] is not None:
        # Of this scan alone.
        np.maximum(found["time_ns"], 0, out=found["time_ns"])
    if stored.sensor is not None and found["lidar_id"] is None:
        # All points are of this sensor, whether the layout has a field for it or not.
        found["lidar_id"] = np.full(stored.xyz.shape[:-1], stored.sensor, np.uint8)
    return {name: _copied(one, _KINDS[name]) for name, one in found.items() if one is not None}


def _copied(values: Array | None, kind: str) -> Array:
    return np.zeros(0, kind) if values is None else np.array(values, kind, order="C")


def _metadata_of(report: RunReport) -> RunMetadata:
    """The constants of a run in its report."""
    return RunMetadata(
        rate=report.rate_hz,
        slices=report.slices,
        t_init_ns=report.t_init_ns,
        sensors=tuple(sensor.name for sensor in report.sensors),
        timescale=report.timescale,
        sort=report.sort or None,
        **dict(report.variants),
    )


def _sensors(
    where: str, names: tuple[str, ...], report: RunReport | None
) -> tuple[SensorInfo, ...]:
    """The sensors; without a report their models are unknown, and their poses NaN.

    Channels and ring numbers are 0: outputs do not have them.
    """
    known = {} if report is None else {sensor.name: sensor for sensor in report.sensors}
    found = []
    for name in names:
        model, pose = "", np.full((4, 4), np.nan)
        if name in known:
            model, pose = known[name].model, known[name].body_from_sensor
            if pose.shape != (4, 4):
                raise RecordingError(
                    f"{where}: expected a pose (4, 4) of {name} in the report, found a damaged "
                    "one; restore it, or convert again"
                )
        found.append(SensorInfo(name, model, 0, 0, 0, pose))
    return tuple(found)
