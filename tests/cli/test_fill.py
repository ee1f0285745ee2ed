"""Scans that lack a lidar: fill, gaps, warnings, `--fail-on`, `--drop-incomplete`, empty clouds.

Columns are 195312.5 ns apart, 512 in a window, and on its bounds; packets have 16.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import mlbatch
from tests.builders.captures import udp_frame
from tests.builders.sessions import EPOCH_NS, Shell, Unit, twin, write_metadata, write_session
from tests.builders.transcripts import transcripts

CASES = transcripts("fill", AWK="awk -F, -f columns.awk -v n")
PACKETS = 32
LEFT = Unit(begin_ns=EPOCH_NS, turns=12)
RIGHT = twin(LEFT, 222)
# Packets of `right` that are removed: all but the first of window 5, all of windows 6 to 9. Scan 0
# is window 1, as the first stamp is on a bound.
REMOVED = range(5 * PACKETS + 1, 10 * PACKETS)
FILLS = [1.0] * 4 + [16 / 512] + [0.0] * 4 + [1.0]
# Columns of a table by their names in n, one row a line.
COLUMNS_AWK = """\
NR == 1 { for (i = 1; i <= NF; i++) at[$i] = i; count = split(n, names, " "); next }
{ line = $at[names[1]]; for (i = 2; i <= count; i++) line = line " " $at[names[i]]; print line }
"""


def _session(folder: Path, unit: Unit, is_kept: Callable[[int], bool], *units: Unit) -> None:
    """Lidars, and packets of one that are kept."""
    folder.mkdir()
    write_metadata(folder / f"{unit.spec.serial}.json", unit.spec)
    records = [
        (host_ns, udp_frame(payload, unit.ip, dport=unit.port)[0])
        for packet, (host_ns, payload) in enumerate(unit.payloads)
        if is_kept(packet)
    ]
    write_session(folder, *units, more=records)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all sessions."""
    folder = tmp_path_factory.mktemp("fill")
    write_all(folder)
    return folder


def write_all(folder: Path) -> None:
    """Sessions of the transcripts."""
    (folder / "columns.awk").write_text(COLUMNS_AWK)
    _session(folder / "gap", RIGHT, lambda packet: packet not in REMOVED, LEFT)
    write_session(folder / "partial", replace(LEFT, begin_ns=EPOCH_NS + 90_000_000, turns=3))
    # 256 of 512 columns: packets 8 to 23 of each revolution.
    narrow = replace(LEFT, spec=replace(LEFT.spec, window=(128, 383)), turns=6)
    _session(folder / "narrow", narrow, lambda packet: 8 <= packet % PACKETS < 24)
    dark = replace(RIGHT, range_mm=0, turns=4)
    write_session(folder / "half", replace(LEFT, turns=4), dark)
    write_session(folder / "dark", replace(LEFT, turns=4, range_mm=0), dark)


@pytest.mark.parametrize("name", CASES)
def test_transcript(shell: Shell, place: Path, tmp_path: Path, name: str) -> None:
    CASES[name].check_with(place, shell, tmp_path)


def test_npz_and_python_have_fill(shell: Shell, place: Path) -> None:
    capture = place / "gap" / "drive.pcap"
    assert shell(f"convert {capture} --identity-extrinsics -o out -q").code == 0
    for scans in (mlbatch.read("out"), mlbatch.scans(capture, identity_extrinsics=True)):
        assert [scan.fill.tolist() for scan in scans] == [[1.0, fill] for fill in FILLS]
