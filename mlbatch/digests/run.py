"""What a report says about the recording and the options, without paths, times and machine."""

from __future__ import annotations

from mlbatch.digests.values import Json
from mlbatch.errors import RecordingError
from mlbatch.report.report import parse_report

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
    found = _chosen(report, _SENSOR)
    extrinsics = report["extrinsics"]
    if isinstance(extrinsics, dict):
        found["body_from_sensor"] = extrinsics.get("body_from_sensor")
    return found


def _chosen(values: dict[str, Json], keys: tuple[str, ...]) -> dict[str, Json]:
    return {key: values[key] for key in keys if key in values}
