"""`mlbatch.read`: the scans of an output, one after another, whatever its format.

Anything that the readers of a format report as damaged is an error here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mlbatch.bounded import parse_json
from mlbatch.errors import RecordingError
from mlbatch.outputs.cloud_messages import CLOUD, read_cloud
from mlbatch.outputs.clouds import CloudPlace, Values, scan_of_cloud, scan_of_fields
from mlbatch.outputs.commented import CommentedReader
from mlbatch.outputs.damage import CheckLog, DamageError, VerifyError
from mlbatch.outputs.float_rows import KITTI_SUFFIX, NUSCENES_SUFFIX, read_rows, start_of
from mlbatch.outputs.folders import ScanFile, scan_files
from mlbatch.outputs.kinds import kind_of
from mlbatch.outputs.las import LasReader
from mlbatch.outputs.npz import arrays_of
from mlbatch.outputs.pcd import PcdReader
from mlbatch.outputs.ply import PlyReader
from mlbatch.outputs.run_files import RunFiles, RunOfOutput, row_of, variants_of
from mlbatch.outputs.scan import Scan
from mlbatch.outputs.table import ScanRow, TableOfRun
from mlbatch.types import RunInfo
from mlbatch.writers.atomic import PARTIAL_SUFFIX

if TYPE_CHECKING:
    from mlbatch.outputs.mcap_file import McapFile

_SCHEMA = "mlbatch.scan/1"
_WITHOUT_HEADER = (NUSCENES_SUFFIX, KITTI_SUFFIX)


def read(path: Path) -> Iterator[Scan]:
    """Yield the scans of an output in its order, with `--split` those of each sensor.

    path: a .mcap or .bag file, a folder (files of scans, ROS 2 bag), or one file of a scan. Raises
    RecordingError where the output is damaged, unfinished or of another program.
    """
    if path.name.endswith(PARTIAL_SUFFIX):
        raise RecordingError(
            f"{path}: expected a finished output, found that of an unfinished run; convert again, "
            "or continue it with --resume"
        )
    try:
        yield from _scans(path)
    except VerifyError as err:
        raise RecordingError(str(err)) from err


def _scans(path: Path) -> Iterator[Scan]:
    kind = kind_of(path)
    if kind.name == "mcap":
        return _scans_of_mcap(path, {path.name: path})
    if kind.name == "rosbag1":
        return _scans_of_bag(path)
    log = CheckLog()
    if kind.name == "rosbag2":
        from mlbatch.outputs.rosbag2 import open_bag

        bag, _ = open_bag(log, path)
        _refuse_damage(log, path)
        return _scans_of_mcap(path, {f"{path.name}/{file.name}": file for file in bag})
    if kind.form is not None:
        files = scan_files(log, path, kind.form.suffix)
        _refuse_damage(log, path)
        return _scans_of_files(path, kind.form.suffix, files)
    suffix = next((one for one in _FILE_READERS if path.name.endswith(one)), None)
    if suffix is not None and path.is_file():
        folder = path.parent
        named = [file for file in scan_files(log, folder, suffix) if file.path == path]
        # The files of a sensor are in a folder of their own.
        if not RunFiles.of(folder).report and RunFiles.of(folder.parent).report:
            folder = folder.parent
            named = [file for file in scan_files(log, folder, suffix) if file.path == path]
        if named:
            return _scans_of_files(folder, suffix, named)
    raise RecordingError(
        f"{path}: expected an output of `mlbatch convert` (a .mcap or .bag file, or a folder), "
        f"found {kind.found}; name one"
    )


def _refuse_damage(log: CheckLog, path: Path) -> None:
    """Raise RecordingError for what a reader of a format has found."""
    for violation in log.violations:
        raise RecordingError(
            f"{path}: {violation.where}: expected {violation.expected}, found {violation.found}; "
            "see `mlbatch verify`, and convert again"
        )


# -- messages -------------------------------------------------------------------------------------


def _scans_of_mcap(output: Path, paths: Mapping[str, Path]) -> Iterator[Scan]:
    """The scans of an output of MCAP files; paths: of all, by their names for errors."""
    from mlbatch.outputs.mcap_file import McapFile

    log = CheckLog()
    clouds: _Clouds | None = None
    for where, path in paths.items():
        file = McapFile(log, path, where)
        if clouds is None:
            clouds = _Clouds(_run_of_mcap(output, path, file))
        for message in file.messages():
            _refuse_damage(log, path)
            if message.type == CLOUD:
                yield from clouds.scan(message.topic, message.data, message.encoding)
        _refuse_damage(log, path)


def _run_of_mcap(output: Path, path: Path, file: McapFile) -> RunOfOutput:
    """The constants of a run in its first file; report and table may be in the folder."""
    grid = file.metadata.get("mlbatch.grid")
    if grid is None:
        raise RecordingError(
            f"{path}: expected an MCAP file of mlbatch, with a metadata record mlbatch.grid, found "
            "another; name the output of `mlbatch convert`"
        )
    if "windows_per_file" in grid and not output.is_dir():
        raise RecordingError(
            f"{path}: expected a whole output, found one of the files of a bag; name its folder"
        )
    report = file.metadata.get("mlbatch.report", {}).get("json", "")
    table = file.attachments.get("scans.csv", b"").decode("utf-8", "replace")
    own = RunFiles(str(path), report, table)
    try:
        return RunOfOutput(
            str(path),
            tuple(map(str, parse_json(grid["sensors"]))),
            grid["rate_hz"],
            int(grid["slices"]),
            grid["timescale"],
            int(grid["t_init_ns"]),
            grid.get("sort", "columns"),
            RunFiles.of(output) if "windows_per_file" in grid else own,
            variants_of(grid),
        )
    except (KeyError, TypeError, ValueError) as err:
        raise RecordingError(
            f"{path}: expected rate, slices and sensors in mlbatch.grid, found "
            f"{type(err).__name__}: {err}; convert again"
        ) from err


def _scans_of_bag(path: Path) -> Iterator[Scan]:
    from mlbatch.outputs.rosbag1 import BagFile

    log = CheckLog()
    clouds = _Clouds(RunFiles.of(path).about())
    for message in BagFile(log, path, path.name).messages():
        _refuse_damage(log, path)
        if message.type == CLOUD:
            yield from clouds.scan(message.topic, message.data, message.encoding)
    _refuse_damage(log, path)


class _Clouds:
    """Converts the messages of a run to scans."""

    def __init__(self, about: RunOfOutput) -> None:
        self._about = about
        self._places = about.places()
        self._table = about.table()
        self._infos: dict[tuple[str, str], RunInfo] = {}
        # Clouds so far.
        self._read = 0

    def scan(self, topic: str, data: bytes | memoryview, encoding: str) -> Iterator[Scan]:
        """The scan of a message; none for a forwarded topic."""
        from mlbatch.outputs.encoding import MessageCursor

        own = {"/points": None} | {
            f"/{name}/points": number for number, name in enumerate(self._about.sensors)
        }
        if topic not in own:
            return
        try:
            cloud = read_cloud(MessageCursor.of_message(data, encoding))
        except DamageError as err:
            raise RecordingError(f"{self._about.where}: {topic}: {err}; convert again") from err
        layout = "dense" if cloud.is_dense else "organized"
        key = (cloud.frame_id, layout)
        if key not in self._infos:
            self._infos[key] = self._about.info(*key)
        if "batching" in dict(self._about.variants):
            index, part, start_ns, end_ns = self._set()
        else:
            start_ns = self._places.start_of_message(cloud.stamp_ns)
            index, part, end_ns = self._places.place(start_ns)
        row = row_of(self._table, index, part, own[topic])
        if row is None:
            raise RecordingError(
                f"{self._about.where}: expected a row of scan {index} slice {part} in scans.csv, "
                "found none; put scans.csv back, or convert again"
            )
        place = CloudPlace(self._infos[key], index, part, start_ns, end_ns, row, own[topic])
        rows = cloud.records.T if layout == "organized" else cloud.records.reshape(-1)
        yield scan_of_cloud(place, rows, row.complete)

    def _set(self) -> tuple[int, int, int, int]:
        """Index, slice, start and end (ns) of the next set of sweeps: a line of scans.csv each."""
        number = self._read
        self._read += 1
        rows = None if self._table is None else self._table.rows
        if rows is None or number >= len(rows):
            return number, 0, 0, 0
        row = rows[number]
        return int(row["index"]), 0, int(row["start_ns"]), int(row["end_ns"])


# -- a file a scan --------------------------------------------------------------------------------


@dataclass(slots=True)
class _FileRun:
    """The run of a folder; info: of the first scan."""

    files: RunFiles
    info: RunInfo | None = None
    about: RunOfOutput | None = None
    # Starts of scans without one, by folder and file.
    starts: dict[Path, dict[Path, int]] = field(default_factory=dict)
    _table: TableOfRun | None = None
    _has_table: bool = False

    def shared(self, about: RunOfOutput, frame_id: str, layout: str) -> RunInfo:
        """What all scans share, made once."""
        if self.info is None:
            self.about = about
            self.info = about.info(frame_id, layout)
        return self.info

    def row(self, scan: Scan, only: int | None) -> ScanRow | None:
        """The row of a scan in scans.csv; None if there is none."""
        if self.about is not None and not self._has_table:
            self._table = self.about.table()
            self._has_table = True
        return row_of(self._table, scan.index, scan.slice, only)


def _scans_of_files(folder: Path, suffix: str, files: list[ScanFile]) -> Iterator[Scan]:
    reader = _FILE_READERS[suffix]
    run = _FileRun(RunFiles.of(folder))
    for file in files:
        try:
            scan, index = reader(file, run)
        except DamageError as err:
            raise RecordingError(
                f"{file.path}: {err}; see `mlbatch verify`, and convert again"
            ) from err
        scan.sensor = file.sensor or ""
        row = run.row(scan, None if file.sensor is None else index)
        if row is None and file.suffix in _WITHOUT_HEADER:
            raise RecordingError(
                f"{file.path}: expected a row of scan {scan.index} slice {scan.slice} in "
                "scans.csv, found none; put scans.csv back, or convert again"
            )
        if row is not None:
            scan.complete = row.complete if file.suffix in _WITHOUT_HEADER else scan.complete
            scan.columns_per_sensor = row.columns
            scan.max_gap_ns = row.max_gap_ns
            scan.coverage = row.coverage
            scan.overlap = row.overlap
            scan.fill = np.array(row.fill, np.float32)
            scan.ready_host_ns = row.ready_host_ns
        yield scan


def _sensor_index(file: ScanFile, names: tuple[str, ...]) -> int | None:
    """Index of the sensor in whose folder a file is; None without `--split`."""
    if file.sensor is None:
        return None
    if file.sensor not in names:
        raise DamageError(f"the folder of one of {', '.join(names)}", file.sensor)
    return names.index(file.sensor)


def _npz_scan(file: ScanFile, run: _FileRun) -> tuple[Scan, int | None]:
    try:
        values = arrays_of(file)
        if str(values["schema"]) != _SCHEMA:
            raise DamageError(f"the schema {_SCHEMA}", str(values["schema"]))
        names = tuple(map(str, values["sensors"].tolist()))
        slices = int(values["slices"])
        rate_hz = str(values["rate_hz"])
        about = RunOfOutput(
            str(file.path),
            names,
            rate_hz,
            slices,
            str(values["timescale"]),
            None,
            str(values.get("sort", "columns")),
            run.files,
            variants_of(values),
        )
        layout = "dense" if values["xyz"].ndim == 2 else "organized"
        info = run.shared(about, str(values["frame_id"]), layout)
        columns = values["column_lidar_id"]
        scan = Scan(
            info=info,
            index=int(values["index"]),
            slice=int(values["slice"]),
            start_ns=int(values["start_ns"]),
            end_ns=int(values["end_ns"]),
            complete=bool(values["complete"]),
            ready_host_ns=0,
            xyz=values["xyz"],
            intensity=values["intensity"],
            reflectivity=values.get("reflectivity"),
            range_m=values["range_m"],
            time_ns=values["time_ns"],
            ring=values["ring"],
            return_type=values["return_type"],
            lidar_id=values["lidar_id"],
            column=values.get("column"),
            column_stamp_ns=values["column_stamp_ns"],
            column_lidar_id=columns,
            columns_per_sensor=tuple(np.bincount(columns, minlength=len(names)).tolist()),
            max_gap_ns=(),
            fill=values.get("fill", np.zeros(0, np.float32)),
            absent=frozenset({"ring_base"}),
        )
    except (KeyError, TypeError, ValueError) as err:
        raise DamageError("the keys of docs/formats.md", f"{type(err).__name__}: {err}") from err
    return scan, _sensor_index(file, names)


def _commented_scan(file: ScanFile, run: _FileRun) -> tuple[Scan, int | None]:
    """A scan of a format that has its metadata in comments: PLY, PCD, LAS."""
    log = CheckLog()
    reader = _COMMENTED[file.suffix](log)
    comments, points = reader.parse(file.read())
    _refuse_damage(log, file.path)
    metadata = comments.metadata()
    index, part, slices = comments.place()
    names = metadata.sensors
    if names is None or metadata.rate is None or metadata.timescale is None:
        raise DamageError("the comments of docs/formats.md", "no rate, timescale or sensors")
    about = RunOfOutput(
        str(file.path),
        names,
        metadata.rate,
        slices,
        metadata.timescale,
        None,
        metadata.sort or "columns",
        run.files,
        variants_of(comments.by_name),
    )
    layout = "organized" if points.organized else "dense"
    info = run.shared(about, metadata.frame_id or "", layout)
    start_ns = comments.number("start_ns")
    only = _sensor_index(file, names)
    end_ns = comments.number("end_ns")
    place = CloudPlace(info, index, part, start_ns, end_ns, None, only)
    fields = {
        "intensity": points.intensity,
        "reflectivity": points.reflectivity,
        "time": points.time_s,
        "t": points.time_ns,
        "ring": points.ring,
        "return_type": points.return_type,
        "lidar_id": points.lidar_id,
    }
    stored = {name: values for name, values in fields.items() if values is not None}
    scan = scan_of_fields(place, points.xyz, stored, comments.is_complete())
    return scan, only


def _rows_scan(file: ScanFile, run: _FileRun) -> tuple[Scan, int | None]:
    """A scan of kitti or nuscenes: all but the points is in report and scans.csv."""
    found = read_rows(file)
    about = run.about or run.files.about()
    info = run.shared(about, "", "dense")
    start_ns = start_of(file, run.starts)
    index, part, end_ns = about.places().place(start_ns)
    only = _sensor_index(file, about.sensors)
    place = CloudPlace(info, index, part, start_ns, end_ns, None, only)
    fields: dict[str, Values] = {"intensity": found.rows[:, 3]}
    if found.times is not None:
        fields |= {
            "ring": found.rows[:, 4],
            "time": found.times[:, 0],
            "lidar_id": found.times[:, 1],
        }
    # `complete` is in scans.csv.
    return scan_of_fields(place, found.rows[:, :3], fields, False), only


_COMMENTED: dict[str, Callable[[CheckLog], CommentedReader]] = {
    ".ply": PlyReader,
    ".pcd": PcdReader,
    ".las": LasReader,
    ".laz": LasReader,
}
# By the suffix of the first file of a scan; that of kitti is the end of that of nuscenes.
_FILE_READERS: dict[str, Callable[[ScanFile, _FileRun], tuple[Scan, int | None]]] = {
    ".npz": _npz_scan,
    **dict.fromkeys(_COMMENTED, _commented_scan),
    NUSCENES_SUFFIX: _rows_scan,
    KITTI_SUFFIX: _rows_scan,
}
