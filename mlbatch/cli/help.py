"""Help of the commands: options in groups, as text or, on a terminal, drawn by rich.

typer's own drawing loads a Markdown parser, which takes longer than all else in `--help`.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from mlbatch import options

if TYPE_CHECKING:
    from rich.table import Table

ARGUMENTS = "Arguments"
OTHER = "Options"
# Longer lines are hard to read.
MAX_WIDTH = 120
# Rows of a group: names of a parameter and their help.
Rows = list[tuple[str, str]]
# Group of each option, in the order of help; options of commands other than `convert` come last.
_OTHERS: Mapping[str, str] = {
    **{"recordings": "Input", "whole": "Input", "tolerance": "Batching", "timeout": "Batching"},
    **{name: "Output" for name in ("figures", "as_json", "write_rig")},
    "duration": "Selection",
    "help": "Run",
}
_GROUP_OF = {
    **_OTHERS,
    **{option.name: option.group for option in options.CONVERT},
}
_PLACES = {name: at for at, name in enumerate((*options.BY_NAME, *_OTHERS))} | {"recordings": -1}
# What `-h` of a command with many options shows; HELP_ALL shows the others, too.
COMMON: Mapping[str, frozenset[str]] = {
    "convert": frozenset(
        {
            *("recordings", "rig", "dataset", "metadata", "rate", "deskew"),
            *("only", "start", "end", "exclude_box", "output", "format"),
            *("accumulate", "html", "overwrite", "dry_run", "resume", "fail_on", "quiet"),
        }
    ),
    "batch": frozenset(
        {
            *("sources", "output", "rig", "dataset", "workers", "jobs", "part", "only", "plan"),
            *("retries", "retry_failed", "scheduler", "rate", "format", "fail_on", "quiet"),
        }
    ),
}
HELP_ALL = "--help-all"
# Commands with few options have no groups.
GROUPED = ("convert", "inspect", "compare", "extract", "calibrate")


def groups_of(command: Any, context: Any) -> dict[str, Rows]:
    """Rows of help by group, both in the order of the table of options."""
    found: dict[str, list[tuple[int, tuple[str, str]]]] = {}
    shown = None if context.meta.get(HELP_ALL) else COMMON.get(command.name)
    for param in command.get_params(context):
        # The names of this option are a set: which of them is its name changes.
        is_help = param.name.startswith("help")
        if shown is not None and not is_help and param.name.rstrip("_") not in shown:
            continue
        record = param.get_help_record(context)
        if is_help and command.name in COMMON:
            record = ("-h, --help", f"Show this page; {HELP_ALL}: every option.")
        if record is not None:
            is_grouped = command.name in GROUPED
            name = "help" if is_help else param.name.rstrip("_")
            place = _PLACES.get(name, len(_PLACES)) if is_grouped else 0
            found.setdefault(_group(command.name, name, param), []).append((place, record))
    order = [ARGUMENTS, *options.GROUPS, OTHER]
    titles = sorted(found, key=lambda group: order.index(group) if group in order else len(order))
    return {
        title: [record for _, record in sorted(found[title], key=lambda row: row[0])]
        for title in titles
    }


def _group(command: str, name: str, param: Any) -> str:
    given = getattr(param, "rich_help_panel", None)
    if given or command not in GROUPED:
        return given or (ARGUMENTS if param.param_type_name == "argument" else OTHER)
    return _GROUP_OF.get(name, OTHER)


def command_rows(group: Any, context: Any) -> Rows:
    """Name and summary of each command."""
    commands = [(name, group.get_command(context, name)) for name in group.list_commands(context)]
    return [(name, one.get_short_help_str(limit=200)) for name, one in commands if not one.hidden]


def is_drawn() -> bool:
    """True if help is drawn: on a terminal; files and pipes get plain text."""
    return sys.stdout.isatty()


def drawn(command: Any, context: Any, groups: Mapping[str, Rows]) -> str:
    """Help for a terminal, with its width and colors."""
    import io

    from rich.console import Console
    from rich.panel import Panel
    from rich.text import Text

    text = io.StringIO()
    console = Console(file=text, force_terminal=True, highlight=False)
    console.width = min(console.width, MAX_WIDTH)
    pieces = command.collect_usage_pieces(context)
    usage = Text.assemble(("Usage: ", "bold"), context.command_path, " ", (" ".join(pieces), "dim"))
    console.print(usage)
    console.print()
    console.print(Text(" ".join((command.help or "").split())))
    console.print()
    widest = max((len(name) for rows in groups.values() for name, _ in rows), default=0)
    # Half of the width is for the texts.
    names_width = min(widest, console.width // 2 - 4)
    for title, rows in groups.items():
        table = _table(rows, names_width)
        console.print(Panel(table, title=title, title_align="left", border_style="dim"))
    # Without padding.
    return "\n".join(map(str.rstrip, text.getvalue().splitlines()))


def _table(rows: Rows, names_width: int) -> Table:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, show_header=False, expand=True, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(width=names_width)
    table.add_column(ratio=1)
    for name, text in rows:
        body, sign, extra = text.rpartition("  [")
        help_text = Text(body if sign else text)
        if sign:
            help_text.append(f" [{extra}", style="dim")
        table.add_row(Text(name, style="cyan"), help_text)
    return table
