"""The page of a batch: one HTML file in the style of the page of a run, with links to those."""

from __future__ import annotations

import os
from html import escape
from importlib import resources
from pathlib import Path
from urllib.parse import quote

import mlbatch
from mlbatch.batch.session import is_url
from mlbatch.batch.status import (
    HEAD,
    UNFINISHED,
    BatchStatus,
    SessionStatus,
    bytes_text,
    duration_text,
    loss_text,
)
from mlbatch.page import MARK, check_page, write_text_page

_ORDER = {"failed": 0, UNFINISHED: 1, "done": 2}
# Levels of loss and fill, as in docs/page.md.
_LOSS_WARNING = 0.001
_LOSS_PROBLEM = 0.01
_FILL_WARNING = 0.9
_BADGES = {"failed": "problem", UNFINISHED: "warning", "done": "good"}
_STYLE = """
.good .badge { background: var(--good); }
td strong.warning { color: var(--warning); }
td strong.problem { color: var(--problem); }
"""


def write_status_page(path: Path, status: BatchStatus) -> None:
    """Write the page; an earlier page is replaced, any other file never."""
    check_page(path, overwrite=True)
    write_text_page(path, _page(path, status))


def _page(path: Path, status: BatchStatus) -> str:
    style = resources.files("mlbatch.page").joinpath("page.css").read_text(encoding="utf-8")
    title = Path(status.output).name or status.output
    rows = sorted(status.sessions, key=lambda one: (_ORDER[one.state], one.name))
    body = "\n".join([_header(title, status), _cards(status), _table(path, status, rows)])
    return f"""{MARK.decode()}
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; \
style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta name="generator" content="mlbatch {escape(mlbatch.__version__)}">
<link rel="icon" href="data:,">
<title>{escape(title)} - mlbatch</title>
<style>
{style}{_STYLE}</style>
</head>
<body>
<main>
{body}
</main>
</body>
</html>
"""


def _header(title: str, status: BatchStatus) -> str:
    failed = status.count("failed")
    unfinished = status.count(UNFINISHED)
    cut_off = sum(one.is_cut_off for one in status.sessions)
    level = "problem" if failed else "warning" if unfinished or cut_off else "good"
    heading = f"{failed} of {len(status.sessions)} sessions failed" if failed else ""
    if not heading:
        done = status.count("done")
        heading = f"{done} of {len(status.sessions)} sessions are done"
    parts = [f"{unfinished} unfinished: running, or interrupted."] * bool(unfinished)
    parts += [f"{cut_off} with a recording that was cut off."] * bool(cut_off)
    others = " ".join(parts)
    return (
        f"<header>\n<h1>{escape(title)}</h1>\n<div class='verdict {level}' id='verdict'>"
        f"<em>{level}</em><strong>{escape(heading)}</strong><p>{escape(others)}</p></div>\n</header>"
    )


def _cards(status: BatchStatus) -> str:
    records = status.records
    cards = {
        "done": f"{status.count('done'):,}",
        "failed": f"{status.count('failed'):,}",
        "unfinished": f"{status.count(UNFINISHED):,}",
        "cut off": f"{sum(one.is_cut_off for one in status.sessions):,}",
        "scans": f"{sum(one.scans for one in records):,}",
        "lost packets": loss_text(records),
        "sessions with clock trouble": f"{sum(bool(one.clock_codes) for one in status.sessions):,}",
        "output": bytes_text(sum(one.output_bytes for one in records)),
        "recorded": duration_text(sum(one.recorded_s for one in records)),
        "time of all sessions": duration_text(sum(one.wall_s for one in records)),
    }
    items = "".join(
        f"<div class='card'><b>{escape(value)}</b><span>{escape(name)}</span></div>"
        for name, value in cards.items()
        if value
    )
    return f"<div class='cards'>{items}</div>"


def _table(path: Path, status: BatchStatus, rows: list[SessionStatus]) -> str:
    cells = "".join(f"<th>{one}</th>" for one in HEAD)
    lines = "".join(_row(path, status, one) for one in rows)
    return (
        "<section>\n<h2>Sessions</h2>\n<div class='scroll'><table>"
        f"<tr>{cells}</tr>{lines}</table></div>\n</section>"
    )


def _row(path: Path, status: BatchStatus, one: SessionStatus) -> str:
    cells = {head: escape(text) for head, text in zip(HEAD, one.row, strict=True)}
    if one.page:
        cells["session"] = f"<a href='{_link(path, status, one.page)}'>{cells['session']}</a>"
    badge = f"<span class='badge'>{one.state}</span>"
    cells["state"] = f"<span class='{_BADGES[one.state]}'>{badge}</span>"
    marks = {"lost": "warning" if one.loss >= _LOSS_WARNING else "", "fill": "", "": ""}
    if one.loss >= _LOSS_PROBLEM:
        marks["lost"] = "problem"
    if one.record is not None and one.record.fill is not None and one.record.fill < _FILL_WARNING:
        marks["fill"] = "warning"
    if one.is_cut_off:
        marks[""] = "problem"
    for head, level in marks.items():
        if level:
            cells[head] = f"<strong class='{level}'>{cells[head]}</strong>"
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells.values()) + "</tr>"


def _link(path: Path, status: BatchStatus, page: str) -> str:
    """A page as seen from this one."""
    if not is_url(status.output):
        target = Path(status.output) / page
        page = os.path.relpath(target.resolve(), path.resolve().parent)
    return escape(quote(os.fsencode(page)), quote=True)
