"""Text tables; cells may quote recordings, and contain nothing that a terminal interprets.

A terminal gets the first form that fits its width: a table, its transpose, a table with folded
cells, a block for each row. Files and pipes get whole lines, whatever their length.
"""

from __future__ import annotations

import io
import re
import sys
import textwrap
from collections.abc import Sequence

from mlbatch.errors import one_line

Rows = Sequence[Sequence[str]]
# Width where the output is no terminal: a file or a pipe gets whole lines.
_UNLIMITED = 10_000
# Blanks between columns, and between the fields of a block.
_GAP = 2
_FIELD_GAP = "   "
# Columns that are folded keep this width, if they have it.
_FOLDED_WIDTH = 16
_NUMBER = re.compile(r"[-+]?[\d.,]+( (%|ms|s|Hz|ppm))?|-|")


def table_lines(rows: Rows, *, transposable: bool = False) -> list[str]:
    """Rows, head first, as lines; transposable: heads may be the first column instead."""
    clean = [[one_line(cell) for cell in row] for row in rows]
    width = terminal_width()
    if width is None:
        return _table(clean, _UNLIMITED, is_styled=False)
    transposed = [list(column) for column in zip(*clean, strict=True)]
    if _sum(_widths(clean)) <= width:
        return _table(clean, width, is_styled=True)
    if transposable and _sum(_widths(transposed)) <= width:
        return _table(transposed, width, is_styled=True)
    if _sum(_folded_widths(clean)) <= width:
        return _table(clean, width, is_styled=True)
    if transposable and _sum(_longest_words(transposed)) <= width:
        return _table(transposed, width, is_styled=True)
    return [line for row in clean[1:] for line in _block(clean[0], row, width)]


def paragraph(text: str) -> str:
    """Text without control characters; on a terminal folded between words."""
    clean = one_line(text)
    width = terminal_width()
    if width is None:
        return clean
    return "\n".join(textwrap.wrap(clean, width, break_on_hyphens=False)) or clean


def fits(rows: Rows) -> bool:
    """Whether a table needs no folding."""
    width = terminal_width()
    return width is None or _sum(_widths(rows)) <= width


def terminal_width() -> int | None:
    """Columns of the terminal that standard output is; None for files and pipes."""
    if not sys.stdout.isatty():
        return None
    from rich.console import Console

    return Console().width


def _sum(widths: Sequence[int]) -> int:
    return sum(widths) + _GAP * (len(widths) - 1)


def _widths(rows: Rows) -> list[int]:
    from rich.cells import cell_len

    return [max(map(cell_len, column)) for column in zip(*rows, strict=True)]


def _longest_words(rows: Rows) -> list[int]:
    from rich.cells import cell_len

    return [
        max(cell_len(word) for cell in column for word in cell.split(" "))
        for column in zip(*rows, strict=True)
    ]


def _folded_widths(rows: Rows) -> list[int]:
    pairs = zip(_widths(rows), _longest_words(rows), strict=True)
    return [max(longest, min(whole, _FOLDED_WIDTH)) for whole, longest in pairs]


def _table(rows: Rows, width: int, *, is_styled: bool) -> list[str]:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, _GAP, 0, 0))
    for column in zip(*rows[1:], strict=True) if rows[1:] else rows[0]:
        is_number = is_styled and all(_NUMBER.fullmatch(cell) for cell in column)
        table.add_column(overflow="fold", justify="right" if is_number else "left")
    for number, row in enumerate(rows):
        style = "bold" if is_styled and not number else ""
        table.add_row(*(Text(cell, style=style) for cell in row))
    text = io.StringIO()
    if is_styled:
        console = Console(file=text, width=width, force_terminal=True, highlight=False)
    else:
        console = Console(file=text, width=width, color_system=None)
    console.print(table)
    return [line.rstrip() for line in text.getvalue().splitlines()]


def _block(head: Sequence[str], row: Sequence[str], width: int) -> list[str]:
    """A row as a title and its other cells with their heads, without empty ones."""
    from rich.console import Console
    from rich.padding import Padding
    from rich.text import Text

    lines: list[Text] = []
    for name, cell in zip(head[1:], row[1:], strict=True):
        if not cell:
            continue
        field = Text.assemble((f"{name} ", "dim"), cell)
        if lines and _GAP + lines[-1].cell_len + len(_FIELD_GAP) + field.cell_len <= width:
            lines[-1] = Text.assemble(lines[-1], _FIELD_GAP, field)
        else:
            lines.append(field)
    text = io.StringIO()
    console = Console(file=text, width=width, force_terminal=True, highlight=False)
    console.print(Text(row[0], style="bold", overflow="fold"))
    for line in lines:
        line.overflow = "fold"
        console.print(Padding(line, (0, 0, 0, _GAP)))
    return [line.rstrip() for line in text.getvalue().splitlines()]
