"""Report and table of a run: where they are, and their texts."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mlbatch.bounded import MOST_TABLE_BYTES, open_file, read_text
from mlbatch.outputs.damage import CheckLog, VerifyError
from mlbatch.outputs.folders import entries
from mlbatch.outputs.kinds import REPORT, format_of, kind_of

if TYPE_CHECKING:
    from mlbatch.outputs.mcap_file import McapFile

TABLE = "scans.csv"
# How a session of a batch ended; in its folder.
SESSION_JSON = "session.json"
# In mlbatch.grid of each of several files; their report and table are in the folder.
PIECES = "windows_per_file"
# In the header of an MCAP file: the version, which simulated and extracted recordings do not have.
_LIBRARY = re.compile(rb"mlbatch \d")
_HEAD_BYTES = 64


@dataclass(frozen=True, slots=True)
class RunFiles:
    """Paths of the report and the table of an output."""

    output: Path
    report: Path
    table: Path
    # `--report` names the report: it has to exist.
    is_given: bool = False

    @classmethod
    def of(cls, output: Path, report: Path | None = None) -> RunFiles:
        """In an output folder, next to an output file; report: the path of `--report`."""
        if output.is_dir():
            usual, table = output / REPORT, output / TABLE
        else:
            usual, table = (output.with_name(f"{output.name}.{name}") for name in (REPORT, TABLE))
        return cls(output, report or usual, table, report is not None)

    def report_text(self) -> str | None:
        """The text of the report."""
        text = _text(self.report)
        if text is None and self.is_given:
            raise VerifyError(
                f"{self.report}: expected a report, found no such file; leave out --report"
            )
        return text

    def table_text(self) -> str | None:
        """The text of the table."""
        return _text(self.table)

    def texts(self) -> tuple[str | None, str | None]:
        """Report and table; those inside of a single MCAP file that has none next to it."""
        report, table = self.report_text(), self.table_text()
        if report is None or table is None:
            files = mcaps_of(self.output)
            # Several files have neither.
            if len(files) == 1:
                from mlbatch.outputs.mcap_file import McapFile

                inner = inner_texts(McapFile(CheckLog(), files[0], files[0].name))
                report = inner[0] if report is None else report
                table = inner[1] if table is None else table
        return report, table


def is_output(path: Path) -> bool:
    """Whether a path is an output of `convert`, by its first bytes, its report or its files."""
    if not path.exists():
        return False
    kind = kind_of(path)
    if kind.name == "rosbag1":
        return RunFiles.of(path).report.exists()
    mcaps = mcaps_of(path)
    if mcaps:
        with open_file(mcaps[0]) as file:
            return _LIBRARY.search(file.read(_HEAD_BYTES)) is not None
    return kind.form is not None or format_of([path]) is not None


def mcaps_of(output: Path) -> list[Path]:
    """MCAP files of an output: itself, or the files in a bag folder; none in other outputs."""
    kind = kind_of(output).name
    if kind == "rosbag2":
        return [entry for entry in entries(output) if entry.suffix == ".mcap"]
    return [output] if kind == "mcap" else []


def inner_texts(file: McapFile) -> tuple[str | None, str | None]:
    """Report and table in an MCAP file."""
    table = file.attachments.get(TABLE)
    return (
        file.metadata.get("mlbatch.report", {}).get("json"),
        None if table is None else table.decode("utf-8", "replace"),
    )


def _text(path: Path) -> str | None:
    """A small file; None if there is none."""
    try:
        return read_text(path, MOST_TABLE_BYTES)
    except FileNotFoundError:
        return None
    except OSError as err:
        raise VerifyError(f"{path}: expected a readable file, found {err.strerror!r}") from err
    except UnicodeDecodeError as err:
        raise VerifyError(f"{path}: expected text in UTF-8, found other bytes; restore it") from err
