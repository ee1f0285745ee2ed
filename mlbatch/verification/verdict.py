"""The result of `verify`: its checks, the violations, and what an output cannot show."""

from __future__ import annotations

from dataclasses import dataclass

from mlbatch.outputs.damage import CheckLog, Violation

# Every check and what it requires, in the order in which a verdict shows them.
CHECKS = {
    "container": "files are complete: lengths, indexes, checksums; no .partial output",
    "names": "the name of a file is the index and slice of its scan",
    "layout": "keys or fields of points, their types and shapes",
    "metadata": "rate, slices, sensors, frame and timescale are the same everywhere",
    "grid": "windows and slices begin and end on the grid: no gap, no overlap, no drift",
    "index": "index and slice are those of the window, and increase",
    "t_init": "scan 0 begins at t_init, a bound of the grid",
    "stamps": "log time, publish time and header stamp are the start of the window, or as --stamp",
    "columns": "the stamp of a column is inside its window",
    "order": "stamps never decrease; points are in the order of their columns",
    "times": "no point is before its column, or after the end of its column",
    "finite": "coordinates and ranges are finite; empty slots of organized scans are empty",
    "geometry": "the distance of a point from its sensor is the measured range",
    "sensors": "lidar_id is a sensor, that of the column",
    "rings": "rings of different sensors are different, in the order of the sensors",
    "returns": "return types are in the table",
    "duplicates": "no column occurs twice",
    "table": "scans.csv agrees with the scans",
    "checksum": "the bytes of a scan are those that were written, by scans.csv",
    "ledger": "every packet, column and point is written or counted",
    "report": "counts and figures of the report agree with the output",
    "tf_static": "one message before all others places every sensor",
    "frames": "every frame that a message names is in the tree of /tf_static",
    "imu": "IMU messages are in order of time, at the time of their header",
    "messages": "the counts of forwarded messages agree with the report",
}


@dataclass(frozen=True, slots=True)
class Check:
    """Outcome of a check."""

    name: str
    # Number of values that were checked.
    checked: int
    # Number of violations, including those that are not kept.
    violations: int
    # Reason why nothing, or only a part, is checkable in this output.
    limit: str

    @property
    def outcome(self) -> str:
        """One of ok, violated, not checkable."""
        if self.violations:
            return "violated"
        return "ok" if self.checked else "not checkable"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The result for one output."""

    path: str
    # As in `convert --format`.
    format: str
    scans: int
    points: int
    # None where the format does not show columns.
    columns: int | None
    checks: tuple[Check, ...]
    violations: tuple[Violation, ...]

    @property
    def count(self) -> int:
        """All violations, also those that are not kept."""
        return sum(check.violations for check in self.checks)

    @property
    def ok(self) -> bool:
        """Whether there is no violation."""
        return self.count == 0


def outcomes(log: CheckLog, limits: dict[str, str]) -> tuple[Check, ...]:
    """All checks; limits: by check, why it is not or only partly checkable."""
    return tuple(
        Check(
            name,
            log.checked[name],
            log.failed[name],
            limits.get(name, "" if log.checked[name] else "no such data in this output"),
        )
        for name in CHECKS
    )
