"""Sections of a rig file: how the value of each key is read, and its form as JSON schema."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

from mlbatch.rig.yaml_tree import Node

# A JSON schema (draft 2020-12) of one value.
Form: TypeAlias = Mapping[str, object]


class Key(NamedTuple):
    """A key of a section: its name, the reader of its value, and the value without the key.

    form: of the value; about: one line for people who write a rig.
    """

    name: str
    read: Callable[[Node], Any]
    form: Form
    about: str
    default: Any = None


@dataclass(frozen=True, slots=True)
class Section:
    """A mapping with these keys and no others.

    excludes: keys that others exclude; needs: keys that need another one.
    """

    keys: tuple[Key, ...]
    required: tuple[str, ...] = ()
    excludes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    needs: Mapping[str, str] = field(default_factory=dict)
    may_be_empty: bool = True

    def fields(self, node: Node) -> Mapping[str, Node]:
        """Return the entries of a mapping; RigError for keys that do not fit."""
        names = [key.name for key in self.keys]
        fields = node.fields(names, self.required)
        if not fields and not self.may_be_empty:
            raise node.error(f"at least one of {', '.join(names)}", "none", "add one of them")
        for key, others in self.excludes.items():
            for other in others:
                if key in fields and other in fields:
                    found = f"{other} as well (line {fields[other].line})"
                    raise fields[key].error(f"{key} without {other}", found, "keep one of the two")
        for key, other in self.needs.items():
            if key in fields and other not in fields:
                raise fields[key].error(f"{key} with {other}", f"no {other}", f"add the {other}")
        return fields

    def read(self, node: Node) -> dict[str, Any]:
        """Return the values by key; RigError for the first mistake."""
        fields = self.fields(node)
        return {
            key.name: key.read(fields[key.name]) if key.name in fields else key.default
            for key in self.keys
        }

    @property
    def form(self) -> Form:
        """Form of the mapping."""
        form: dict[str, object] = {
            "type": "object",
            "properties": {key.name: {"description": key.about, **key.form} for key in self.keys},
            "additionalProperties": False,
        }
        if self.required:
            form["required"] = list(self.required)
        if not self.may_be_empty:
            form["minProperties"] = 1
        if self.excludes:
            form["allOf"] = [
                {"not": {"required": [key, other]}}
                for key, others in self.excludes.items()
                for other in others
            ]
        if self.needs:
            form["dependentRequired"] = {key: [other] for key, other in self.needs.items()}
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
