"""A golden file: scans and run of an output in JSON, one line per scan, without paths and times."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

import mlbatch
from mlbatch.bounded import parse_json, read_text
from mlbatch.digests.comparison import Json
from mlbatch.errors import RecordingError
from mlbatch.outputs.read import read
from mlbatch.outputs.run_files import RunFiles
from mlbatch.outputs.scan import Scan
from mlbatch.outputs.stored_scan import POINT_ARRAYS
from mlbatch.outputs.table import read_table
from mlbatch.reports.report import parse_report

Values: TypeAlias = npt.NDArray[Any]

SCHEMA = "mlbatch.digest/3"
# Schema 1 has no version; 1 and 2 have `four` for `samples`; the rest is the same.
_EARLIER = ("mlbatch.digest/1", "mlbatch.digest/2")
_STAMPS = ("first_stamp_ns", "last_stamp_ns")
# Accounts that do not depend on the container of a recording.
_SENSOR = (
    *("name", "model", "lidar_id", "packets", "imu_packets", "imu_samples", "columns", "points"),
)
_SCANS = (
    *("written", "empty", "incomplete", "dropped_incomplete", "underfilled"),
    *("underfilled_by_sensor", "without", "no_points", "empty_clouds", "points"),
)
# Stamps of messages, sets and the instant of points are only there if they are not the usual ones.
_GRID = (
    *("rate_hz", "period_ns", "t_init_ns", "slices", "sort"),
    *("stamp", "batching", "batching_times", "deskew_to"),
)
POINT_FIELDS = ("xyz", *POINT_ARRAYS, "column")
COLUMN_FIELDS = ("column_stamp_ns", "column_lidar_id")
_DIGITS = 16
# Places of the four points, as parts of the number of points.
_PARTS = 3
# Digits of means: sums of float64 may differ in the last ones between processors.
_MEAN_DIGITS = 10


def golden_of(output: Path) -> dict[str, Json]:
    """Describe an output; RecordingError where it is damaged."""
    report, table = RunFiles.of(output).texts()
    about: dict[str, Json] = {}
    scans: list[dict[str, Json]] = []
    stamps = _stamps(output, table)
    for scan in read(output):
        if not about:
            about = {"frame_id": scan.frame_id, "layout": scan.info.layout}
        scans.append(_scan(scan, stamps))
    if not scans:
        raise RecordingError(
            f"{output}: expected scans to describe, found none; see `mlbatch verify`"
        )
    return {"schema": SCHEMA, **about, "run": describe_run(output, report), "scans": [*scans]}


def _stamps(output: Path, table: str | None) -> dict[tuple[int, int], dict[str, Json]]:
    """First and last stamp of the scans by index and slice, from scans.csv."""
    if table is None:
        return {}
    rows = read_table(table, f"{output}: scans.csv")
    return {
        (int(row["index"]), int(row["slice"])): {name: int(row[name]) for name in _STAMPS}
        for row in rows
    }


def _scan(scan: Scan, stamps: dict[tuple[int, int], dict[str, Json]]) -> dict[str, Json]:
    is_organized = scan.info.layout == "organized"
    valid = scan.is_valid if is_organized else None
    fields: dict[str, Json] = {
        name: describe(array, None if name in COLUMN_FIELDS else valid)
        for name, array in fields_of(scan)
    }
    return {
        "index": scan.index,
        "slice": scan.slice,
        **({"sensor": scan.sensor} if scan.sensor else {}),
        "start_ns": scan.start_ns,
        "end_ns": scan.end_ns,
        "complete": scan.complete,
        "points": scan.point_count,
        "columns": list(scan.columns_per_sensor),
        "max_gap_ns": list(scan.max_gap_ns),
        "fill": values(scan.fill),
        **stamps.get((scan.index, scan.slice), {}),
        "fields": fields,
    }


# -- run --------------------------------------------------------------------------------------


def describe_run(where: object, text: str | None) -> dict[str, Json]:
    """Grid, accounts, poses and warning codes of a run, from its report; nothing without one.

    Raises RecordingError for a report of another program.
    """
    if text is None:
        return {}
    report = parse_report(where, text)
    try:
        return {
            "timescale": report["timescale"],
            "grid": _chosen(report["grid"], _GRID),
            "sensors": [_sensor(sensor) for sensor in report["sensors"]],
            "scans": _chosen(report["scans"], _SCANS),
            "warnings": sorted(
                f"{one['code']} {one['sensor']}".strip() for one in report["warnings"]
            ),
        }
    except (KeyError, TypeError, ValueError) as err:
        raise RecordingError(
            f"{where}: expected a report of the run, found a damaged one "
            f"({type(err).__name__}: {err}); restore it, or convert again"
        ) from err


def _sensor(report: dict[str, Json]) -> dict[str, Json]:
    sensor = _chosen(report, _SENSOR)
    extrinsics = report["extrinsics"]
    if isinstance(extrinsics, dict):
        sensor["body_from_sensor"] = extrinsics.get("body_from_sensor")
    return sensor


def _chosen(values: dict[str, Json], keys: tuple[str, ...]) -> dict[str, Json]:
    return {key: values[key] for key in keys if key in values}


# -- arrays -----------------------------------------------------------------------------------


def fields_of(scan: Scan) -> Iterator[tuple[str, Values]]:
    """Name and values of each array that the output stores; of organized scans with empty slots."""
    for name in (*POINT_FIELDS, *COLUMN_FIELDS):
        array = getattr(scan, name)
        if array is not None and name not in scan.absent:
            yield name, array


def describe(array: Values, valid: npt.NDArray[np.bool_] | None) -> dict[str, Json]:
    """A checksum of all values; mean, least, largest and four of the valid ones (None: all)."""
    found: dict[str, Json] = {"sha256": checksum(array)}
    kept = array if valid is None else array[valid]
    if len(kept):
        last = len(kept) - 1
        samples = [last * part // _PARTS for part in range(_PARTS + 1)]
        found["mean"] = mean(kept)
        found["min"] = values(kept.min(axis=0))
        found["max"] = values(kept.max(axis=0))
        found["samples"] = values(kept[samples])
    return found


def checksum(array: Values) -> str:
    """The first digits of the SHA-256 of the values, in little endian."""
    data = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    return hashlib.sha256(data.data).hexdigest()[:_DIGITS]


def values(array: npt.NDArray[Any]) -> Json:
    """Numbers of an array as nested lists; reals in the digits that give them back, NaN as null."""
    if array.ndim:
        return [values(one) for one in array]
    if array.dtype.kind != "f":
        number: int = array.item()
        return number
    return _real(float(str(array[()])))


def mean(array: npt.NDArray[Any]) -> Json:
    """Means over the first axis, rounded."""
    means = np.mean(array, axis=0, dtype=np.float64)
    rounded = [_real(float(f"{one:.{_MEAN_DIGITS}g}")) for one in np.atleast_1d(means)]
    return rounded[0] if means.ndim == 0 else list(rounded)


def _real(value: float) -> float | None:
    return value if math.isfinite(value) else None


# -- as a file --------------------------------------------------------------------------------


def golden_text(golden: dict[str, Json]) -> str:
    """A golden file: with the version that made it, and a line for each scan, for reviews."""
    head = {"schema": golden["schema"], "version": mlbatch.__version__}
    head |= {key: value for key, value in golden.items() if key != "scans"}
    text = json.dumps(head, indent=1, ensure_ascii=False, allow_nan=False)
    return text.removesuffix("\n}") + ',\n "scans": [\n' + ",\n".join(_lines(golden)) + "\n ]\n}\n"


def _lines(golden: dict[str, Json]) -> Iterator[str]:
    scans = golden["scans"]
    for scan in scans if isinstance(scans, list) else ():
        yield "  " + json.dumps(scan, ensure_ascii=False, allow_nan=False)


def read_golden(path: Path) -> dict[str, Json]:
    """Read a golden file; RecordingError for another file."""
    try:
        golden = parse_json(read_text(path))
    except (OSError, ValueError) as err:
        found = getattr(err, "strerror", None) or f"{type(err).__name__}: {err}"
        raise RecordingError(
            f"{path}: expected a golden file (JSON), found {found}; write one with "
            "`mlbatch digest OUTPUT -o FILE`"
        ) from err
    schema = golden.get("schema") if isinstance(golden, dict) else None
    if schema not in (SCHEMA, *_EARLIER) or not isinstance(golden.get("scans"), list):
        raise RecordingError(
            f"{path}: expected a golden file of the schema {SCHEMA}, found {schema!r}; write one "
            "with `mlbatch digest OUTPUT -o FILE`"
        )
    found_golden: dict[str, Json] = golden
    if schema in _EARLIER:
        _rename_samples(found_golden)
    return found_golden


def _rename_samples(golden: dict[str, Json]) -> None:
    scans = golden["scans"]
    for scan in scans if isinstance(scans, list) else ():
        fields = scan.get("fields") if isinstance(scan, dict) else None
        for field in fields.values() if isinstance(fields, dict) else ():
            if isinstance(field, dict) and "four" in field:
                field["samples"] = field.pop("four")
