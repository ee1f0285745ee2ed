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
from mlbatch.outputs.containers import MessagePlace
from mlbatch.outputs.damage import CheckLog, DamageError
from mlbatch.outputs.encoding import MessageCursor
from mlbatch.outputs.folders import ScanFile
from mlbatch.outputs.kinds import FileFormat, format_of, kind_of
from mlbatch.outputs.metadata import RunMetadata, metadata_of_grid
from mlbatch.outputs.run_files import PIECES, RunFiles, inner_texts
from mlbatch.outputs.scan import Scan
from mlbatch.outputs.stored_scan import POINT_ARRAYS, StoredScan
from mlbatch.outputs.table import UNKNOWN, TableOfRun, read_table
from mlbatch.reports.report import RunReport, report_of
from mlbatch.types import RunInfo, SensorInfo
from mlbatch.units import NS_PER_S, parse_rate

if TYPE_CHECKING:
    from mlbatch.outputs.mcap_file import McapFile
    from mlbatch.outputs.rosbag1 import BagFile

Array: TypeAlias = npt.NDArray[Any]
_PARTIAL = ".partial"
_COLUMN_ARRAYS = ("column", "column_stamp_ns", "column_lidar_id")


class ScanPlace(NamedTuple):
    """A scan of an output; sensor: with `--split`; points: -1 if no table has their number."""

    sensor: str
    window: int
    slice: int
    start_ns: int
    points: int
    path: str


class IndexedScans:
    """The scans of an output by number, in its order; files are closed between."""

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


def open_scans(path: Path, report: Path | None = None) -> IndexedScans:
    """The scans of an output of `convert`, each of which can be read alone.

    path: a .mcap or .bag file, or a folder (files of scans, ROS 2 bag); report: its path, None for
    the usual one. Only the indexes of the output are read. RecordingError for what is damaged,
    unfinished or of another program.
    """
    if path.name.endswith(_PARTIAL):
        raise RecordingError(
            f"{path}: expected a finished output, found that of an unfinished run; convert again, "
            "or continue it with --resume"
        )
    kind = kind_of(path)
    log = CheckLog()
    if kind.form is not None:
        return _IndexedFiles(path, kind.form, kind.form.files(log, path), log, report)
    if kind.name:
        return _IndexedMessages(path, kind.name, log, report)
    found = "one file of a folder" if format_of([path]) is not None else kind.found
    raise RecordingError(
        f"{path}: expected an output of `mlbatch convert` (a .mcap or .bag file, or a folder), "
        f"found {found}; name one"
    )


def _file_of_folder(path: Path) -> IndexedScans | None:
    """The scan in one file of a folder; None for other paths."""
    form = format_of([path]) if path.is_file() and kind_of(path).form is None else None
    if form is None:
        return None
    folder = path.parent
    # The files of a sensor are in a folder of their own.
    if not RunFiles.of(folder).report.exists() and RunFiles.of(folder.parent).report.exists():
        folder = folder.parent
    files = [one for one in form.files(CheckLog(), folder) if one.path == path]
    return _IndexedFiles(folder, form, files, CheckLog(), None) if files else None


def opened(path: Path) -> IndexedScans:
    """The scans of an output as of `open_scans`, or the one in a file of a folder."""
    return _file_of_folder(path) or open_scans(path)


def read(path: Path, *, by_window: bool = False) -> Iterator[Scan]:
    """Yield the scans of an output in its order, with `--split` sensor by sensor.

    path: as of `open_scans`, or one file of a scan; by_window: by time also where sensors have
    folders. Raises RecordingError where the output is damaged, unfinished or of another program.
    """
    scans = opened(path)
    numbers: Iterable[int] = range(len(scans.places))
    if by_window:
        numbers = sorted(numbers, key=lambda number: scans.places[number][1:3])
    return map(scans.scan, numbers)


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
    log: CheckLog, output: Path, path: Path, file: McapFile | BagFile, report_path: Path | None
) -> _Run:
    """The constants of a run by its first file; report and table may be in the folder."""
    from mlbatch.outputs.rosbag1 import BagFile

    files = RunFiles.of(output, report_path)
    if isinstance(file, BagFile):
        return _Run(str(path), RunMetadata(), files.report_text(), files.table_text())
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
        report, table = files.report_text(), files.table_text()
    metadata = metadata_of_grid(log, path.name, grid)
    _refuse_damage(log, path)
    return _Run(str(path), metadata, report, table)


class _IndexedMessages(IndexedScans):
    """An MCAP file, or a bag."""

    def __init__(self, path: Path, kind: str, log: CheckLog, report: Path | None) -> None:
        from mlbatch.outputs.mcap_file import McapFile

        self._files: list[McapFile | BagFile] = []
        # Number of the file.
        self._messages: list[tuple[int, MessagePlace]] = []
        for file, source in _message_files(log, path, kind):
            if not self._files:
                super().__init__(path, _run_of_file(log, path, file, source, report))
                # Topics of scans, with the only sensor of each.
                self._topics: dict[str, int | None] = {"/points": None}
                self._topics |= {f"/{name}/points": i for i, name in enumerate(self._run.sensors)}
            if isinstance(source, McapFile):
                # They have all rows of scans.csv.
                source.attachments.clear()
            try:
                found = source.places(self._topics)
            except DamageError as err:
                raise _damaged(file, err) from err
            _refuse_damage(log, path)
            for place in found:
                number = len(self._messages)
                index, part, _, _ = self._run.window_of_message(place.log_ns, number)
                self._add(file, index, part, self._topics[place.topic])
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
            _refuse_damage(log, self.path)
            if message is None or message.type != CLOUD:
                raise DamageError(f"{CLOUD} in {place.topic}", "another message")
            cloud = read_cloud(MessageCursor.of_message(message.data, message.encoding))
            index, part, start_ns, end_ns = self._run.window_of_message(cloud.stamp_ns, number)
            cloud = replace(cloud, stamp_ns=start_ns)
            stored = stored_scan(cloud, message.where, self._topics[place.topic])
        except (DamageError, OSError) as err:
            raise _damaged(self.path, err) from err
        stored.index, stored.slice, stored.end_ns = index, part, end_ns
        return self._run.scan(stored, cloud.frame_id)


def _damaged(path: Path, err: Exception) -> RecordingError:
    return RecordingError(f"{path}: {err}; see `mlbatch verify`, and convert again")


# -- a file for each scan -------------------------------------------------------------------------


class _IndexedFiles(IndexedScans):
    """A folder with a file for each scan, or some of its files."""

    def __init__(
        self,
        path: Path,
        form: FileFormat,
        files: list[ScanFile],
        log: CheckLog,
        report: Path | None,
    ) -> None:
        self._files = files
        _refuse_damage(log, path)
        self._reader = form.reader(log)
        try:
            metadata = self._reader.begin(files[0]) if files else RunMetadata()
        except DamageError as err:
            raise _damaged(files[0].path, err) from err
        _refuse_damage(log, path)
        texts = RunFiles.of(path, report)
        run = _Run(str(path), metadata, texts.report_text(), texts.table_text())
        super().__init__(path, run)
        self._reader.know(run.metadata)
        self._frame_id = metadata.frame_id or ""
        for file in files:
            sensor = file.sensor_index(log, run.sensors)
            self._add(file.path, file.index, file.slice or 0, sensor)
        _refuse_damage(log, path)

    def scan(self, number: int) -> Scan:
        # Damage of one scan is none of the next.
        log = self._reader.log = CheckLog()
        stored = list(self._reader.scans([self._files[number]]))
        _refuse_damage(log, self.path)
        return self._run.scan(stored[0], self._frame_id)


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
        found = None if self._table is None else self._table.row(index, part)
        if found is None:
            number = self._first + index * self._grid.slices + part
            return self._grid.bound(number), UNKNOWN
        # With `--split` that of all sensors.
        return int(found["start_ns"]), int(found["points"]) if sensor is None else UNKNOWN

    def scan(self, stored: StoredScan, frame_id: str) -> Scan:
        """A scan as users get it."""
        if stored.end_ns is None:
            stored.index, stored.slice, stored.end_ns = self._place(stored.start_ns)
        place = (stored.index or 0, stored.slice or 0)
        row = None if self._table is None else self._table.of_scan(*place, stored.sensor)
        if row is None and stored.complete is None:
            raise RecordingError(
                f"{self._where}: {stored.where}: expected a row of scan {place[0]} slice "
                f"{place[1]} in scans.csv, found none; put scans.csv back, or convert again"
            )
        arrays = point_arrays(stored)
        has_columns = stored.column_stamp_ns is not None
        absent = () if has_columns else (*(POINT_ARRAYS.keys() - arrays.keys()), *_COLUMN_ARRAYS)
        owners = _copied(stored.column_lidar_id, "u1")
        if row is None:
            counts = np.bincount(owners, minlength=len(self.sensors)).tolist()
            row = {
                "columns_per_sensor": tuple(counts) if has_columns else (),
                "max_gap_ns": (),
                "fill": _copied(stored.fill, "<f4"),
                "ready_host_ns": 0,
            }
        if stored.complete is not None:
            row["complete"] = stored.complete
        empty: dict[str, Any] = {name: np.zeros(0, kind) for name, kind in POINT_ARRAYS.items()}
        # Arrays that outputs may lack for all sensors.
        empty |= {"reflectivity": None, "range_m": None}
        return Scan(
            info=self._info_of(frame_id, stored.organized),
            index=place[0],
            slice=place[1],
            start_ns=stored.start_ns,
            end_ns=stored.end_ns,
            xyz=_copied(stored.xyz, "<f4"),
            **{name: arrays.get(name, empty[name]) for name in POINT_ARRAYS},
            column=None if stored.column is None else _copied(stored.column, "<u4"),
            column_stamp_ns=_copied(stored.column_stamp_ns, "<i8"),
            column_lidar_id=owners,
            absent=frozenset({*absent, "ring_base"}),
            sensor="" if stored.sensor is None else self.sensors[stored.sensor],
            **row,
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
    found: dict[str, Array | None] = {name: getattr(stored, name) for name in POINT_ARRAYS}
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
    return {
        name: _copied(one, POINT_ARRAYS[name]) for name, one in found.items() if one is not None
    }


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
