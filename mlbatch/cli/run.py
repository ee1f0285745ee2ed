"""Running a conversion: segments, progress, messages, summary, report.

Apart from `convert.py`, whose options are described without loading any of this.
"""

from __future__ import annotations

import shlex
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
from mlbatch.pipeline.conversion import Conversion, Progress
from mlbatch.pipeline.interrupts import interruptible
from mlbatch.pipeline.job import Job, TimeSegment
from mlbatch.pipeline.output import Output, OutputRequest
from mlbatch.reports.report import RunReport, report_of, report_text
from mlbatch.writers import report_paths
from mlbatch.writers.atomic import discard

# Loaded where it is needed: a dry run has no files.
if TYPE_CHECKING:
    from mlbatch.reports.limits import Limit


class Target(NamedTuple):
    """Where the result goes, and how much is printed."""

    request: OutputRequest
    prints_report: bool  # to standard output, without a summary
    html: Path | None  # page of the run
    html_scans: int | None  # see `Source`
    split_jumps: bool
    limits: tuple[Limit, ...]  # of `--fail-on`
    quiet: bool
    verbose: bool

    @property
    def written(self) -> Path | None:
        """The output, None in a dry run."""
        return self.request.written

    @property
    def map(self) -> Path | None:
        """The map, None without and in a dry run."""
        return None if self.request.dry_run else self.request.accumulate


def run(job: Job, target: Target) -> None:
    """Convert, write the report, print the summary; with `--on-jump split` each segment.

    Raises typer.Exit with code 3 after outputs that exceed limits of `--fail-on`.
    """
    with interruptible():
        beyond = _run_segments(job, target) if target.split_jumps else _run_one(job, target)
    exit_beyond(beyond)


# -- one output -------------------------------------------------------------------------------


def _run_one(job: Job, target: Target) -> list[str]:
    """Make one output; return one line for each limit of `--fail-on` that is exceeded."""
    if job.shard is not None:
        _check_shard(target)
    request = target.request
    output = Output(job, request, say, lambda text: say(f"warning: {text}"))
    if output.is_complete:
        return _beyond_limits_before(target, output.format)
    report_path = output.report_path
    _check_page(target, report_path, output.format)
    stages = ("clocks", "convert") if job.align_clocks_to else ("convert",)
    shown = not target.quiet
    with progress_bar(*stages, is_shown=shown, is_verbose=target.verbose) as progress:
        conversion, report = _made(output, progress)
    for note in conversion.notes:
        say(f"warning: {note.code}: {note.message}")
    if job.shard is not None and output.files is not None:
        if not target.quiet:
            number, count = job.shard.number, job.shard.count
            text = (
                f"wrote {target.written}: shard {number} of {count}, {output.files.scans} of "
                f"{output.files.total} scans, {report.scans.points} points; join all {count} with "
                "mlbatch merge"
            )
            typer.echo(one_line(text))
        return []
    _write_page(conversion, report, target)
    if target.prints_report or (request.dry_run and report_path is None):
        # One line per segment: several JSON documents in a row are no document.
        typer.echo(report_text(report, in_a_line=target.split_jumps), nl=False)
    elif not target.quiet:
        _print_summary(conversion, report, target, report_path)
    if not target.limits:
        return []
    # Not loaded without limits.
    from mlbatch.reports.limits import exceeded, not_covered

    for gap in not_covered(target.limits, report):
        say(f"limit not tested: {gap}")
    return exceeded(target.limits, report)


def _print_summary(
    conversion: Conversion, inputs: RunReport, target: Target, report_path: Path | None
) -> None:
    if target.verbose:
        _print_sensors(conversion)
    print_summary(inputs)
    if written := [str(path) for path in (target.written, target.map) if path is not None]:
        typer.echo(one_line(f"wrote {' and '.join(written)}, report {report_path}"))
    if target.written is not None:
        name = shlex.quote(str(target.written))
        page = f"mlbatch report {name} makes the page"
        if target.html is not None:
            page = f"the page is {target.html}"
        typer.echo(one_line(f"{page}, mlbatch view {name} plays the scans"))


def _beyond_limits_before(target: Target, name: str) -> list[str]:
    """One line per exceeded limit in the output of an earlier run; name: of the format."""
    if not target.limits or target.request.output is None:
        return []
    from mlbatch.reports.limits import exceeded

    path = target.request.report or report_paths(target.request.output, name).report
    try:
        return exceeded(target.limits, RunReport.from_json(parse_json(read_text(path))))
    except (OSError, ValueError) as err:
        raise ExportError(
            f"{path}: expected the report of the complete output for --fail-on, found "
            f"{getattr(err, 'strerror', None) or 'no JSON'!r}; give its path by --report"
        ) from err


def _made(output: Output, progress: Progress | None) -> tuple[Conversion, RunReport]:
    """Make an output; errors that leave a resumable one mention `--resume`."""
    files = output.files
    try:
        return output.make(progress)
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


def _check_shard(target: Target) -> None:
    """Refuse options that have no meaning for a shard."""
    given = {
        "--dry-run": target.request.dry_run,
        "--report": target.request.report is not None or target.prints_report,
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
    own = [path for path in (report_path, target.map) if path is not None]
    if target.written is not None:
        own.append(report_paths(target.written, name).scans_csv)
    if page in [path.absolute() for path in own]:
        raise ExportError(
            f"{target.html}: expected a page apart from the output, its table and report, found "
            "the name of one of them; choose another"
        )
    check_page(target.html, overwrite=target.request.overwrite or target.request.resume)


def _write_page(conversion: Conversion, inputs: RunReport, target: Target) -> None:
    if target.html is None:
        return
    # Not loaded for runs without a page.
    from mlbatch.page import write_page
    from mlbatch.page.source import Source

    report = report_of(target.html, report_text(inputs))
    table = None if conversion.table is None else conversion.table.text()
    write_page(
        target.html,
        Source(
            *(report, table, target.written, target.html, target.html_scans),
            report_path=target.request.report,
        ),
    )


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

    Returns one line for each limit of `--fail-on` that is exceeded.
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
            if target.request.resume:
                # The end of the segment is needed first: complete segments are not made again.
                for _ in Conversion(one).windows():
                    pass
            label = "" if is_whole else f"segment {number}: "
            beyond += [f"{label}{line}" for line in _run_one(one, own_target)]
            outputs += 1
        except ClockJump as jump:
            if jump.host_ns <= (segment.begin_ns or 0):
                raise
            say(f"segment {number} ends where {jump}")
            segment = TimeSegment(segment.begin_ns, jump.host_ns)
            if own_target.written is not None and (is_whole or not target.request.resume):
                # Outputs of segments have other names.
                discard(own_target.written)
            if own_target.map is not None:
                discard(own_target.map)
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


def _numbered(target: Target, number: int) -> Target:
    """The target of a segment: scans.seg2.mcap, scans.seg2."""
    request = target.request._replace(
        output=_with_number(target.request.output, number, ".mcap", ".bag"),
        report=_with_number(target.request.report, number, ".json"),
        accumulate=_with_number(target.map, number, target.map.suffix if target.map else ""),
    )
    return target._replace(request=request, html=_with_number(target.html, number, ".html"))


def _with_number(path: Path | None, number: int, *suffixes: str) -> Path | None:
    if path is None:
        return None
    suffix = path.suffix if path.suffix.lower() in suffixes else ""
    return path.with_name(f"{path.name.removesuffix(suffix)}.seg{number}{suffix}")
