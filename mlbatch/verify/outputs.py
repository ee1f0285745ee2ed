"""Each kind of output: where its scans and papers are, and what it leaves open."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mlbatch.verify import containers, messages, npz, ply, rosbag1
from mlbatch.verify.claims import Claims
from mlbatch.verify.containers import McapFile
from mlbatch.verify.examination import Examination
from mlbatch.verify.folders import entries, scan_files
from mlbatch.verify.messages import LAYOUT_LIMITS, Topics
from mlbatch.verify.report_checks import (
    TABLE,
    Beside,
    Papers,
    check_copies,
    claims_of_grid,
    inner_papers,
    read_papers,
)
from mlbatch.verify.rosbag1 import BagFile
from mlbatch.verify.rosbag2 import METADATA, bag_file, check_metadata
from mlbatch.verify.verdict import DamageError, Judge, Verdict, VerifyError

_RANGES = "ranges to 1 m: beams do not leave from the origin of their sensor"
_NO_REPORT = "no report beside it; give it with --report"
_FOREIGN = "wanted an output of mlbatch (a folder of npz or PLY files, an MCAP file, a bag)"


@dataclass(frozen=True, slots=True)
class Proof:
    """An output under examination; asked: `--report` was given."""

    path: Path
    beside: Beside
    asked: bool
    judge: Judge

    def verdict(
        self, name: str, examination: Examination, limits: dict[str, str], papers: Papers
    ) -> Verdict:
        """The end."""
        judge, tally = self.judge, examination.tally
        if papers.report is None:
            limits = dict.fromkeys(("ledger", "report", "t_init"), _NO_REPORT) | limits
        if not tally.scans and not judge.violations:
            raise VerifyError(f"{self.path}: wanted scans, got none; convert again")
        return Verdict(
            path=str(self.path),
            format=name,
            scans=tally.scans,
            points=tally.points,
            columns=tally.columns if tally.knows_columns else None,
            checks=judge.checks(limits),
            violations=tuple(judge.violations),
        )


def examine(proof: Proof) -> Verdict:
    """Find out what an output is, and prove it."""
    path = proof.path
    if path.is_dir():
        kind = _kind_of_folder(path)
        return kind(proof)
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as err:
        raise VerifyError(f"{path}: wanted to read it, got {err.strerror!r}") from err
    if head.startswith(containers.MAGIC):
        return _of_mcap(proof, path, "mcap", Claims())
    if head.startswith(rosbag1.MAGIC):
        return _of_rosbag1(proof)
    what = "an empty file" if not head else "a file of another kind"
    raise VerifyError(f"{path}: {_FOREIGN}, got {what}; name the output of `mlbatch convert`")


def _kind_of_folder(path: Path) -> Callable[[Proof], Verdict]:
    inside = entries(path)
    if any(entry.name == METADATA for entry in inside):
        return _of_rosbag2
    folders = [entry for entry in inside if entry.is_dir() and not entry.name.startswith(".")]
    names = [*inside, *(inner for folder in folders for inner in entries(folder))]
    for suffix, kind in ((npz.SUFFIX, _of_npz), (ply.SUFFIX, _of_ply)):
        if any(entry.suffix == suffix for entry in names):
            return kind
    what = "an empty folder" if not inside else "a folder without scans"
    raise VerifyError(f"{path}: {_FOREIGN}, got {what}; name the output of `mlbatch convert`")


def _of_npz(proof: Proof) -> Verdict:
    reader = npz.NpzReader(proof.judge)
    return _of_files(proof, "npz", npz.SUFFIX, reader, npz.LIMITS | {"geometry": _RANGES})


def _of_ply(proof: Proof) -> Verdict:
    return _of_files(proof, "ply", ply.SUFFIX, ply.PlyReader(proof.judge), ply.LIMITS)


def _of_files(
    proof: Proof,
    name: str,
    suffix: str,
    reader: npz.NpzReader | ply.PlyReader,
    limits: dict[str, str],
) -> Verdict:
    judge = proof.judge
    papers = read_papers(judge, proof.beside, asked=proof.asked)
    if not proof.beside.table.exists():
        judge.blame("table", TABLE, "the table of scans", "none")
    files = scan_files(judge, proof.path, suffix)
    if not files:
        raise VerifyError(f"{proof.path}: wanted files of scans, got strange names only")
    try:
        own = reader.begin(files[0])
    except DamageError as err:
        raise VerifyError(
            f"{files[0].path}: {err}; restore the first scan, or convert again"
        ) from err
    claims = papers.claims(judge, own)
    examination = Examination(judge, str(proof.path), claims, papers)
    for scan in reader.scans(files):
        examination.scan(scan)
    examination.finish(split=files[0].sensor is not None)
    if isinstance(reader, npz.NpzReader) and reader.organized:
        limits = limits | npz.ORGANIZED_LIMITS
    return proof.verdict(name, examination, limits, papers)


def _of_rosbag2(proof: Proof) -> Verdict:
    file, about = bag_file(proof.judge, proof.path)

    def check(topics: Topics, span_ns: tuple[int, int]) -> None:
        check_metadata(proof.judge, about, file.name, topics.counts, span_ns)

    return _of_mcap(proof, file, "rosbag2", Claims(), check)


def _of_mcap(
    proof: Proof,
    path: Path,
    name: str,
    claims: Claims,
    check: Callable[[Topics, tuple[int, int]], None] | None = None,
) -> Verdict:
    judge, where = proof.judge, path.name
    file = McapFile(judge, path, where)
    grid = file.metadata.get("mlbatch.grid")
    if grid is None:
        raise VerifyError(
            f"{path}: wanted an MCAP file of mlbatch, with a metadata record mlbatch.grid, got one "
            f"of {file.library or 'an unknown writer'!r}; name the output of `mlbatch convert`"
        )
    judge.equal("metadata", f"{where} profile", "ros2", file.profile)
    attachment = file.attachments.get(TABLE)
    papers = inner_papers(judge, path, file.metadata.get("mlbatch.report"), attachment)
    check_copies(judge, papers, attachment, proof.beside, asked=proof.asked)
    claims = papers.claims(judge, claims_of_grid(judge, where, grid))
    examination = Examination(judge, str(path), claims, papers)
    topics = Topics(judge, claims, examination, papers.report)
    for message in file.messages():
        topics.take(message)
    topics.finish(where)
    if check is not None:
        check(topics, file.span_ns)
    return proof.verdict(_named(name, topics), examination, _limits(topics), papers)


def _of_rosbag1(proof: Proof) -> Verdict:
    judge, path = proof.judge, proof.path
    papers = read_papers(judge, proof.beside, asked=proof.asked)
    claims = papers.claims(judge, Claims())
    examination = Examination(judge, str(path), claims, papers)
    topics = Topics(judge, claims, examination, papers.report)
    for message in BagFile(judge, path, path.name).messages():
        topics.take(message)
    topics.finish(path.name)
    limits = _limits(topics) | rosbag1.LIMITS
    if claims.rate is None:
        limits |= dict.fromkeys(("grid", "index"), f"a bag does not tell its rate; {_NO_REPORT}")
    if papers.table is None:
        limits |= dict.fromkeys(("columns", "table"), f"no {TABLE} beside it")
    return proof.verdict(_named("rosbag1", topics), examination, limits, papers)


def _named(name: str, topics: Topics) -> str:
    return f"{name}, {topics.layout}" if topics.layout else name


def _limits(topics: Topics) -> dict[str, str]:
    """What messages of this layout leave open."""
    own = {
        check: f"the point layout {topics.layout} has no field for it"
        for check, layouts in LAYOUT_LIMITS.items()
        if topics.layout in layouts and not topics.judge.judged[check]
    }
    if topics.layout == "ouster":
        own["geometry"] = _RANGES
    if topics.split:
        own["rings"] = "rings of every sensor begin at 0 with --split"
    return messages.LIMITS | own
