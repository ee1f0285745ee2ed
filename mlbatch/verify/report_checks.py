"""Report and table: found inside or beside an output, read, and known to agree."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from mlbatch.verify.claims import Claims
from mlbatch.verify.document import Document
from mlbatch.verify.report import check_same, claims_of
from mlbatch.verify.table import Table, read_table
from mlbatch.verify.verdict import Judge, VerifyError

REPORT, TABLE = "report.json", "scans.csv"
_MOST_DIGITS = 19


@dataclass(frozen=True, slots=True)
class Beside:
    """Where report and table of an output lie; their names in messages are those of the files."""

    report: Path
    table: Path

    @classmethod
    def of(cls, output: Path, report: Path | None) -> Beside:
        """In an output folder, beside an output file; report: where the run was told to put it."""
        if output.is_dir():
            return cls(report or output / REPORT, output / TABLE)
        name = output.name
        own = output.with_name(f"{name}.{REPORT}")
        return cls(report or own, output.with_name(f"{name}.{TABLE}"))


def text_of(path: Path) -> str | None:
    """A small file; None if there is none."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    except OSError as err:
        raise VerifyError(f"{path}: wanted to read it, got {err.strerror!r}") from err
    except UnicodeDecodeError as err:
        raise VerifyError(f"{path}: wanted text in UTF-8, got other bytes; restore it") from err


@dataclass(slots=True)
class Papers:
    """What tells of the run beside the scans; None where there is none."""

    report: Document | None
    table: Table | None

    def claims(self, judge: Judge, own: Claims) -> Claims:
        """What the output says of itself, and the report and the table agree with."""
        found = own
        if self.report is not None:
            found = found.joined(judge, self.report.where, claims_of(self.report))
        if self.table is not None:
            found = found.joined(judge, self.table.where, Claims(sensors=self.table.sensors))
        return found


def read_papers(judge: Judge, beside: Beside, *, asked: bool) -> Papers:
    """Report and table beside an output; asked: the report has to be there."""
    text = text_of(beside.report)
    if text is None and asked:
        raise VerifyError(f"{beside.report}: wanted a report, got no such file; leave out --report")
    report = None if text is None else Document.parsed(judge, beside.report, text)
    table = text_of(beside.table)
    found = None if table is None else read_table(judge, beside.table.name, table)
    return Papers(report, found)


def inner_papers(
    judge: Judge, path: Path, metadata: dict[str, str] | None, attachment: bytes | None
) -> Papers:
    """Report and table that lie inside a file."""
    report, where = None, path.name
    if metadata is None:
        judge.blame("metadata", where, "a metadata record mlbatch.report", "none")
    else:
        name = f"{where} mlbatch.report"
        report = Document.parsed(judge, path, metadata.get("json", ""), name)
    if attachment is None:
        judge.blame("table", where, f"an attachment {TABLE}", "none")
        return Papers(report, None)
    text = attachment.decode("utf-8", "replace")
    return Papers(report, read_table(judge, f"{where} {TABLE}", text))


def check_copies(
    judge: Judge, inner: Papers, attachment: bytes | None, beside: Beside, *, asked: bool
) -> None:
    """Copies beside a file say the same as those inside."""
    text = text_of(beside.report)
    if text is None and asked:
        raise VerifyError(f"{beside.report}: wanted a report, got no such file; leave out --report")
    if text is not None and inner.report is not None:
        other = Document.parsed(judge, beside.report, text)
        check_same(judge, inner.report, other)
    table = text_of(beside.table)
    if table is not None and attachment is not None:
        same = table.encode() == attachment
        judge.passed("table")
        if not same:
            judge.blame("table", beside.table.name, "the bytes of the attachment", "others")


def claims_of_grid(judge: Judge, where: str, grid: dict[str, str]) -> Claims:
    """What the metadata record mlbatch.grid says."""
    numbers: dict[str, int | None] = {}
    for key in ("slices", "t_init_ns"):
        text = grid.get(key, "")
        # Python refuses to read very long ones.
        numbers[key] = int(text) if text.isdecimal() and len(text) <= _MOST_DIGITS else None
        judge.passed("metadata")
        if numbers[key] is None:
            judge.blame("metadata", f"{where} mlbatch.grid {key}", "a number", text or "nothing")
    for key in ("rate_hz", "timescale", "frame_id"):
        if key not in grid:
            judge.blame("metadata", f"{where} mlbatch.grid {key}", "a text", "nothing")
    try:
        names = json.loads(grid.get("sensors", ""))
    except ValueError:
        names = None
    if not isinstance(names, list):
        judge.blame("metadata", f"{where} mlbatch.grid sensors", "a list", grid.get("sensors"))
        names = None
    return Claims(
        grid.get("rate_hz"),
        numbers["slices"],
        numbers["t_init_ns"],
        None if names is None else tuple(map(str, names)),
        grid.get("timescale"),
        grid.get("frame_id"),
    )
