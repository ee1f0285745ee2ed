"""Every fault in rigs of one to four vendors, in every container: the declared result, and checks.

The law of windows is that of `tests/reference/batching.py`. Every vendor is once the victim of
every fault, since the rigs of one to four lidars begin with another vendor each.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.verification import verify
from tests.builders.run import Outcome as Printed
from tests.builders.run import command, load, scan_files
from tests.matrix.containers import CONTAINERS, rig_text
from tests.matrix.lidars import (
    HOUR_NS,
    LENGTH_NS,
    NOON_NS,
    NS_PER_MS,
    NS_PER_S,
    VENDORS,
    Sent,
    Spell,
    plain,
    write_metadata,
)
from tests.reference.batching import FeedPacket, Outcome, Settings, Window, reference_scans

PERIOD_NS = 50 * NS_PER_MS
HALF_NS = LENGTH_NS // 2
Session = tuple[Sent, ...]
# What is left for the batching, from the session and its first receive time: of `--on-jump split` a
# session for each output.
Leaves = Callable[[Session, int], tuple[Session, ...]]
Report = dict[str, Any]

# -- sessions -------------------------------------------------------------------------------------


def ahead(vendor: str) -> Sent:
    """The same half second by a clock that counts TAI."""
    row = VENDORS[vendor]
    ahead_ns = 37 * NS_PER_S
    return row.send(Spell(NOON_NS + row.begin_ns + ahead_ns, LENGTH_NS, ahead_ns=-ahead_ns))


def wrapping(vendor: str) -> Sent:
    """Half a second over the full hour, in which every count begins anew."""
    row = VENDORS[vendor]
    begin_ns = NOON_NS // HOUR_NS * HOUR_NS - HALF_NS + row.begin_ns
    return row.send(Spell(begin_ns, LENGTH_NS, row.wrap))


def restarting(vendor: str) -> Sent:
    """Up for 100 s at first; then all counts and clocks begin anew, but not the capture host's."""
    row = VENDORS[vendor]
    up_ns = 100 * NS_PER_S
    before = row.send(Spell(up_ns + row.begin_ns, HALF_NS - 20 * NS_PER_MS, 5000))
    again = Spell(row.begin_ns + 20 * NS_PER_MS, HALF_NS, 0, up_ns + HALF_NS)
    return before.then(row.send(again))


# -- what faults leave ----------------------------------------------------------------------------


def victim(change: Callable[[Sent, int], Sent]) -> Leaves:
    """The last lidar is changed; change: also from the first receive time."""
    return lambda session, begin_ns: ((*session[:-1], change(session[-1], begin_ns)),)


def silent(from_ms: int, until_ms: int) -> Leaves:
    """Packets of an interval after the first receive time are lost."""

    def remaining(sent: Sent, begin_ns: int) -> Sent:
        since_ms = (sent.host_ns - begin_ns) / NS_PER_MS
        return sent.where(np.flatnonzero((since_ms < from_ms) | (since_ms >= until_ms)))

    return victim(remaining)


def shifted(by_ns: int) -> Leaves:
    """The clock is off."""
    return victim(lambda sent, _: replace(sent, stamp_ns=sent.stamp_ns + by_ns))


def drifting(sent: Sent, begin_ns: int) -> Sent:
    """The clock gains 500 ppm from the first receive time on, always whole ns."""
    gained_ns, rest = np.divmod((sent.host_ns - begin_ns) * 500, 1_000_000)
    assert not rest.any()
    return replace(sent, stamp_ns=sent.stamp_ns + gained_ns[:, None])


def cut(by_ns: int) -> Leaves:
    """Two pieces, by receive time; in the second all clocks are off."""

    def pieces(session: Session, begin_ns: int) -> tuple[Session, ...]:
        late = [sent.host_ns - begin_ns >= HALF_NS for sent in session]
        first, second = (
            tuple(
                sent.where(np.flatnonzero(is_late == of_second))
                for sent, is_late in zip(session, late, strict=True)
            )
            for of_second in (False, True)
        )
        return first, tuple(replace(sent, stamp_ns=sent.stamp_ns + by_ns) for sent in second)

    return pieces


def restarted(session: Session, begin_ns: int) -> tuple[Session, ...]:
    """Before and after the stamps step back."""
    again = [int(np.argmax(np.diff(sent.stamp_ns[:, 0]) < 0)) + 1 for sent in session]
    pairs = list(zip(session, again, strict=True))
    return (
        tuple(sent.where(np.arange(at)) for sent, at in pairs),
        tuple(sent.where(np.arange(at, len(sent.host_ns))) for sent, at in pairs),
    )


# -- the table ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Kind:
    """A fault as a user writes it, {v}: the victim, and what it gives.

    is_chance: chance decides which packets are gone, any may be; error: what the run says without
    `--on-jump split`, or of a rig of several lidars; remedy: a lidar with the fault in its packets,
    and the `clock` of its rig that mends it; counts: of the victim's packets, lowest and highest by
    the packets `sent` and those `touched` by the report; wait_ns: of `words`.
    """

    fault: str = ""
    leaves: Leaves = lambda session, _: (session,)
    counts: Mapping[str, str] = field(default_factory=dict)
    words: tuple[str, ...] = ()
    wait_ns: int = NS_PER_S
    is_chance: bool = False
    error: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    remedy: tuple[Callable[[str], Sent], str] | None = None
    send: Callable[[str], Sent] = plain


def short(fault: str, leaves: Leaves, **counts: str) -> Kind:
    """Other lidars are not waited for."""
    return Kind(fault, leaves, counts, ("--max-wait", "0.1"), 100 * NS_PER_MS)


ALL = {"read": "sent", "accepted": "sent", "lost": "0", "reordered": "0"}
LESS = {"read": "sent-touched", "accepted": "sent-touched", "lost": "0", "reordered": "0"}
# Loss at the ends cannot be known.
BETWEEN = "touched-3..touched"
FORWARD = ("clock jump within the recording", "a step forward", "--on-jump split")
BACK = ("clock reset within the recording", "a step back", "--on-jump split")
KINDS: Mapping[str, Kind] = {
    "drop": Kind("drop:{v}:5%", counts={**LESS, "lost": BETWEEN}, is_chance=True),
    "stall": short("stall:{v}:0.15s-0.3s", silent(150, 300), **{**LESS, "lost": "touched"}),
    "late": short("late:{v}:0.2s", silent(-1, 200), **LESS),
    "early": short("early:{v}:0.3s", silent(300, 1000), **LESS),
    "duplicate": Kind(
        "dup:{v}:10%", counts={**ALL, "read": "sent+touched", "duplicate": "touched"}
    ),
    "reorder": Kind("reorder:{v}:10%", counts={**ALL, "reordered": "touched"}),
    "delay": Kind("delay:{v}:60ms", counts=ALL, warnings=("clocks",)),
    "offset": Kind("jump:{v}:300ms@0s", shifted(300 * NS_PER_MS), ALL, warnings=("clocks",)),
    # A vendor alone is converted; it is 37 s from the capture host.
    "whole seconds": Kind(
        *("jump:{v}:37s@0s", shifted(37 * NS_PER_S), ALL),
        error=("37.", "--clock host", "clock.offset_s"),
        warnings=("clock_epoch",),
        remedy=(ahead, "{offset_s: -37}"),
    ),
    "drift": Kind("drift:{v}:500ppm", victim(drifting), ALL),
    "jump forward": Kind("jump:*:37s@0.25s", cut(37 * NS_PER_S), error=FORWARD),
    "jump back": Kind("jump:*:-20s@0.25s", cut(-20 * NS_PER_S), error=BACK),
    "wrap": Kind("reorder:{v}:10%", counts={**ALL, "reordered": "touched"}, send=wrapping),
    "restart": Kind(leaves=restarted, error=BACK, send=restarting),
    # Whether a bit is one that shows is chance.
    "bit flips": Kind(
        "bitflip:{v}:2%",
        counts={
            **dict.fromkeys(("read", "accepted"), "sent-touched..sent"),
            **dict.fromkeys(("lost", "reordered"), "0..touched"),
        },
        is_chance=True,
        warnings=("rejected", "unassigned"),
    ),
    "truncation": Kind(
        "truncate:{v}:3%",
        counts={**LESS, "read": "sent", "bad_size": "touched", "lost": BETWEEN},
        is_chance=True,
        warnings=("rejected",),
    ),
}


@dataclass(frozen=True, slots=True)
class Cell:
    """A fault in a rig in a container, in a folder of its own."""

    kind: Kind
    session: Session
    container: str
    folder: Path

    @property
    def victim(self) -> str:
        """The sensor that the fault affects."""
        return self.session[-1].vendor

    def pieces(self) -> tuple[Session, ...]:
        """What the fault leaves for the batching."""
        return self.kind.leaves(self.session, min(int(one.host_ns.min()) for one in self.session))

    def prepare(self, session: Session, clock: str = "") -> None:
        """The recording, its rig, and what that names; clock: of the victim."""
        write_metadata(self.folder)
        for before in self.folder.glob("drive.*"):
            before.unlink()
        CONTAINERS[self.container](self.folder, session)
        text = rig_text(session, self.container, {self.victim: clock} if clock else None)
        (self.folder / "rig.yaml").write_text(text, encoding="utf-8")

    def convert(self, *words: str, is_faulty: bool = True) -> Printed:
        """Run the command."""
        (recording,) = self.folder.glob("drive.*")
        paths = ("-o", self.folder / "out", "--rig", self.folder / "rig.yaml")
        fault = self.kind.fault.format(v=self.victim)
        faults = ["--fault", fault] if fault and is_faulty else []
        return command("convert", recording, *paths, "--quiet", *faults, *words)

    def check_refused(self, *, is_faulty: bool = True) -> None:
        """One line on stderr, and nothing written."""
        done = self.convert(is_faulty=is_faulty)
        assert (done.code, done.err.count("\n")) == (1, 1)
        assert done.err.startswith("mlbatch: error: ")
        assert all(word in done.err for word in self.kind.error)
        assert not list(self.folder.glob("out*"))


CELLS = [
    (name, size, list(CONTAINERS)[(number + size) % len(CONTAINERS)])
    for number, name in enumerate(KINDS)
    for size in (1, 2, 3, 4)
]


@pytest.mark.parametrize(("name", "size", "container"), CELLS)
def test_cell(name: str, size: int, container: str, tmp_path: Path) -> None:
    kind = KINDS[name]
    first = list(KINDS).index(name)
    vendors = [list(VENDORS)[(first + number) % len(VENDORS)] for number in range(size)]
    cell = Cell(kind, tuple(map(kind.send, vendors)), container, tmp_path)
    cell.prepare(cell.session)
    if kind.remedy is None and kind.error:
        check_split(cell)
    elif kind.error and size > 1:
        cell.check_refused()
    else:
        check_merged(cell)
    if kind.remedy is not None and size > 1:
        check_remedied(cell, *kind.remedy)


def check_merged(cell: Cell) -> None:
    """One output of all sensors, with those warnings that are needed."""
    kind = cell.kind
    done = cell.convert(*kind.words)
    assert done.code == 0, done.err
    report = check_output(cell.folder / "out")
    counts = [sensor["packets"] for sensor in report["sensors"]]
    # More than 0.1 % of the packets of a sensor are lost, or scans lack half of its columns.
    lost = [one["lost"] > (one["accepted"] + one["lost"]) / 1000 for one in counts]
    needed = {
        "loss": any(lost) or report["scans"]["underfilled"] > 0,
        "no_points": bool(report["scans"]["no_points"]),
    }
    assert len(done.warnings) == len(done.err.splitlines())
    assert {code for code in needed if needed[code]} <= set(done.warnings)
    assert all(code in kind.warnings or needed.get(code) for code in done.warnings), done.err
    check_counts(cell, report)
    if kind.is_chance:
        check_subset(cell, report)
    else:
        check_law(cell.folder / "out", cell.pieces()[0], kind.wait_ns, report)


def check_remedied(cell: Cell, send: Callable[[str], Sent], clock: str) -> None:
    """A sensor whose clock is off: refused, until its rig has the offset."""
    session = (*cell.session[:-1], send(cell.victim))
    cell.prepare(session)
    cell.check_refused(is_faulty=False)
    cell.prepare(session, clock)
    done = cell.convert(is_faulty=False)
    assert (done.code, done.err) == (0, "")
    out = cell.folder / "out"
    check_law(out, cell.session, NS_PER_S, check_output(out))


def check_split(cell: Cell) -> None:
    """An error, or an output for each stretch."""
    cell.check_refused()
    done = cell.convert("--on-jump", "split")
    assert done.code == 0, done.err
    pieces = cell.pieces()
    folders = sorted(cell.folder.glob("out*"))
    assert [path.name for path in folders] == [f"out.seg{n + 1}" for n in range(len(pieces))]
    for folder, piece in zip(folders, pieces, strict=True):
        report = check_output(folder)
        check_law(folder, piece, cell.kind.wait_ns, report)
        for sent, sensor in zip(piece, report["sensors"], strict=True):
            packets = sensor["packets"]
            assert packets["accepted"] == packets["read"] == len(sent.payloads)
            assert (packets["lost"], packets["reordered"]) == (0, 0)


# -- checks of an output --------------------------------------------------------------------------


def check_output(folder: Path) -> Report:
    """`verify` finds nothing, and ledgers balance."""
    verdict = verify(folder)
    assert verdict.violations == ()
    assert verdict.scans
    report: Report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    capture = report["capture"]
    assert capture["frames"] == capture["datagrams"] + sum(capture["skipped"].values())
    for sensor in report["sensors"]:
        packets, columns, points = (sensor[name] for name in ("packets", "columns", "points"))
        assert packets["read"] == packets["accepted"] + sum(packets["rejected"].values())
        assert columns["decoded"] == columns["written"] + sum(columns["dropped"].values())
        assert points.pop("slots") == sum(points.values())
    return report


def check_counts(cell: Cell, report: Report) -> None:
    """The victim's packets are counted as declared; nothing befell the others."""
    (fault,) = report["faults"]
    assert fault["packets"] > 0
    for sent, sensor in zip(cell.session, report["sensors"], strict=True):
        packets = sensor["packets"]
        found = {**packets, "duplicate": 0, **packets["rejected"]}
        counts = cell.kind.counts if sent.vendor == cell.victim else ALL
        for name, text in counts.items():
            values = {"sent": len(sent.payloads), "touched": fault["packets"]}
            bounds = [eval(one, {}, values) for one in text.split("..")]
            assert bounds[0] <= found.get(name, 0) <= bounds[-1], name


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
        span_ns = int(scan["start_ns"]), int(scan["end_ns"])
        assert span_ns == (window.start_ns, window.start_ns + PERIOD_NS)
        assert bool(scan["complete"]) == window.complete, path.name
        assert np.array_equal(scan["column_stamp_ns"], stamps)
        assert np.array_equal(scan["column_lidar_id"], sensor)
        assert len(scan["xyz"]) == points
    assert int(report["grid"]["t_init_ns"]) == expected.t_init_ns
    assert [one["columns"]["dropped"] for one in report["sensors"]] == expected.dropped
    scans = [report["scans"][name] for name in ("written", "incomplete", "empty")]
    assert scans == [len(expected.windows), expected.incomplete, expected.empty]


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
        assert bool(scan["complete"]) == window.complete
        hurt, was_hurt = (one == len(cell.session) - 1 for one in (scan["column_lidar_id"], sensor))
        assert np.array_equal(scan["column_stamp_ns"][~hurt], stamps[~was_hurt])
        astray += len(np.setxor1d(scan["column_stamp_ns"][hurt], stamps[was_hurt]))
    columns = cell.session[-1].stamp_ns.shape[1]
    # Where a packet's stamps are damaged its columns are missing in one place, and in another.
    assert astray <= 2 * columns * fault["packets"]
