"""Text tables; cells may quote recordings, and contain nothing that a terminal interprets."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence

from mlbatch.errors import one_line

# Width where the output is no terminal: a file or a pipe gets whole lines.
_UNLIMITED = 10_000


def table_lines(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines; cells are padded, and folded where the terminal is too narrow."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
    for _ in rows[0]:
        table.add_column(overflow="fold")
    for row in rows:
        table.add_row(*(Text(one_line(cell)) for cell in row))
    text = io.StringIO()
    width = None if sys.stdout.isatty() else _UNLIMITED
    Console(file=text, width=width, color_system=None).print(table)
    return [line.rstrip() for line in text.getvalue().splitlines()]
