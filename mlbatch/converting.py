"""A conversion with its writer: every scan is written, or nothing under a final name.

One thread reads, batches and decodes, another writes. With `--jobs N` one thread reads and batches,
and N of them decode and write, each a scan.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mlbatch import accounts
from mlbatch.decoding import Bench, Decoded, LeftOut, Task
from mlbatch.errors import NoScanError, RecordingError
from mlbatch.job import Job
from mlbatch.pipeline import Conversion, Progress
from mlbatch.report import ReportInputs, imbalances, report_text
from mlbatch.resume import Course
from mlbatch.types import ImuSamples, Message, RunInfo, Summary
from mlbatch.workers import Steps, Workers, in_one_go
from mlbatch.writers import ScanJob, ScanWriter

OpenWriter = Callable[[RunInfo], ScanWriter]
# Given what the report is made of, and the complete output before it gets its final name.
Last = Callable[[ReportInputs, Path], None]
# Scans that one thread decodes ahead of the one that writes.
_AHEAD = 2
# Tasks that several threads find waiting, when they are done with theirs.
_WAITING = 2


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
    # One more than wait to be written: the one that is being decoded.
    waits = job.jobs == 1 and open_writer is not None
    run = Conversion(job, buffers=_AHEAD + 1 if waits else 1)
    if course is not None:
        course.join(run)
    output = _Output(run, open_writer, course)
    try:
        output.make(progress)
        run.close()
        if course is not None:
            course.complete()
        inputs = _finish(run, output.writer, last)
        if course is not None:
            course.remove()
        output.writer = None
    except NoScanError:
        output.discard()
        raise
    finally:
        if output.writer is not None:
            output.writer.abandon()
        if course is not None:
            course.settle()
    return run, inputs


@dataclass(frozen=True, slots=True)
class _Piece:
    """A scan on its way into the output; task None: what passes by where there is no scan.

    is_kept: a continued output holds it; before: what comes before it; decoded: None where that is
    still to be done.
    """

    task: Task | None
    is_kept: bool
    before: list[ImuSamples | Message]
    decoded: Decoded | None


class _Output:
    """The output under construction; `writer` is None as long as it is not begun, or never."""

    def __init__(
        self, run: Conversion, open_writer: OpenWriter | None, course: Course | None
    ) -> None:
        self.writer: ScanWriter | None = None
        self._run = run
        self._open_writer = open_writer
        self._course = course
        self._jobs = run.job.jobs
        self._idle: list[Bench] = []
        self._is_begun = False
        self._scans = 0

    def make(self, progress: Progress | None) -> None:
        """Decode and write all scans."""
        run, alone = self._run, self._jobs == 1
        ahead = _AHEAD if alone else self._jobs + _WAITING
        with (
            contextlib.closing(run.tasks(progress)) as tasks,
            Workers(self._steps, self._jobs, ahead) as workers,
        ):
            for item in tasks:
                task = None if isinstance(item, LeftOut) else item
                before = run.take_passing(item.end_ns)
                if task is None and not before:
                    continue
                self._begin()
                piece = self._piece(task, before)
                if alone and self._open_writer is None:
                    # There is nothing to write that another thread could do meanwhile.
                    in_one_go(self._steps(piece))
                else:
                    workers.put(piece)
            workers.finish()

    def _piece(self, task: Task | None, before: list[ImuSamples | Message]) -> _Piece:
        if task is None:
            return _Piece(None, False, before, None)
        is_kept = self._course is not None and self._scans < self._course.done
        self._scans += 1
        decoded = None
        if self._jobs == 1:
            began_s = time.perf_counter()
            decoded = self._run.benches[0].decode(task)
            self._run.stages.decode_s += time.perf_counter() - began_s
        return _Piece(task, is_kept, before, decoded)

    def discard(self) -> None:
        """Remove the output: without a scan there is nothing to go on from."""
        if self.writer is not None:
            self.writer.abandon()
            self.writer = None
        if self._course is not None:
            self._course.discard()

    def _begin(self) -> None:
        """Open the output, now that it is known what its scans say of themselves; once."""
        if self._is_begun:
            return
        self._is_begun = True
        self._idle.extend(self._run.benches)
        if self._open_writer is not None and self._run.info is not None:
            if self._course is not None:
                # Before anything of the output is touched: another run may have begun it meanwhile.
                self._course.begin()
            self.writer = self._open_writer(self._run.info)

    def _steps(self, piece: _Piece) -> Steps:
        """What a thread does for a scan, or for what passes by without one; see `Workers`."""
        bench, decoded, began_s = None, piece.decoded, time.perf_counter()
        if piece.task is not None and decoded is None:
            bench = self._idle.pop()
            decoded = bench.decode(piece.task)
        decode_s = time.perf_counter() - began_s
        watch, job = _Watch(), self._job(piece, decoded)
        watch.do(job.pack)
        yield
        if decoded is not None:
            self._run.account(decoded.scan)
        for item in piece.before:
            _hand_over(item, self.writer)
        watch.do(job.append)
        yield
        watch.do(job.compress)
        yield
        watch.do(job.commit)
        if decoded is not None and self._course is not None and self.writer is not None:
            self._course.note(decoded.fates, self.writer)
        self._run.stages.write_s += watch.spent_s
        if bench is not None:
            self._run.stages.decode_s += decode_s
            self._idle.append(bench)

    def _job(self, piece: _Piece, decoded: Decoded | None) -> ScanJob:
        if self.writer is None:
            return ScanJob()
        if piece.task is None or decoded is None:
            return self.writer.flush()
        write = self.writer.skip if piece.is_kept else self.writer.write
        return write(decoded.scan, piece.task.only)


@dataclass(slots=True)
class _Watch:
    """Measures the time that stages of a job take, without the waiting between them."""

    spent_s: float = 0.0

    def do(self, stage: Callable[[], None]) -> None:
        """Do a stage."""
        began_s = time.perf_counter()
        stage()
        self.spent_s += time.perf_counter() - began_s


def _hand_over(item: ImuSamples | Message, writer: ScanWriter | None) -> None:
    if writer is None:
        return
    if isinstance(item, Message):
        writer.write_message(item)
    else:
        writer.write_imu(item)


def _finish(run: Conversion, writer: ScanWriter | None, last: Last | None) -> ReportInputs:
    """Hand over what is left, close the ledgers and complete the output."""
    began_s = time.perf_counter()
    for item in run.take_passing(None):
        _hand_over(item, writer)
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
