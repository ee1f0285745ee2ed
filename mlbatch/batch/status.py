"""The state of a batch, from the records of its sessions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from mlbatch.batch.record import DONE, FAILED, KNOWN_BAD, SessionRecord, read_record
from mlbatch.batch.session import LOG_TXT, STARTED_JSON, is_url
from mlbatch.errors import RecordingError
from mlbatch.outputs.run_files import SESSION_JSON
from mlbatch.reports.report import CUT_OFF

# Warnings of clocks, as in the page of a run.
CLOCK_CODES = frozenset(
    {"clocks", "clock_jump", "clock_epoch", "host_step", "timescale", "cloud_time"}
)
POSE_CODES = frozenset({"pose", "same_pose", "far_pose", "identity_extrinsics"})
UNFINISHED = "unfinished"
SKIPPED = "skipped"
STATES = (DONE, FAILED, UNFINISHED, KNOWN_BAD)
HEAD = ("session", "state", "scans", "lost", "fill", "clocks", "output", "time", "")


@dataclass(frozen=True, slots=True)
class SessionStatus:
    """A session; record: None while session.json is not there.

    page: path of the page of its run, relative to the output; is_earlier: of an earlier run, that
    counts.
    """

    name: str
    record: SessionRecord | None
    page: str = ""
    is_earlier: bool = False

    @property
    def state(self) -> str:
        """done, failed, known_bad or unfinished: running, or interrupted."""
        return UNFINISHED if self.record is None else self.record.state

    @property
    def word(self) -> str:
        """State in the last table of a batch; failures of earlier runs, too, are failures."""
        return SKIPPED if self.is_earlier and self.state == DONE else self.state

    @property
    def is_failed(self) -> bool:
        """Whether there is no output, or one beyond limits."""
        return self.state == FAILED

    @property
    def is_cut_off(self) -> bool:
        """Whether a recording ends early, so that the session is shorter than its drive."""
        return self.record is not None and CUT_OFF in self.record.warnings

    @property
    def reason(self) -> str:
        """Why it failed; of a session that is done, the codes of its warnings."""
        return "" if self.record is None else self.record.line or ", ".join(self.record.warnings)

    @property
    def line(self) -> str:
        """The row in words, for a log."""
        named = zip(HEAD[2:], self.row[2:], strict=True)
        cells = (f"{name} {cell}".strip() for name, cell in named if cell)
        return ", ".join((self.word, *cells))

    @property
    def clock_codes(self) -> list[str]:
        """Warnings about clocks."""
        return [] if self.record is None else sorted(CLOCK_CODES & set(self.record.warnings))

    @property
    def has_pose_warning(self) -> bool:
        """Whether a warning says that poses may be wrong: the scans look good, and are not."""
        return self.record is not None and not POSE_CODES.isdisjoint(self.record.warnings)

    @property
    def loss(self) -> float:
        """Share of the packets that were lost."""
        return 0.0 if self.record is None else loss_of([self.record])

    @property
    def row(self) -> tuple[str, ...]:
        """Cells of a table row, in the order of `HEAD`."""
        record = self.record
        if record is None:
            return (self.name, self.word, *[""] * (len(HEAD) - 2))
        return (
            self.name,
            self.word,
            str(record.scans or ""),
            loss_text([record]),
            "" if record.fill is None else f"{record.fill:.3f}",
            ", ".join(self.clock_codes),
            bytes_text(record.output_bytes) if record.outputs else "",
            duration_text(record.wall_s),
            self.reason,
        )


@dataclass(frozen=True, slots=True)
class BatchStatus:
    """All sessions of an output, by name."""

    output: str
    sessions: tuple[SessionStatus, ...]

    def count(self, state: str) -> int:
        """Number of sessions in a state."""
        return sum(one.state == state for one in self.sessions)

    @property
    def records(self) -> list[SessionRecord]:
        """Records of the sessions that have ended."""
        return [one.record for one in self.sessions if one.record is not None]


def status_of(output: str) -> BatchStatus:
    """Read the state of a batch; RecordingError where there is none."""
    root = output.rstrip("/") if is_url(output) else Path(output)
    files = _files(root)
    sessions = []
    for name in sorted(files):
        if files[name].isdisjoint((SESSION_JSON, STARTED_JSON, LOG_TXT)):
            continue
        pages = sorted(one for one in files[name] if fnmatch(one, "page*.html"))
        record = read_record(root / name if isinstance(root, Path) else f"{root}/{name}")
        sessions.append(SessionStatus(name, record, f"{name}/{pages[0]}" if pages else ""))
    if not sessions:
        raise RecordingError(
            f"{output}: expected the output of `mlbatch batch`, found no session in it; check the "
            "name"
        )
    return BatchStatus(output, tuple(sessions))


def _files(root: Path | str) -> Mapping[str, set[str]]:
    """The names of the files in each folder of an output."""
    found: dict[str, set[str]] = {}
    if isinstance(root, str):
        from mlbatch.batch.remote import listed

        paths: Iterable[Sequence[str]] = (
            one.url.removeprefix(f"{root}/").split("/") for one in listed(root)
        )
    elif root.is_dir():
        paths = (path.relative_to(root).parts for path in root.glob("*/*"))
    else:
        raise RecordingError(
            f"{root}: expected the output of `mlbatch batch`, found no such folder; check the name"
        )
    for parts in paths:
        if len(parts) == 2:
            found.setdefault(parts[0], set()).add(parts[1])
    return found


# -- figures as texts -------------------------------------------------------------------------


def loss_of(records: Iterable[SessionRecord]) -> float:
    """Share of the packets that were lost; 0 without packets."""
    lost = sum(one.lost for one in records)
    return lost / max(1, lost + sum(one.packets for one in records))


def loss_text(records: Sequence[SessionRecord]) -> str:
    """Share of the packets that were lost."""
    return f"{100 * loss_of(records):.2f} %" if any(r.packets + r.lost for r in records) else ""


def bytes_text(count: int) -> str:
    """A size."""
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count} B"


def duration_text(seconds: float) -> str:
    """A time."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes / 60:.1f} h"
