"""`mlbatch.convert`: a run of the command line's `convert`, and its report."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from mlbatch.options import INSTANTS
from mlbatch.pipeline import preflight
from mlbatch.pipeline.files import Files
from mlbatch.pipeline.job import Job, check_max_bag_s
from mlbatch.pipeline.job_identity import identity_of_parts
from mlbatch.pipeline.run import convert
from mlbatch.python.options import OutputOptions, choice, names_of, path_of
from mlbatch.report.ledger import SensorLedger
from mlbatch.report.report import (
    RunReport,
    Section,
    SensorReport,
    build_report,
    report_text,
    summary_lines,
)
from mlbatch.report.scan_table import ScanStatistics
from mlbatch.types import RunInfo
from mlbatch.writers import (
    ScanWriter,
    WriterOptions,
    check_options,
    check_target,
    check_variants,
    choose_format,
    extras,
    jobs_for,
    open_writer,
    parse_jobs,
    record_layout,
    report_paths,
    sync_entries,
    write_text,
)


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


@dataclass(frozen=True, slots=True)
class Run:
    """A finished conversion; path: of its output, None after a dry run."""

    path: Path | None
    report: Report
    report_path: Path | None


def run_job(job: Job, output: Path | None, options: OutputOptions) -> Run:
    """Convert to `output` (None: a dry run); the report is written as by the command."""
    asked = parse_jobs("jobs", str(options.get("jobs", "auto")))
    report = path_of("report", options.get("report"))
    name = choose_format(output, options.get("format"))
    job = replace(
        job,
        passed=names_of(options.get("copy_topics", ())),
        stamp=choice("stamp", options.get("stamp", INSTANTS[0]), INSTANTS),
        max_bag_s=check_max_bag_s("max_bag_duration", options.get("max_bag_duration", 0.0)),
    )
    writer_options = WriterOptions(
        options.get("point_layout", "standard"),
        options.get("overwrite", False),
        job.split,
        compression=options.get("compression", "none"),
        ply_style=options.get("ply_style", "standard"),
        fsync=options.get("fsync", True),
        max_bag_s=job.max_bag_s,
    )
    check_options(name, writer_options)
    check_variants(name, job.variants)
    jobs = jobs_for(asked, name, writer_options) if output is not None else asked or 1
    job = replace(job, extras=extras(name, writer_options), jobs=jobs)
    if output is None:
        preflight.check_report(job, report, None, name)
        _, content = convert(job, None)
        if report is not None:
            write_text(report, report_text(content))
        return Run(None, Report(content), report)
    preflight.check_output(job, output, name)
    job = replace(job, record=record_layout(name, writer_options))
    files = Files(output, job, name, writer_options, None)
    writer_options = writer_options._replace(files=files)
    check_target(name, output, writer_options, job.layout)
    if shortage := preflight.check_disk(job, output):
        warnings.warn(shortage, stacklevel=3)
    report_path = report or report_paths(output, name).report
    preflight.check_report(job, report_path, output, name)
    is_inside = report_path.parent.absolute() == output.absolute()

    def opener(info: RunInfo) -> ScanWriter:
        return open_writer(name, output, info, writer_options)

    def write_report(content: RunReport, partial: Path) -> None:
        path = partial / report_path.name if is_inside else report_path
        content = content._replace(identity=identity_of_parts(files.identity))
        write_text(path, report_text(content), writer_options.fsync)
        if writer_options.fsync and path.parent.absolute() != output.parent.absolute():
            sync_entries(path.parent)

    _, content = convert(job, opener, None, files, write_report)
    return Run(output, Report(content), report_path)
