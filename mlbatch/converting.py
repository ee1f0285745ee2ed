"""A conversion with its writer: every scan is written, or nothing under a final name."""

from __future__ import annotations

import time
from collections.abc import Callable

from mlbatch import accounts
from mlbatch.errors import RecordingError
from mlbatch.job import Job
from mlbatch.pipeline import Conversion, Progress
from mlbatch.report import ReportInputs, imbalances, report_text
from mlbatch.types import RunInfo, Summary
from mlbatch.writers import ScanWriter

OpenWriter = Callable[[RunInfo], ScanWriter]


def convert(
    job: Job,
    open_writer: OpenWriter | None,
    progress: Progress | None = None,
) -> tuple[Conversion, ReportInputs]:
    """Run a job; open_writer None is a dry run. Gives the run and what its report is made of."""
    run = Conversion(job)
    writer: ScanWriter | None = None
    try:
        for scan, only in run.scans(progress):
            began_s = time.perf_counter()
            if writer is None and open_writer is not None:
                writer = open_writer(scan.info)
            run.hand_over(writer, scan.end_ns)
            if writer is not None:
                writer.write(scan, only)
            run.stages.write_s += time.perf_counter() - began_s
        began_s = time.perf_counter()
        run.hand_over(writer, None)
        run.tell_of_passed()
        inputs = accounts.report_inputs(run)
        broken = imbalances(inputs)
        if broken:
            raise RecordingError(f"the ledger does not balance, please report: {broken[0]}")
        if writer is not None:
            table = run.table.text() if run.table is not None else ""
            report = report_text(inputs, machine=False)
            writer.finish(Summary(run.batcher.t_init_ns, report, table))
            writer = None
            run.stages.write_s += time.perf_counter() - began_s
            inputs = accounts.report_inputs(run)
    finally:
        if writer is not None:
            writer.abandon()
    return run, inputs
