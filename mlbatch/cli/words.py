"""Options with a list of words: shown by `--help`, completed by shells, checked by options.py."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import typer

# The words, or a function that looks them up.
Words = Iterable[str] | Callable[[], Iterable[str]]


def one_of(words: Words, *names: str, help: str, metavar: str = "") -> Any:
    """A typer option with one of some words as value; metavar: in place of their list."""
    if callable(words):
        look_up = words
    else:
        known = tuple(words)
        metavar = metavar or f"[{'|'.join(known)}]"

        def look_up() -> Iterable[str]:
            return known

    def complete(incomplete: str) -> list[str]:
        return [word for word in look_up() if word.startswith(incomplete)]

    return typer.Option(*names, help=help, metavar=metavar, autocompletion=complete)


def format_words() -> Iterable[str]:
    """Formats of outputs."""
    from mlbatch.writers import format_names

    return format_names()


def point_layout_words() -> Iterable[str]:
    """Presets of the fields of a point."""
    from mlbatch.writers.point_layouts import CLOUD_LAYOUTS

    return list(CLOUD_LAYOUTS)


def decode_words() -> Iterable[str]:
    """Options of decoders with their values."""
    from mlbatch.sensors import DECODE_OPTIONS

    return [f"{key}={value}" for key, values in DECODE_OPTIONS.items() for value in values]
