"""The kinds of outputs: how each is read, what it cannot show, and the result of all checks.

Libraries of a format are loaded only for outputs of that format.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mlbatch.outputs import npz
from mlbatch.outputs.damage import CHECKS, CheckLog, DamageError, VerifyError, Violation
from mlbatch.outputs.kinds import RANGES, FileFormat, kind_of
from mlbatch.outputs.metadata import RunMetadata, metadata_of_grid
from mlbatch.outputs.run_files import PIECES, TABLE, RunFiles
from mlbatch.verification import messages
from mlbatch.verification.examination import Examination, Progress
from mlbatch.verification.messages import TopicChecks, layout_limits
from mlbatch.verification.report_checks import ReportFiles

if TYPE_CHECKING:
    from mlbatch.outputs.rosbag2 import Yaml


@dataclass(frozen=True, slots=True)
class Check:
    """Outcome of a check."""

    name: str
    # Number of values that were checked.
    checked: int
    # Number of violations, including those that are not kept.
    violations: int
    # Reason why nothing, or only a part, is checkable in this output.
    limit: str

    @property
    def outcome(self) -> str:
        """One of ok, violated, not checkable."""
        if self.violations:
            return "violated"
        return "ok" if self.checked else "not checkable"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The result for one output."""

    path: str
    # As in `convert --format`.
    format: str
    scans: int
    points: int
    # None where the format does not show columns.
    columns: int | None
    checks: tuple[Check, ...]
    violations: tuple[Violation, ...]

    @property
    def count(self) -> int:
        """All violations, also those that are not kept."""
        return sum(check.violations for check in self.checks)

    @property
    def ok(self) -> bool:
        """Whether there is no violation."""
        return self.count == 0


def outcomes(log: CheckLog, limits: dict[str, str]) -> tuple[Check, ...]:
    """All checks; limits: by check, why it is not or only partly checkable."""
    return tuple(
        Check(
            name,
            log.checked[name],
            log.failed[name],
            limits.get(name, "" if log.checked[name] else "no such data in this output"),
        )
        for name in CHECKS
    )


_NO_REPORT = "no report in or next to the output; give it with --report"
_FOREIGN = "expected an output of mlbatch (a folder of scans, an MCAP file, a bag)"
_NAME_ONE = "name the output of `mlbatch convert`"


@dataclass(frozen=True, slots=True)
class Output:
    """An output to check."""

    path: Path
    files: RunFiles
    log: CheckLog
    progress: Progress | None = None

    def verdict(
        self, name: str, examination: Examination, limits: dict[str, str], files: ReportFiles
    ) -> Verdict:
        """The result after all checks; limits: why checks are not or only partly possible."""
        totals = examination.totals
        limits = limits | examination.limits
        if files.table is None or files.table.checksum is None:
            reason = f"no {TABLE}" if files.table is None else f"a {TABLE} of an earlier version"
            limits = {"checksum": f"{reason}: it has the checksums"} | limits
        if files.report is None:
            limits = dict.fromkeys(("ledger", "report", "t_init"), _NO_REPORT) | limits
        if not totals.scans and not self.log.violations:
            raise VerifyError(f"{self.path}: expected scans, found none; convert again")
        return Verdict(
            path=str(self.path),
            format=name,
            scans=totals.scans,
            points=totals.points,
            columns=totals.columns if totals.knows_columns else None,
            checks=outcomes(self.log, limits),
            violations=tuple(self.log.violations),
        )


def check_output(output: Output) -> Verdict:
    """Check an output of any kind."""
    kind = kind_of(output.path)
    if kind.form is not None:
        return _check_files(kind.form, output)
    if kind.name == "mcap":
        return _check_mcap(output, [output.path], kind.name)
    if kind.name == "rosbag1":
        return _check_bag(output)
    if kind.name == "rosbag2":
        return _check_rosbag2(output)
    raise VerifyError(f"{output.path}: {_FOREIGN}, found {kind.found}; {_NAME_ONE}")


def _side_files(output: Output) -> ReportFiles:
    """The report and the table, which has to be there."""
    files = ReportFiles.read(output.log, output.files)
    if not output.files.table.exists():
        output.log.fail("table", TABLE, "the table of scans", "none")
    return files


def _examination(output: Output, files: ReportFiles, metadata: RunMetadata) -> Examination:
    return Examination(output.log, str(output.path), metadata, files, output.progress)


def _no_grid(metadata: RunMetadata, what: str) -> dict[str, str]:
    """The checks that are impossible without a rate."""
    if metadata.rate is not None:
        return {}
    return dict.fromkeys(("grid", "index"), f"{what} no rate; {_NO_REPORT}")


def _check_files(form: FileFormat, output: Output) -> Verdict:
    log = output.log
    reader = form.reader(log)
    files = _side_files(output)
    scans = form.files(log, output.path)
    if not scans:
        found = log.violations[0] if log.violations else "none"
        raise VerifyError(f"{output.path}: expected files of scans, found {found}; convert again")
    try:
        own = reader.begin(scans[0])
    except DamageError as err:
        raise VerifyError(
            f"{scans[0].path}: {err}; restore the first scan, or convert again"
        ) from err
    metadata = files.metadata(log, own)
    reader.know(metadata)
    examination = _examination(output, files, metadata)
    for scan in reader.scans(scans):
        examination.scan(scan)
    examination.finish(split=scans[0].sensor is not None)
    limits = dict(form.limits) | _no_grid(metadata, "rows have")
    if reader.organized:
        limits |= npz.ORGANIZED_LIMITS
    return output.verdict(form.name, examination, limits, files)


def _check_rosbag2(output: Output) -> Verdict:
    from mlbatch.outputs.rosbag2 import open_bag

    paths, about = open_bag(output.log, output.path)
    return _check_mcap(output, paths, "rosbag2", about)


def _check_mcap(
    output: Output, paths: Sequence[Path], name: str, about: Yaml | None = None
) -> Verdict:
    """about: metadata.yaml of a ROS 2 bag."""
    from mlbatch.verification.indexes import BagFile, CheckedMcap, check_metadata

    log = output.log
    mcaps = []
    for path in paths:
        file = CheckedMcap(log, path)
        grid = file.metadata.get("mlbatch.grid")
        if grid is None:
            raise VerifyError(
                f"{path}: expected an MCAP file of mlbatch, with a metadata record mlbatch.grid, "
                f"found one of {file.library or 'an unknown writer'!r}; {_NAME_ONE}"
            )
        if PIECES in grid and not output.path.is_dir():
            raise VerifyError(
                f"{path}: expected a whole output, found one of the files of a bag; name its folder"
            )
        log.equal("metadata", f"{path.name} profile", "ros2", file.profile)
        mcaps.append(file)
    first, *others = (file.metadata["mlbatch.grid"] for file in mcaps)
    for path, grid in zip(paths[1:], others, strict=True):
        log.equal("metadata", f"{path.name} mlbatch.grid", first, grid)
    if PIECES in first or others:
        files = _side_files(output)
    else:
        attachment = mcaps[0].attachments.get(TABLE)
        report = mcaps[0].metadata.get("mlbatch.report")
        files = ReportFiles.inside(log, paths[0], report, attachment)
        files.check_copies(log, attachment, output.files)
    metadata = files.metadata(log, metadata_of_grid(log, paths[0].name, first))
    topics = TopicChecks(log, metadata, _examination(output, files, metadata), files.report)
    counts = topics.check_files(mcaps, output.path.name if others else paths[0].name)
    if about is not None:
        spans = (file.span_ns for file in mcaps)
        names = (path.name for path in paths)
        found = list(map(BagFile, names, counts, spans))
        check_metadata(log, about, found, topics.counts)
    return output.verdict(_format(name, topics), topics.examination, _limits(topics), files)


def _check_bag(output: Output) -> Verdict:
    from mlbatch.outputs.rosbag1 import LIMITS, BagFile

    log = output.log
    path = output.path
    files = ReportFiles.read(log, output.files)
    metadata = files.metadata(log, RunMetadata())
    topics = TopicChecks(log, metadata, _examination(output, files, metadata), files.report)
    topics.check_files([BagFile(log, path, path.name)], path.name)
    limits = _limits(topics) | LIMITS | _no_grid(metadata, "a bag has")
    if files.table is None:
        limits |= dict.fromkeys(("columns", "table"), f"no {TABLE} next to the output")
    return output.verdict(_format("rosbag1", topics), topics.examination, limits, files)


def _format(name: str, topics: TopicChecks) -> str:
    return f"{name}, {topics.layout}" if topics.layout else name


def _limits(topics: TopicChecks) -> dict[str, str]:
    """Reasons why checks are not possible on messages of a layout."""
    limits = layout_limits(topics.layout).items()
    own = {check: text for check, text in limits if not topics.log.checked[check]}
    if topics.layout == "ouster":
        own["geometry"] = RANGES
    if topics.strange_frames:
        own["frames"] = f"recorded messages name frames that are not there: {topics.strange_frames}"
    if topics.split:
        own["rings"] = "rings of every sensor begin at 0 with --split"
    return messages.LIMITS | own
