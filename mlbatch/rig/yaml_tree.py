"""YAML files as trees of values that know their file, key path and line, for precise errors.

Scalars keep their text: 29.97 is exactly 2997/100, `on` stays `on`, and 0012 stays a serial number.
Nothing is constructed from tags, and aliases are refused, so that they cannot multiply.
"""

from __future__ import annotations

import difflib
import errno
import itertools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import yaml

from mlbatch.bounded import read_bytes
from mlbatch.errors import RigError

# Limits for untrusted files; a rig of 256 sensors needs less.
MAX_BYTES = 300_000
MAX_VALUES = 20_000
MAX_DEPTH = 16
_MAX_DIGITS = 100
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d{1,3})?", re.ASCII)
_KEY = re.compile(r"\w{1,40}", re.ASCII)
# A key without indentation.
_BLOCK = re.compile(r"[A-Za-z_][\w.\- ]*:")
_OPENCV_HEAD = re.compile(r"\A%(?=YAML:\d)")
# Spellings of YAML 1.1.
_FLAGS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}
_NULLS = ("", "~", "null", "Null", "NULL")


class Node(NamedTuple):
    """A value of the file: a scalar (`text`), a list (`items`) or a mapping (`entries`).

    path: keys from the root, as `sensors[1].name`; line: counts from 1; kind: scalar, list or
    mapping, or repeated: a key of a foreign file that occurs twice or is damaged, text: how;
    plain: a scalar without quotes.
    """

    file: Path
    path: str
    line: int
    kind: str
    text: str = ""
    plain: bool = False
    items: tuple[Node, ...] = ()
    entries: Mapping[str, Node] = MappingProxyType({})

    def error(self, expected: str, found: str, remedy: str) -> RigError:
        """Return the error for an unusable value."""
        return self.error_here(f"expected {expected}, found {found}; {remedy}")

    def error_here(self, message: str) -> RigError:
        """Return an error with the position of this value."""
        return _error(self.file, self.line, self.path, message)

    @property
    def place(self) -> str:
        """File, line and key path, as errors begin."""
        return _place(self.file, self.line, self.path)

    @property
    def shown(self) -> str:
        """The value in a few words, for errors."""
        if self.kind == "list":
            return f"a list of {len(self.items)}"
        if self.kind == "mapping":
            return "a mapping"
        if self.is_null():
            return "nothing"
        if self.kind == "repeated":
            return self.text
        return short(self.text) if self.plain else f"the text {short(self.text)}"

    def is_null(self) -> bool:
        """Return whether the value is missing or null."""
        return self.kind == "scalar" and self.plain and self.text in _NULLS

    def fields(self, known: Sequence[str], required: Sequence[str] = ()) -> Mapping[str, Node]:
        """Return the entries of a mapping; RigError for unknown and missing keys."""
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

    def entry(self, key: str) -> Node:
        """Return the value of a key that a mapping must have; other keys do not matter."""
        if key not in self.entries:
            content = self.shown
            if self.kind == "mapping":
                content = f"keys {', '.join(self.entries) or 'none'}"
            raise self.error(f"the key {key}", content, "correct the file")
        return self.entries[key]

    def elements(self, what: str) -> tuple[Node, ...]:
        """Return the values of a list."""
        if self.kind != "list":
            raise self.error(f"a list of {what}", self.shown, "write [a, b] or lines with `- `")
        return self.items

    def word(self, what: str, pattern: re.Pattern[str]) -> str:
        """Return text of the given form."""
        if self.kind != "scalar" or self.is_null() or not pattern.fullmatch(self.text):
            raise self.error(what, self.shown, "correct it or remove the key")
        return self.text

    def choice(self, words: Sequence[str]) -> str:
        """Return one of some words."""
        if self.kind != "scalar" or self.text not in words:
            raise self.error(" or ".join(words), self.shown, "use one of these words")
        return self.text

    def flag(self) -> bool:
        """Return true or false."""
        value = _FLAGS.get(self.text.lower()) if self.plain else None
        if value is None:
            raise self.error("true or false", self.shown, "write one of the two, without quotes")
        return value

    def exact(self) -> Fraction:
        """Return the number that the text is, exactly."""
        if not (self.plain and len(self.text) <= _MAX_DIGITS and _NUMBER.fullmatch(self.text)):
            remedy = "write a decimal number, without quotes or unit"
            raise self.error("a finite number", self.shown, remedy)
        return Fraction(self.text)

    def number(self) -> float:
        """Return a number in float64."""
        self.exact()
        value = float(self.text)
        if not math.isfinite(value):
            raise self.error("a finite number", self.shown, "give one within the range of float64")
        return value

    def whole(self, low: int, high: int) -> int:
        """Return an integer in [low, high]."""
        exact = self.exact()
        if exact.denominator != 1 or not low <= exact <= high:
            expected = f"a whole number from {low} to {high}"
            raise self.error(expected, self.shown, "correct it or remove the key")
        return int(exact)

    def numbers(self, count: int) -> list[float]:
        """Return a list of `count` numbers."""
        items = self.elements(f"{count} numbers")
        if len(items) != count:
            raise self.error(f"{count} numbers", self.shown, f"give all {count} and no more")
        return [item.number() for item in items]


def read_yaml(file: Path) -> Node:
    """Read a YAML file; RigError unless it is one document of plain values."""
    return _read(file, _text(file), _Loader)


def read_foreign(file: Path) -> Node:
    """Read YAML of OpenCV, or JSON: its tags and head are accepted, repeated keys are marked."""
    # Not a directive of YAML, which has a blank there.
    return _read(file, _OPENCV_HEAD.sub("#", _text(file), count=1), _ForeignLoader)


def read_foreign_blocks(file: Path) -> Node:
    """Read a foreign file key by key; what is no YAML is marked and does not affect the others."""
    lines = _text(file).splitlines()
    starts = [number for number, line in enumerate(lines) if _BLOCK.match(line)]
    entries: dict[str, Node] = {}
    for start, end in itertools.pairwise([*starts, len(lines)]):
        name = lines[start].partition(":")[0].strip()
        # Empty lines keep the numbers of lines.
        text = "\n" * start + "\n".join(lines[start:end])
        if name in entries:
            first = f"first on line {entries[name].line}"
            entries[name] = Node(file, name, start + 1, "repeated", text=f"the key twice ({first})")
            continue
        try:
            entries |= _read(file, text, _ForeignLoader).entries
        except RigError:
            entries[name] = Node(file, name, start + 1, "repeated", text="a mistake in YAML")
    return Node(file, "", 1, "mapping", entries=entries)


def _read(file: Path, text: str, kind: type[_Loader]) -> Node:
    try:
        loader = kind(file, text)
        # An empty file has no node.
        root = loader.get_node() if loader.check_node() else None
        if loader.check_node():
            line = _line(loader.next_event())
            message = "expected one document, found a second one; remove what follows `---`"
            raise _error(file, line, "", message)
    except yaml.MarkedYAMLError as err:
        line = err.problem_mark.line + 1 if err.problem_mark else 1
        remedy = "check indentation, colons and brackets here and one line above"
        message = f"expected YAML, found a mistake ({err.problem}); {remedy}"
        raise _error(file, line, "", message) from err
    except yaml.reader.ReaderError as err:
        line = text.count("\n", 0, int(err.position)) + 1
        found = f"the control character {ord(text[int(err.position)]):#04x}"
        raise _error(file, line, "", f"expected YAML, found {found}; remove it") from err
    if root is None:
        return Node(file, "", 1, "scalar", plain=True)
    return _tree(file, root, "", _line(root), marks_repeated=kind is _ForeignLoader)


class _Loader(yaml.SafeLoader):
    """Composes plain values; refuses anchors, aliases, tags, and more values than the limits."""

    TAGS: tuple[str, ...] = ()

    def __init__(self, file: Path, text: str) -> None:
        super().__init__(text)
        self._file = file
        self._paths: list[str] = []
        self._values = 0

    def next_event(self) -> yaml.Event:
        """Return the next event of the parser without consuming it."""
        # Declared here, as the type stubs of PyYAML leave it out.
        peek: Callable[[], yaml.Event] = self.peek_event
        return peek()

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Compose the next value; index: position in a list, key node in a mapping, None: a key."""
        event = self.next_event()
        path = self._paths[-1] if self._paths else ""
        is_key = parent is not None and index is None
        if not is_key:
            path = _below(path, index)
            self._values += 1
        message = ""
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            message = "expected plain values, found an anchor or alias; write the value out"
        elif (tag := getattr(event, "tag", None)) is not None and tag not in self.TAGS:
            message = f"expected plain values, found the tag {short(tag)}; remove it"
        elif is_key and not isinstance(event, yaml.ScalarEvent):
            message = "expected a word as key, found brackets; put the brackets after the colon"
        elif len(self._paths) > MAX_DEPTH:
            message = f"expected at most {MAX_DEPTH} levels, found more; remove brackets"
        elif self._values > MAX_VALUES:
            remedy = "check that this is a rig file"
            message = f"expected at most {MAX_VALUES} values, found more; {remedy}"
        if message:
            raise _error(self._file, _line(event), path, message)
        self._paths.append(path)
        node = super().compose_node(parent, index)
        self._paths.pop()
        return node


class _ForeignLoader(_Loader):
    """Accepts the tag of OpenCV's matrices; nothing is constructed from it."""

    TAGS = ("tag:yaml.org,2002:opencv-matrix",)


def _below(path: str, index: object) -> str:
    """Return the path of an element; index: as of `_Loader.compose_node`."""
    if isinstance(index, yaml.ScalarNode):
        name = str(index.value)
        key = name if _KEY.fullmatch(name) else short(name)
        return f"{path}.{key}" if path else key
    return path if index is None else f"{path}[{index}]"


def _tree(
    file: Path, node: yaml.Node, path: str, line: int, *, marks_repeated: bool = False
) -> Node:
    """Convert a composed value; line: that of its key in a mapping, as a block begins below."""
    if isinstance(node, yaml.ScalarNode):
        return Node(file, path, line, "scalar", text=str(node.value), plain=node.style is None)
    if isinstance(node, yaml.SequenceNode):
        items = [
            _tree(file, item, _below(path, index), _line(item), marks_repeated=marks_repeated)
            for index, item in enumerate(node.value)
        ]
        return Node(file, path, line, "list", items=tuple(items))
    entries: dict[str, Node] = {}
    for key, value in node.value:
        name = str(key.value)
        own_path = _below(path, key)
        if name in entries:
            first = f"first on line {entries[name].line}"
            if marks_repeated:
                text = f"the key twice ({first})"
                entries[name] = Node(file, own_path, _line(key), "repeated", text=text)
                continue
            found = f"it again ({first})"
            message = f"expected each key once, found {found}; remove one of the two"
            raise _error(file, _line(key), own_path, message)
        entries[name] = _tree(file, value, own_path, _line(key), marks_repeated=marks_repeated)
    return Node(file, path, line, "mapping", entries=entries)


def _text(file: Path) -> str:
    try:
        data = read_bytes(file, MAX_BYTES)
    except OSError as err:
        if err.errno == errno.EFBIG:
            raise RigError(
                f"{file}: expected at most {MAX_BYTES} bytes, found more; "
                "check that this is a rig file and not a recording"
            ) from err
        reason = (err.strerror or str(err)).lower()
        raise RigError(f"{file}: expected a readable file, found {reason}; check the path") from err
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as err:
        line = data.count(b"\n", 0, err.start) + 1
        message = f"expected UTF-8 text, found the byte {data[err.start]:#04x}; save it as UTF-8"
        raise _error(file, line, "", message) from err


def _line(place: yaml.Event | yaml.Node) -> int:
    return place.start_mark.line + 1 if place.start_mark else 1


def short(text: str) -> str:
    """Return text in quotes, on one line, cut to 40 characters."""
    return repr(text if len(text) <= 40 else text[:40] + "...")


def _error(file: Path, line: int, path: str, message: str) -> RigError:
    return RigError(f"{_place(file, line, path)}: {message}")


def _place(file: Path, line: int, path: str) -> str:
    return f"{file}:{line}: {path}" if path else f"{file}:{line}"
