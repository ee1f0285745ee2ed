"""Every fault in rigs of one to four vendors: the declared result, and checks.

The rows of the table are in `cells.py`, the law of windows in `tests/reference/batching.py`. Every
vendor is once the victim of every fault, since the rigs of one to four lidars begin with another
vendor each. The largest rig is in every container, the others in one each.
"""

from __future__ import annotations

import functools
import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.verification import verify
from tests.builders.run import Outcome as Printed
from tests.builders.run import command, csv_without_arrival, load, scan_files
from tests.matrix.cells import KINDS, Kind, Session, plain
from tests.matrix.containers import CONTAINERS, rig_text, span_ns
from tests.matrix.lidars import NS_PER_MS, NS_PER_S, VENDORS, Sent, write_metadata
from tests.reference.batching import FeedPacket, Outcome, Settings, Window, reference_scans

SIZES = (1, 2, 3, 4)
PERIOD_NS = 50 * NS_PER_MS
WARNING = "mlbatch: warning: "
Report = dict[str, Any]
Print = tuple[object, ...]


@functools.cache
def session_of(name: str, size: int) -> Session:
    """The rig of a kind; the last lidar is the victim."""
    first = list(KINDS).index(name)
    vendors = [list(VENDORS)[(first + number) % len(VENDORS)] for number in range(size)]
    return tuple((KINDS[name].session or plain)(vendor) for vendor in vendors)


@dataclass(frozen=True, slots=True)
class Cell:
    """A fault in a rig in a container, in a folder of its own."""

    name: str
    size: int
    container: str
    folder: Path

    @property
    def kind(self) -> Kind:
        """The row of the table."""
        return KINDS[self.name]

    @property
    def session(self) -> Session:
        """What the lidars send."""
        return session_of(self.name, self.size)

    @property
    def victim(self) -> str:
        """Sensors that the fault affects."""
        return self.session[-1].vendor

    @property
    def begin_ns(self) -> int:
        """Receive time of the first packet."""
        return span_ns(self.session)[0]

    def prepare(self, session: Session, clock: str = "") -> None:
        """The recording, its rig, and what that names; clock: of the victim."""
        write_metadata(self.folder)
        for before in self.folder.glob("drive.*"):
            before.unlink()
        CONTAINERS[self.container](self.folder, session)
        clocks = {self.victim: clock} if clock else None
        text = rig_text(session, self.container, clocks)
        (self.folder / "rig.yaml").write_text(text, encoding="utf-8")

    def convert(self, *words: str, faulty: bool = True, output: str = "out") -> Printed:
        """Run the command."""
        (recording,) = self.folder.glob("drive.*")
        rig = self.folder / "rig.yaml"
        target = self.folder / output
        fault = self.kind.fault.format(v=self.victim)
        faults = ["--fault", fault] if fault and faulty else []
        return command("convert", recording, "-o", target, "--rig", rig, "--quiet", *faults, *words)


# -- checks of every output -----------------------------------------------------------------------


def report_of(folder: Path) -> Report:
    report: Report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    return report


def check_proof(folder: Path) -> Report:
    """`verify` finds nothing, ledgers balance, and no scan has a column before its period."""
    verdict = verify(folder)
    assert verdict.violations == ()
    assert verdict.scans
    report = report_of(folder)
    capture = report["capture"]
    assert capture["frames"] == capture["datagrams"] + sum(capture["skipped"].values())
    for sensor in report["sensors"]:
        packets = sensor["packets"]
        columns = sensor["columns"]
        points = sensor["points"]
        assert packets["read"] == packets["accepted"] + sum(packets["rejected"].values())
        assert columns["decoded"] == columns["written"] + sum(columns["dropped"].values())
        assert points.pop("slots") == sum(points.values())
    for path in scan_files(folder):
        scan = load(path)
        stamps = scan["column_stamp_ns"].astype(np.int64)
        start_ns = int(scan["start_ns"])
        assert int(scan["end_ns"]) - start_ns == PERIOD_NS
        assert (stamps >= start_ns).all()
        assert (stamps < start_ns + PERIOD_NS).all()
        assert (np.diff(stamps) >= 0).all()
    return report


def reference(session: Session, wait_ns: int = NS_PER_S) -> Outcome:
    """The paper's loop over the packets in the order of arrival."""
    feed = [
        FeedPacket(number, host_ns, -1, tuple(stamps), (True,) * len(stamps))
        for number, sent in enumerate(session)
        for host_ns, stamps in zip(sent.host_ns.tolist(), sent.stamp_ns.tolist(), strict=True)
    ]
    feed.sort(key=lambda packet: packet.host_ns)
    return reference_scans(feed, Settings(Fraction(20), len(session), max_wait_ns=wait_ns))


def columns_of(session: Session, window: Window) -> tuple[I64Array, I64Array, int]:
    """Stamp and sensor of the columns of a window, and the number of its points."""
    places = window.columns
    stamps = [session[sensor].stamp_ns[packet, column] for sensor, packet, column in places]
    points = [session[sensor].points[packet, column] for sensor, packet, column in places]
    return np.array(stamps), np.array([place[0] for place in places]), int(sum(points))


def check_law(folder: Path, session: Session, wait_ns: int, report: Report) -> None:
    """Exactly these columns in these windows, and everything else counted by its reason."""
    expected = reference(session, wait_ns)
    files = scan_files(folder)
    assert [int(path.stem) for path in files] == [window.index for window in expected.windows]
    for path, window in zip(files, expected.windows, strict=True):
        scan = load(path)
        stamps, sensor, points = columns_of(session, window)
        assert int(scan["start_ns"]) == window.start_ns
        assert bool(scan["complete"]) == window.complete, path.name
        assert np.array_equal(scan["column_stamp_ns"], stamps)
        assert np.array_equal(scan["column_lidar_id"], sensor)
        assert len(scan["xyz"]) == points
    assert int(report["grid"]["t_init_ns"]) == expected.t_init_ns
    assert [one["columns"]["dropped"] for one in report["sensors"]] == expected.dropped
    scans = report["scans"]
    assert (scans["written"], scans["incomplete"], scans["empty"]) == (
        len(expected.windows),
        expected.incomplete,
        expected.empty,
    )


def check_counts(cell: Cell, report: Report) -> None:
    """The victim's packets are counted as declared; nothing befell the others."""
    (fault,) = report["faults"]
    assert fault["packets"] > 0
    for sent, sensor in zip(cell.session, report["sensors"], strict=True):
        packets = sensor["packets"]
        total = len(sent.payloads)
        found = {"lost": packets["lost"], "reordered": packets["reordered"], "duplicate": 0}
        found |= {"read": packets["read"], "accepted": packets["accepted"], **packets["rejected"]}
        if sent.vendor != cell.victim:
            assert (found["read"], found["accepted"]) == (total, total)
            assert (found["lost"], found["reordered"]) == (0, 0)
            continue
        for name, declared in (cell.kind.counts or {}).items():
            low, high = declared(total, fault["packets"])
            assert low <= found.get(name, 0) <= high, name


# -- equal results of runs ------------------------------------------------------------------------


def prints(folder: Path) -> Print:
    """Everything that must be identical, and all ledgers."""
    report = report_of(folder)
    files = tuple((path.name, sha256(path.read_bytes()).digest()) for path in scan_files(folder))
    table = csv_without_arrival((folder / "scans.csv").read_text(encoding="utf-8"))
    parts = ("packets", "columns", "points")
    ledgers = [[sensor[part] for part in parts] for sensor in report["sensors"]]
    return files, table, json.dumps(ledgers), json.dumps(report.get("faults"))


def scans_of(folder: Path) -> Print:
    """Scans alone."""
    return prints(folder)[:2]


def outputs(folder: Path) -> list[Path]:
    """What a run left, in order."""
    return sorted(path for path in folder.glob("out*") if path.is_dir())


@functools.cache
def faultless(name: str, size: int) -> Print:
    """Scans of the capture without the fault."""
    with tempfile.TemporaryDirectory() as folder:
        cell = Cell(name, size, "pcap", Path(folder))
        cell.prepare(cell.session)
        done = cell.convert(faulty=False)
        assert (done.code, done.err) == (0, "")
        return scans_of(cell.folder / "out")


# What the first container of a fault and a rig gave, in this process.
first_prints: dict[tuple[str, int], tuple[Print, ...]] = {}


# -- the matrix -----------------------------------------------------------------------------------

CELLS = [
    (name, size, container)
    for number, name in enumerate(KINDS)
    for size in SIZES
    for container in (
        CONTAINERS if size == SIZES[-1] else (list(CONTAINERS)[(number + size) % len(CONTAINERS)],)
    )
]


@pytest.mark.parametrize(("name", "size", "container"), CELLS)
def test_cell(name: str, size: int, container: str, tmp_path: Path) -> None:
    cell = Cell(name, size, container, tmp_path)
    cell.prepare(cell.session)
    kind = cell.kind
    if kind.pieces is not None:
        check_split(cell)
    elif kind.refused_together and size > 1:
        check_refused(cell, kind.refused_together)
        assert not outputs(tmp_path)
    else:
        check_merged(cell)
    if kind.remedied is not None:
        check_remedied(cell, *kind.remedied)
    found = tuple(prints(path) for path in outputs(tmp_path))
    assert found == first_prints.setdefault((name, size), found)


def check_merged(cell: Cell) -> None:
    """One output of all sensors."""
    kind = cell.kind
    out = cell.folder / "out"
    done = cell.convert(*kind.words)
    assert done.code == 0, done.err
    report = check_proof(out)
    needed = {"loss": has_loss(report), "no_points": bool(report["scans"]["no_points"])}
    codes = set()
    for line in done.err.splitlines():
        assert line.startswith(WARNING)
        code = line.removeprefix(WARNING).split(":")[0]
        assert code in kind.warnings or needed.get(code), line
        codes.add(code)
    assert codes >= {code for code, is_needed in needed.items() if is_needed}
    check_counts(cell, report)
    if kind.subset:
        check_subset(cell, report)
        return
    session = cell.session if kind.change is None else kind.change(cell.session, cell.begin_ns)
    check_law(out, session, kind.wait_ns, report)
    if kind.change is None:
        assert scans_of(out) == faultless(cell.name, cell.size)


def has_loss(report: Report) -> bool:
    """More than 0.1 % of the packets of a sensor are lost, or scans lack half of its columns."""
    counts = [sensor["packets"] for sensor in report["sensors"]]
    lost = [one["lost"] > (one["accepted"] + one["lost"]) / 1000 for one in counts]
    return any(lost) or report["scans"]["underfilled"] > 0


def check_subset(cell: Cell, report: Report) -> None:
    """Packets are missing or damaged, the others are where they belong."""
    expected = reference(cell.session)
    (fault,) = report["faults"]
    files = scan_files(cell.folder / "out")
    assert [int(path.stem) for path in files] == [window.index for window in expected.windows]
    astray = 0
    for path, window in zip(files, expected.windows, strict=True):
        scan = load(path)
        stamps, sensor, _ = columns_of(cell.session, window)
        last = cell.size - 1
        assert bool(scan["complete"]) == window.complete
        hurt = scan["column_lidar_id"] == last
        was_hurt = sensor == last
        assert np.array_equal(scan["column_stamp_ns"][~hurt], stamps[~was_hurt])
        astray += len(np.setxor1d(scan["column_stamp_ns"][hurt], stamps[was_hurt]))
    columns = cell.session[-1].stamp_ns.shape[1]
    # Where a packet's stamps are damaged its columns are missing in one place, and in another.
    assert astray <= 2 * columns * fault["packets"]


def check_refused(cell: Cell, words: Sequence[str], *, faulty: bool = True) -> None:
    """One line on stderr, and nothing written."""
    done = cell.convert(faulty=faulty)
    assert done.code == 1
    assert done.err.startswith("mlbatch: error: ")
    assert done.err.count("\n") == 1
    for word in words:
        assert word in done.err


def check_remedied(cell: Cell, send: Callable[[str], Sent], clock: str) -> None:
    """A sensor whose clock is off: refused, until its rig has the offset."""
    session = (*cell.session[:-1], send(cell.victim))
    cell.prepare(session)
    if cell.size > 1:
        check_refused(cell, cell.kind.refused_together, faulty=False)
    cell.prepare(session, clock)
    done = cell.convert(faulty=False, output="remedied")
    assert (done.code, done.err) == (0, "")
    check_proof(cell.folder / "remedied")
    assert scans_of(cell.folder / "remedied") == faultless(cell.name, cell.size)


def check_split(cell: Cell) -> None:
    """An error, or an output for each stretch."""
    kind = cell.kind
    assert kind.pieces is not None
    check_refused(cell, kind.error)
    assert not outputs(cell.folder)
    done = cell.convert("--on-jump", "split")
    assert done.code == 0, done.err
    pieces = kind.pieces(cell.session, cell.begin_ns)
    folders = outputs(cell.folder)
    assert [path.name for path in folders] == [f"out.seg{n + 1}" for n in range(len(pieces))]
    for folder, piece in zip(folders, pieces, strict=True):
        report = check_proof(folder)
        check_law(folder, piece, kind.wait_ns, report)
        for sent, sensor in zip(piece, report["sensors"], strict=True):
            packets = sensor["packets"]
            assert packets["accepted"] == packets["read"] == len(sent.payloads)
            assert (packets["lost"], packets["reordered"]) == (0, 0)
