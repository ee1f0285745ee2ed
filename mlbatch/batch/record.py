"""session.json: how the last run of a session ended. Written last, complete or not at all."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from mlbatch.batch.session import STARTED_JSON
from mlbatch.bounded import parse_json, read_text
from mlbatch.outputs.run_files import SESSION_JSON
from mlbatch.writers.atomic import write_text

SCHEMA = "mlbatch.session/1"
DONE = "done"
FAILED = "failed"
KNOWN_BAD = "known_bad"


@dataclass(slots=True)
class SessionRecord:
    """Outcome of a session; counts are from its reports."""

    name: str
    state: str  # done, failed or known_bad
    exit_code: int  # of convert; negative: the signal that ended it
    line: str  # the error, the limits that were exceeded, or why it is bad; "" if done
    key: dict[str, str]
    limit: str = ""  # of time or disk that ended it; another one makes it run again
    attempts: int = 1
    inputs: list[str] = field(default_factory=list)
    outputs: list[str] = field(default_factory=list)
    input_bytes: int = 0
    output_bytes: int = 0
    wall_s: float = 0.0
    recorded_s: float = 0.0
    scans: int = 0
    points: int = 0
    incomplete: int = 0
    packets: int = 0
    lost: int = 0
    rejected: int = 0
    fill: float | None = None  # least mean fill of a sensor
    warnings: list[str] = field(default_factory=list)

    @property
    def is_done(self) -> bool:
        """Whether the output is there and within its limits."""
        return self.state == DONE


def read_record(place: Path | str) -> SessionRecord | None:
    """The record in the folder of a session, or below its URL.

    None if there is none, or one of another version.
    """
    found = _document(place, SESSION_JSON)
    if found.pop("schema", None) != SCHEMA:
        return None
    known = {one.name for one in fields(SessionRecord)}
    try:
        record = SessionRecord(**{key: value for key, value in found.items() if key in known})
    except TypeError:
        return None
    is_valid = isinstance(record.key, dict) and record.state in (DONE, FAILED, KNOWN_BAD)
    return record if is_valid else None


def write_record(folder: Path, record: SessionRecord) -> None:
    """Write session.json, and remove the note that a run has begun, unless it can continue."""
    document = {"schema": SCHEMA, **asdict(record)}
    write_text(folder / SESSION_JSON, json.dumps(document, indent=1, ensure_ascii=False) + "\n")
    if not record.limit:
        (folder / STARTED_JSON).unlink(missing_ok=True)


def read_started(folder: Path) -> dict[str, str]:
    """The key of a run that has begun and not ended; empty without one."""
    return _document(folder, STARTED_JSON)


def write_started(folder: Path, key: dict[str, str]) -> None:
    """Write the key of a run before the run begins."""
    write_text(folder / STARTED_JSON, json.dumps(key, indent=1, ensure_ascii=False) + "\n")


def _document(place: Path | str, name: str) -> dict[str, Any]:
    """A file of a session; empty where there is none, or a damaged one."""
    try:
        if isinstance(place, Path):
            found = parse_json(read_text(place / name))
        else:
            from mlbatch.batch import remote

            found = parse_json(remote.read_text(f"{place}/{name}"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
