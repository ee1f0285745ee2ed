"""Resuming an interrupted conversion, so that its output equals that of an uninterrupted one.

Batching depends on nothing but packets and is cheap. A resumed run reads and batches everything
again, but skips what is slow: decoding and writing scans that the `.partial` already contains. The
counters of their points come from the state file (`state_file.py`); all else is computed again.

Each scan in the state file has a checksum of what was read for it and before it. A resumed run
computes the same; where they differ, the recording has changed, which is an error.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mlbatch.errors import ClockJump, UsageError
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.job_identity import difference, input_identity, job_identity
from mlbatch.pipeline.state_file import FinishedScan, State, StateFile, read_state, state_path
from mlbatch.types import ImuSamples, Message
from mlbatch.writers import (
    ScanWriter,
    WriterOptions,
    discard,
    discard_old,
    export_errors,
    partial_path,
)
from mlbatch.writers.output_file import crc32

if TYPE_CHECKING:
    from mlbatch.pipeline.conversion import Conversion
    from mlbatch.pipeline.decode_pool import DecodeTask, Outcomes

# A kill costs no more than the work since the last record of the state file.
INTERVAL_S = 0.5


# -- an earlier run ---------------------------------------------------------------------------


class EarlierRun(NamedTuple):
    """Remains of an earlier run to the same output."""

    state: State | None  # None if there is nothing to resume
    damage: str  # one line on the part of its state file that does not count, or ""
    is_complete: bool  # the output exists, without a `.partial`
    was_published: bool  # it is complete, and the run was killed before it removed its state file


def find(target: Path) -> EarlierRun:
    """Find what is left of an earlier run to `target`; ExportError while another run writes it."""
    found = read_state(state_path(target))
    state = found.state
    has_partial = partial_path(target).exists()
    is_complete = target.exists() and not has_partial
    can_resume = state is not None and bool(state.scans) and has_partial
    return EarlierRun(
        state if can_resume else None,
        found.damage if has_partial else "",
        is_complete,
        is_complete and state is not None,
    )


def forget(target: Path) -> None:
    """Remove the state of an earlier run, and what it would have removed last."""
    path = state_path(target)
    with export_errors(path):
        path.unlink(missing_ok=True)
    discard_old(target)


def abandon(target: Path) -> None:
    """Remove all that an interrupted run left."""
    forget(target)
    discard(target)


def find_jump(job: Job) -> ClockJump | None:
    """First clock step in the session of a job, None without; nothing is decoded."""
    # A merge of shards, which needs this module, converts nothing.
    from mlbatch.pipeline.conversion import Conversion

    run = Conversion(job)
    try:
        for _ in run.windows():
            pass
    except ClockJump as jump:
        return jump
    return None


# -- the run ----------------------------------------------------------------------------------


class ResumeLog:
    """Progress of one output, in memory and in its state file.

    recorded: scans in the state file.
    """

    def __init__(
        self, target: Path, job: Job, name: str, options: WriterOptions, state: State | None
    ) -> None:
        """name: of the format; state: of the run to resume, None: start over."""
        self._target = target
        self._identity = job_identity(job, name, options)
        self._segment = str(job.segment)
        if state is not None and state.segment != self._segment:
            # The end of the segment was not known then: its last scans may be other ones now.
            state = None
        self._state = state
        self._file: StateFile | None = None
        self._run: Conversion | None = None
        self._content = 0
        self._taken = 0
        # Of the scans that are not in the state file: what they are made from, as taken; then the
        # finished ones.
        self._contents: deque[int] = deque()
        self._finished: deque[FinishedScan] = deque()
        self._given = 0
        self.recorded = self.done
        self._due_s = 0.0

    @property
    def done(self) -> int:
        """Scans that the `.partial` already contains."""
        return 0 if self._state is None else len(self._state.scans)

    @property
    def is_resumable(self) -> bool:
        """Whether the `.partial` of this run has scans that another run can continue after."""
        return bool(self.recorded) and partial_path(self._target).exists()

    @property
    def kept_bytes(self) -> int | None:
        """Bytes of the output's file to keep; None: nothing to resume."""
        return None if self._state is None else self._state.kept_bytes

    @property
    def kept_crc(self) -> int:
        """CRC-32 of these bytes."""
        return 0 if self._state is None else self._state.kept_crc

    @property
    def identity(self) -> dict[str, str]:
        """Identity of the job and, once it runs, of its inputs."""
        return self._identity

    @property
    def run(self) -> Conversion | None:
        """The run, once it has begun."""
        return self._run

    @property
    def content(self) -> int:
        """Checksum of what was read for the scans so far."""
        return self._content

    def join(self, run: Conversion) -> None:
        """Pass the finished scans to a run; UsageError if it is another job."""
        self._run = run
        for sensor in run.sensors:
            sensor.ring.keep_sums()
        self._identity |= input_identity(run)
        if self._state is None:
            return
        changed = difference(self._state.identity, self._identity)
        if changed:
            raise UsageError(
                f"{partial_path(self._target)}: expected the job of the interrupted run, found "
                f"{changed}; give the same, or leave out --resume to start over"
            )
        run.earlier = (scan.outcomes for scan in self._state.scans)

    def begin(self) -> None:
        """Open the state file, before the output: from now on no other run writes it."""
        is_new = self._state is None
        state = self._state or State(self._identity, self._segment)
        self._file = StateFile(state_path(self._target), state, is_new=is_new)
        self._due_s = time.monotonic() + INTERVAL_S

    def take(
        self, before: Sequence[ImuSamples | Message], task: DecodeTask | None
    ) -> FinishedScan | None:
        """Add what is written next; returns the scan if the `.partial` already contains it.

        before: what is forwarded before the scan; task: of the scan, None without one. UsageError
        if the scan of the interrupted run was made from something else.
        """
        for item in before:
            self._content = _forwarded_content(item, self._content)
        if task is None or self._run is None:
            return None
        self._content = self._run.pool.content(task, self._content)
        self._taken += 1
        if self._state is None or self._taken > self.done:
            self._contents.append(self._content)
            return None
        kept = self._state.scans[self._taken - 1]
        if self._content != kept.content:
            raise UsageError(
                f"{partial_path(self._target)}: expected the packets of the interrupted run, found "
                f"others for scan {self._taken} of {self.done} that are finished: a recording was "
                "changed; restore it, or leave out --resume to start over"
            )
        return kept

    def note(self, outcomes: Outcomes, checksum: int | None, writer: ScanWriter) -> None:
        """Note a scan that was written or skipped; call in the order of the scans."""
        self._given += 1
        if self._given <= self.done:
            return
        self._finished.append(
            FinishedScan(self._contents.popleft(), [list(counts) for counts in outcomes], checksum)
        )
        if time.monotonic() >= self._due_s:
            self._record(writer)
            self._due_s = time.monotonic() + INTERVAL_S

    def _record(self, writer: ScanWriter) -> None:
        checkpoint = writer.checkpoint()
        # With several jobs later scans may be safe, which were not noted yet.
        scans = min(checkpoint.scans, self._given)
        fresh = scans - self.recorded
        if fresh > 0 and self._file is not None:
            finished = [self._finished.popleft() for _ in range(fresh)]
            self._file.add(finished, checkpoint.kept_bytes, checkpoint.kept_crc)
            self.recorded = scans

    def complete(self) -> None:
        """Raise UsageError if the `.partial` contains more scans than the recording gives."""
        if self._given < self.done:
            raise UsageError(
                f"{partial_path(self._target)}: expected the {self.done} scans of the interrupted "
                f"run again, found {self._given}; leave out --resume to start over"
            )

    def sync(self) -> None:
        """Force what is done to the disk; call when the run ends early."""
        if self._file is None:
            return
        if partial_path(self._target).exists():
            self._file.sync(partial_path(self._target))
        else:
            # The output could not be opened.
            self._file.remove()

    def discard(self) -> None:
        """Remove the output and its state; call when the run ends without a scan."""
        if self._file is not None:
            self._file.remove()
            self._file = None
            discard(self._target)

    def remove(self) -> None:
        """Remove the state file; call when the output has its final name."""
        if self._file is not None:
            self._file.remove()
            self._file = None


def _forwarded_content(item: ImuSamples | Message, before: int) -> int:
    """Checksum of what is forwarded, and of what precedes it."""
    if isinstance(item, Message):
        return crc32(item.data, crc32(f"{item.topic.name} {item.host_ns} ".encode(), before))
    for values in (item.stamp_ns, item.acceleration, item.angular_velocity):
        before = crc32(np.ascontiguousarray(values).tobytes(), before)
    return crc32(bytes([item.sensor & 0xFF]), before)
