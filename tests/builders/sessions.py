"""Small sessions of Ouster lidars as captures, and the command line run within the test's process.

A revolution has 512 columns, at 10 Hz; packets are received `latency_ns` after their last column.
"""

from __future__ import annotations

import json
import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from mlbatch.simulate.ouster.encode import OusterSpec, encode_frame, imu_packet, metadata_json
from mlbatch.writers import atomic
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.run import Outcome, command

REPOSITORY = Path(__file__).resolve().parents[2]
FIXTURE = REPOSITORY / "fixtures" / "two_lidars"
CAPTURE = FIXTURE / "two_lidars.pcap"
RIG = FIXTURE / "rig.yaml"
# As words of a command.
FIX = f"{CAPTURE} --rig {RIG}"
RECORDINGS = REPOSITORY / ".." / "shared" / "recordings"
NO_RECORDINGS = "the folder of real recordings is not here"
NS_PER_S = 10**9
NS_PER_MS = 10**6
EPOCH_NS = 1_800_000_000 * NS_PER_S
PACKETS_PER_TURN = 32
SMALL = OusterSpec(beams=16, columns_per_frame=512, serial=111)
Records = list[tuple[int, bytes]]
Report = dict[str, Any]
Arrays = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Unit:
    """A lidar in a session; begin_ns: its first stamp; host_ns: host clock minus sensor clock."""

    spec: OusterSpec = SMALL
    ip: str = "10.0.0.1"
    port: int = 7502
    begin_ns: int = EPOCH_NS + 20 * NS_PER_MS
    turns: int = 3
    host_ns: int = NS_PER_MS
    first_frame: int = 5
    tail: bytes = b""
    range_mm: int = 4000

    def ahead(self, ns: int) -> Unit:
        """The lidar with a clock ahead of what it was; packets are received as before."""
        return replace(self, begin_ns=self.begin_ns + ns, host_ns=self.host_ns - ns)

    @property
    def payloads(self) -> list[tuple[int, bytes]]:
        """(receive time, payload) of every lidar packet."""
        ranges = np.full((512, self.spec.beams, 1), self.range_mm)
        found = []
        for turn in range(self.turns):
            begin_ns = self.begin_ns + turn * 100 * NS_PER_MS
            packets = encode_frame(self.spec, begin_ns, self.first_frame + turn, ranges)
            for number, payload in enumerate(packets):
                arrival = begin_ns + (number + 1) * 100 * NS_PER_MS // PACKETS_PER_TURN
                found.append((arrival + self.host_ns, payload + self.tail))
        return found

    @property
    def records(self) -> Records:
        """(receive time, frame) of every lidar packet."""
        return [
            (host_ns, udp_frame(payload, self.ip, dport=self.port)[0])
            for host_ns, payload in self.payloads
        ]

    def imu_records(self, count: int = 5, port: int = 7503) -> Records:
        """(receive time, frame) of legacy IMU packets, 10 ms apart from the first stamp on."""
        zero = np.zeros((1, 3))
        stamps = [self.begin_ns + i * 10 * NS_PER_MS for i in range(count)]
        return [
            (
                stamp + self.host_ns,
                udp_frame(
                    imu_packet(self.spec, np.array([stamp]), zero + 9.8, zero), self.ip, dport=port
                )[0],
            )
            for stamp in stamps
        ]


def twin(unit: Unit, serial: int, ip: str = "10.0.0.2") -> Unit:
    """The same lidar with another serial number at another address."""
    return replace(unit, spec=replace(unit.spec, serial=serial), ip=ip)


def write_session(
    folder: Path, *units: Unit, more: Records | None = None, metadata: bool = True
) -> Path:
    """A capture of the units (and `more` records) in `folder`, with their metadata."""
    folder.mkdir(parents=True, exist_ok=True)
    records = [*(more or []), *(record for unit in units for record in unit.records)]
    if metadata:
        for unit in units:
            write_metadata(folder / f"{unit.spec.serial}.json", unit.spec)
    return write_pcap(folder / "drive.pcap", sorted(records, key=lambda record: record[0]))


def write_metadata(path: Path, spec: OusterSpec) -> Path:
    """The metadata file of a lidar."""
    path.write_text(json.dumps(metadata_json(spec)), encoding="utf-8")
    return path


@dataclass(frozen=True, slots=True)
class Shell:
    """The command line within this process, in a folder and without syncs."""

    monkeypatch: pytest.MonkeyPatch
    folder: Path

    def __post_init__(self) -> None:
        self.monkeypatch.chdir(self.folder)
        self.monkeypatch.setattr(atomic, "sync_to_disk", lambda path: None)

    def __call__(self, *arguments: str | Path) -> Outcome:
        """Run `mlbatch ARGUMENTS`; a single text is split into words, as a shell does."""
        alone = arguments[0] if len(arguments) == 1 else ""
        return command(*(shlex.split(alone) if isinstance(alone, str) and alone else arguments))

    def dry(self, words: str) -> Report:
        """The report of a dry run."""
        outcome = self(f"convert {words} --dry-run")
        assert outcome.code == 0, outcome.err
        report: Report = json.loads(outcome.out)
        return report


def arrays(path: str) -> Arrays:
    """All of an npz file."""
    with np.load(path) as scan:
        return dict(scan)


def names(folder: str, suffix: str = ".npz") -> list[str]:
    """Files of an output, sorted."""
    return sorted(p.relative_to(folder).as_posix() for p in Path(folder).rglob("*" + suffix))


def report_of(path: str) -> Report:
    """A report file."""
    report: Report = json.loads(Path(path).read_text())
    return report
