"""A session of a batch, and the files of its folder."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from mlbatch.errors import RigError, UsageError

if TYPE_CHECKING:
    from mlbatch.rig.rig import Rig

# The key of a run that has begun; removed when session.json is there.
STARTED_JSON = "started.json"
REPORT_JSON = "report.json"
LOG_TXT = "log.txt"
PAGE_HTML = "page.html"
OUTPUT = "scans"
# Output formats that are one file; others are folders.
_SUFFIX = {"mcap": ".mcap", "rosbag1": ".bag"}
# Files that a run writes to the folder of its session, with `--on-jump split` for each segment.
OWN = re.compile(
    r"scans(\.seg\d+)?(\.mcap|\.bag)?(\.scans\.csv)?(\.partial)?(\.state|\.old)?"
    r"|(report|page)(\.seg\d+)?\.(json|html)(\.partial)?|log\.txt"
    r"|(session|started)\.json(\.partial)?"
)
_AMOUNT = re.compile(r"(\d{1,9}(?:\.\d{1,6})?) ?([A-Za-z]+)")
_NAME = re.compile(r"[^\s/.\\\x00-\x1f\x7f][^/\\\x00-\x1f\x7f]{0,199}")
# Options that cannot change an output.
_NOT_IN_KEY = frozenset({"--jobs", "--no-fsync"})


@dataclass(frozen=True, slots=True)
class Option:
    """An option of `convert` and its values; none: a flag."""

    name: str  # as typed: --max-wait
    values: tuple[str, ...] = ()

    @property
    def words(self) -> list[str]:
        """The option as words of a command line."""
        if not self.values:
            return [self.name]
        return [word for value in self.values for word in (self.name, value)]


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a session, None: no limit; disk_bytes: of its folder, with unfinished files."""

    time_s: float | None = None
    disk_bytes: float | None = None

    @property
    def texts(self) -> tuple[str, ...]:
        """Each limit in words."""
        time = f"{self.time_s:g} s" if self.time_s is not None else ""
        disk = f"{self.disk_bytes / 1e6:g} MB" if self.disk_bytes is not None else ""
        return tuple(filter(None, (time, disk)))


NO_LIMITS = Limits()


@dataclass(frozen=True, slots=True)
class Session:
    """Recordings that are converted together; inputs and rig: paths or URLs.

    known_bad: why it is not converted, "" if it is.
    """

    name: str
    inputs: tuple[str, ...]
    rig: str | None = None
    options: tuple[Option, ...] = ()
    limits: Limits = NO_LIMITS
    known_bad: str = ""

    def absolute(self) -> Session:
        """The session with absolute paths, for processes with other working folders."""
        rig = None if self.rig is None else _absolute(self.rig)
        return replace(self, inputs=tuple(map(_absolute, self.inputs)), rig=rig)

    @property
    def urls(self) -> list[str]:
        """Recordings and rig that are in a store."""
        return [text for text in (*self.inputs, self.rig or "") if is_url(text)]

    @property
    def local_rig(self) -> Path | None:
        """The rig, unless it is in a store."""
        return None if self.rig is None or is_url(self.rig) else Path(self.rig)

    def values(self, name: str, rig: Rig | None = None) -> tuple[str, ...]:
        """Values of an option of `convert`: as given, else from the rig."""
        kept = {one.name: one.values for one in rig.options} if rig is not None else {}
        given = {one.name.removeprefix("--"): one.values for one in self.options}
        return (kept | given).get(name, ())

    @property
    def output(self) -> str:
        """Name of the output in the folder of the session; the format decides it."""
        (name,) = self.values("format", read_rig(self.rig)) or ("mcap",)
        return OUTPUT + _SUFFIX.get(name, "")

    @property
    def key_words(self) -> list[str]:
        """The options that may change the output, in a fixed order."""
        kept = sorted(
            (one for one in self.options if one.name not in _NOT_IN_KEY), key=lambda one: one.name
        )
        return [word for one in kept for word in one.words]


_TIME_UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0}
_DISK_UNITS = {"MB": 1e6, "GB": 1e9, "TB": 1e12}


def read_limits(time: str | None, disk: str | None, places: tuple[str, str]) -> Limits:
    """Limits as written: `90 min` and `50 GB`; places: of both, for a UsageError."""
    of_time, of_disk = places
    return Limits(
        None if time is None else _amount(time, _TIME_UNITS, "2 h, 90 min or 30 s", of_time),
        None if disk is None else _amount(disk, _DISK_UNITS, "50 GB, 500 MB or 1.5 TB", of_disk),
    )


def _amount(text: str, units: Mapping[str, float], examples: str, where: str) -> float:
    match = _AMOUNT.fullmatch(text.strip())
    if match is None or match[2] not in units or not float(match[1]):
        raise UsageError(f"{where}: expected a limit as {examples}, found {text!r}; add its unit")
    return float(match[1]) * units[match[2]]


def check_name(name: str, where: str) -> str:
    """A name of a session, which is that of a folder; UsageError otherwise."""
    if not _NAME.fullmatch(name) or name.endswith((" ", ".partial")):
        raise UsageError(
            f"{where}: expected a session name that is a folder name (no slash, no leading dot), "
            f"found {name!r}; give another by `name`"
        )
    return name


def check_unique(sessions: Sequence[Session]) -> None:
    """Raise UsageError if two sessions have one name, also where case does not count."""
    seen: dict[str, Session] = {}
    for session in sessions:
        other = seen.setdefault(session.name.casefold(), session)
        if other is not session:
            raise UsageError(
                f"sessions: expected different names, found {session.name!r} for "
                f"{', '.join(other.inputs)} and for {', '.join(session.inputs)}; use a manifest "
                'with `name: "{folder}-{stem}"`'
            )


def is_url(text: str) -> bool:
    """Whether an input or output is in object storage, or on a web server."""
    return "://" in text


def _absolute(text: str) -> str:
    return text if is_url(text) else str(Path(text).absolute())


def read_rig(rig: str | None, recordings: Sequence[str] = ()) -> Rig | None:
    """The rig of a session; None without one, in a store, or if `convert` will name a mistake."""
    if rig is None or is_url(rig):
        return None
    from mlbatch.rig import rig as rigs

    try:
        return rigs.read_rig(Path(rig), [Path(one) for one in recordings if not is_url(one)])
    except RigError:
        return None


def own_files(folder: Path) -> list[Path]:
    """Files that a run wrote to the folder of a session."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if OWN.fullmatch(path.name))
