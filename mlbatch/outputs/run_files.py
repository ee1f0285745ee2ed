"""What an output says about its run: sensors, grid, extrinsics; from report.json and scans.csv."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.batching.grid import Grid
from mlbatch.bounded import MOST_TABLE_BYTES, parse_json, read_text
from mlbatch.errors import RecordingError, UsageError
from mlbatch.outputs.table import ScanRow, TableOfRun, read_table
from mlbatch.types import VARIANTS, RunInfo, SensorInfo
from mlbatch.units import parse_rate
from mlbatch.writers.atomic import REPORT_JSON, SCANS_CSV, side_path

_SCHEMA = "mlbatch.report/1"
# Of outputs of versions that had no other.
_SORT = "columns"


@dataclass(frozen=True, slots=True)
class RunFiles:
    """The texts of report and table of an output; "": there is none; where: for errors."""

    where: str
    report: str
    table: str

    @classmethod
    def of(cls, output: Path) -> RunFiles:
        """The files in an output folder, or next to an output file."""
        if output.is_dir():
            paths = (output / REPORT_JSON, output / SCANS_CSV)
        else:
            paths = (side_path(output, REPORT_JSON), side_path(output, SCANS_CSV))
        return cls(str(output), *map(_text, paths))

    def about(self) -> RunOfOutput:
        """Everything that the report says about the run; RecordingError without a report."""
        if not self.report:
            raise RecordingError(
                f"{self.where}: expected the report of the run, which has rate and sensors, found "
                "none; put it back where `convert` wrote it"
            )
        try:
            document = parse_json(self.report)
            if document["schema"] != _SCHEMA:
                raise ValueError(document["schema"])
            grid = document["grid"]
            return RunOfOutput(
                self.where,
                tuple(str(sensor["name"]) for sensor in document["sensors"]),
                str(grid["rate_hz"]),
                int(grid["slices"]),
                str(document["timescale"]),
                grid["t_init_ns"],
                str(grid.get("sort", _SORT)),
                self,
                variants_of(grid),
            )
        except (KeyError, TypeError, ValueError) as err:
            raise self._damaged(err) from err

    def sensors(self, names: Sequence[str]) -> tuple[SensorInfo, ...]:
        """The sensors; without a report their models are unknown, and their poses NaN.

        Channels and ring numbers are 0: outputs do not have them.
        """
        known: dict[str, tuple[str, F64Array]] = {}
        if self.report:
            try:
                for sensor in parse_json(self.report)["sensors"]:
                    pose = np.array(sensor["extrinsics"]["body_from_sensor"], np.float64)
                    known[sensor["name"]] = str(sensor["model"]), pose.reshape(4, 4)
            except (KeyError, TypeError, ValueError) as err:
                raise self._damaged(err) from err
        unknown = ("", np.full((4, 4), np.nan))
        found = ((name, *known.get(name, unknown)) for name in names)
        return tuple(SensorInfo(name, model, 0, 0, 0, pose) for name, model, pose in found)

    def _damaged(self, err: Exception) -> RecordingError:
        return RecordingError(
            f"{self.where}: expected a report of the schema {_SCHEMA}, found a damaged one "
            f"({type(err).__name__}: {err}); restore it, or convert again"
        )


def variants_of(values: Mapping[str, object]) -> tuple[tuple[str, str], ...]:
    """The options of `RunInfo.variants` among the metadata of an output."""
    return tuple((name, str(values[name])) for name in VARIANTS if name in values)


@dataclass(frozen=True, slots=True)
class RunOfOutput:
    """Constants of a run as its output has them."""

    where: str
    sensors: tuple[str, ...]
    rate_hz: str
    slices: int
    timescale: str
    t_init_ns: int | None
    sort: str
    files: RunFiles
    variants: tuple[tuple[str, str], ...] = ()  # as of `RunInfo`

    def info(self, frame_id: str, layout: str) -> RunInfo:
        """What all scans share."""
        sensors = self.files.sensors(self.sensors)
        return RunInfo(
            sensors,
            frame_id,
            self.rate_hz,
            self.timescale,
            self.slices,
            layout,
            self.sort,
            variants=self.variants,
        )

    def places(self) -> Places:
        """Index and slice of scans by their start; RecordingError for an impossible grid."""
        try:
            grid = Grid(parse_rate(self.rate_hz), self.slices)
        except UsageError as err:
            raise RecordingError(f"{self.where}: {err}; convert again") from err
        stamp = dict(self.variants).get("stamp", "start")
        return Places(grid, grid.index_of(self.t_init_ns or 0), stamp)

    def table(self) -> TableOfRun | None:
        """scans.csv; None if there is none."""
        if not self.files.table:
            return None
        rows = read_table(self.files.table, f"{self.where}: {SCANS_CSV}")
        return TableOfRun(rows, self.sensors)


@dataclass(frozen=True, slots=True)
class Places:
    """The grid of a run; first: number of its first slice."""

    grid: Grid
    first: int
    stamp: str = "start"

    def start_of_message(self, stamp_ns: int) -> int:
        """Start of the window of a message."""
        # The end of a window is the start of the next one.
        return self.grid.floor_bound(stamp_ns - (self.stamp == "end"))

    def place(self, start_ns: int) -> tuple[int, int, int]:
        """Index, slice and end (ns) of the scan that starts at a time."""
        number = self.grid.index_of(start_ns)
        index, part = divmod(number - self.first, self.grid.slices)
        return index, part, self.grid.bound(number + 1)


def row_of(table: TableOfRun | None, index: int, part: int, only: int | None) -> ScanRow | None:
    """The row of a scan; only: the sensor of the scan with `--split`."""
    row = None if table is None else table.row(index, part)
    if row is None or only is None:
        return row
    return ScanRow(
        row.complete,
        tuple(count if i == only else 0 for i, count in enumerate(row.columns)),
        # Of the window, as is fill: also of sensors that are not in this scan.
        row.max_gap_ns,
        tuple(share if i == only else 0.0 for i, share in enumerate(row.coverage)),
        tuple(share if i == only else 0.0 for i, share in enumerate(row.overlap)),
        row.fill,
        row.ready_host_ns,
    )


def _text(path: Path) -> str:
    try:
        return read_text(path, MOST_TABLE_BYTES)
    except FileNotFoundError:
        return ""
    except (OSError, UnicodeDecodeError) as err:
        raise RecordingError(
            f"{path}: expected a readable text file, found {err}; restore it"
        ) from err
