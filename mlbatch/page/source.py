"""What a page is made of: the report, the table of scans, and the output if it is there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mlbatch.bounded import open_file, parse_json
from mlbatch.errors import ExportError, RecordingError
from mlbatch.outputs.folders import refuse_shard
from mlbatch.page.values import Values
from mlbatch.verification.report_checks import REPORT, SCHEMA, TABLE, ReportPlaces

_REPORT_SUFFIX = f".{REPORT}"


@dataclass(frozen=True, slots=True)
class Source:
    """A run."""

    report: Values
    table: str | None  # text of scans.csv
    output: Path | None  # None: no scans
    page: Path  # usual place of the page


def read_report(where: Path, text: str | bytes) -> Values:
    """The report in a JSON text."""
    try:
        root = parse_json(text)
    except ValueError as err:
        raise ExportError(
            f"{where}: expected a report in JSON, found {err}; restore it, or convert again"
        ) from err
    report = Values(root)
    if report.text("schema") != SCHEMA:
        found = report.text("schema") or "none"
        raise ExportError(
            f"{where}: expected a report of schema {SCHEMA}, found {found!r}; name the report of "
            "`mlbatch convert`"
        )
    return report


def source_of_text(where: Path, text: str | bytes) -> Source:
    """The run of a report alone, given as text; where: for errors."""
    return Source(read_report(where, text), None, None, where.with_suffix(".html"))


def find_source(path: Path, report: Path | None = None) -> Source:
    """The run of a report or of an output; report: path of `--report`, if it is not the usual one.

    Raises ExportError if there is no report.
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
    places = ReportPlaces(path, path, is_given=True)
    report = read_report(path, places.report_text() or "")
    output: Path | None = None
    if path.name.endswith(_REPORT_SUFFIX):
        output = path.with_name(path.name.removesuffix(_REPORT_SUFFIX))
    elif path.name == REPORT:
        output = path.parent
    if output is None or not output.exists():
        return Source(report, None, None, path.with_suffix(".html"))
    table = ReportPlaces.of(output, None).table_text()
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
    places = ReportPlaces.of(path, report)
    text = places.report_text()
    table = places.table_text()
    if text is None or table is None:
        inner_report, inner_table = _inside(path)
        text = inner_report if text is None else text
        table = inner_table if table is None else table
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
    return Source(read_report(places.report, text), table, path, page_of(path))


def _container(path: Path) -> str:
    """What recording a file may be; "" for others."""
    if path.is_dir():
        return ""
    from mlbatch.readers import readers
    from mlbatch.readers.source import read_head

    try:
        head = read_head(path)
    except RecordingError:
        return ""
    return next((one.CONTAINER for one in readers() if one.recognises(head)), "")


def _inside(path: Path) -> tuple[str | None, str | None]:
    """Report and table in an MCAP file; None in other outputs."""
    from mlbatch.page.clouds import mcaps_of

    files = mcaps_of(path)
    # Several files have neither.
    if len(files) != 1:
        return None, None
    from mcap.reader import make_reader

    from mlbatch.outputs.containers import BoundedFile, library_errors
    from mlbatch.outputs.damage import DamageError

    report = None
    table = None
    try:
        with library_errors("an MCAP file with an index"), BoundedFile(files[0]) as stream:
            reader = make_reader(stream)
            for metadata in reader.iter_metadata():
                if metadata.name == "mlbatch.report":
                    report = metadata.metadata.get("json")
            for attachment in reader.iter_attachments():
                if attachment.name == TABLE:
                    table = attachment.data.decode("utf-8", "replace")
    except DamageError as err:
        raise ExportError(f"{path}: {err}; convert again") from err
    return report, table
