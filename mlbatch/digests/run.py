"""What a report says about the recording and the options, without paths, times and machine."""

from __future__ import annotations

from pathlib import Path

from mlbatch.bounded import parse_json
from mlbatch.digests.values import Json
from mlbatch.errors import RecordingError
from mlbatch.outputs.run_files import RunFiles

_SCHEMA = "mlbatch.report/1"
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


def run_files(output: Path) -> RunFiles:
    """Report and table in or next to an output; those inside of an MCAP file without others."""
    found = RunFiles.of(output)
    if found.report and found.table:
        return found
    report, table = _inside(output)
    return RunFiles(found.where, found.report or report, found.table or table)


def _inside(output: Path) -> tuple[str, str]:
    from mlbatch.outputs.damage import CheckLog
    from mlbatch.outputs.mcap_file import McapFile

    if not output.is_file() or not output.name.endswith(".mcap"):
        return "", ""
    file = McapFile(CheckLog(), output, output.name)
    report = file.metadata.get("mlbatch.report", {}).get("json", "")
    return report, file.attachments.get("scans.csv", b"").decode("utf-8", "replace")


def describe_run(files: RunFiles) -> dict[str, Json]:
    """Grid, accounts, poses and warning codes of a run; nothing without a report.

    Raises RecordingError for a report of another program.
    """
    if not files.report:
        return {}
    try:
        report = parse_json(files.report)
        if report["schema"] != _SCHEMA:
            raise ValueError(report["schema"])
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
            f"{files.where}: expected a report of the schema {_SCHEMA}, found a damaged one "
            f"({type(err).__name__}: {err}); restore it, or convert again"
        ) from err


def _sensor(report: dict[str, Json]) -> dict[str, Json]:
    found = _chosen(report, _SENSOR)
    extrinsics = report["extrinsics"]
    if isinstance(extrinsics, dict):
        found["body_from_sensor"] = extrinsics.get("body_from_sensor")
    return found


def _chosen(values: dict[str, Json], keys: tuple[str, ...]) -> dict[str, Json]:
    return {key: values[key] for key in keys if key in values}
