"""The state of a batch, from the folders of its sessions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mlbatch.batch.record import SessionRecord, parse_record, read_record
from mlbatch.batch.session import LOG_TXT, SESSION_JSON, STARTED_JSON, is_url
from mlbatch.errors import RecordingError
from mlbatch.report.report import CUT_OFF

# Warnings of clocks, as in the page of a run.
CLOCK_CODES = frozenset(
    {"clocks", "clock_jump", "clock_epoch", "host_step", "timescale", "cloud_time"}
)
UNFINISHED = "unfinished"


@dataclass(frozen=True, slots=True)
class SessionStatus:
    """A session folder; record: None while session.json is not there."""

    name: str
    record: SessionRecord | None
    page: str = ""  # path of the page of the run, relative to the output

    @property
    def state(self) -> str:
        """done, failed or unfinished: running, or interrupted."""
        return UNFINISHED if self.record is None else self.record.state

    @property
    def is_cut_off(self) -> bool:
        """Whether a recording ends early, so that the session is shorter than its drive."""
        return self.record is not None and CUT_OFF in self.record.warnings

    @property
    def reason(self) -> str:
        """Why it failed; of a session that is done, the codes of its warnings."""
        return "" if self.record is None else self.record.line or ", ".join(self.record.warnings)

    @property
    def clock_codes(self) -> list[str]:
        """Warnings about clocks."""
        return [] if self.record is None else sorted(CLOCK_CODES & set(self.record.warnings))


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
    if is_url(output):
        return _remote_status(output)
    folder = Path(output)
    if not folder.is_dir():
        raise RecordingError(
            f"{folder}: expected the output of `mlbatch batch`, found no such folder; check the "
            "name"
        )
    sessions = [found for path in sorted(folder.iterdir()) if (found := _session(path)) is not None]
    if not sessions:
        raise RecordingError(
            f"{folder}: expected the output of `mlbatch batch`, found no session in it; check the "
            "name"
        )
    return BatchStatus(output, tuple(sessions))


def _remote_status(output: str) -> BatchStatus:
    from mlbatch.batch.remote import listed, read_text

    root = output.rstrip("/")
    files = [one.url.removeprefix(f"{root}/").split("/") for one in listed(root)]
    names = sorted({parts[0] for parts in files if parts[1:] in ([SESSION_JSON], [LOG_TXT])})
    if not names:
        raise RecordingError(
            f"{output}: expected the output of `mlbatch batch`, found no session in it; check the "
            "name"
        )
    pages = {parts[0]: "/".join(parts) for parts in files if parts[-1].startswith("page")}
    sessions = [
        SessionStatus(
            name, parse_record(read_text(f"{root}/{name}/{SESSION_JSON}")), pages.get(name, "")
        )
        for name in names
    ]
    return BatchStatus(output, tuple(sessions))


def _session(folder: Path) -> SessionStatus | None:
    names = (SESSION_JSON, STARTED_JSON, LOG_TXT)
    if not any((folder / name).is_file() for name in names):
        return None
    pages = sorted(folder.glob("page*.html"))
    page = f"{folder.name}/{pages[0].name}" if pages else ""
    return SessionStatus(folder.name, read_record(folder), page)
