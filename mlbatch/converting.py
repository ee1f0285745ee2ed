"""A conversion with its writer: every scan is written, or nothing under a final name."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from mlbatch import accounts
from mlbatch.errors import RecordingError
from mlbatch.job import Job
from mlbatch.pipeline import Conversion, Progress
from mlbatch.report import ReportInputs, imbalances, report_text
from mlbatch.resume import Course
from mlbatch.types import RunInfo, Summary
from mlbatch.writers import ScanWriter

OpenWriter = Callable[[RunInfo], ScanWriter]
# Given what the report is made of, and the complete output before it gets its final name.
Last = Callable[[ReportInputs, Path], None]


def convert(
    job: Job,
    open_writer: OpenWriter | None,
    progress: Progress | None = None,
    course: Course | None = None,
    last: Last | None = None,
) -> tuple[Conversion, ReportInputs]:
    """Run a job; open_writer None is a dry run. Gives the run and what its report is made of.

    course: of the output, so that an interrupted run can be resumed.
    """
    run = Conversion(job)
    if course is not None:
        course.join(run)
    writer: ScanWriter | None = None
    try:
        for number, (scan, only) in enumerate(run.scans(progress)):
            began_s = time.perf_counter()
            if writer is None and open_writer is not None:
                writer = open_writer(scan.info)
                if course is not None:
                    course.begin()
            run.hand_over(writer, scan.end_ns)
            if writer is not None and course is not None and number < course.done:
                writer.pass_over(scan, only)
            elif writer is not None:
                writer.write(scan, only)
            if writer is not None and course is not None:
                course.note(run, writer)
            run.stages.write_s += time.perf_counter() - began_s
        if course is not None:
            course.complete()
        inputs = _finish(run, writer, last)
        if course is not None:
            course.remove()
        writer = None
    finally:
        if writer is not None:
            writer.abandon()
            if course is not None:
                course.settle()
    return run, inputs


def _finish(run: Conversion, writer: ScanWriter | None, last: Last | None) -> ReportInputs:
    """Hand over what is left, close the ledgers and complete the output."""
    began_s = time.perf_counter()
    run.hand_over(writer, None)
    run.tell_of_passed()
    inputs = accounts.report_inputs(run)
    broken = imbalances(inputs)
    if broken:
        raise RecordingError(f"the ledger does not balance, please report: {broken[0]}")
    if writer is None:
        return inputs
    table = run.table.text() if run.table is not None else ""
    report = report_text(inputs, machine=False)

    def complete(partial: Path) -> None:
        nonlocal inputs
        run.stages.write_s += time.perf_counter() - began_s
        inputs = accounts.report_inputs(run)
        if last is not None:
            last(inputs, partial)

    writer.finish(Summary(run.batcher.t_init_ns, report, table), complete)
    return inputs
