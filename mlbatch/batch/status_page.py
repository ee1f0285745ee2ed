"""The page of a batch: one HTML file in the style of the page of a run, with links to those."""

from __future__ import annotations

import os
from pathlib import Path
from urllib.parse import quote

from mlbatch.batch.record import DONE, FAILED, KNOWN_BAD
from mlbatch.batch.session import is_url
from mlbatch.batch.status import (
    HEAD,
    STATES,
    UNFINISHED,
    BatchStatus,
    SessionStatus,
    bytes_text,
    duration_text,
    loss_text,
)
from mlbatch.page import check_page, write_text_page
from mlbatch.page.templates import Verdict, render

# In the order of the page, with the level of each.
_LEVELS = {FAILED: "problem", UNFINISHED: "warning", KNOWN_BAD: "neutral", DONE: "good"}
_ORDER = [*_LEVELS]
# Levels of loss and fill, as in docs/page.md.
_LOSS_WARNING = 0.001
_LOSS_PROBLEM = 0.01
_FILL_WARNING = 0.9


def write_status_page(path: Path, status: BatchStatus) -> None:
    """Write the page; an earlier page is replaced, any other file never."""
    check_page(path, overwrite=True)
    sessions = sorted(
        status.sessions,
        key=lambda one: (_ORDER.index(one.state), not one.has_pose_warning, one.name),
    )
    page = render(
        "batch.html",
        title=Path(status.output).name or status.output,
        verdict=_verdict(status),
        cards=_cards(status),
        head=HEAD,
        rows=[
            {
                "cells": dict(zip(HEAD, one.row, strict=True)),
                "badge": _LEVELS[one.state],
                "levels": _levels(one),
                "page": _link(path, status, one.page) if one.page else "",
            }
            for one in sessions
        ],
    )
    write_text_page(path, page)


def _verdict(status: BatchStatus) -> Verdict:
    count = len(status.sessions)
    failed, unfinished = status.count(FAILED), status.count(UNFINISHED)
    known_bad = status.count(KNOWN_BAD)
    cut_off = sum(one.is_cut_off for one in status.sessions)
    poses = sum(one.has_pose_warning for one in status.sessions)
    doubtful = unfinished or cut_off or poses
    level = "problem" if failed else "warning" if doubtful else "good"
    heading = f"{status.count(DONE)} of {count} sessions are done"
    if failed:
        heading = f"{failed} of {count} sessions failed"
    parts = [f"{unfinished} unfinished: running, or interrupted."] * bool(unfinished)
    parts += [f"{known_bad} known as bad, not converted."] * bool(known_bad)
    parts += [f"{poses} with a warning of poses."] * bool(poses)
    parts += [f"{cut_off} with a recording that was cut off."] * bool(cut_off)
    return Verdict(level, level, heading, " ".join(parts))


def _cards(status: BatchStatus) -> dict[str, str]:
    records = status.records
    return {
        **{state.replace("_", " "): f"{status.count(state):,}" for state in STATES},
        "cut off": f"{sum(one.is_cut_off for one in status.sessions):,}",
        "scans": f"{sum(one.scans for one in records):,}",
        "lost packets": loss_text(records),
        "sessions with clock trouble": f"{sum(bool(one.clock_codes) for one in status.sessions):,}",
        "output": bytes_text(sum(one.output_bytes for one in records)),
        "recorded": duration_text(sum(one.recorded_s for one in records)),
        "time of all sessions": duration_text(sum(one.wall_s for one in records)),
    }


def _levels(one: SessionStatus) -> dict[str, str]:
    """Levels of the cells that are marked."""
    fill = 1.0 if one.record is None or one.record.fill is None else one.record.fill
    levels = dict.fromkeys(HEAD, "")
    if one.loss >= _LOSS_WARNING:
        levels["lost"] = "problem" if one.loss >= _LOSS_PROBLEM else "warning"
    if fill < _FILL_WARNING:
        levels["fill"] = "warning"
    if one.has_pose_warning:
        levels[""] = "warning"
    if one.is_cut_off:
        levels[""] = "problem"
    return levels


def _link(path: Path, status: BatchStatus, page: str) -> str:
    """A page as seen from this one."""
    if not is_url(status.output):
        target = Path(status.output) / page
        page = os.path.relpath(target.resolve(), path.resolve().parent)
    return quote(os.fsencode(page))
