"""The data of a page: the report, the table of scans, and the output if it is there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mlbatch.bounded import open_file
from mlbatch.errors import ExportError, RecordingError, UsageError
from mlbatch.outputs.folders import refuse_shard
from mlbatch.outputs.kinds import REPORT
from mlbatch.outputs.run_files import RunFiles
from mlbatch.reports.report import RunReport, report_of

_REPORT_SUFFIX = f".{REPORT}"


@dataclass(frozen=True, slots=True)
class Source:
    """A run."""

    report: RunReport
    table: str | None  # text of scans.csv
    output: Path | None  # None: no scans
    page: Path  # usual place of the page
    scans: int | None = None  # number to show, 0: all; None: as many as the page has room for
    report_path: Path | None = None  # if it is not the usual one


def shown_scans(text: str | None, option: str = "--html-scans") -> int | None:
    """`scans` of a source by a text: a number, or all."""
    if text is None or text == "all":
        return None if text is None else 0
    if not (text.isascii() and text.isdigit() and int(text)):
        raise UsageError(
            f"{option}: expected a number of scans from 1 on or all, found {text!r}; write 10"
        )
    return int(text)


def source_of_text(where: Path, text: str | bytes) -> Source:
    """The run of a report alone, given as text; where: for errors."""
    return Source(report_of(where, text), None, None, where.with_suffix(".html"))


def find_source(path: Path, report: Path | None = None) -> Source:
    """The run of a report or of an output; report: path of `--report`, if it is not the usual one.

    Raises MlbatchError if there is no report.
    """
    if not path.exists():
        raise ExportError(
            f"{path}: expected a report or an output, found no such file or folder; check the name"
        )
    if _is_json(path):
        return _of_report(path)
    return _of_output(path, report)


def _is_json(path: Path) -> bool:
    if path.is_dir():
        return False
    try:
        with open_file(path) as file:
            return file.read(64).lstrip().startswith(b"{")
    except OSError as err:
        raise ExportError(f"{path}: expected a readable file, found {err.strerror!r}") from err


def _of_report(path: Path) -> Source:
    report = report_of(path, RunFiles(path, path, path).report_text() or "")
    output: Path | None = None
    if path.name.endswith(_REPORT_SUFFIX):
        output = path.with_name(path.name.removesuffix(_REPORT_SUFFIX))
    elif path.name == REPORT:
        output = path.parent
    if output is None or not output.exists():
        return Source(report, None, None, path.with_suffix(".html"))
    table = RunFiles.of(output).table_text()
    # The folder of a dry run's report has no scans.
    is_output = output.is_file() or table is not None
    if not is_output:
        return Source(report, table, None, path.with_suffix(".html"))
    return Source(report, table, output, page_of(output))


def page_of(output: Path) -> Path:
    """Usual place of the page; not in a folder of scans, which could not be overwritten then."""
    named = output if output.name else output.resolve()
    return named.with_name(f"{named.name}.html")


def _of_output(path: Path, report: Path | None) -> Source:
    refuse_shard(path)
    files = RunFiles.of(path, report)
    text, table = files.texts()
    if text is None:
        container = _container(path)
        if container:
            raise ExportError(
                f"{path}: expected an output with its report, found {container} without one; "
                f"convert a recording first (mlbatch convert {path} -o scans.mcap), or give the "
                "report with --report"
            )
        raise ExportError(
            f"{path}: expected a report in or next to the output, found none; give it with "
            "--report, or convert the recording"
        )
    return Source(report_of(files.report, text), table, path, page_of(path), report_path=report)


def _container(path: Path) -> str:
    """Kind of recording that a file may be; "" for other files."""
    if path.is_dir():
        return ""
    from mlbatch.readers import readers
    from mlbatch.readers.source import read_head

    try:
        head = read_head(path)
    except RecordingError:
        return ""
    return next((one.CONTAINER for one in readers() if one.recognises(head)), "")
