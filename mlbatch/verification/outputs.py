"""The kinds of outputs: how each is read, what it cannot show, and the result of all checks.

Libraries of a format are loaded only for outputs of that format.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mlbatch.outputs import npz
from mlbatch.outputs.damage import CHECKS, CheckLog, DamageError, VerifyError, Violation
from mlbatch.outputs.kinds import RANGES, FileFormat, kind_of
from mlbatch.outputs.metadata import RunMetadata, metadata_of_grid
from mlbatch.outputs.run_files import PIECES, TABLE, RunFiles
from mlbatch.verification import messages
from mlbatch.verification.examination import Examination, Progress
from mlbatch.verification.messages import TopicChecks, layout_limits
from mlbatch.verification.report_checks import ReportFiles


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


class _Output:
    """An output to check, with its report and table, and the metadata of its run."""

    def __init__(
        self, path: Path, paths: RunFiles, log: CheckLog, progress: Progress | None
    ) -> None:
        self.path = path
        self.paths = paths
        self.log = log
        self._progress = progress
        # Why checks are not or only partly possible.
        self.limits: dict[str, str] = {}
        self.files = ReportFiles(None, None)

    def read_side_files(self, *, has_table: bool = True) -> None:
        """Read the report and the table in or next to the output; has_table: it has to be there."""
        self.files = ReportFiles.read(self.log, self.paths)
        if has_table and not self.paths.table.exists():
            self.log.fail("table", TABLE, "the table of scans", "none")

    def examine(self, own: RunMetadata, without_rate: str = "") -> Examination:
        """Begin the checks; own: metadata in the output; without_rate: what may have none."""
        self.metadata = self.files.metadata(self.log, own)
        if self.metadata.rate is None and without_rate:
            reason = f"{without_rate} no rate; {_NO_REPORT}"
            self.limits |= dict.fromkeys(("grid", "index"), reason)
        self.examination = Examination(
            self.log, str(self.path), self.metadata, self.files, self._progress
        )
        return self.examination

    def verdict(self, name: str) -> Verdict:
        """The result after all checks; name: of the format."""
        totals = self.examination.totals
        table = self.files.table
        limits = self.limits | self.examination.limits
        if table is None or table.checksum is None:
            reason = f"no {TABLE}" if table is None else f"a {TABLE} of an earlier version"
            limits = {"checksum": f"{reason}: it has the checksums"} | limits
        if self.files.report is None:
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


def check_output(path: Path, paths: RunFiles, log: CheckLog, progress: Progress | None) -> Verdict:
    """Check an output of any kind; paths: of its report and table."""
    kind = kind_of(path)
    output = _Output(path, paths, log, progress)
    if kind.form is not None:
        return _check_files(kind.form, output)
    if kind.name:
        return _check_messages(kind.name, output)
    raise VerifyError(f"{path}: {_FOREIGN}, found {kind.found}; {_NAME_ONE}")


def _check_files(form: FileFormat, output: _Output) -> Verdict:
    log = output.log
    reader = form.reader(log)
    output.read_side_files()
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
    output.limits |= form.limits
    examination = output.examine(own, "rows have")
    reader.know(output.metadata)
    for scan in reader.scans(scans):
        examination.scan(scan)
    examination.finish(split=scans[0].sensor is not None)
    if reader.organized:
        output.limits |= npz.ORGANIZED_LIMITS
    return output.verdict(form.name)


def _check_messages(kind: str, output: _Output) -> Verdict:
    """Check a container of messages."""
    log, path, name = output.log, output.path, output.path.name
    if kind == "rosbag1":
        from mlbatch.outputs.rosbag1 import LIMITS, BagFile

        output.read_side_files(has_table=False)
        if output.files.table is None:
            reason = f"no {TABLE} next to the output"
            output.limits |= dict.fromkeys(("columns", "table"), reason)
        output.limits |= LIMITS
        topics = TopicChecks(log, output.examine(RunMetadata(), "a bag has"), output.files.report)
        topics.check_files([BagFile(log, path, name)], name)
    else:
        topics = _check_mcaps(output, is_bag=kind == "rosbag2")
    output.limits = _limits(topics) | output.limits
    return output.verdict(f"{kind}, {topics.layout}" if topics.layout else kind)


def _check_mcaps(output: _Output, *, is_bag: bool) -> TopicChecks:
    """Check an MCAP file, or those of a ROS 2 bag."""
    from mlbatch.outputs.rosbag2 import open_bag
    from mlbatch.verification.indexes import CheckedMcap, check_metadata

    log, path = output.log, output.path
    paths, about = open_bag(log, path) if is_bag else ([path], None)
    mcaps = [CheckedMcap(log, one) for one in paths]
    for one, file in zip(paths, mcaps, strict=True):
        grid = file.metadata.get("mlbatch.grid")
        if grid is None:
            raise VerifyError(
                f"{one}: expected an MCAP file of mlbatch, with a metadata record mlbatch.grid, "
                f"found one of {file.library or 'an unknown writer'!r}; {_NAME_ONE}"
            )
        if PIECES in grid and not path.is_dir():
            raise VerifyError(
                f"{one}: expected a whole output, found one of the files of a bag; name its folder"
            )
        log.equal("metadata", f"{one.name} profile", "ros2", file.profile)
    first, *others = (file.metadata["mlbatch.grid"] for file in mcaps)
    for one, grid in zip(paths[1:], others, strict=True):
        log.equal("metadata", f"{one.name} mlbatch.grid", first, grid)
    if PIECES in first or others:
        output.read_side_files()
    else:
        attachment = mcaps[0].attachments.get(TABLE)
        report = mcaps[0].metadata.get("mlbatch.report")
        output.files = ReportFiles.inside(log, paths[0], report, attachment)
        output.files.check_copies(log, attachment, output.paths)
    examination = output.examine(metadata_of_grid(log, paths[0].name, first))
    topics = TopicChecks(log, examination, output.files.report)
    counts = topics.check_files(mcaps, path.name if others else paths[0].name)
    if about is not None:
        check_metadata(log, about, mcaps, counts, topics.counts)
    return topics


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
