"""A scan from its raw columns into the output, in four stages."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from mlbatch.pipeline.conversion import Conversion
from mlbatch.pipeline.decode_pool import Decoded, DecodeTask, DecodeWorker
from mlbatch.types import ImuSamples, Message
from mlbatch.writers.base import FilesWriter, ScanJob, ScanWriter

if TYPE_CHECKING:
    from mlbatch.pipeline.files import Files, FinishedScan


class ScanTask:
    """The stages of one scan; see `workers.StagedTask`."""

    def __init__(
        self,
        run: Conversion,
        task: DecodeTask | None,
        before: Sequence[ImuSamples | Message],
        writers: Sequence[ScanWriter],
        idle: list[DecodeWorker],
        files: Files | None,
        *,
        kept: FinishedScan | None,
        index: int | None,
    ) -> None:
        """task: None where messages are to be written without a scan; before: what to write first.

        writers: none in a dry run; idle: decode workers not in use;
        files: of the output, None in a dry run; kept: the scan, if it is in a file of another
        run; index: of its window, None where no scan follows the messages.
        """
        self._run = run
        self._task = task
        self._before = before
        self._writers = writers
        self._idle = idle
        self._files = files
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
        counts_points = self._files is not None and self._files.is_journaled
        self._decoded = worker.decode(self._task, counts_points=counts_points)
        self._decode_s += time.perf_counter() - began_s

    def decode(self) -> None:
        """Raw columns to points, points to the bytes of the output. Any thread."""
        if self._decoded is None and self._task is not None:
            self._worker = self._idle.pop()
            self.decode_with(self._worker)
        if self._writers:
            self._jobs = [self._writer_job(writer) for writer in self._writers]
        self._timed(lambda job: job.pack())

    def append(self) -> None:
        """Count the scan, write what precedes it, reserve its place in the output. In order."""
        if self._decoded is not None:
            scan = self._decoded.scan
            checksum = self._jobs[0].checksum if self._kept is None else self._kept.checksum
            is_listed = self._files is None or self._files.is_listed(scan)
            self._run.account(scan, checksum, is_listed)
        if self._index is not None:
            for job in self._jobs:
                job.start(self._index)
        for item in self._before:
            forward(item, self._writers)
        self._timed(lambda job: job.append())

    def compress(self) -> None:
        """Compress what is complete. Any thread."""
        self._timed(lambda job: job.compress())

    def commit(self) -> None:
        """Write what is complete; note the scan for its file. In order."""
        if self._task is not None and self._decoded is not None and self._files is not None:
            scan, outcomes = self._decoded
            if self._kept is None:
                self._files.note(scan, self._task.only, outcomes, self._jobs[0].checksum)
        self._timed(lambda job: job.commit())
        self._run.stages.write_s += self._write_s
        self._run.stages.decode_s += self._decode_s
        if self._worker is not None:
            # Only now, since its arrays were read until here.
            self._idle.append(self._worker)

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


def forward(item: ImuSamples | Message, writers: Sequence[ScanWriter]) -> None:
    """Write IMU samples or a message."""
    for writer in writers:
        if isinstance(item, Message):
            writer.write_message(item)
        else:
            writer.write_imu(item)
