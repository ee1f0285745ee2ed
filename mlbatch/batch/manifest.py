"""The sessions of a batch: from a manifest (YAML), or from glob patterns."""

from __future__ import annotations

import contextlib
import glob as globbing
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path, PurePosixPath

from mlbatch import options
from mlbatch.batch.session import (
    NO_LIMITS,
    Limits,
    Option,
    Session,
    check_name,
    check_unique,
    is_url,
    read_limits,
    read_rig,
)
from mlbatch.errors import RecordingError, UsageError
from mlbatch.pipeline.job import Shard
from mlbatch.readers.datasets import BAG_METADATA
from mlbatch.rig.recipes import rig_of
from mlbatch.rig.yaml_tree import Node, read_yaml

SCHEMA = "mlbatch.batch/1"
_KEYS = ("schema", "rig", "dataset", "rigs", "options", "limits", "known_bad", "sessions")
_SESSION_KEYS = ("glob", "name", "inputs", "rig", "dataset", "options", "limits")
_RULE_KEYS = ("sessions", "from", "until", "rig")
_LIMIT_KEYS = ("time", "disk")
_TEXT = re.compile(r"\S(.*\S)?")
_FIELDS = re.compile(r"\{(\w*)\}")
_TEMPLATE_WORDS = ("folder", "stem", "name")
# Files of a folder that are recordings; gzip and zstd of them, too.
_RECORDINGS = re.compile(r".*\.(pcap|pcapng|cap|mcap|bag|db3)(\.gz|\.zst|\.zstd)?", re.IGNORECASE)
_SUFFIXES = re.compile(r"(?<=.)(\.(gz|zstd?|pcapng|pcap|cap|mcap|bag|db3))+$")
# Not looked into before they are fetched: objects with these names are no recordings.
_DOCUMENTS = re.compile(r".*\.(json|ya?ml|csv|dat|tum|txt|md|log|html)", re.IGNORECASE)
# Names that a message shows.
_SHOWN = 5
_DATE = re.compile(r"(?<!\d)(20\d\d)([-_]?)(\d\d)\2(\d\d)")
_WILD = re.compile(r"[*?\[]")
# Options of `convert` that a manifest may have: of the batch, `--only` names sessions.
_OPTIONS = {one.name: one for one in options.BATCH} | {
    name: options.BY_NAME[name] for name in ("only", "jobs")
}


@dataclass(frozen=True, slots=True)
class Common:
    """Values for all sessions that have none of their own.

    rig: may have fields as names of sessions; rig_place: key of the manifest, "" of the command
    line, which reads it itself; rules: rigs by name or date, the first that fits before `rig`.
    """

    rig: str | None = None
    options: tuple[Option, ...] = ()
    rig_place: str = ""
    limits: Limits = NO_LIMITS
    rules: tuple[RigRule, ...] = ()

    def rig_of(self, name: str, match: str) -> str | None:
        """The rig of a session, by what its pattern matched or by its first recording.

        Raises UsageError where the manifest has no such file.
        """
        rule = next((one for one in self.rules if one.fits(name, match)), None)
        rig, place = (self.rig, self.rig_place) if rule is None else (rule.rig, rule.place)
        if rig is None and self.rules:
            raise UsageError(
                f"{self.rules[0].place}: expected a rig for session {name}, found no rule that "
                "fits it; add one, or the key rig for all others"
            )
        if rig is None:
            return None
        rig = _named(rig, match)
        if place and not is_url(rig) and not Path(rig).is_file():
            raise UsageError(
                f"{place}: expected the rig of session {name}, found no file {rig}; "
                "correct the path, which is relative to the manifest"
            )
        return rig

    def session(self, name: str, inputs: tuple[str, ...], match: str) -> Session:
        """A session; UsageError where it has no rig."""
        return Session(name, inputs, self.rig_of(name, match), self.options, self.limits)


@dataclass(frozen=True, slots=True)
class RigRule:
    """A rig for sessions by name (a pattern), or by date: from the first day to the last."""

    rig: str
    place: str
    pattern: str = "*"
    first: date | None = None
    last: date | None = None

    def fits(self, name: str, match: str) -> bool:
        """Whether it is for a session; UsageError where one needs a date and has none."""
        if not fnmatchcase(name, self.pattern):
            return False
        if self.first is None and self.last is None:
            return True
        day = _date_in(name) or _date_in(match)
        if day is None:
            raise UsageError(
                f"{self.place}: expected a date in the name of session {name} or in its path, "
                "found none; choose its rig by the key sessions in a rule before this one"
            )
        return (self.first or day) <= day <= (self.last or day)


def _date_in(text: str) -> date | None:
    """The last date in a name or path: 2024-05-01, 2024_05_01 or 20240501."""
    for found in reversed(list(_DATE.finditer(text))):
        with contextlib.suppress(ValueError):
            return date(int(found[1]), int(found[3]), int(found[4]))
    return None


def _nothing(text: str) -> None: ...


def sessions_of(
    sources: Sequence[str],
    given: Common,
    say: Callable[[str], None] = _nothing,
) -> tuple[Session, ...]:
    """The sessions of manifests and patterns in their order.

    given: by the command line; its options override a manifest. say: gets a line for each
    pattern that matches files that are no recordings, which are left out. Raises UsageError and
    RigError for mistakes, also where a pattern matches nothing.
    """
    found: list[Session] = []
    for source in sources:
        if source.lower().endswith((".yaml", ".yml")) and not is_url(source):
            found += _of_manifest(Path(source), given, say)
        else:
            found += _of_pattern(source, "{stem}", given, source, say)
    check_unique(found)
    return tuple(found)


# -- patterns ---------------------------------------------------------------------------------


def _of_pattern(
    pattern: str, template: str, common: Common, where: str, say: Callable[[str], None]
) -> Iterator[Session]:
    """A session for each file or folder that matches, but files that are no recordings."""
    matches = _matches(pattern)
    if _WILD.search(pattern):
        others = [match for match in matches if not _may_be_recording(match)]
        matches = [match for match in matches if match not in others]
        if others and matches:
            names = ", ".join(PurePosixPath(match).name for match in others[:_SHOWN])
            more = ", ..." if len(others) > _SHOWN else ""
            say(f"{where}: left out {len(others)} files that are no recordings: {names}{more}")
    if not matches:
        raise UsageError(
            f"{where}: expected recordings or folders, found none for {pattern!r}; check the "
            "pattern"
        )
    found = []
    for match in matches:
        name = _named(template, match)
        found.append((name, match, _inputs(match, partial(common.rig_of, name, match))))
    if not any(inputs for *_, inputs in found):
        raise UsageError(
            f"{where}: expected recordings in what matches {pattern!r}, found none; check the "
            "pattern, or give the rig that describes folders of sweeps"
        )
    for name, match, inputs in found:
        if inputs:
            yield common.session(check_name(name, where), inputs, match)


def _matches(pattern: str) -> list[str]:
    if is_url(pattern):
        if not _WILD.search(pattern):
            return [pattern]
        from mlbatch.batch.remote import matching

        return matching(pattern)
    return sorted(path.rstrip("/") for path in globbing.glob(pattern, recursive=True))


def _may_be_recording(match: str) -> bool:
    """False for files that have neither the name nor the content of a recording."""
    if _RECORDINGS.fullmatch(match) or match.endswith("/"):
        return True
    if is_url(match):
        return not _DOCUMENTS.fullmatch(match)
    path = Path(match)
    if not path.is_file():
        return True
    from mlbatch.readers import readers
    from mlbatch.readers.source import read_head

    try:
        head = read_head(path)
    except RecordingError:
        # Empty, or not readable.
        return False
    return any(one.recognises(head) for one in readers())


def _inputs(match: str, rig_of: Callable[[], str | None]) -> tuple[str, ...]:
    """Recordings of a match: itself, or the recordings in a folder; empty if there are none."""
    if is_url(match):
        if not match.endswith("/"):
            return (match,)
        from mlbatch.batch.remote import listed

        return tuple(
            one.url for one in listed(match, is_deep=False) if _RECORDINGS.fullmatch(one.url)
        )
    path = Path(match)
    if not path.is_dir() or (path / BAG_METADATA).is_file():
        return (match,)
    found = tuple(
        str(entry)
        for entry in sorted(path.iterdir())
        if (_RECORDINGS.fullmatch(entry.name) and entry.is_file())
        or (entry / BAG_METADATA).is_file()
    )
    rig = None
    if not found:
        # A folder without recordings and without a rig is no session.
        with contextlib.suppress(UsageError):
            rig = read_rig(rig_of(), (match,))
    sweeps = () if rig is None else [one.sweeps.paths for one in rig.sensors if one.sweeps]
    is_of_sweeps = any(next(path.glob(pattern), None) is not None for pattern in sweeps)
    return (match,) if is_of_sweeps else found


def _named(template: str, match: str) -> str:
    """The name of a session: folder, stem (without suffixes of recordings) and name of a match."""
    # Of "." and "..", too, and of a file in the folder that one is in.
    path = PurePosixPath(match.rstrip("/") if is_url(match) else os.path.abspath(match))
    is_folder = match.endswith("/") or (not is_url(match) and Path(match).is_dir())
    stem = path.name if is_folder else _SUFFIXES.sub("", path.name)
    folder = path.name if is_folder else path.parent.name
    words = {"folder": folder, "stem": stem, "name": path.name}
    return _FIELDS.sub(lambda found: words.get(found[1], found[0]), template)


# -- manifests --------------------------------------------------------------------------------


def _of_manifest(path: Path, given: Common, say: Callable[[str], None]) -> Iterator[Session]:
    root = read_yaml(path).fields(_KEYS, ("schema", "sessions"))
    root["schema"].choice((SCHEMA,))
    of_all = _options(root.get("options"))
    mine = {option.name[2:].replace("-", "_"): option for option in given.options}
    nodes = root["sessions"].elements("sessions")
    if not nodes:
        raise root["sessions"].error("a list of sessions", "an empty one", "add one")
    of_manifest = _rig(root)
    rules = tuple(map(_rule, root["rigs"].elements("rules"))) if "rigs" in root else ()
    found: list[Session] = []
    for node in nodes:
        entries = node.fields(_SESSION_KEYS)
        own = _options(entries.get("options"))
        common = replace(given, options=_joined(of_all, own, mine))
        rig = _rig(entries)
        if given.rig is None:
            common = replace(common, rules=rules if rig is None else ())
            of_session, place = rig or of_manifest or (None, "")
            common = replace(common, rig=of_session, rig_place=place)
        for limits in filter(None, (root.get("limits"), entries.get("limits"))):
            common = replace(common, limits=_limits(limits, common.limits, given.limits))
        found += _of_entry(node, entries, common, say)
    yield from _with_known_bad(found, root.get("known_bad"))


def _rig(entries: Mapping[str, Node]) -> tuple[str, str] | None:
    """The rig of all sessions or of one, and its place: by the key rig, or dataset."""
    rig, dataset = entries.get("rig"), entries.get("dataset")
    if dataset is not None:
        given = None if rig is None else Path(_text(rig))
        return str(rig_of(given, _text(dataset), dataset.place)), dataset.place
    return None if rig is None else (_rig_path(rig), rig.place)


def _rule(node: Node) -> RigRule:
    entries = node.fields(_RULE_KEYS, ("rig",))
    if len(entries) == 1:
        raise node.error("sessions, from or until", "only rig", "add one, or use the key rig")
    pattern = _text(entries["sessions"]) if "sessions" in entries else "*"
    first, last = (_day(entries[key]) if key in entries else None for key in ("from", "until"))
    if first and last and first > last:
        raise node.error(f"until not before {first}", str(last), "exchange them")
    return RigRule(_rig_path(entries["rig"]), entries["rig"].place, pattern, first, last)


def _day(node: Node) -> date:
    text = _text(node)
    try:
        return date.fromisoformat(text)
    except ValueError:
        raise node.error("a date as 2024-05-31", repr(text), "correct it") from None


def _limits(node: Node, known: Limits, given: Limits) -> Limits:
    """Limits of a manifest: over those known before, below those of the command line."""
    entries = node.fields(_LIMIT_KEYS)
    time, disk = (_text(entries[key]) if key in entries else None for key in _LIMIT_KEYS)
    of_time, of_disk = (entries.get(key, node).place for key in _LIMIT_KEYS)
    found = read_limits(time, disk, (of_time, of_disk))
    return Limits(
        given.time_s or found.time_s or known.time_s,
        given.disk_bytes or found.disk_bytes or known.disk_bytes,
    )


def _with_known_bad(sessions: Sequence[Session], node: Node | None) -> Iterator[Session]:
    """The sessions; those that a list of names or patterns has with its reason."""
    entries: Mapping[str, Node] = {}
    if node is not None:
        if node.kind != "mapping":
            raise node.error("sessions with reasons", node.shown, "write `NAME: reason`")
        entries = node.entries
    for pattern, reason in entries.items():
        if not any(fnmatchcase(one.name, pattern) for one in sessions):
            raise reason.error("the name of a session", repr(pattern), "correct it")
    for one in sessions:
        fitting = (_text(reason) for key, reason in entries.items() if fnmatchcase(one.name, key))
        yield replace(one, known_bad=next(fitting, ""))


def _of_entry(
    node: Node, entries: Mapping[str, Node], common: Common, say: Callable[[str], None]
) -> Iterator[Session]:
    if ("glob" in entries) == ("inputs" in entries):
        found = "both" if "glob" in entries else "none"
        raise node.error("one of the keys glob and inputs", found, "give one of them")
    name = entries.get("name")
    if "inputs" in entries:
        inputs = tuple(_path(one) for one in entries["inputs"].elements("recordings"))
        if not inputs:
            raise entries["inputs"].error("a list of recordings", "an empty one", "add one")
        text = _named("{stem}", inputs[0]) if name is None else _text(name)
        yield common.session(check_name(text, node.place), inputs, inputs[0])
        return
    template = "{stem}" if name is None else _text(name)
    _check_fields(template, name or node)
    yield from _of_pattern(_path(entries["glob"]), template, common, entries["glob"].place, say)


def _rig_path(node: Node) -> str:
    """A path of a rig, with fields of names."""
    _check_fields(_text(node), node)
    return _path(node)


def _check_fields(template: str, node: Node) -> None:
    for word in _FIELDS.findall(template):
        if word not in _TEMPLATE_WORDS:
            known = ", ".join(f"{{{one}}}" for one in _TEMPLATE_WORDS)
            raise node.error(known, f"{{{word}}}", "use one of them")


def _text(node: Node) -> str:
    return node.word("a text", _TEXT)


def _path(node: Node) -> str:
    """A path, relative to the manifest, or a URL."""
    text = _text(node)
    if is_url(text):
        return text
    slash = "/" if text.endswith("/") else ""
    return f"{node.file.parent / text}{slash}"


def _options(node: Node | None) -> dict[str, Option | None]:
    """Options of `convert`, named with `_` or `-`; None: a flag that is false."""
    if node is None or node.is_null():
        return {}
    entries = {name.replace("-", "_"): value for name, value in node.entries.items()}
    found = node._replace(entries=entries).fields(tuple(_OPTIONS))
    return {name: _option(value, _OPTIONS[name]) for name, value in found.items()}


def _option(node: Node, option: options.Option) -> Option | None:
    if option.kind == options.FLAG:
        return Option(option.long) if node.flag() else None
    is_list = option.kind in (options.TEXTS, options.PATHS) and node.kind == "list"
    return Option(option.long, tuple(map(_text, node.items if is_list else (node,))))


def _joined(*several: Mapping[str, Option | None]) -> tuple[Option, ...]:
    """Merge options; later ones replace earlier ones of the same name."""
    found = {name: option for options in several for name, option in options.items()}
    return tuple(option for option in found.values() if option is not None)


# -- a part of them ---------------------------------------------------------------------------


def chosen(sessions: Sequence[Session], only: Sequence[str], part: Shard) -> tuple[Session, ...]:
    """The sessions of `--only` and `--part`: of N parts, each Nth session by name."""
    names = {session.name for session in sessions}
    for name in only:
        if name not in names:
            import difflib

            nearest = difflib.get_close_matches(name, sorted(names), n=1, cutoff=0.0)[0]
            raise UsageError(
                f"--only: expected the name of a session, found {name!r}; the nearest is {nearest}"
            )
    mine = [name for number, name in enumerate(sorted(names)) if part.has(number)]
    return tuple(one for one in sessions if one.name in mine and (not only or one.name in only))
