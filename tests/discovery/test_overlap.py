"""Recordings of one session overlap in receive time, or continue one another."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from mlbatch.readers import open_recording
from mlbatch.types import StreamTable
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.reading import packets_in
from tests.builders.sessions import NS_PER_MS, NS_PER_S, Records, Shell, Unit, twin, write_metadata

DAY_NS = 24 * 3600 * NS_PER_S
ONE = Unit()
# In its packets, 5 s later; both last 0.3 s.
LATER = replace(twin(ONE, 222), begin_ns=ONE.begin_ns + 5 * NS_PER_S)
IDENTITY = "--identity-extrinsics"
Pack = Callable[[Path], Path]


def _capture(path: Path, records: Records, spec_of: Sequence[Unit] = ()) -> Path:
    for unit in spec_of:
        write_metadata(path.parent / f"{unit.spec.serial}.json", unit.spec)
    return write_pcap(path, sorted(records, key=lambda record: record[0]))


def _packed(path: Path) -> Path:
    """The end of a compressed file is not known before it is read."""
    packed = path.with_suffix(".pcap.gz")
    packed.write_bytes(gzip.compress(path.read_bytes()))
    path.unlink()
    return packed


def _plain(path: Path) -> Path:
    return path


# 2027-01-15T08:00:00Z, by `date -u -d @1800000000`.
FIRST = "2027-01-15T08:00:00.024Z to 2027-01-15T08:00:00.321Z"
SECOND = "2027-01-15T08:00:05.024Z to 2027-01-15T08:00:05.321Z"


@pytest.mark.parametrize("pack", [_plain, _packed])
@pytest.mark.parametrize("order", [1, -1])
def test_different_lidars_at_different_times_are_refused(
    shell: Shell, tmp_path: Path, pack: Pack, order: int
) -> None:
    left = pack(_capture(tmp_path / "left.pcap", ONE.records, [ONE]))
    right = pack(_capture(tmp_path / "right.pcap", LATER.records, [LATER]))
    for jobs in ("1", "3"):
        done = shell(
            "convert", *[left, right][::order], "-o", f"out{jobs}", IDENTITY, "--jobs", jobs
        )
        assert (done.code, done.out) == (1, "")
        assert done.err == (
            f"mlbatch: error: {left} ({FIRST}), {right} ({SECOND}): expected recordings of "
            "different lidars that overlap in receive time, found none that do, so that no scan "
            "has all lidars; convert each alone, or correct the receive times (editcap -t "
            "SECONDS) (no_overlap)\n"
        )
        assert not Path(f"out{jobs}").exists()
    assert "no_overlap" in shell("compare", left, right).err


def test_the_end_of_a_capture_is_known_without_reading_it(shell: Shell, tmp_path: Path) -> None:
    unit = Unit(turns=60)
    path = _capture(tmp_path / "left.pcap", unit.records)
    table = StreamTable()
    last = open_recording(path, table).last_packets(table)
    assert last is not None
    assert str(table.streams[0]) == "10.0.0.1 > port 7502"
    assert path.stat().st_size > 1_500_000
    payloads = unit.payloads[-len(last) :]
    assert 700 < len(last) < len(unit.payloads)
    assert [one[1:] for one in packets_in(last)] == payloads
    # `inspect` reads 10 s, and shows what it knows.
    write_metadata(tmp_path / "111.json", unit.spec)
    right = _capture(tmp_path / "right.pcap", replace(LATER, turns=1).records)
    late = replace(LATER, begin_ns=ONE.begin_ns + 100 * NS_PER_S)
    late_path = _capture(tmp_path / "late.pcap", late.records)
    assert "no_overlap" not in shell("inspect", path, right).out
    assert "no_overlap" in shell("inspect", path, late_path).out


def test_the_end_of_a_capture_of_very_many_small_packets_is_known(tmp_path: Path) -> None:
    frames = [(number, udp_frame(b"x", dport=number % 7)[0]) for number in range(30_000)]
    path = write_pcap(tmp_path / "small.pcap", frames)
    last = open_recording(path, StreamTable()).last_packets(StreamTable())
    assert last is not None
    assert last.host_ns.tolist() == list(range(30_000 - len(last), 30_000))
    # In 1 MiB, of 16 + 42 + 1 bytes each; the first record is only looked for.
    assert (1 << 20) // 59 - 2 <= len(last) <= (1 << 20) // 59


def test_a_capture_that_is_cut_off_does_not_show_its_end(tmp_path: Path) -> None:
    path = _capture(tmp_path / "left.pcap", ONE.records)
    path.write_bytes(path.read_bytes()[:-100])
    assert open_recording(path, StreamTable()).last_packets(StreamTable()) is None


@dataclass(frozen=True)
class Parts:
    """Recordings of a session that is accepted, by name."""

    units: dict[str, Sequence[Unit]]
    options: str = ""
    rig: str = ""
    warnings: Sequence[str] = ()


NEXT = replace(ONE, begin_ns=ONE.begin_ns + 300 * NS_PER_MS, first_frame=8)
BOTH = (ONE, twin(ONE, 222))
ACCEPTED = {
    "parts of one": Parts({"part_0": [ONE], "part_1": [NEXT]}),
    # The counter of the sensor starts again, so that its first packets look like copies.
    "parts after a pause": Parts(
        {"part_0": [ONE], "part_1": [replace(LATER, spec=ONE.spec, ip=ONE.ip)]},
        warnings=["rejected"],
    ),
    "parts of two": Parts(
        {
            "left_0": [ONE],
            "left_1": [NEXT],
            "right_0": [twin(ONE, 222)],
            "right_1": [twin(NEXT, 222)],
        },
        IDENTITY,
        warnings=["identity_extrinsics"],
    ),
    # Its columns are missing from the scans of the second part.
    "one that ends with the first part": Parts(
        {"part_0": BOTH, "part_1": [NEXT]}, IDENTITY, warnings=["identity_extrinsics", "loss"]
    ),
    "one that moves to another address": Parts(
        {"part_0": [ONE], "part_1": [replace(NEXT, ip="10.0.0.9")]}
    ),
    "one that is left out": Parts({"left": [ONE], "right": [LATER]}, "--ignore 222", warnings=()),
    "only one": Parts({"left": [ONE], "right": [LATER]}, "--only 111", warnings=()),
    "one that the rig lacks": Parts(
        {"left": [ONE], "right": [LATER]},
        rig='- {name: left, stream: {serial: "111"}, metadata: 111.json}\n',
        warnings=["not_in_rig"],
    ),
    "one that may be absent": Parts(
        {"left": [ONE], "right": [LATER]},
        rig='- {name: left, stream: {serial: "111"}, extrinsics: {translation_m: [0, 0, 1]}}\n'
        '- {name: right, stream: {serial: "222"}, extrinsics: {translation_m: [0, 0, 2]}, '
        "optional: true}\n",
        warnings=["no_overlap", "loss"],
    ),
}


@pytest.mark.parametrize("pack", [_plain, _packed])
@pytest.mark.parametrize("name", ACCEPTED)
def test_what_is_one_session(shell: Shell, tmp_path: Path, name: str, pack: Pack) -> None:
    case = ACCEPTED[name]
    paths = []
    for part, units in case.units.items():
        records = [record for unit in units for record in unit.records]
        paths.append(pack(_capture(tmp_path / f"{part}.pcap", records, units)))
    words = case.options.split()
    if case.rig:
        (tmp_path / "rig.yaml").write_text(f"sensors:\n{case.rig}")
        words += ["--rig", str(tmp_path / "rig.yaml")]
    done = shell("convert", *paths, "-o", "out", "--keep-partial", *words)
    assert done.code == 0, done.err
    assert done.warnings == list(case.warnings)


@pytest.mark.parametrize("pack", [_plain, _packed])
@pytest.mark.parametrize(("gap_ns", "is_refused"), [(DAY_NS, False), (DAY_NS + 1000, True)])
def test_parts_of_one_lidar_are_at_most_a_day_apart(
    shell: Shell, tmp_path: Path, pack: Pack, gap_ns: int, is_refused: bool
) -> None:
    last_ns = ONE.payloads[-1][0]
    first_ns = ONE.payloads[0][0]
    # Stamps go on, so that nothing but receive times tells the break.
    later = replace(NEXT, host_ns=NEXT.host_ns + last_ns + gap_ns - first_ns - 300 * NS_PER_MS)
    assert later.payloads[0][0] - last_ns == gap_ns
    one = pack(_capture(tmp_path / "part_0.pcap", ONE.records, [ONE]))
    other = pack(_capture(tmp_path / "part_1.pcap", later.records))
    done = shell("convert", one, other, "-o", "out")
    assert done.code == is_refused
    assert Path("out").exists() != is_refused
    if is_refused:
        assert done.err == (
            f"mlbatch: error: {one} ({FIRST}), {other} (2027-01-16T08:00:00.321Z to "
            "2027-01-16T08:00:00.617Z): expected recordings of one session at most a day apart, "
            "found more; convert each alone, or correct the receive times (editcap -t SECONDS) "
            "(no_overlap)\n"
        )


def test_an_end_before_the_second_recording_does_not_help(shell: Shell, tmp_path: Path) -> None:
    left = _capture(tmp_path / "left.pcap", ONE.records, [ONE])
    right = _capture(tmp_path / "right.pcap", LATER.records, [LATER])
    done = shell("convert", left, right, "-o", "out", IDENTITY, "--end", "+0.2")
    assert (done.code, "no_overlap" in done.err) == (1, True)
