"""What the command line says and does about runs that were interrupted, and that may be."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

import typer

from mlbatch.errors import ExportError, MlbatchError, RecordingError
from mlbatch.pipeline import resume as resuming
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.resume import ResumeLog
from mlbatch.writers import WriterOptions


@contextlib.contextmanager
def by_termination() -> Iterator[None]:
    """Take the signal that asks a process to end as an interrupt from the keyboard."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def is_complete(output: Path, *, overwrite: bool) -> bool:
    """Whether an earlier run has finished the output, so that there is nothing to do."""
    found = resuming.find(output)
    # An older output is replaced with --overwrite, but not what the interrupted run made.
    if not found.is_complete or (overwrite and not found.was_published):
        return False
    resuming.forget(output)
    typer.echo(f"mlbatch: {output}: is complete; there is nothing to resume", err=True)
    return True


def course(job: Job, output: Path, name: str, options: WriterOptions, *, resume: bool) -> ResumeLog:
    """The way of an output: on from where the last run was interrupted, or anew."""
    state = resuming.find(output).state
    if state is not None and not resume:
        typer.echo(
            f"mlbatch: warning: interrupted: {output}.partial with {len(state.rows)} finished "
            "scans is begun anew; with --resume a run goes on after them",
            err=True,
        )
    found = ResumeLog(output, job, name, options, state if resume else None)
    if found.kept_bytes is None:
        resuming.forget(output)
        if resume:
            typer.echo(f"mlbatch: {output}: nothing to resume; begun from the start", err=True)
    else:
        typer.echo(f"mlbatch: {output}: resumed after {found.done} scans", err=True)
    return found


def refuse_jump(job: Job, *, resume: bool) -> None:
    """Raise where a clock jumps before anything is written.

    A resumed run must know where its part ends, since parts that are complete are not made again.
    """
    jump = resuming.jump_in(job) if resume else None
    if jump is not None:
        raise jump


def discard(output: Path | None) -> None:
    """Remove what a run left that met a clock jump: its parts have other names."""
    if output is not None:
        resuming.abandon(output)


def with_advice(err: MlbatchError, course: ResumeLog | None) -> MlbatchError:
    """The same error; where a disk failed and scans are safe, it says how to go on."""
    if course is None or not course.recorded or not isinstance(err.__cause__, OSError):
        return err
    if type(err) not in (ExportError, RecordingError):
        return err
    advice = f"then --resume goes on after the {course.recorded} scans that are safe"
    return type(err)(f"{err}; {advice}")
