"""`mlbatch.convert`: a run of the command line's `convert`, and its report."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from mlbatch.outputs.scan import preformatted
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.output import Output
from mlbatch.python.options import OutputOptions, output_job, output_request
from mlbatch.reports.ledger import SensorLedger
from mlbatch.reports.report import (
    RunReport,
    Section,
    SensorReport,
    build_report,
    summary_lines,
)
from mlbatch.reports.scan_table import ScanStatistics

# Of the caller of `mlbatch.convert`, as calls above that of `warnings.warn`.
_USER = 6


@dataclass(frozen=True, slots=True)
class SensorFigures:
    """A sensor in the report of a run; ledger: all its counts."""

    name: str
    model: str
    packets: int  # read
    lost: int  # packets
    rejected: Mapping[str, int]  # packets by reason
    columns: int  # written
    dropped: Mapping[str, int]  # columns by reason
    points: int  # written
    ledger: SensorLedger

    @classmethod
    def of(cls, sensor: SensorReport) -> SensorFigures:
        """The figures of one sensor."""
        ledger = sensor.ledger
        return cls(
            name=sensor.name,
            model=sensor.model,
            packets=ledger.packets.read,
            lost=ledger.packets.lost,
            rejected=dict(ledger.packets.rejected),
            columns=ledger.columns.written,
            dropped=dict(ledger.columns.dropped),
            points=ledger.points.written,
            ledger=ledger,
        )


@dataclass(frozen=True, slots=True)
class Report:
    """The report of a run; `content`: all of it."""

    content: RunReport

    @property
    def sensors(self) -> dict[str, SensorFigures]:
        """The sensors by name, in the order of `lidar_id`."""
        return {sensor.name: SensorFigures.of(sensor) for sensor in self.content.sensors}

    @property
    def scans(self) -> ScanStatistics:
        """Numbers of scans and points; spans and periods."""
        return self.content.scans

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings as `code: message`."""
        return tuple(f"{one.code}: {one.message}" for one in self.content.warnings)

    def as_json(self) -> Section:
        """The values of report.json."""
        return build_report(self.content)

    def __str__(self) -> str:
        """The summary that `mlbatch convert` prints."""
        return "\n".join(summary_lines(self.content))


@dataclass(frozen=True, slots=True, repr=False)
class Run:
    """A finished conversion; path: of its output, or of a map alone; None after a dry run."""

    path: Path | None
    report: Report
    report_path: Path | None

    def __repr__(self) -> str:
        """One line; `print(run.report)` prints all that the command does."""
        sensors = ", ".join(self.report.sensors)
        scans, warnings = self.report.scans, len(self.report.warnings)
        output = "dry run" if self.path is None else self.path.name
        return (
            f"<Run {output}: {scans.written} scans of {sensors}, {scans.points} points, "
            f"{warnings} warnings>"
        )

    def _repr_html_(self) -> str:
        return preformatted(self.report)


def run_job(job: Job, path: Path | None, options: OutputOptions) -> Run:
    """Convert to `path` (None: a dry run); the report is written as by the command."""
    request = output_request(path, options)
    request = request._replace(dry_run=path is None and request.accumulate is None)

    def warn(text: str) -> None:
        warnings.warn(text, stacklevel=_USER)

    output = Output(output_job(job, options), request, warn, warn)
    _, content = output.make()
    return Run(path or request.accumulate, Report(content), output.report_path)
