"""Running a conversion: segments, progress, messages, summary, report.

Apart from `convert.py`, whose options are described without loading any of this.
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import typer

from mlbatch.bounded import parse_json, read_text
from mlbatch.cli.progress import progress_bar
from mlbatch.cli.summary import exit_beyond, print_summary, say
from mlbatch.errors import (
    ClockJump,
    ExportError,
    Interrupted,
    NoScanError,
    RecordingError,
    UsageError,
    one_line,
)
from mlbatch.pipeline import preflight
from mlbatch.pipeline.conversion import Conversion, Progress
from mlbatch.pipeline.interrupts import interruptible
from mlbatch.pipeline.job import Job, TimeSegment
from mlbatch.pipeline.run import Last, OpenWriter, convert
from mlbatch.report.report import RunReport, build_report, report_text
from mlbatch.types import RunInfo
from mlbatch.writers import (
    FILES_JSONL,
    SHARD_JSON,
    FilesWriter,
    ScanWriter,
    WriterOptions,
    check_options,
    check_target,
    check_variants,
    choose_format,
    discard,
    export_errors,
    extras,
    jobs_for,
    open_writer,
    partial_path,
    record_layout,
    report_paths,
    state_path,
    sync_entries,
    tidy,
    write_text,
)

# Loaded where it is needed: a dry run has no files.
if TYPE_CHECKING:
    from mlbatch.pipeline.files import Files
    from mlbatch.pipeline.shards import Shard
    from mlbatch.report.limits import Limit


class Target(NamedTuple):
    """Where the result goes, and how much is printed."""

    output: Path | None
    format: str | None
    point_layout: str
    compression: str
    ply_style: str
    dry_run: bool
    jobs: int | None  # None: auto
    report: Path | None
    prints_report: bool  # to standard output, without a summary
    html: Path | None  # page of the run
    split_jumps: bool
    limits: tuple[Limit, ...]  # of `--fail-on`
    overwrite: bool
    resume: bool
    fsync: bool
    quiet: bool
    verbose: bool

    @property
    def written(self) -> Path | None:
        """The output, None in a dry run."""
        return None if self.dry_run else self.output


def run(job: Job, target: Target) -> None:
    """Convert, write the report, print the summary; with `--on-jump split` each segment.

    Raises typer.Exit with code 3 after outputs that exceed limits of `--fail-on`.
    """
    with interruptible():
        beyond = _run_segments(job, target) if target.split_jumps else _run_one(job, target)
    exit_beyond(beyond)


# -- one output -------------------------------------------------------------------------------


def _run_one(job: Job, target: Target) -> list[str]:
    """Make one output; returns what exceeds limits of `--fail-on`, a line each."""
    name = choose_format(target.output, target.format)
    options = WriterOptions(
        target.point_layout,
        target.overwrite,
        job.split,
        compression=target.compression,
        ply_style=target.ply_style,
        fsync=target.fsync,
        max_bag_s=job.max_bag_s,
    )
    check_options(name, options)
    check_variants(name, job.variants)
    if job.shard is not None:
        _check_shard(target, name, options)
    jobs = jobs_for(target.jobs, name, options) if not target.dry_run else target.jobs or 1
    job = replace(job, extras=extras(name, options), jobs=jobs)
    report_path = target.report
    open_output: OpenWriter | None = None
    files = None
    if target.written is not None:
        job = replace(job, record=record_layout(name, options))
        output = target.written
        preflight.check_output(job, output, name)
        if target.resume and _is_complete(job, output, target, name, options):
            return _beyond_limits_before(target, name)
        files = _files(job, output, name, options, resumes=target.resume)
        options = options._replace(files=files)
        if not files.is_continued:
            check_target(name, output, options, job.layout)
            if warning := preflight.check_disk(job, output):
                say(f"warning: {warning}")
        open_output = _opener(name, output, options, files)
        if job.shard is None:
            report_path = report_path or report_paths(output, name).report
    preflight.check_report(job, report_path, target.written, name)
    _check_page(target, report_path, name)
    stages = ("clocks", "convert") if job.align_clocks_to else ("convert",)
    shown = not target.quiet
    with progress_bar(*stages, is_shown=shown, is_verbose=target.verbose) as progress:
        last = None if files is None else _last(target, report_path, name, options, files)
        conversion, inputs = _converted(job, open_output, progress, files, last)
    inputs = _of_job(inputs, files)
    for note in conversion.notes:
        say(f"warning: {note.code}: {note.message}")
    if job.shard is not None and files is not None:
        if not target.quiet:
            _print_shard(job.shard, files, inputs, target)
        return []
    _write_page(conversion, inputs, target)
    if open_output is None and report_path is not None:
        write_text(report_path, report_text(inputs))
    if target.prints_report or (target.dry_run and report_path is None):
        # One line a segment: several JSON documents in a row are no document.
        typer.echo(report_text(inputs, in_a_line=target.split_jumps), nl=False)
    elif not target.quiet:
        _print_summary(conversion, inputs, target, report_path)
    if not target.limits:
        return []
    # Not loaded without limits.
    from mlbatch.report.limits import exceeded

    return exceeded(target.limits, build_report(inputs))


def _print_summary(
    conversion: Conversion, inputs: RunReport, target: Target, report_path: Path | None
) -> None:
    if target.verbose:
        _print_sensors(conversion)
    print_summary(inputs)
    if target.written is not None:
        typer.echo(one_line(f"wrote {target.written}, report {report_path}"))


def _beyond_limits_before(target: Target, name: str) -> list[str]:
    """What exceeds limits in the output that an earlier run completed; name: of the format."""
    if not target.limits or target.output is None:
        return []
    from mlbatch.report.limits import exceeded

    path = target.report or report_paths(target.output, name).report
    try:
        return exceeded(target.limits, parse_json(read_text(path)))
    except (OSError, ValueError) as err:
        raise ExportError(
            f"{path}: expected the report of the complete output for --fail-on, found "
            f"{getattr(err, 'strerror', None) or 'no JSON'!r}; give its path by --report"
        ) from err


def _converted(
    job: Job,
    open_output: OpenWriter | None,
    progress: Progress | None,
    files: Files | None,
    last: Last | None,
) -> tuple[Conversion, RunReport]:
    """Run a job; errors that leave a resumable output mention `--resume`."""
    try:
        return convert(job, open_output, progress, files, last)
    except (ExportError, RecordingError) as err:
        # A subclass has another cause than the disk.
        is_disk = isinstance(err.__cause__, OSError) and type(err) in (ExportError, RecordingError)
        if files is None or not files.is_resumable or not is_disk:
            raise
        advice = f"then --resume continues after the {files.scans} scans that are safe"
        raise type(err)(f"{err}; {advice}") from err
    except KeyboardInterrupt as err:
        if files is None or not files.is_resumable:
            raise
        raise Interrupted(
            "interrupted; finished scans are kept in .partial, from where --resume continues"
        ) from err
    finally:
        for line in () if files is None else files.changed:
            say(line)


def _check_shard(target: Target, name: str, options: WriterOptions) -> None:
    """Refuse options that have no meaning for a shard; name: of the format."""
    from mlbatch.pipeline.shards import check_format

    given = {
        "--dry-run": target.dry_run,
        "--report": target.report is not None or target.prints_report,
        "--html": target.html is not None,
        "--fail-on": bool(target.limits),
        "--on-jump split": target.split_jumps,
    }
    for option, is_given in given.items():
        if is_given:
            raise UsageError(
                f"--shard: expected no {option}, since a shard has a part of the points and no "
                f"report, found both; leave {option} out, see mlbatch merge"
            )
    check_format(name, options)


def _print_shard(shard: Shard, files: Files, inputs: RunReport, target: Target) -> None:
    """Print what a shard has written."""
    typer.echo(
        one_line(
            f"wrote {target.written}: shard {shard.number} of {shard.count}, {files.scans} of "
            f"{files.total} scans, {inputs.scans.points} points; join all {shard.count} with "
            "mlbatch merge"
        )
    )


def _last(
    target: Target, report_path: Path | None, name: str, options: WriterOptions, files: Files
) -> Last:
    """Writes what an output has in the end: the report, or the account of a shard.

    Before the output has its name, so that no output is without one.
    """

    def write(inputs: RunReport, partial: Path) -> None:
        inputs = _of_job(inputs, files)
        if files.is_shard:
            from mlbatch.pipeline.shards import write_account

            write_account(partial, name, options, files, inputs)
            return
        if report_path is None or target.output is None:
            return
        is_inside = report_path.parent.absolute() == target.output.absolute()
        path = partial / report_path.name if is_inside else report_path
        write_text(path, report_text(inputs), target.fsync)
        if target.fsync and path.parent.absolute() != target.output.parent.absolute():
            sync_entries(path.parent)

    return write


def _of_job(inputs: RunReport, files: Files | None) -> RunReport:
    """The report with the command line and, of an output, what made it."""
    inputs = inputs._replace(command=_command())
    if files is None or files.is_shard:
        return inputs
    from mlbatch.pipeline.job_identity import identity_of_parts

    return inputs._replace(identity=identity_of_parts(files.identity))


def _command() -> str:
    """The command line, as typed into a shell."""
    return shlex.join(["mlbatch", *sys.argv[1:]])


def _check_page(target: Target, report_path: Path | None, name: str) -> None:
    """Refuse a page that cannot be written, before the run; name: of the output's format."""
    if target.html is None:
        return
    from mlbatch.page import check_page

    page = target.html.absolute()
    if target.written is not None and target.written.absolute() in (page, *page.parents):
        raise ExportError(
            f"{target.html}: expected a page outside the output, found one in {target.written}; "
            "choose another name"
        )
    own = [] if report_path is None else [report_path]
    if target.written is not None:
        own.append(report_paths(target.written, name).scans_csv)
    if page in [path.absolute() for path in own]:
        raise ExportError(
            f"{target.html}: expected a page apart from the output, its table and report, found "
            "the name of one of them; choose another"
        )
    check_page(target.html, overwrite=target.overwrite or target.resume)


def _write_page(conversion: Conversion, inputs: RunReport, target: Target) -> None:
    if target.html is None:
        return
    # Not loaded for runs without a page.
    from mlbatch.page import write_page
    from mlbatch.page.source import Source, read_report

    report = read_report(target.html, report_text(inputs))
    table = None if conversion.table is None else conversion.table.text()
    write_page(target.html, Source(report, table, target.written, target.html))


def _opener(name: str, output: Path, options: WriterOptions, files: Files) -> OpenWriter:
    def start(info: RunInfo) -> ScanWriter:
        if files.is_continued:
            # Only now it is known that this is the job of the interrupted run.
            say(f"{output}: resumed after {files.scans} scans")
        writer = open_writer(name, output, info, options)
        if files.is_shard and not isinstance(writer, FilesWriter):
            from mlbatch.pipeline.shards import not_in_files

            writer.abandon()
            raise not_in_files(name)
        return writer

    return start


def _print_sensors(conversion: Conversion) -> None:
    """Print what was found and chosen (`--verbose`)."""
    for sensor in conversion.sensors:
        lidar = sensor.lidar
        # Calibrations and frames may be named by topics, with any character.
        typer.echo(
            one_line(
                f"{sensor.name}: {lidar.model} {lidar.mode}, calibration {lidar.calibration}, "
                f"extrinsics from {sensor.detected.pose.describe()}"
            )
        )


# -- segments between clock steps -------------------------------------------------------------


def _run_segments(job: Job, target: Target) -> list[str]:
    """Convert each segment between clock steps; a step is found when a segment reaches it.

    Returns what exceeds limits of `--fail-on`, a line each.
    """
    beyond = []
    if job.faults:
        # Times of faults count from the start of the session, in all segments.
        job = replace(job, fault_begin_ns=Conversion(job).session.begin_ns)
    number = 1
    outputs = 0
    segment = TimeSegment()
    while True:
        # Without a clock step there is one segment, and its output has no number.
        is_whole = segment == TimeSegment()
        one = replace(job, segment=segment)
        own_target = target if is_whole else _numbered(target, number)
        try:
            if target.resume:
                # The end of the segment is needed first: complete segments are not made again.
                _refuse_jump(one)
            label = "" if is_whole else f"segment {number}: "
            beyond += [f"{label}{line}" for line in _run_one(one, own_target)]
            outputs += 1
        except ClockJump as jump:
            if jump.host_ns <= (segment.begin_ns or 0):
                raise
            say(f"segment {number} ends where {jump}")
            segment = TimeSegment(segment.begin_ns, jump.host_ns)
            if own_target.written is not None and (is_whole or not target.resume):
                # Outputs of segments have other names.
                discard(own_target.written)
            continue
        except NoScanError as err:
            if is_whole:
                raise
            say(f"warning: segment {number}: {err}")
        if segment.end_ns is None:
            break
        number += 1
        segment = TimeSegment(segment.end_ns)
    if not outputs:
        raise NoScanError(
            f"expected a whole window between two clock steps, found none in {number} segments; "
            "write partial ones with --keep-partial"
        )
    return beyond


def _refuse_jump(job: Job) -> None:
    """Raise the first clock step in the session of a job; nothing is decoded."""
    for _ in Conversion(job).windows():
        pass


def _numbered(target: Target, number: int) -> Target:
    """The target of a segment: scans.seg2.mcap, scans.seg2."""
    return target._replace(
        output=_with_number(target.output, number, ".mcap", ".bag"),
        report=_with_number(target.report, number, ".json"),
        html=_with_number(target.html, number, ".html"),
    )


def _with_number(path: Path | None, number: int, *suffixes: str) -> Path | None:
    if path is None:
        return None
    suffix = path.suffix if path.suffix.lower() in suffixes else ""
    return path.with_name(f"{path.name.removesuffix(suffix)}.seg{number}{suffix}")


# -- interrupted runs -------------------------------------------------------------------------


def _is_complete(job: Job, output: Path, target: Target, name: str, options: WriterOptions) -> bool:
    """True if an earlier run of this job completed the output: there is nothing to resume.

    UsageError if another job made the output, ExportError if files of it are missing; name: of the
    format.
    """
    from mlbatch.pipeline.files import missing

    if target.overwrite or not output.exists() or partial_path(output).exists():
        return False
    changed = _difference_of_output(job, output, target, name, options)
    if changed:
        raise UsageError(
            f"{output}: expected the complete output of this job for --resume, found {changed}; "
            "choose another output, or replace this one with --overwrite"
        )
    lost = missing(output, job, name, options)
    if lost:
        raise ExportError(
            f"{output}: expected all files of the complete output for --resume, found {len(lost)} "
            f"missing, first {lost[0]}; restore it, or make all again with --overwrite"
        )
    tidy(output)
    say(f"{output}: is complete; there is nothing to resume")
    return True


def _difference_of_output(
    job: Job, output: Path, target: Target, name: str, options: WriterOptions
) -> str:
    """First difference between a job and the one that made an output, "" if there is none.

    Outputs that do not say which job made them have none.
    """
    from mlbatch.pipeline.job_identity import difference_of_outputs, identity_of, read_identity

    is_shard = (output / SHARD_JSON).is_file()
    if is_shard != (job.shard is not None):
        return f"a shard ({SHARD_JSON})" if is_shard else "all of its scans, not those of a shard"
    report = target.report or report_paths(output, name).report
    identity = read_identity(report if job.shard is None else output / SHARD_JSON)
    own = {} if job.shard is None else {"shard": str(job.shard)}
    return (
        difference_of_outputs(identity, identity_of(job, name, options) | own) if identity else ""
    )


def _files(job: Job, output: Path, name: str, options: WriterOptions, *, resumes: bool) -> Files:
    """The files of an output: those of the interrupted run as well, or all from the start."""
    from mlbatch.pipeline.files import Files, find

    partial = partial_path(output)
    old = state_path(output)
    if old.is_file():
        say(
            f"{old}: expected {FILES_JSONL} in {partial}, found the state file of an earlier "
            "version of mlbatch; it is removed, and all files are made again"
        )
        with export_errors(old):
            old.unlink()
    earlier = find(output)
    if earlier is not None and not resumes:
        say(
            f"warning: interrupted: {partial} with {earlier.scans} finished scans is "
            "discarded; --resume would continue after them"
        )
    files = Files(output, job, name, options, earlier if resumes else None)
    if resumes and not files.is_continued:
        say(f"{output}: nothing to resume; started over")
    return files
