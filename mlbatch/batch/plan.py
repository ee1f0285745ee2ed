"""Plan of a batch: sessions, bytes and time, from earlier sessions of the same output."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

from mlbatch.batch.identity import recordings_of
from mlbatch.batch.record import SessionRecord, read_record
from mlbatch.batch.session import Session, is_url
from mlbatch.batch.task import Task, finished
from mlbatch.errors import MlbatchError

# Without a finished session: outputs of whole recordings took 0.51 to 7 times their bytes
# (docs/performance.md), and two cores convert at least 50 MB of a recording in a second. A session
# costs a process, the probe of ten seconds and a page as well.
USUAL_RATIO = 2.0
USUAL_BYTES_PER_S = 50e6
USUAL_START_S = 1.5


@dataclass(frozen=True, slots=True)
class PlannedSession:
    """A session of a plan; word: missing, changed, done or failed; bytes: of its inputs."""

    name: str
    word: str
    inputs: int
    bytes: int | None  # None: unknown
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Plan:
    """Sessions of a batch, with estimates for the sessions that would run."""

    sessions: tuple[PlannedSession, ...]
    ratio: float  # bytes of output for a byte of input
    bytes_per_s: float  # of input, by a worker
    start_s: float  # of each session besides
    measured: int  # number of finished sessions that these are from; 0: usual values
    workers: int
    cores: int

    @property
    def to_run(self) -> tuple[PlannedSession, ...]:
        """Sessions that would run."""
        return tuple(one for one in self.sessions if one.word in ("missing", "changed"))

    @property
    def bytes_in(self) -> int:
        """Bytes of the recordings of the sessions that would run."""
        return sum(one.bytes or 0 for one in self.to_run)

    @property
    def bytes_out(self) -> int:
        """Bytes of their outputs."""
        return round(self.bytes_in * self.ratio)

    @property
    def seconds(self) -> float:
        """Time with all workers, as far as there are cores; of the longest session at least."""
        each_s = [self.start_s + (one.bytes or 0) / self.bytes_per_s for one in self.to_run]
        at_once = min(self.workers, self.cores)
        return max(sum(each_s) / at_once, max(each_s, default=0.0))


def plan_of(tasks: Sequence[Task], workers: int, *, retry_failed: bool = False) -> Plan:
    """Look at all sessions; nothing is written."""
    records = [read_record(task.upload or task.folder) for task in tasks]
    done = [record for record in records if record is not None and record.is_done]
    kept = [one for one in done if one.input_bytes and one.wall_s]
    bytes_in = sum(one.input_bytes for one in kept)
    ratio = sum(one.output_bytes for one in kept) / bytes_in if kept else USUAL_RATIO
    # The fastest session began within its time.
    start_s = min([USUAL_START_S, *(one.wall_s for one in kept)])
    converting_s = sum(one.wall_s - start_s for one in kept)
    speed = bytes_in / converting_s if converting_s > 0 else USUAL_BYTES_PER_S
    sessions = tuple(
        _planned(task, record, retry_failed=retry_failed)
        for task, record in zip(tasks, records, strict=True)
    )
    return Plan(sessions, ratio, speed, start_s, len(kept), workers, os.cpu_count() or 1)


def _planned(task: Task, record: SessionRecord | None, *, retry_failed: bool) -> PlannedSession:
    name, inputs = task.session.name, task.session.inputs
    try:
        size = _bytes(task.session)
        same = finished(task)
    except MlbatchError as err:
        return PlannedSession(name, "missing", len(inputs), None, str(err))
    if same is not None and (same.is_done or not retry_failed):
        return PlannedSession(name, same.state, len(inputs), size, same.line)
    return PlannedSession(name, "missing" if record is None else "changed", len(inputs), size)


def _bytes(session: Session) -> int:
    """Bytes of the recordings; RecordingError where one is missing."""
    total = sum(file.stat().st_size for file in recordings_of(session))
    urls = list(filter(is_url, session.inputs))
    if urls:
        from mlbatch.batch.remote import head

        total += sum(head(url).size for url in urls)
    return total
