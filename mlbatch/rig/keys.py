"""Keys of mappings in a rig file: how each value is read, and its form as JSON schema."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeAlias, TypeVar

from mlbatch.rig.yaml_tree import Node

T = TypeVar("T")
# A JSON schema (draft 2020-12) of one value.
Form: TypeAlias = Mapping[str, object]


@dataclass(frozen=True, slots=True)
class Key(Generic[T]):
    """A key of a mapping: its name, the reader of its value, and the value without the key.

    form: of the value; about: one line for people who write a rig.
    """

    name: str
    read: Callable[[Node], T]
    default: T
    form: Form
    about: str

    def of(self, fields: Mapping[str, Node]) -> T:
        """Return the value in a mapping."""
        return self.read(fields[self.name]) if self.name in fields else self.default


class Described(Protocol):
    """A `Key` of any value."""

    @property
    def name(self) -> str:
        """The key in the file."""
        ...

    @property
    def form(self) -> Form:
        """Form of the value."""
        ...

    @property
    def about(self) -> str:
        """One line of help."""
        ...


def names(keys: Sequence[Described]) -> list[str]:
    """Names of keys."""
    return [key.name for key in keys]


def mapping_form(
    keys: Sequence[Described],
    required: Sequence[str] = (),
    *,
    excludes: Mapping[str, Sequence[str]] | None = None,
    needs: Mapping[str, str] | None = None,
    may_be_empty: bool = True,
) -> Form:
    """Form of a mapping with these keys and no others.

    excludes: keys that others exclude; needs: keys that need another one.
    """
    known = names(keys)
    form: dict[str, object] = {
        "type": "object",
        "properties": {key.name: {"description": key.about, **key.form} for key in keys},
        "additionalProperties": False,
    }
    if required:
        form["required"] = list(required)
    if not may_be_empty:
        form["minProperties"] = 1
    pairs = [
        {"not": {"required": [key, other]}}
        for key, others in (excludes or {}).items()
        for other in others
        if key in known and other in known
    ]
    if pairs:
        form["allOf"] = pairs
    dependent = {key: [other] for key, other in (needs or {}).items() if key in known}
    if dependent:
        form["dependentRequired"] = dependent
    return form


def choice_form(*words: str) -> Form:
    """One of some words."""
    return {"enum": list(words)}


def whole_form(low: int, high: int) -> Form:
    """A whole number from low to high."""
    return {"type": "integer", "minimum": low, "maximum": high}


def numbers_form(count: int) -> Form:
    """A list of numbers."""
    return {"type": "array", "items": NUMBER, "minItems": count, "maxItems": count}


def text_form(pattern: str) -> Form:
    """Text of a regular expression."""
    return {"type": "string", "pattern": f"^(?:{pattern})$"}


# Other spellings are text for readers of YAML 1.2.
FLAG: Form = {"enum": [True, False, "yes", "no", "on", "off"]}
NUMBER: Form = {"type": "number"}
RANGE_M: Form = {"type": "number", "minimum": 0}
# A number that was not put into quotes is read as the text that it is.
WORD: Form = {"type": ["string", "number"], "pattern": r"^\S+$"}
TEXT: Form = {"type": ["string", "number"], "pattern": r"^\S(.*\S)?$"}
# `on` and `off` are words in a rig, and flags for many readers of YAML.
OPTIONS: Form = {
    "type": "object",
    "additionalProperties": {"type": ["string", "number", "boolean"]},
}
