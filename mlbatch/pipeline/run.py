"""A conversion with its output: every scan is written, or nothing under a final name.

One thread reads, batches and decodes, another writes. With `--jobs N` one thread reads and batches,
and N decode and write, a scan each.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mlbatch.errors import NoScanError, RecordingError
from mlbatch.pipeline import run_report
from mlbatch.pipeline.conversion import Conversion, Progress, SkippedWindow
from mlbatch.pipeline.decode_pool import Decoded, DecodeTask, DecodeWorker
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.workers import OrderedWorkers, run_inline
from mlbatch.reports.report import RunReport, fill_totals, imbalances, report_text
from mlbatch.types import ImuSamples, Message, RunInfo, Summary
from mlbatch.units import NS_PER_S
from mlbatch.writers.base import FilesWriter, ScanJob, ScanWriter

if TYPE_CHECKING:
    from mlbatch.pipeline.files import Files, FinishedScan

OpenWriter = Callable[[RunInfo], ScanWriter]
# Called with the content of the report and the complete output, before that gets its final name.
Last = Callable[[RunReport, Path], None]
# Decode-ahead depth (scans) of the one thread that decodes.
_AHEAD = 2
# Tasks that wait for several threads.
_WAITING = 2
# Messages that are taken from their queue and written at a time.
_PORTION_BYTES = 1 << 18
# How often a dry run counts what it would pass through, in time of scans.
_DRY_NS = NS_PER_S


def convert(
    job: Job,
    open_writer: OpenWriter | None,
    progress: Progress | None = None,
    files: Files | None = None,
    last: Last | None = None,
    map_writer: ScanWriter | None = None,
) -> tuple[Conversion, RunReport]:
    """Run a job; returns the run and the content of its report.

    open_writer: of scans, None without; files: of the output; map_writer: of `--accumulate`.
    """
    # One scan more than are waiting to be written: the one that is being decoded.
    decodes_ahead = job.jobs == 1 and not (open_writer is None and map_writer is None)
    run = Conversion(job, buffers=_AHEAD + 1 if decodes_ahead else 1, progress=progress)
    _return_freed_memory()
    if files is not None:
        files.join(run)
    output = _Output(run, open_writer, files)
    output.writers += [] if map_writer is None else [map_writer]
    try:
        output.make(progress)
        run.close()
        if files is not None:
            files.complete()
        inputs = _finish(run, output.writers, last)
        output.writers = []
    except NoScanError:
        if output.abandon() and files is not None:
            files.discard()
        raise
    finally:
        output.abandon()
        if files is not None:
            files.close()
    return run, inputs


class _Output:
    """The output under construction.

    writers: of scans, from the first one on, and of a map; none in a dry run; files: of the output,
    None in a dry run; idle: decode workers not in use.
    """

    def __init__(
        self, run: Conversion, open_writer: OpenWriter | None, files: Files | None
    ) -> None:
        self.writers: list[ScanWriter] = []
        self.run = run
        self.files = files
        self.idle: list[DecodeWorker] = []
        self._open_writer = open_writer
        self._is_begun = False
        # Up to where IMU samples and messages were passed through.
        self._passed_ns = 0

    def make(self, progress: Progress | None) -> None:
        """Decode and write all scans."""
        run = self.run
        jobs = run.job.jobs
        ahead = _AHEAD if jobs == 1 else jobs + _WAITING
        with (
            contextlib.closing(run.tasks(progress)) as tasks,
            OrderedWorkers[ScanTask](jobs, ahead) as workers,
        ):
            for scan_task in itertools.chain.from_iterable(map(self._scan_tasks, tasks)):
                if jobs == 1:
                    scan_task.decode_with(run.pool.workers[0])
                if jobs == 1 and not self.writers:
                    # Nothing to write that another thread could do meanwhile.
                    run_inline(scan_task)
                else:
                    workers.put(scan_task)
            workers.finish()

    def _scan_tasks(self, item: DecodeTask | SkippedWindow) -> Iterator[ScanTask]:
        """The task of a scan with the messages before it; many messages are tasks of their own."""
        task = None if isinstance(item, SkippedWindow) else item
        before: Sequence[ImuSamples | Message] = ()
        # A dry run only counts messages, so it need not cut them at every window.
        if self._open_writer or self.writers or item.end_ns >= self._passed_ns + _DRY_NS:
            self._passed_ns = item.end_ns
            before = self.run.passed_through(item.end_ns, _PORTION_BYTES)
        # After nothing there is no more.
        while before and (rest := self.run.passed_through(item.end_ns, _PORTION_BYTES)):
            yield self._scan_task(None, before, task)
            before = rest
        if task is not None or before:
            yield self._scan_task(task, before, task)

    def _scan_task(
        self,
        task: DecodeTask | None,
        before: Sequence[ImuSamples | Message],
        following: DecodeTask | None,
    ) -> ScanTask:
        """following: of the scan that the messages precede, None if it is left out."""
        self._begin()
        kept = None if self.files is None else self.files.take(before, task)
        index = None if following is None else following.window.index
        return ScanTask(self, task, before, kept, index)

    def _begin(self) -> None:
        """Open the output, once the headers of its scans are known."""
        if self._is_begun:
            return
        self._is_begun = True
        self.idle.extend(self.run.pool.workers)
        if self._open_writer is not None and self.run.info is not None:
            writer = self._open_writer(self.run.info)
            self.writers.insert(0, writer)
            if self.files is not None and isinstance(writer, FilesWriter):
                self.files.begin()

    def abandon(self) -> bool:
        """Close an output that is not complete, if there is one; returns whether there was."""
        writers, self.writers = self.writers, []
        for writer in writers:
            writer.abandon()
        return bool(writers)


class ScanTask:
    """A scan from its raw columns into the output."""

    def __init__(
        self,
        output: _Output,
        task: DecodeTask | None,
        before: Sequence[ImuSamples | Message],
        kept: FinishedScan | None,
        index: int | None,
    ) -> None:
        """task: None where messages are to be written without a scan; before: what to write first.

        kept: the scan, if it is in a file of another run; index: of its window, None where no scan
        follows the messages.
        """
        self._output = output
        self._task = task
        self._before = before
        self._kept = kept
        self._index = index
        self._worker: DecodeWorker | None = None
        self._decoded: Decoded | None = None
        self._decode_s = 0.0
        self._write_s = 0.0
        # That of the scans comes first, and has the checksum.
        self._jobs = [ScanJob()]

    def decode_with(self, worker: DecodeWorker) -> None:
        """Decode in this thread, so that only writing is left for others."""
        if self._task is None:
            return
        began_s = time.perf_counter()
        files = self._output.files
        counts_points = files is not None and files.is_journaled
        self._decoded = worker.decode(self._task, counts_points=counts_points)
        self._decode_s += time.perf_counter() - began_s

    def decode(self) -> None:
        """Raw columns to points, points to the bytes of the output. Any thread."""
        if self._decoded is None and self._task is not None:
            self._worker = self._output.idle.pop()
            self.decode_with(self._worker)
        if self._output.writers:
            self._jobs = [self._writer_job(writer) for writer in self._output.writers]
        self._timed(lambda job: job.pack())

    def append(self) -> None:
        """Count the scan, write what precedes it, reserve its place in the output. In order."""
        if self._decoded is not None:
            scan = self._decoded.scan
            checksum = self._jobs[0].checksum if self._kept is None else self._kept.checksum
            files = self._output.files
            is_listed = files is None or files.is_listed(scan)
            self._output.run.account(scan, checksum, is_listed)
        if self._index is not None:
            for job in self._jobs:
                job.start(self._index)
        for item in self._before:
            _forward(item, self._output.writers)
        self._timed(lambda job: job.append())

    def compress(self) -> None:
        """Compress what is complete. Any thread."""
        self._timed(lambda job: job.compress())

    def commit(self) -> None:
        """Write what is complete; note the scan for its file. In order."""
        run, files = self._output.run, self._output.files
        if self._task is not None and self._decoded is not None and files is not None:
            scan, outcomes = self._decoded
            if self._kept is None:
                files.note(scan, self._task.only, outcomes, self._jobs[0].checksum)
        self._timed(lambda job: job.commit())
        run.stages.write_s += self._write_s
        run.stages.decode_s += self._decode_s
        if self._worker is not None:
            # Only now, since its arrays were read until here.
            self._output.idle.append(self._worker)

    def _writer_job(self, writer: ScanWriter) -> ScanJob:
        if self._task is None or self._decoded is None:
            return writer.flush()
        if self._kept is not None and isinstance(writer, FilesWriter):
            return writer.skip(self._decoded.scan, self._task.only)
        return writer.write(self._decoded.scan, self._task.only)

    def _timed(self, stage: Callable[[ScanJob], None]) -> None:
        began_s = time.perf_counter()
        for job in self._jobs:
            stage(job)
        self._write_s += time.perf_counter() - began_s


def _forward(item: ImuSamples | Message, writers: Sequence[ScanWriter]) -> None:
    """Write IMU samples or a message."""
    for writer in writers:
        if isinstance(item, Message):
            writer.write_message(item)
        else:
            writer.write_imu(item)


def _write_chunks(job: ScanJob) -> None:
    """Write the chunks that are complete."""
    job.pack()
    job.append()
    job.compress()
    job.commit()


def _finish(run: Conversion, writers: Sequence[ScanWriter], last: Last | None) -> RunReport:
    """Write the last messages, check the ledgers and complete the output."""
    began_s = time.perf_counter()
    while items := run.passed_through(None, _PORTION_BYTES):
        for item in items:
            _forward(item, writers)
        for writer in writers:
            _write_chunks(writer.flush())
    for note in run_report.message_notes(run):
        run.warn(note)
    inputs = run_report.run_report(run)
    broken = imbalances(inputs)
    if broken:
        raise RecordingError(f"the ledger does not balance, please report: {broken[0]}")
    if not writers:
        return inputs
    table = run.table.text() if run.table is not None else ""
    report = report_text(inputs, machine=False)

    def complete(partial: Path) -> None:
        nonlocal inputs
        run.stages.write_s += time.perf_counter() - began_s
        inputs = run_report.run_report(run)
        if last is not None:
            last(inputs, partial)

    summary = Summary(run.batcher.t_init_ns, report, table, fill_totals(inputs))
    for writer in writers[1:]:
        writer.finish(summary)
    writers[0].finish(summary, complete)
    return inputs


def _return_freed_memory() -> None:
    """Return freed pages to the kernel where the C library can (glibc, since 2.8).

    The search for sensors frees arrays of some MB between small objects that stay. The next arrays
    are larger or are only partly used: they would take memory in addition to these pages.
    """
    if sys.platform != "linux":
        return
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
