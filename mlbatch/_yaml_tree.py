"""YAML files as trees of `Node`, built from parser events.

Nothing is constructed from tags, and aliases cannot multiply.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import yaml

from mlbatch._yaml import KEY, MAX_BYTES, MAX_DEPTH, MAX_VALUES, Node, fault, short
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
