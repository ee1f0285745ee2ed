"""Captures of one lidar and of several: one address, two drives, copies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.discovery.discover import SensorSelection, discover
from mlbatch.discovery.match import describe, release
from mlbatch.readers import open_recording
from mlbatch.types import StreamTable
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.run import Outcome, command
from tests.builders.sessions import SMALL, Unit, write_session
from tests.matrix.lidars import NS_PER_MS, NS_PER_S, VENDORS, Sent, Spell, write_metadata

BEGIN_NS = 1_700_000_000 * NS_PER_S
LENGTH_NS = 1200 * NS_PER_MS
FILES = {"ouster": "front.json", "velodyne": "", "hesai": "unit.csv", "robosense": "angles.csv"}


def one(vendor: str) -> Sent:
    return VENDORS[vendor].send(Spell(BEGIN_NS, LENGTH_NS))


def captured(vendor: str, sent: Sent, path: Path) -> Path:
    """A capture of these packets, all from one address."""
    frames = [
        (int(host_ns), frame)
        for host_ns, payload in zip(sent.host_ns, sent.payloads, strict=True)
        for frame in udp_frame(payload, VENDORS[vendor].ip, sport=9000, dport=VENDORS[vendor].port)
    ]
    return write_pcap(path, frames)


def ran(vendor: str, folder: Path, verb: str, *captures: Path, words: str = "") -> Outcome:
    """What a command says of captures of a lidar."""
    write_metadata(folder)
    files: list[str | Path] = ["--metadata", folder / FILES[vendor]] if FILES[vendor] else []
    return command(verb, *captures, *files, *words.split())


def other_drive(vendor: str, late_ns: int, later_ns: int) -> Sent:
    """Packets with other readings, received later, and with later timestamps."""
    sent = VENDORS[vendor].send(Spell(BEGIN_NS + later_ns, LENGTH_NS, ahead_ns=-later_ns))
    middle = len(sent.payloads[0]) // 2
    payloads = tuple(
        one[:middle] + bytes(byte ^ 0x15 for byte in one[middle : middle + 2]) + one[middle + 2 :]
        for one in sent.payloads
    )
    return replace(sent, payloads=payloads, host_ns=sent.host_ns + late_ns)


@pytest.mark.parametrize(
    ("late_ns", "later_ns"),
    [(0, 0), (30 * NS_PER_MS, 0), (400 * NS_PER_MS, 0), (0, 150 * NS_PER_MS), (0, 1_037_000)],
)
@pytest.mark.parametrize("vendor", VENDORS)
def test_recordings_of_two_drives_are_refused(
    vendor: str, late_ns: int, later_ns: int, tmp_path: Path
) -> None:
    """Sensors without a set clock count from the same start on every drive."""
    first = captured(vendor, one(vendor), tmp_path / "first.pcap")
    second = captured(vendor, other_drive(vendor, late_ns, later_ns), tmp_path / "second.pcap")
    for verb, words in (("convert", "--dry-run --quiet"), ("inspect", ""), ("inspect", "--whole")):
        done = ran(vendor, tmp_path, verb, first, second, words=words)
        assert done.code == 1, done.out
        assert len(done.err.splitlines()) == 1
        assert "expected packets of " in done.err
        assert "two drives" in done.err
        assert "convert each" in done.err


@pytest.mark.parametrize("late_ms", [0, 30])
@pytest.mark.parametrize("vendor", VENDORS)
def test_a_copy_of_a_recording_changes_nothing(vendor: str, late_ms: int, tmp_path: Path) -> None:
    sent = one(vendor)
    first = captured(vendor, sent, tmp_path / "first.pcap")
    copy = replace(sent, host_ns=sent.host_ns + late_ms * NS_PER_MS)
    second = captured(vendor, copy, tmp_path / "second.pcap")
    words = "--dry-run --quiet"
    alone, twice = (
        ran(vendor, tmp_path, "convert", *paths, words=words)
        for paths in ([first], [first, second])
    )
    assert (alone.code, twice.code) == (0, 0), twice.err
    assert twice.err == alone.err
    assert ran(vendor, tmp_path, "inspect", first, second).code == 0


def test_two_lidars_at_one_address_are_refused_and_noted(tmp_path: Path) -> None:
    """All that are found: test_interleaved.py."""
    other = VENDORS["velodyne"].send(Spell(BEGIN_NS + 600_000, LENGTH_NS))
    mixed = one("velodyne").then(other)
    mixed = mixed.where(np.argsort(mixed.host_ns, kind="stable"))
    capture = captured("velodyne", mixed, tmp_path / "drive.pcap")
    refused = command("convert", capture, "--dry-run")
    assert (refused.code, "several lidars share the address" in refused.err) == (1, True)
    noted = command("inspect", capture)
    assert (noted.code, "several lidars share the address" in noted.out) == (0, True)


def test_large_samples_are_replaced_by_descriptions(tmp_path: Path) -> None:
    # 6 s of packets of 8448 bytes, of which 16 and six of each quarter of a second are sampled.
    large = Unit(replace(SMALL, beams=128, columns_per_frame=512), turns=60)
    for name, unit, is_large in (("large", large, True), ("small", Unit(SMALL, turns=2), False)):
        table = StreamTable()
        recording = open_recording(write_session(tmp_path / name, unit), table)
        sampler = discover([recording], table, SensorSelection()).sampler
        before = {kind: describe(sampler, kind) for kind in sampler.kinds}
        release(sampler, sampler.kinds)
        assert {kind: describe(sampler, kind) for kind in sampler.kinds} == before
        released = [not one.pieces for one in sampler.kinds.values()]
        assert any(released) == is_large
