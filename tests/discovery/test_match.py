"""Several lidars at one address are refused; damage of the packets of one lidar is not."""

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
# Time of a packet of each lidar of the matrix, ns: the sheets' column periods times columns.
PACKET_NS = {
    "ouster": 100 * NS_PER_MS // 512 * 16,
    "velodyne": 24 * 55_296,
    "hesai": 8 * 50_000,
    "robosense": 24 * 55_552,
}
FILES = {"ouster": "front.json", "velodyne": "", "hesai": "unit.csv", "robosense": "angles.csv"}


def one(vendor: str) -> Sent:
    return VENDORS[vendor].send(Spell(BEGIN_NS, LENGTH_NS))


def both(vendor: str, ahead_ns: int, clock_ahead_ns: int = 0) -> Sent:
    """Packets of two lidars in receive order; of the second, sending and clock are ahead."""
    spell = Spell(BEGIN_NS + ahead_ns + clock_ahead_ns, LENGTH_NS, ahead_ns=-clock_ahead_ns)
    mixed = one(vendor).then(VENDORS[vendor].send(spell))
    return mixed.where(np.argsort(mixed.host_ns, kind="stable"))


def captured(vendor: str, sent: Sent, path: Path) -> Path:
    """A capture of these packets, all from one address."""
    frames = [
        (int(host_ns), frame)
        for host_ns, payload in zip(sent.host_ns, sent.payloads, strict=True)
        for frame in udp_frame(payload, VENDORS[vendor].ip, sport=9000, dport=VENDORS[vendor].port)
    ]
    return write_pcap(path, frames)


def told(vendor: str, folder: Path, verb: str, *captures: Path, words: str = "") -> Outcome:
    """What a command says of captures of a lidar."""
    write_metadata(folder)
    files: list[str | Path] = ["--metadata", folder / FILES[vendor]] if FILES[vendor] else []
    return command(verb, *captures, *files, *words.split())


def converted(vendor: str, sent: Sent, folder: Path) -> tuple[int, str]:
    """Exit code and error of a conversion of these packets, all from one address."""
    capture = captured(vendor, sent, folder / "drive.pcap")
    result = told(vendor, folder, "convert", capture, words="--dry-run --quiet")
    return result.code, result.err


@pytest.mark.parametrize("share", [0.07, 0.3, 0.5, 0.81])
@pytest.mark.parametrize("vendor", VENDORS)
def test_two_lidars_that_alternate_are_refused(vendor: str, share: float, tmp_path: Path) -> None:
    # A third of a revolution apart, so that the rotors differ as well.
    ahead_ns = 33 * NS_PER_MS // PACKET_NS[vendor] * PACKET_NS[vendor]
    code, err = converted(vendor, both(vendor, ahead_ns + int(share * PACKET_NS[vendor])), tmp_path)
    assert code == 1
    assert "several lidars share the address" in err


@pytest.mark.parametrize("vendor", VENDORS)
def test_two_clocks_are_refused(vendor: str, tmp_path: Path) -> None:
    code, err = converted(vendor, both(vendor, 5 * NS_PER_MS, 700 * NS_PER_S), tmp_path)
    assert code == 1
    assert "several lidars share the address" in err


def other_drive(sent: Sent, late_ns: int) -> Sent:
    """Packets of the same timestamps and numbers with other readings."""
    middle = len(sent.payloads[0]) // 2
    payloads = tuple(
        one[:middle] + bytes(byte ^ 0x15 for byte in one[middle : middle + 2]) + one[middle + 2 :]
        for one in sent.payloads
    )
    return replace(sent, payloads=payloads, host_ns=sent.host_ns + late_ns)


@pytest.mark.parametrize("late_ms", [0, 30, 400])
@pytest.mark.parametrize("vendor", VENDORS)
def test_recordings_of_two_drives_are_refused(vendor: str, late_ms: int, tmp_path: Path) -> None:
    """Sensors without a set clock count from the same start on every drive."""
    first = captured(vendor, one(vendor), tmp_path / "first.pcap")
    drive = other_drive(one(vendor), late_ms * NS_PER_MS)
    second = captured(vendor, drive, tmp_path / "second.pcap")
    for verb, words in (("convert", "--dry-run --quiet"), ("inspect", ""), ("inspect", "--whole")):
        done = told(vendor, tmp_path, verb, first, second, words=words)
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
        told(vendor, tmp_path, "convert", *paths, words=words)
        for paths in ([first], [first, second])
    )
    assert (alone.code, twice.code) == (0, 0), twice.err
    assert twice.err == alone.err
    assert told(vendor, tmp_path, "inspect", first, second).code == 0


def test_inspect_notes_it(tmp_path: Path) -> None:
    converted("velodyne", both("velodyne", 600_000), tmp_path)
    result = command("inspect", tmp_path / "drive.pcap")
    assert result.code == 0
    assert "several lidars share the address" in result.out


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
