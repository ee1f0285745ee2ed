"""Scans that lack a lidar: fill, gaps, warnings, `--fail-on`, `--drop-incomplete`, empty clouds.

Columns are 195312.5 ns apart, 512 in a window, and on its bounds; packets have 16.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader

import mlbatch
from tests.builders.captures import udp_frame
from tests.builders.sessions import (
    EPOCH_NS,
    Shell,
    Unit,
    arrays,
    report_of,
    twin,
    write_metadata,
    write_session,
)

COLUMN_NS = 195_312.5
PER_WINDOW = 512
PACKETS = 32
LEFT = Unit(begin_ns=EPOCH_NS, turns=12)
RIGHT = twin(LEFT, 222)
# Packets of `right` that are removed: all but the first of window 5, all of windows 6 to 9. Scan 0
# is window 1, as the first stamp is on a bound.
REMOVED = range(5 * PACKETS + 1, 10 * PACKETS)
NAMES = ("ouster_111", "ouster_222")
FILLS = [1.0] * 4 + [16 / PER_WINDOW] + [0.0] * 4 + [1.0]


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """The session of both lidars, 0.5 s of the second removed."""
    return _session(tmp_path / "session", lambda packet: packet not in REMOVED)


def _session(folder: Path, is_kept: Callable[[int], bool]) -> Path:
    write_metadata_of(folder)
    records = [
        (host_ns, udp_frame(payload, RIGHT.ip, dport=RIGHT.port)[0])
        for packet, (host_ns, payload) in enumerate(RIGHT.payloads)
        if is_kept(packet)
    ]
    return write_session(folder, LEFT, more=records)


def write_metadata_of(folder: Path, unit: Unit = RIGHT) -> None:
    """The metadata of a lidar."""
    folder.mkdir(parents=True, exist_ok=True)
    write_metadata(folder / f"{unit.spec.serial}.json", unit.spec)


def _rows(path: str) -> list[dict[str, str]]:
    with Path(path).open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("jobs", [1, 3])
def test_half_a_second_of_one_lidar(shell: Shell, capture: Path, jobs: int) -> None:
    words = f"convert {capture} --identity-extrinsics --jobs {jobs} -o out"
    outcome = shell(words)
    assert (outcome.code, outcome.warnings) == (0, ["identity_extrinsics", "loss"])
    scans = report_of("out/report.json")["scans"]
    assert (scans["written"], scans["incomplete"], scans["underfilled"]) == (10, 0, 5)
    assert scans["without"] == {"ouster_222": 4}
    assert scans["underfilled_by_sensor"] == {"ouster_222": 5}
    fills = [sensor["fill"] for sensor in report_of("out/report.json")["sensors"]]
    assert fills == [1.0, pytest.approx(sum(FILLS) / 10, abs=1e-6)]
    rows = _rows("out/scans.csv")
    for index, (row, fill) in enumerate(zip(rows, FILLS, strict=True)):
        assert (row["complete"], float(row["fill_ouster_111"])) == ("true", 1.0)
        assert float(row["fill_ouster_222"]) == fill
        stored = arrays(f"out/{index:06d}.npz")
        assert (stored["fill"].dtype.str, stored["fill"].tolist()) == ("<f4", [1.0, fill])
    assert "5 scans lack columns of ouster_222: 4 have none" in outcome.out.splitlines()
    # 159 of 12 * 32 packets.
    assert "ouster_222: 159 of 384 packets lost (41.4 %); 5 of 10 scans have less" in outcome.err
    verified = shell("verify out")
    assert verified.code == 0, verified.out


def test_the_gap_spans_windows(shell: Shell, capture: Path) -> None:
    """The last column before the gap is 5 * 512 + 15, the first one after it 10 * 512."""
    assert shell(f"convert {capture} --identity-extrinsics -o out.mcap -q").code == 0
    gaps_ns = [int(row["max_gap_ns_ouster_222"]) for row in _rows("out.mcap.scans.csv")]
    last = 5 * PER_WINDOW + 15
    ends = [*(PER_WINDOW * window for window in range(6, 11)), 10 * PER_WINDOW]
    expected = [*[1.0] * 4, *(end - last for end in ends)]
    assert gaps_ns == pytest.approx([columns * COLUMN_NS for columns in expected], abs=1)
    assert shell("verify out.mcap").code == 0
    with Path("out.mcap").open("rb") as file:
        records = {one.name: one.metadata for one in make_reader(file).iter_metadata()}
    assert records["mlbatch.fill"]["underfilled"] == "5"
    assert records["mlbatch.fill"]["without"] == '{"ouster_222": 4}'


def test_slices_have_their_own_fill(shell: Shell, capture: Path) -> None:
    """Of 4 slices of 128 columns the one with the last packet has 16, 19 later ones none.

    The tail is only the last slice of the last window.
    """
    assert shell(f"convert {capture} --identity-extrinsics --slices 4 -o out -q").code == 0
    fills = [float(row["fill_ouster_222"]) for row in _rows("out/scans.csv")]
    assert fills == [1.0] * 16 + [0.125] + [0.0] * 19 + [1.0] * 7
    scans = report_of("out/report.json")["scans"]
    assert (scans["underfilled"], scans["without"]) == (20, {"ouster_222": 19})
    assert shell("verify out").code == 0


def test_split_scans_have_the_fill_of_their_sensor(shell: Shell, capture: Path) -> None:
    assert shell(f"convert {capture} --identity-extrinsics --split -o out -q").code == 0
    assert arrays("out/ouster_111/000004.npz")["fill"].tolist() == [1.0]
    assert arrays("out/ouster_222/000004.npz")["fill"].tolist() == [16 / PER_WINDOW]
    assert [float(row["fill_ouster_222"]) for row in _rows("out/scans.csv")] == FILLS
    assert report_of("out/report.json")["scans"]["without"] == {"ouster_222": 4}
    assert shell("verify out").code == 0


def test_ply_and_python_have_fill(shell: Shell, capture: Path) -> None:
    assert shell(f"convert {capture} --identity-extrinsics --format ply -o out -q").code == 0
    head = Path("out/000004.ply").read_bytes().split(b"end_header")[0].decode()
    assert "comment fill 1.0 0.03125" in head.splitlines()
    assert shell("verify out").code == 0
    scans = list(mlbatch.scans(capture, identity_extrinsics=True))
    assert [scan.fill.tolist() for scan in scans] == [[1.0, fill] for fill in FILLS]


def test_incomplete_scans_that_are_left_out_are_counted(shell: Shell, capture: Path) -> None:
    outcome = shell(f"convert {capture} --identity-extrinsics --drop-incomplete 50 -o out")
    assert outcome.code == 0
    scans = report_of("out/report.json")["scans"]
    assert (scans["written"], scans["dropped_incomplete"], scans["underfilled"]) == (5, 5, 0)
    assert (
        "5 scans at 10 Hz (0 incomplete, 0 empty windows, 5 left out by --drop-inc" in outcome.out
    )
    assert shell("verify out").code == 0


def test_head_and_tail_are_not_underfilled(shell: Shell, tmp_path: Path) -> None:
    """Both are partial by wish: 3 revolutions from 10 ms before a bound."""
    capture = write_session(tmp_path / "s", replace(LEFT, begin_ns=EPOCH_NS + 90_000_000, turns=3))
    outcome = shell(f"convert {capture} --keep-partial --strict -o out")
    assert outcome.code == 0, outcome.err
    rows = _rows("out/scans.csv")
    # 10 ms are 51.2 columns.
    assert [float(row["fill_ouster_111"]) for row in rows] == [52 / 512, 1.0, 1.0, 460 / 512]
    assert report_of("out/report.json")["scans"]["underfilled"] == 0


@pytest.mark.parametrize("words", ["", "--slices 4", "--rate 20", "--rate 15"])
def test_a_lidar_with_an_azimuth_window_is_full(shell: Shell, tmp_path: Path, words: str) -> None:
    """256 of 512 columns: packets 8 to 23 of each revolution."""
    unit = replace(LEFT, spec=replace(LEFT.spec, window=(128, 383)), turns=6)
    folder = tmp_path / "s"
    write_metadata_of(folder, unit)
    records = [
        (host_ns, udp_frame(payload, unit.ip, dport=unit.port)[0])
        for packet, (host_ns, payload) in enumerate(unit.payloads)
        if 8 <= packet % PACKETS < 24
    ]
    capture = write_session(folder, metadata=False, more=records)
    outcome = shell(f"convert {capture} --strict -o out {words}")
    assert outcome.code == 0, outcome.err
    report = report_of("out/report.json")
    assert (report["scans"]["underfilled"], report["warnings"]) == (0, [])
    fills = [row["fill_ouster_111"] for row in _rows("out/scans.csv")]
    assert set(fills) <= {"1.0", "NaN"}
    if not words:
        assert set(fills) == {"1.0"}


# -- limits ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", ["-o out", "--dry-run --report dry.json", "--dry-run"])
def test_limits_fail_after_the_output_is_complete(shell: Shell, capture: Path, words: str) -> None:
    limits = "--fail-on loss>0.1%,underfilled>0 --fail-on warnings>1"
    outcome = shell(f"convert {capture} --identity-extrinsics {limits} {words}")
    assert outcome.code == 3
    lines = [line for line in outcome.err.splitlines() if "limit" in line]
    assert lines == [
        "mlbatch: limit exceeded: loss>0.1%: found ouster_222: 159 of 384 (41.41 %) packets lost",
        "mlbatch: limit exceeded: underfilled>0: found 5 of 10 (50 %) scans underfilled",
    ]
    if words == "-o out":
        assert report_of("out/report.json")["scans"]["written"] == 10
        assert shell("verify out").code == 0
        # The complete output is judged again, by its report.
        again = shell(f"convert {capture} --identity-extrinsics --resume {limits} {words}")
        assert (again.code, "is complete; there is nothing to resume" in again.err) == (3, True)
        assert [line for line in again.err.splitlines() if "limit" in line] == lines
        Path("out/report.json").unlink()
        lost = shell(f"convert {capture} --identity-extrinsics --resume {limits} {words}")
        assert (lost.code, "expected the report of the complete output" in lost.err) == (1, True)


# -- scans without points -------------------------------------------------------------------------


def test_columns_without_points_are_counted(shell: Shell, tmp_path: Path) -> None:
    """All ranges of `right` are 0; those of `left` are 4 m."""
    dark = replace(RIGHT, range_mm=0, turns=4)
    capture = write_session(tmp_path / "s", replace(LEFT, turns=4), dark)
    outcome = shell(f"convert {capture} --identity-extrinsics -o out")
    assert (outcome.code, outcome.warnings) == (0, ["identity_extrinsics", "no_points"])
    scans = report_of("out/report.json")["scans"]
    assert (scans["no_points"], scans["empty_clouds"]) == ({"ouster_222": 2}, 0)
    both = write_session(tmp_path / "dark", replace(LEFT, turns=4, range_mm=0), dark)
    outcome = shell(f"convert {both} --identity-extrinsics -o dark.mcap")
    assert outcome.warnings == ["identity_extrinsics", "no_points", "no_points", "empty_cloud"]
    scans = report_of("dark.mcap.report.json")["scans"]
    assert scans["no_points"] == {"ouster_111": 2, "ouster_222": 2}
    assert (scans["empty_clouds"], scans["points"]) == (2, 0)
    outcome = shell(f"convert {capture} --identity-extrinsics -o split --split")
    assert outcome.warnings == ["identity_extrinsics", "no_points", "empty_cloud"]
    assert report_of("split/report.json")["scans"]["empty_clouds"] == 2
    strict = shell(f"convert {capture} --identity-extrinsics -o strict --strict")
    assert (strict.code, "no_points, an error because of --strict" in strict.err) == (1, True)
