"""Going on where an interrupted conversion stopped, so that its output does not show it.

Batching depends on nothing but packets and is cheap. So a resumed run reads and batches everything
again, and leaves out what is slow: decoding and writing scans that the `.partial` already holds.
What became of their points comes from the state file, all else is computed again.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

from mlbatch import _resume_identity as identities
from mlbatch._resume_state import Row, State, StateFile, read_state, state_path
from mlbatch.errors import ClockJump, NoScanError, UsageError
from mlbatch.job import Job
from mlbatch.ledger import POINT_FATES
from mlbatch.pipeline import Conversion
from mlbatch.writers import ScanWriter, WriterOptions, discard, discard_old, partial_path

# A kill costs no more than what was done since the last line of the state file.
INTERVAL_S = 0.5


@dataclass(frozen=True, slots=True)
class Found:
    """What an earlier run to the same output left.

    state: to go on from, None: nothing; is_complete: the output stands alone under its name;
    was_published: and the run that put it there was killed right after that.
    """

    state: State | None
    is_complete: bool
    was_published: bool


def find(target: Path) -> Found:
    """What is left of an earlier run to `target`; an error while another run writes it."""
    state = read_state(state_path(target))
    has_partial = partial_path(target).exists()
    is_complete = target.exists() and not has_partial
    can_go_on = state is not None and bool(state.rows) and has_partial
    return Found(state if can_go_on else None, is_complete, is_complete and state is not None)


def forget(target: Path) -> None:
    """Remove the state of an earlier run, and what it would have removed last."""
    state_path(target).unlink(missing_ok=True)
    discard_old(target)


def abandon(target: Path) -> None:
    """Remove all that an interrupted run left."""
    forget(target)
    discard(target)


def jump_in(job: Job) -> ClockJump | None:
    """Where the clock of a sensor jumps; nothing is decoded."""
    run = Conversion(job)
    run.finished = itertools.repeat([[0] * len(POINT_FATES)] * len(run.feeds))
    try:
        for _ in run.scans():
            pass
    except ClockJump as jump:
        return jump
    except NoScanError:
        return None
    return None


class Course:
    """How far the output of one run has come, in the run's memory and in its state file."""

    def __init__(
        self, target: Path, job: Job, name: str, options: WriterOptions, state: State | None
    ) -> None:
        """name: of the format; state: of the run to continue, None: begin anew."""
        self._target = target
        self._identity = identities.of_job(job, name, options)
        self._part = str(job.part)
        if state is not None and state.part != self._part:
            # A part whose end was not known yet: not all of its scans are those of the shorter one.
            state = None
        self._state = state
        self._file: StateFile | None = None
        self._waiting: deque[Row] = deque()
        self._given = 0
        self.recorded = self.done
        self._due_s = 0.0

    @property
    def done(self) -> int:
        """Scans that the `.partial` already holds."""
        return 0 if self._state is None else len(self._state.rows)

    @property
    def kept_bytes(self) -> int | None:
        """What stays of the output's file; None: there is nothing to continue."""
        return None if self._state is None else self._state.kept_bytes

    def join(self, run: Conversion) -> None:
        """Refuse to continue what another job began, and tell the run which scans are done."""
        self._identity |= identities.of_inputs(run)
        if self._state is None:
            return
        difference = identities.difference(self._state.identity, self._identity)
        if difference:
            raise UsageError(
                f"{partial_path(self._target)}: wanted the job of the interrupted run to go on "
                f"with, got {difference}; give the same, or leave out --resume to begin anew"
            )
        run.finished = iter(self._state.rows)

    def begin(self) -> None:
        """Open the state file, before the output: from now on no other run writes it."""
        is_new = self._state is None
        state = self._state or State(self._identity, self._part)
        self._file = StateFile(state_path(self._target), state, is_new=is_new)
        self._due_s = time.monotonic() + INTERVAL_S

    def note(self, fates: Row, writer: ScanWriter) -> None:
        """Take notice of a scan that was written or gone past, in the order of the scans.

        fates: of the slots of every sensor in it.
        """
        self._given += 1
        if self._given <= self.done:
            return
        self._waiting.append(fates)
        if time.monotonic() >= self._due_s:
            self._record(writer)
            self._due_s = time.monotonic() + INTERVAL_S

    def _record(self, writer: ScanWriter) -> None:
        safe = writer.checkpoint()
        # With several jobs later scans may be safe, of which nothing is known so far.
        scans = min(safe.scans, self._given)
        fresh = scans - self.recorded
        if fresh > 0 and self._file is not None:
            self._file.add([self._waiting.popleft() for _ in range(fresh)], safe.kept_bytes)
            self.recorded = scans

    def complete(self) -> None:
        """Refuse an output that holds more than the recording gives."""
        if self._given < self.done:
            raise UsageError(
                f"{partial_path(self._target)}: wanted {self.done} scans of the interrupted run "
                f"again, got {self._given}; leave out --resume to begin anew"
            )

    def settle(self) -> None:
        """The run ends early: force to the disk what it has done."""
        if self._file is None:
            return
        if partial_path(self._target).exists():
            self._file.settle()
        else:
            # The output could not be opened.
            self._file.remove()

    def discard(self) -> None:
        """The run ends without a scan: nothing of what it wrote stays."""
        if self._file is not None:
            self._file.remove()
            self._file = None
            discard(self._target)

    def remove(self) -> None:
        """The output has its final name."""
        if self._file is not None:
            self._file.remove()
            self._file = None
