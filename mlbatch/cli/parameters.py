"""Parameters of commands: made of the table of options, or with a list of words."""

from __future__ import annotations

import inspect
import keyword
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer

from mlbatch import options
from mlbatch.options import Option

# The words, or a function that looks them up.
Words = Iterable[str] | Callable[[], Iterable[str]]
_TYPES: dict[str, Any] = {
    options.FLAG: bool,
    options.TEXT: str,
    options.TEXTS: list[str],
    options.WHOLE: int,
    options.NUMBER: float,
    options.PATH: Path,
    options.PATHS: list[Path],
}


def one_of(words: Words, *names: str, help: str, metavar: str = "", **more: Any) -> Any:
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

    return typer.Option(*names, help=help, metavar=metavar, autocompletion=complete, **more)


# Parameters of several commands, apart from the options of a conversion.
Recordings: TypeAlias = Annotated[
    list[Path],
    typer.Argument(
        help="Recordings of one session: pcap, pcapng, MCAP, ROS bags; folders of them; "
        "patterns in quotes ('*.pcap')."
    ),
]
Verbose: TypeAlias = Annotated[
    bool,
    typer.Option("--verbose", "-v", help="Print progress once a minute if stderr is no terminal."),
]
AsJson: TypeAlias = Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")]


def _formats() -> Iterable[str]:
    from mlbatch.writers.formats import format_names

    return format_names()


def _point_layouts() -> Iterable[str]:
    from mlbatch.writers.point_layouts import CLOUD_LAYOUTS

    return list(CLOUD_LAYOUTS)


def _decode_options() -> Iterable[str]:
    from mlbatch.sensors import DECODE_OPTIONS

    return [f"{key}={value}" for key, values in DECODE_OPTIONS.items() for value in values]


# Words that plug-ins and vendors add to.
_LOOKED_UP: dict[str, Words] = {
    "format": _formats,
    "point_layout": _point_layouts,
    "decode": _decode_options,
}


def parameter(option: Option) -> inspect.Parameter:
    """The parameter of a command that takes an option."""
    names = (option.long, *option.flags)
    more: dict[str, Any] = {"hidden": option.hidden, "show_default": option.shown_default}
    words = _LOOKED_UP.get(option.name, option.words)
    if words:
        info = one_of(words, *names, help=option.about, metavar=option.metavar, **more)
    else:
        # A flag without a metavar of its own has none.
        metavar = option.metavar or None
        info = typer.Option(*names, help=option.about, metavar=metavar, **more)
    kind = _TYPES[option.kind]
    return inspect.Parameter(
        f"{option.name}_" if keyword.iskeyword(option.name) else option.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=option.default,
        annotation=Annotated[kind if option.default is not None else kind | None, info],
    )


def shared(*names: str, **about: str) -> list[inspect.Parameter]:
    """Parameters of options that another command shares with `convert`; about: its help of some."""
    rows = (options.BY_NAME[name] for name in names)
    return [
        parameter(
            replace(
                row,
                about=about.get(row.name, row.about),
                # Without synonyms.
                flags=tuple(flag for flag in row.flags if not flag.startswith("--")),
            )
        )
        for row in rows
    ]


def with_parameters(command: Callable[..., None], added: Iterable[inspect.Parameter]) -> None:
    """Give a command parameters in place of its `**options`: the parser reads its signature."""
    named = [
        one
        for one in inspect.signature(command, eval_str=True).parameters.values()
        if one.kind != one.VAR_KEYWORD
    ]
    signature = inspect.Signature([*named, *added])
    command.__signature__ = signature  # type: ignore[attr-defined]
    command.__annotations__ = {name: one.annotation for name, one in signature.parameters.items()}


def is_stdout(path: Path | None) -> bool:
    """True for `-`, standard output."""
    return path == Path("-")
