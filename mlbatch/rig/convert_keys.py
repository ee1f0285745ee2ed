"""`convert:` of a rig file: options of `mlbatch convert` that are kept with the rig.

Named as on the command line, with _ for -. What is of one run alone (paths, --dry-run, --resume,
--overwrite) and what the rig has keys for (--rate, --metadata, --exclude-box) is not among them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from mlbatch import options
from mlbatch.options import Option
from mlbatch.rig.keys import (
    FLAG,
    OPTIONS,
    TEXT,
    Form,
    Key,
    Section,
    choice_form,
    whole_form,
)
from mlbatch.rig.yaml_tree import Node

_TEXT = re.compile(r"\S(.*\S)?")
# Values of `deskew` that are no files.
POSE_MODELS = ("imu", "constant-velocity")
_MOST_JOBS = 64
# Of an option without a bound.
_MOST_WHOLE = 2**31

Values = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RigOption:
    """An option in a rig; values: as on the command line; place: file, line and key path."""

    name: str
    values: Values
    place: str = field(default="", compare=False)


def _poses(node: Node) -> Values:
    """Where poses come from; files relative to the rig file, as all paths in it."""
    text = node.word("text", _TEXT)
    return (text if text in POSE_MODELS else str(node.file.parent / text),)


def _pairs(node: Node) -> Values:
    """A mapping of options as KEY=VALUE."""
    if node.kind != "mapping":
        raise node.error("a mapping of options", node.shown, "write {option: value}")
    return tuple(f"{name}={value.word('one word', _TEXT)}" for name, value in node.entries.items())


def _jobs(node: Node) -> Values:
    return ("auto",) if node.text == "auto" else (str(node.whole(1, _MOST_JOBS)),)


# Options whose value in a rig is none of the usual kinds.
_OTHERS: Final[Mapping[str, tuple[Callable[[Node], Values], Form]]] = {
    "deskew": (_poses, TEXT),
    "decode": (_pairs, OPTIONS),
    "jobs": (_jobs, {"anyOf": [choice_form("auto"), whole_form(1, _MOST_JOBS)]}),
}


def _bounds(option: Option) -> tuple[int, int]:
    """The lowest and the highest value of a whole number."""
    return int(option.low or 0), _MOST_WHOLE if option.high is None else int(option.high)


def _value(option: Option, node: Node) -> Values:
    """The value of an option, as on the command line."""
    if option.kind == options.FLAG:
        return ("true" if node.flag() else "false",)
    if option.kind == options.TEXTS:
        items = node.items if node.kind == "list" else (node,)
        return tuple(item.word("text, or a list of texts", _TEXT) for item in items)
    if option.kind == options.WHOLE:
        return (str(node.whole(*_bounds(option))),)
    if option.kind == options.NUMBER:
        low = option.low or 0.0
        high = option.high
        if not low <= node.number() <= (node.number() if high is None else high):
            bounds = f"{low:g} or more" if high is None else f"from {low:g} to {high:g}"
            raise node.error(f"a number {bounds}", node.shown, "correct it")
        return (node.text,)
    if option.words and not option.is_open:
        return (node.choice(option.words),)
    return (node.word("text", _TEXT),)


def _form(option: Option) -> Form:
    """The JSON schema of a value."""
    if option.kind == options.FLAG:
        return FLAG
    if option.kind == options.TEXTS:
        return {"anyOf": [TEXT, {"type": "array", "items": TEXT}]}
    if option.kind == options.WHOLE:
        return whole_form(*_bounds(option))
    if option.kind == options.NUMBER:
        bounds = {"minimum": option.low, "maximum": option.high}
        return {"type": "number", **{name: at for name, at in bounds.items() if at is not None}}
    return choice_form(*option.words) if option.words and not option.is_open else TEXT


def key_of(option: Option) -> Key:
    """The key of a rig that keeps an option."""
    read, form = _OTHERS.get(option.name) or (partial(_value, option), _form(option))
    return Key(option.name, read, form, option.about)


CONVERT = Section(tuple(key_of(option) for option in options.CONVERT if option.in_rig))


def read_options(node: Node) -> tuple[RigOption, ...]:
    """Return the options of a `convert:` section."""
    fields = CONVERT.fields(node)
    return tuple(
        RigOption(key.name, key.read(fields[key.name]), fields[key.name].place)
        for key in CONVERT.keys
        if key.name in fields
    )
