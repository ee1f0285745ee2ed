"""Help of the commands: options in groups, as text or, on a terminal, drawn by rich.

typer's own drawing loads a Markdown parser, which takes longer than all else in `--help`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table

ARGUMENTS = "Arguments"
OTHER = "Options"
# Longer lines are hard to read.
MAX_WIDTH = 120
# Rows of a group: names of a parameter and their help.
Rows = list[tuple[str, str]]
# Parameters of each group, in the order of help; what is in none is listed last, as OTHER.
GROUPS: Mapping[str, tuple[str, ...]] = {
    "Input": (*("recordings", "rig", "metadata", "decode", "identity_extrinsics", "whole"),),
    "Batching": (
        *("batching", "batching_times", "deskew", "deskew_to"),
        *("rate", "slices", "split", "max_wait", "keep_partial", "drop_incomplete"),
        *("tolerance", "timeout"),
    ),
    "Selection": (
        *("only", "ignore", "start", "end", "min_range", "max_range", "exclude_box"),
        *("keep_repeated", "pass_"),
    ),
    "Output": (
        *(
            "output",
            "format_",
            "layout",
            "sort",
            "point_layout",
            "stamp",
            "ply_style",
            "max_bag_duration",
            "compression",
            "report",
            "html",
        ),
        *("figures", "as_json", "write_rig", "overwrite", "no_fsync"),
    ),
    "Clocks": ("clock", "align_clocks", "align_to", "on_jump"),
    "Run": (
        *("dry_run", "shard", "jobs", "resume", "strict", "fail_on"),
        *("fault", "fault_seed", "quiet", "verbose", "help"),
    ),
}
# Commands with few options have no groups.
GROUPED = ("convert", "inspect", "compare")
_GROUP_OF = {name: group for group, names in GROUPS.items() for name in names}


def groups_of(command: Any, context: Any) -> dict[str, Rows]:
    """Rows of help by group, both in the order of GROUPS."""
    found: dict[str, list[tuple[int, tuple[str, str]]]] = {}
    for param in command.get_params(context):
        record = param.get_help_record(context)
        if record is not None:
            group = _group(command.name, param)
            names = GROUPS.get(group, ())
            place = names.index(param.name) if param.name in names else len(names)
            found.setdefault(group, []).append((place, record))
    order = [ARGUMENTS, *GROUPS, OTHER]
    titles = sorted(found, key=lambda group: order.index(group) if group in order else len(order))
    return {
        title: [record for _, record in sorted(found[title], key=lambda row: row[0])]
        for title in titles
    }


def _group(command: str, param: Any) -> str:
    given = getattr(param, "rich_help_panel", None)
    if given or command not in GROUPED:
        return given or (ARGUMENTS if param.param_type_name == "argument" else OTHER)
    return _GROUP_OF.get(param.name, OTHER)


def command_rows(group: Any, context: Any) -> Rows:
    """Name and summary of each command."""
    found = [(name, group.get_command(context, name)) for name in group.list_commands(context)]
    return [(name, one.get_short_help_str(limit=200)) for name, one in found if not one.hidden]


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
    return "\n".join(_without_padding(text.getvalue()))


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


def _without_padding(text: str) -> Iterator[str]:
    for line in text.splitlines():
        yield line.rstrip()
