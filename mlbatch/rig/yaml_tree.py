"""YAML files as trees of `Node`, built from parser events.

Nothing is constructed from tags, and aliases cannot multiply.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path

import yaml

from mlbatch.errors import RigError


def read_yaml(file: Path) -> Node:
    """The tree of a YAML file; RigError for anything that is not one plain document."""
    text = _text(file)
    composer = _Composer(file, yaml.parse(text, Loader=yaml.SafeLoader))
    try:
        return composer.document()
    except yaml.MarkedYAMLError as err:
        line = err.problem_mark.line + 1 if err.problem_mark else 1
        remedy = "check indentation, colons and brackets here and one line above"
        raise fault(file, line, "", f"wanted YAML, got {err.problem}; {remedy}") from err
    except yaml.reader.ReaderError as err:
        line = text.count("\n", 0, int(err.position)) + 1
        got = f"the control character {ord(text[int(err.position)]):#04x}"
        raise fault(file, line, "", f"wanted YAML, got {got}; remove it") from err


def _text(file: Path) -> str:
    try:
        with file.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except (OSError, ValueError) as err:
        reason = (getattr(err, "strerror", None) or str(err)).lower()
        raise RigError(f"{file}: wanted a readable file, got {reason}; check the path") from err
    if len(data) > MAX_BYTES:
        raise RigError(
            f"{file}: wanted at most {MAX_BYTES} bytes, got more; "
            "check that this is a rig file and not a recording"
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as err:
        line = data.count(b"\n", 0, err.start) + 1
        got = f"the byte {data[err.start]:#04x}"
        raise fault(file, line, "", f"wanted UTF-8 text, got {got}; save it as UTF-8") from err


def _line(event: yaml.Event) -> int:
    return event.start_mark.line + 1 if event.start_mark else 1


class _Composer:
    """Builds the tree from parser events."""

    def __init__(self, file: Path, events: Iterator[yaml.Event]) -> None:
        self.file = file
        self.events = events
        self.values = 0

    def document(self) -> Node:
        """The only document of the stream; an empty file is a scalar without text."""
        root = Node(self.file, "", 1, "scalar", plain=True)
        documents = 0
        for event in self.events:
            if not isinstance(event, yaml.DocumentStartEvent):
                continue
            documents += 1
            if documents > 1:
                message = "wanted one document, got a second one; remove what follows `---`"
                raise fault(self.file, _line(event), "", message)
            root = self.node(next(self.events), "", 0)
        return root

    def node(self, event: yaml.Event, path: str, depth: int) -> Node:
        """The value that begins with `event`."""
        line = _line(event)
        self.values += 1
        self._check(event, path, line, depth)
        if isinstance(event, yaml.ScalarEvent):
            plain = event.style is None
            return Node(self.file, path, line, "scalar", text=str(event.value), plain=plain)
        if isinstance(event, yaml.SequenceStartEvent):
            return Node(self.file, path, line, "list", items=tuple(self._items(path, depth)))
        return Node(self.file, path, line, "mapping", entries=self._entries(path, depth))

    def _check(self, event: yaml.Event, path: str, line: int, depth: int) -> None:
        message = ""
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            message = "wanted plain values, got an anchor or alias; write the value out"
        elif (tag := getattr(event, "tag", None)) is not None:
            message = f"wanted plain values, got the tag {short(tag)}; remove it"
        elif depth > MAX_DEPTH:
            message = f"wanted at most {MAX_DEPTH} levels, got more; remove brackets"
        elif self.values > MAX_VALUES:
            message = f"wanted at most {MAX_VALUES} values, got more; check that this is a rig file"
        if message:
            raise fault(self.file, line, path, message)

    def _items(self, path: str, depth: int) -> Iterator[Node]:
        for index, event in enumerate(self.events):
            if isinstance(event, yaml.SequenceEndEvent):
                return
            yield self.node(event, f"{path}[{index}]", depth + 1)

    def _entries(self, path: str, depth: int) -> Mapping[str, Node]:
        entries: dict[str, Node] = {}
        for event in self.events:
            if isinstance(event, yaml.MappingEndEvent):
                break
            line = _line(event)
            self._check(event, path, line, depth)
            if not isinstance(event, yaml.ScalarEvent):
                message = "wanted a word as key, got brackets; put the brackets after the colon"
                raise fault(self.file, line, path, message)
            name = str(event.value)
            key = name if KEY.fullmatch(name) else short(name)
            here = f"{path}.{key}" if path else key
            if name in entries:
                message = f"wanted each key once, got it again (first on line {entries[name].line})"
                raise fault(self.file, line, here, message + "; remove one of the two")
            # The line of the key: that of the value is one further down where it is a block.
            entries[name] = replace(self.node(next(self.events), here, depth + 1), line=line)
        return entries


# YAML as a tree of places: each value knows its file, key path and line, for errors that help.
#
# Scalars keep their text: 29.97 is exactly 2997/100, `on` stays `on`, and 0012 stays a serial
# number. `_yaml_tree.py` builds the tree.

# Of both, the 256 sensors that a rig may have need less; a parser takes its time for each value.
MAX_BYTES, MAX_VALUES = 300_000, 20_000
MAX_DEPTH = 16
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d{1,3})?", re.ASCII)
_MAX_DIGITS = 100
KEY = re.compile(r"\w{1,40}", re.ASCII)
# The spellings of YAML 1.1, which people know.
_FLAGS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}
_NOTHING = ("", "~", "null", "Null", "NULL")


@dataclass(frozen=True, slots=True)
class Node:
    """A value of the file: a scalar (`text`), a list (`items`) or a mapping (`entries`).

    path: keys that lead here, as `sensors[1].name`; line: from 1; plain: written without quotes.
    """

    file: Path
    path: str
    line: int
    kind: str
    text: str = ""
    plain: bool = False
    items: tuple[Node, ...] = ()
    entries: Mapping[str, Node] = field(default_factory=dict)

    def error(self, wanted: str, got: str, remedy: str) -> RigError:
        """The error for a value that cannot be used."""
        return self.fault(f"wanted {wanted}, got {got}; {remedy}")

    def fault(self, message: str) -> RigError:
        """An error that says where this value stands."""
        return fault(self.file, self.line, self.path, message)

    @property
    def shown(self) -> str:
        """What stands here, in a few words."""
        if self.kind == "scalar":
            if self.is_nothing():
                return "nothing"
            return short(self.text) if self.plain else f"the text {short(self.text)}"
        return f"a list of {len(self.items)}" if self.kind == "list" else "a mapping"

    def is_nothing(self) -> bool:
        """Whether the value was left out or is null."""
        return self.kind == "scalar" and self.plain and self.text in _NOTHING

    def fields(self, known: Sequence[str], required: Sequence[str] = ()) -> Mapping[str, Node]:
        """The entries of a mapping that has no other keys than the known ones."""
        if self.kind != "mapping":
            keys = ", ".join(known)
            raise self.error(f"a mapping with keys of {keys}", self.shown, "write `key: value`")
        for key, node in self.entries.items():
            if key not in known:
                nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.0)[0]
                remedy = f"the nearest known key is {nearest}"
                raise node.error(f"a key of {', '.join(known)}", short(key), remedy)
        for key in required:
            if key not in self.entries:
                raise self.error(f"the key {key}", "none", "add it")
        return self.entries

    def elements(self, what: str) -> tuple[Node, ...]:
        """The values of a list."""
        if self.kind != "list":
            raise self.error(f"a list of {what}", self.shown, "write [a, b] or lines with `- `")
        return self.items

    def word(self, what: str, pattern: re.Pattern[str]) -> str:
        """Text of the given form."""
        if self.kind != "scalar" or self.is_nothing() or not pattern.fullmatch(self.text):
            raise self.error(what, self.shown, "correct it or remove the key")
        return self.text

    def choice(self, words: Sequence[str]) -> str:
        """One of some words."""
        if self.kind != "scalar" or self.text not in words:
            raise self.error(" or ".join(words), self.shown, "use one of these words")
        return self.text

    def flag(self) -> bool:
        """True or false."""
        value = _FLAGS.get(self.text.lower()) if self.plain else None
        if value is None:
            raise self.error("true or false", self.shown, "write one of the two, without quotes")
        return value

    def exact(self) -> Fraction:
        """A number, as it is written."""
        if not (self.plain and len(self.text) <= _MAX_DIGITS and _NUMBER.fullmatch(self.text)):
            remedy = "write a decimal number, without quotes or unit"
            raise self.error("a finite number", self.shown, remedy)
        return Fraction(self.text)

    def number(self) -> float:
        """A number in float64."""
        self.exact()
        value = float(self.text)
        if not math.isfinite(value):
            raise self.error("a finite number", self.shown, "give one that float64 can hold")
        return value

    def whole(self, low: int, high: int) -> int:
        """An integer in [low, high]."""
        exact = self.exact()
        if exact.denominator != 1 or not low <= exact <= high:
            wanted = f"a whole number from {low} to {high}"
            raise self.error(wanted, self.shown, "correct it or remove the key")
        return int(exact)

    def numbers(self, count: int) -> list[float]:
        """A list of so many numbers."""
        items = self.elements(f"{count} numbers")
        if len(items) != count:
            raise self.error(f"{count} numbers", self.shown, f"give all {count} and no more")
        return [item.number() for item in items]


def short(text: str) -> str:
    """Text in quotes, on one line and not too long."""
    return repr(text if len(text) <= 40 else text[:40] + "...")


def fault(file: Path, line: int, path: str, message: str) -> RigError:
    """The error about a place in a file."""
    place = f"{file}:{line}: {path}: " if path else f"{file}:{line}: "
    return RigError(place + message)
