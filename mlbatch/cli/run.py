"""Running a conversion from the command line: progress, summary, report."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import typer

from mlbatch.cli import interrupted
from mlbatch.errors import ClockJump, Interrupted, MlbatchError, NoScanError, one_line
from mlbatch.pipeline import preflight
from mlbatch.pipeline.conversion import Conversion, Progress
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.resume import ResumeLog
from mlbatch.pipeline.run import Last, OpenWriter, convert
from mlbatch.pipeline.segments import Part
from mlbatch.report.report import ReportInputs, report_text, summary_lines
from mlbatch.types import RunInfo
from mlbatch.writers import (
    ScanWriter,
    WriterOptions,
    check_compression,
    check_target,
    choose_format,
    extras,
    open_writer,
    report_paths,
    write_text,
)


@dataclass(frozen=True, slots=True)
class Wanted:
    """Where the result goes and how much is said about it."""

    output: Path | None
    format: str | None
    point_layout: str
    compression: str
    dry_run: bool
    report: Path | None
    splits_jumps: bool
    overwrite: bool
    resume: bool
    quiet: bool
    verbose: bool


def run(job: Job, wanted: Wanted) -> None:
    """Convert, write the report, print the summary; with `--on-jump split` part by part."""
    with interrupted.by_termination():
        if wanted.splits_jumps:
            _run_parts(job, wanted)
        else:
            _convert(job, wanted)


def _run_parts(job: Job, wanted: Wanted) -> None:
    """Convert each stretch between clock jumps; a jump is found where a part runs into it."""
    if job.faults:
        # Times of faults count from the start of the session, in all parts of it.
        job = replace(job, fault_begin_ns=Conversion(job).session.begin_ns)
    number, part, scans = 1, Part(), 0
    while True:
        # Without a jump there is one part, which needs no number.
        alone = part == Part()
        now, named = replace(job, part=part), wanted if alone else _numbered(wanted, number)
        try:
            interrupted.refuse_jump(now, resume=wanted.resume)
            _convert(now, named)
            scans += 1
        except ClockJump as jump:
            if jump.host_ns <= (part.begin_ns or 0):
                raise
            typer.echo(f"mlbatch: part {number} ends where {jump}", err=True)
            part = Part(part.begin_ns, jump.host_ns)
            if alone or not wanted.resume:
                interrupted.discard(None if wanted.dry_run else named.output)
            continue
        except NoScanError as err:
            if alone:
                raise
            typer.echo(f"mlbatch: warning: part {number}: {err}", err=True)
        if part.end_ns is None:
            break
        number, part = number + 1, Part(part.end_ns)
    if not scans:
        raise NoScanError(f"none of {number} parts between clock jumps holds a whole window")


def _numbered(wanted: Wanted, number: int) -> Wanted:
    """The same with names of a part: scans.seg2.mcap, scans.seg2."""
    return replace(
        wanted,
        output=_of_part(wanted.output, number, ".mcap", ".bag"),
        report=_of_part(wanted.report, number, ".json"),
    )


def _of_part(path: Path | None, number: int, *suffixes: str) -> Path | None:
    if path is None:
        return None
    suffix = path.suffix if path.suffix.lower() in suffixes else ""
    return path.with_name(f"{path.name.removesuffix(suffix)}.seg{number}{suffix}")


def _convert(job: Job, wanted: Wanted) -> None:
    opener, report_path, course = None, wanted.report, None
    # A dry run without an output decodes what a .mcap of this point layout would hold.
    name = choose_format(wanted.output or Path("scans.mcap"), wanted.format)
    options = WriterOptions(
        wanted.point_layout, wanted.overwrite, job.split, compression=wanted.compression
    )
    check_compression(name, options)
    job = replace(job, extras=extras(name, options))
    if wanted.output is not None and not wanted.dry_run:
        preflight.place(job, wanted.output, name)
        if wanted.resume and interrupted.is_complete(wanted.output, overwrite=wanted.overwrite):
            return
        course = interrupted.course(job, wanted.output, name, options, resume=wanted.resume)
        options = replace(options, kept_bytes=course.kept_bytes)
        if options.kept_bytes is None:
            check_target(name, wanted.output, options, job.layout)
            preflight.disk(job, wanted.output)
        opener = _opener(name, wanted.output, options)
        report_path = report_path or report_paths(wanted.output, name).report
    preflight.report(job, report_path, None if wanted.dry_run else wanted.output, name)
    with _progress(wanted.quiet) as progress:
        conversion, inputs = _converted(job, opener, progress, course, _last(wanted, report_path))
    for note in conversion.notes:
        typer.echo(one_line(f"mlbatch: warning: {note.code}: {note.message}"), err=True)
    if opener is None and report_path is not None:
        write_text(report_path, report_text(inputs))
    elif wanted.dry_run and report_path is None:
        # Of several parts each is a line, since documents one after the other are none.
        typer.echo(report_text(inputs, in_a_line=wanted.splits_jumps), nl=False)
        return
    if not wanted.quiet:
        if wanted.verbose:
            _tell(conversion)
        for line in summary_lines(inputs):
            if not line.startswith("warning "):
                typer.echo(one_line(line))
        if wanted.output is not None and not wanted.dry_run:
            typer.echo(f"wrote {wanted.output}, report {report_path}")


def _converted(
    job: Job,
    opener: OpenWriter | None,
    progress: Progress | None,
    course: ResumeLog | None,
    last: Last,
) -> tuple[Conversion, ReportInputs]:
    try:
        return convert(job, opener, progress, course, last)
    except MlbatchError as err:
        told = interrupted.with_advice(err, course)
        if told is err:
            raise
        raise told from err
    except KeyboardInterrupt as err:
        # Of a run that writes nothing, or nothing so far, there is no more to say.
        if course is None or not course.recorded:
            raise
        raise Interrupted(
            "interrupted; what was written stays under .partial, where --resume goes on"
        ) from err


def _last(wanted: Wanted, report_path: Path | None) -> Last:
    """The report comes before the output has its name, so that no output is without."""

    def write(inputs: ReportInputs, partial: Path) -> None:
        if report_path is None or wanted.output is None:
            return
        inside = report_path.parent.absolute() == wanted.output.absolute()
        write_text(partial / report_path.name if inside else report_path, report_text(inputs))

    return write


def _opener(name: str, target: Path, options: WriterOptions) -> OpenWriter:
    def start(info: RunInfo) -> ScanWriter:
        return open_writer(name, target, info, options)

    return start


def _tell(conversion: Conversion) -> None:
    for sensor in conversion.sensors:
        lidar = sensor.lidar
        # Topics name calibrations and frames, and may be named anything.
        typer.echo(
            one_line(
                f"{sensor.name}: {lidar.model} {lidar.mode}, calibration {lidar.calibration}, "
                f"extrinsics from {sensor.detected.pose.describe()}"
            )
        )
    typer.echo(f"decoded by {conversion.session.engine}")


@contextlib.contextmanager
def _progress(quiet: bool) -> Iterator[Progress | None]:
    """A progress bar with rate and remaining time, on a terminal only."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        DownloadColumn,
        TimeRemainingColumn,
        TransferSpeedColumn,
    )
    from rich.progress import (
        Progress as Bar,
    )

    with Bar(
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    ) as bar:
        task = bar.add_task("convert", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
