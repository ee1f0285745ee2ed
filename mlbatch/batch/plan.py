"""Plan of a batch: sessions, bytes and time, from earlier sessions of the same output."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mlbatch.api import extract
from mlbatch.batch.identity import recordings_of
from mlbatch.batch.record import KNOWN_BAD, SessionRecord, read_record
from mlbatch.batch.session import NO_LIMITS, Session, is_url
from mlbatch.batch.task import Task, finished, run_session
from mlbatch.errors import MlbatchError

# Without a finished session: outputs of whole recordings took 0.51 to 7 times their bytes
# (docs/performance.md), and two cores convert at least 50 MB of a recording in a second. A session
# costs a process, the probe of ten seconds and a page as well.
USUAL_RATIO = 2.0
USUAL_BYTES_PER_S = 50e6
USUAL_START_S = 1.5
# Length of the piece that is converted to measure; a session's usual start is in it, too.
PIECE_S = 10.0
_TO_RUN = ("missing", "changed")


@dataclass(frozen=True, slots=True)
class PlannedSession:
    """A session of a plan; word: missing, changed, done, failed or known_bad; bytes: of inputs."""

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
    source: str  # what these are from
    workers: int
    cores: int

    @property
    def to_run(self) -> tuple[PlannedSession, ...]:
        """Sessions that would run."""
        return tuple(one for one in self.sessions if one.word in _TO_RUN)

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
    """Look at all sessions; without a finished one, convert a piece of one and remove it."""
    records = [read_record(task.upload or task.folder) for task in tasks]
    sessions = tuple(
        _planned(task, record, retry_failed=retry_failed)
        for task, record in zip(tasks, records, strict=True)
    )
    done = [record for record in records if record is not None and record.is_done]
    kept = [one for one in done if one.input_bytes and one.wall_s]
    source = f"from {len(kept)} finished sessions"
    if not kept:
        piece = _piece(tasks, sessions)
        kept = [] if piece is None else [piece]
        source = "usual values, not measured"
        if piece is not None:
            source = f"from the first {PIECE_S:g} s of session {piece.name}"
    bytes_in = sum(one.input_bytes for one in kept)
    ratio = sum(one.output_bytes for one in kept) / bytes_in if kept else USUAL_RATIO
    # The fastest session began within its time.
    start_s = min([USUAL_START_S, *(one.wall_s for one in kept)])
    converting_s = sum(one.wall_s - start_s for one in kept)
    speed = bytes_in / converting_s if converting_s > 0 else USUAL_BYTES_PER_S
    return Plan(sessions, ratio, speed, start_s, source, workers, os.cpu_count() or 1)


def _piece(tasks: Sequence[Task], sessions: Sequence[PlannedSession]) -> SessionRecord | None:
    """The first seconds of a session of middle size, converted; None where that is not possible.

    Everything is in a temporary folder, which is removed.
    """
    sizes = {one.name: one.bytes for one in sessions if one.word in _TO_RUN and one.bytes}
    local = sorted(
        (task for task in tasks if task.session.name in sizes and not task.is_remote),
        key=lambda task: sizes[task.session.name] or 0,
    )
    if not local:
        return None
    task = local[len(local) // 2]
    with tempfile.TemporaryDirectory(prefix="mlbatch-plan-") as folder:
        first = Path(task.session.inputs[0])
        container = first.suffix if first.suffix in (".mcap", ".bag") else ".pcap"
        piece = Path(folder) / f"piece{container}"
        try:
            extract(
                task.session.inputs,
                piece,
                rig=task.session.rig,
                metadata=task.session.values("metadata"),
                duration=PIECE_S,
            )
            session = replace(task.session, inputs=(str(piece),), limits=NO_LIMITS)
            record = run_session(replace(task, session=session, folder=Path(folder) / "out"))
        except MlbatchError:
            return None
    return record if record.is_done and record.input_bytes else None


def _planned(task: Task, record: SessionRecord | None, *, retry_failed: bool) -> PlannedSession:
    name, inputs = task.session.name, task.session.inputs
    if task.session.known_bad:
        return PlannedSession(name, KNOWN_BAD, len(inputs), None, task.session.known_bad)
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
