"""`convert --shard` and `merge`: the output of one run, or one clear line."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import signal
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from mlbatch.types import Scan
from mlbatch.writers.formats import npz
from mlbatch.writers.output_file import Bytes
from tests.builders.captures import write_pcap
from tests.builders.sessions import (
    FIXTURE,
    Outcome,
    Shell,
    Unit,
    recording_shell,
    write_metadata,
)
from tests.resume_storm import contents, write_recordings

CAPTURE = f"{FIXTURE / 'two_lidars.pcap'} --rig {FIXTURE / 'rig.yaml'}"
# From fixtures/two_lidars/SOURCE.md: a window of 10 Hz each.
SCANS = 7


@pytest.fixture
def shell(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Shell:
    """The command line, in an empty folder."""
    return recording_shell(monkeypatch, capsys, tmp_path)


def _shards(shell: Shell, words: str, count: int, mixed: bool = False) -> list[str]:
    """Convert all shards; gives their folders. mixed: by one job or several."""
    folders = []
    for number in range(1, count + 1):
        more = f" --jobs {number}" if mixed else ""
        done = shell(f"convert {words} --shard {number}/{count} -o part{number} -q{more}")
        assert done.code == 0, done.err
        folders.append(f"part{number}")
    return folders


def _merged(shell: Shell, folders: Sequence[str], more: str = "") -> Outcome:
    Path("merged").mkdir(exist_ok=True)
    return shell(f"merge {' '.join(folders)} -o merged/out -q {more}")


def _whole(shell: Shell, words: str) -> tuple[dict[str, object], Outcome]:
    """All files of one run, and what it printed."""
    Path("whole").mkdir()
    outcome = shell(f"convert {words} -o whole/out -q")
    assert outcome.code == 0, outcome.err
    return contents(Path("whole")), outcome


def _assert_as_one_run(shell: Shell, words: str, count: int, mixed: bool = False) -> None:
    whole, one_run = _whole(shell, words)
    merged = _merged(shell, _shards(shell, words, count, mixed)[::-1])
    assert merged.code == 0, merged.err
    assert contents(Path("merged")) == whole
    assert merged.err == one_run.err


# -- the law ----------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 3, 7, 10])
def test_shards_give_the_bytes_of_one_run(shell: Shell, count: int) -> None:
    _assert_as_one_run(shell, CAPTURE, count)


def test_every_shard_has_its_scans_and_no_report(shell: Shell) -> None:
    _shards(shell, CAPTURE, 3)
    names = [sorted(os.listdir(f"part{number}")) for number in (1, 2, 3)]
    assert names == [
        ["000000.npz", "000003.npz", "000006.npz", "files.jsonl", "scans.csv", "shard.json"],
        ["000001.npz", "000004.npz", "files.jsonl", "scans.csv", "shard.json"],
        ["000002.npz", "000005.npz", "files.jsonl", "scans.csv", "shard.json"],
    ]


@pytest.mark.parametrize(
    "options",
    [
        "--format ply --ply-style float",
        "--format pcd",
        "--format las",
        "--format kitti",
        "--format nuscenes --keep-partial",
        "--split --slices 2",
        "--layout organized --keep-partial",
        "--sort points --slices 3",
        "--batching latest",
        "--align-clocks",
        "--drop-incomplete 70 --fault drop:left:30% --fault-seed 5",
        "--fault stall:left:0.3s-0.5s --max-wait 0.05 --keep-partial",
        "--exclude-box=-1000,-1000,-1000,1000,1000,5",
        "--start +0.2 --end +0.5",
        "--format rosbag2 --max-bag-duration 0.1",
        "--format rosbag2 --max-bag-duration 0.2 --keep-partial --compression zstd:1",
        "--format rosbag2 --max-bag-duration 0.3 --split --slices 2 --point-layout ouster",
        "--format rosbag2 --max-bag-duration 5 --layout organized --start +0.2",
        "--format rosbag2 --max-bag-duration 0.2 --batching latest",
        "--format rosbag2 --max-bag-duration 0.2 --stamp end --drop-incomplete 70 "
        "--fault drop:left:30% --fault-seed 5",
    ],
)
def test_options_give_the_bytes_of_one_run(shell: Shell, options: str) -> None:
    _assert_as_one_run(shell, f"{CAPTURE} {options}", 3)


def test_jobs_may_differ_between_shards(shell: Shell) -> None:
    _assert_as_one_run(shell, f"{CAPTURE} --slices 2", 4, mixed=True)


def test_a_bag_with_messages_gives_the_bytes_of_one_run(shell: Shell) -> None:
    write_recordings(Path(), turns=6)
    _assert_as_one_run(shell, "bag/drive.mcap --identity-extrinsics --pass /chatter", 2)


@pytest.mark.parametrize("jobs", ["", "--jobs 3"])
@pytest.mark.parametrize("seconds", [0.1, 0.25, 9])
def test_files_of_a_bag_with_messages_are_those_of_one_run(
    shell: Shell, seconds: float, jobs: str
) -> None:
    """Messages are in the file of the scan that follows them, whatever shard writes it."""
    write_recordings(Path(), turns=9)
    options = f"--pass /chatter --format rosbag2 --max-bag-duration {seconds} {jobs}"
    _assert_as_one_run(shell, f"bag/drive.mcap --identity-extrinsics {options}", 3)


@pytest.mark.parametrize("options", ["", "--split", "--slices 2 --keep-partial"])
def test_files_of_a_bag_without_messages_are_those_of_one_run(shell: Shell, options: str) -> None:
    """The packets of lidars alone: other shards' files begin without a message."""
    Path("in").mkdir()
    unit = Unit(turns=9)
    write_metadata(Path("in/111.json"), unit.spec)
    write_pcap(Path("in/drive.pcap"), unit.records)
    _assert_as_one_run(shell, f"in/drive.pcap --format rosbag2 --max-bag-duration 0.2 {options}", 3)


def test_every_shard_has_its_files_of_a_bag(shell: Shell) -> None:
    """Seven windows, two a file: four files."""
    _shards(shell, f"{CAPTURE} --format rosbag2 --max-bag-duration 0.2", 3)
    names = [sorted(os.listdir(f"part{number}")) for number in (1, 2, 3)]
    assert [[name for name in one if name.startswith("part")] for one in names] == [
        ["part1_0.mcap", "part1_3.mcap"],
        ["part2_1.mcap"],
        ["part3_2.mcap"],
    ]
    others = ["files.jsonl", "metadata.yaml", "scans.csv", "shard.json"]
    assert all([name for name in one if not name.startswith("part")] == others for one in names)


def test_the_bag_of_a_shard_can_be_read(shell: Shell) -> None:
    """By the library `rosbags`: metadata.yaml names the files that are there."""
    _shards(shell, f"{CAPTURE} --format rosbag2 --max-bag-duration 0.2", 2)
    with AnyReader([Path("part2")]) as reader:
        topics = [one.topic for one, _, _ in reader.messages()]
    # Windows 2, 3 and 6 of 7.
    assert topics.count("/points") == 3


def test_every_shard_has_its_rows_of_the_table(shell: Shell) -> None:
    whole, _ = _whole(shell, f"{CAPTURE} --keep-partial --slices 2")
    table = whole["out/scans.csv"]
    assert isinstance(table, bytes)
    header, *rows = table.splitlines()
    folders = _shards(shell, f"{CAPTURE} --keep-partial --slices 2", 3)
    found = [Path(one, "scans.csv").read_bytes().splitlines() for one in folders]
    assert [one[0] for one in found] == [header] * 3
    assert sorted(row for one in found for row in one[1:]) == sorted(rows)
    assert all(len(one) > 2 for one in found)


def test_a_renamed_part_of_a_bag_is_merged(shell: Shell) -> None:
    words = f"{CAPTURE} --format rosbag2 --max-bag-duration 0.2"
    whole, _ = _whole(shell, words)
    _shards(shell, words, 2)
    Path("part1").rename("other")
    assert _merged(shell, ["other", "part2"]).code == 0
    assert contents(Path("merged")) == whole


@pytest.mark.parametrize("damage", ["lost", "short", "zeros"])
def test_a_damaged_part_of_a_bag_is_named(shell: Shell, damage: str) -> None:
    folders = _shards(shell, f"{CAPTURE} --format rosbag2 --max-bag-duration 0.2", 2)
    file = Path("part2/part2_3.mcap")
    size = file.stat().st_size
    if damage == "lost":
        file.unlink()
        _refused(shell, folders, 1, "part2/part2_3.mcap", "No such file")
    else:
        if damage == "short":
            os.truncate(file, size - 1)
        else:
            with file.open("r+b") as opened:
                opened.seek(-60, os.SEEK_END)
                opened.write(bytes(60))
        expected = "part2/part2_3.mcap: expected the bytes that the shard has written, found others"
        _refused(shell, folders, 1, expected)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ("", "000003.npz"),
        ("", "scans.csv"),
        ("--format nuscenes", "000003.time.bin"),
        ("--format nuscenes", "times.txt"),
        ("--format ply --split", "left/000003.ply"),
        ("--format rosbag2 --max-bag-duration 0.2 --compression zstd", "part2_3.mcap"),
    ],
)
def test_a_changed_byte_of_a_part_is_named(shell: Shell, options: str, name: str) -> None:
    folders = _shards(shell, f"{CAPTURE} {options}", 2)
    file = Path("part2", name)
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    folder = str(file.parent)
    _refused(shell, folders, 1, folder, "expected the bytes that the shard has written, found")


def test_a_clock_step_is_the_error_of_one_run(shell: Shell) -> None:
    write_recordings(Path(), turns=6)
    whole = shell("convert jumps/drive.pcap -o out")
    shard = shell("convert jumps/drive.pcap -o part --shard 1/2")
    assert (shard.code, shard.err) == (whole.code, whole.err)
    assert shard.code == 1
    assert not Path("part").exists()


def test_counts_of_the_report_are_those_of_all_shards(shell: Shell) -> None:
    folders = _shards(shell, CAPTURE, 2)
    accounts = [json.loads(Path(one, "shard.json").read_text()) for one in folders]
    assert _merged(shell, folders).code == 0
    report = json.loads(Path("merged/out/report.json").read_text())
    for number, sensor in enumerate(report["sensors"]):
        own = [one["report"]["sensors"][number]["ledger"]["points"]["written"] for one in accounts]
        assert all(own)
        assert sensor["points"]["written"] == sum(own)
    assert report["timing"]["cpu_s"] > sum(one["report"]["timing"]["cpu_s"] for one in accounts)
    commands = report["command"].split(" && ")
    assert [words.split()[1] for words in commands] == ["convert", "convert", "merge"]


def test_the_merged_output_is_valid(shell: Shell) -> None:
    assert _merged(shell, _shards(shell, CAPTURE, 3)).code == 0
    assert shell("verify merged/out").code == 0


def test_parts_stay_and_can_be_merged_again(shell: Shell) -> None:
    folders = _shards(shell, CAPTURE, 2)
    before = {path: path.read_bytes() for path in Path().glob("part*/*")}
    assert _merged(shell, folders).code == 0
    assert _merged(shell, folders, "--overwrite").code == 0
    assert {path: path.read_bytes() for path in Path().glob("part*/*")} == before


def test_another_file_system_gets_copies(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    def other(source: Path, path: Path) -> None:
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", other)
    _assert_as_one_run(shell, CAPTURE, 2)


@pytest.mark.parametrize("base", [Path(), Path("..")])
def test_symbolic_links_of_a_part_are_not_taken_over(shell: Shell, base: Path) -> None:
    """The output has the files themselves, also where links are relative to the part."""
    folders = _shards(shell, CAPTURE, 2)
    files = {path.name: path.read_bytes() for path in Path().glob("part*/*.npz")}
    Path("linked").mkdir()
    for path in Path("part1").iterdir():
        target = base / path if base.parts else path.absolute()
        (Path("linked") / path.name).symlink_to(target)
    merged = _merged(shell, ["linked", folders[1]])
    assert merged.code == 0, merged.err
    shutil.rmtree("linked")
    shutil.rmtree("part1")
    found = list(Path("merged/out").glob("*.npz"))
    assert not any(path.is_symlink() for path in found)
    assert {path.name: path.read_bytes() for path in found} == files


def test_copies_of_a_recording_are_the_same_recording(shell: Shell) -> None:
    for name in ("one", "two"):
        Path(name).mkdir()
        shutil.copyfile(FIXTURE / "two_lidars.pcap", f"{name}/two_lidars.pcap")
    os.utime("two/two_lidars.pcap", (1, 1))
    for number, name in enumerate(("one", "two"), 1):
        words = CAPTURE.replace(str(FIXTURE / "two_lidars.pcap"), f"{name}/two_lidars.pcap")
        assert shell(f"convert {words} --shard {number}/2 -o part{number} -q").code == 0
    whole, _ = _whole(shell, CAPTURE)
    assert _merged(shell, ["part1", "part2"]).code == 0
    merged = contents(Path("merged"))
    assert {k: v for k, v in merged.items() if not k.endswith("report.json")} == {
        k: v for k, v in whole.items() if not k.endswith("report.json")
    }


def test_a_limit_is_checked_on_all_scans(shell: Shell) -> None:
    folders = _shards(shell, f"{CAPTURE} --fault drop:left:30%", 2)
    outcome = _merged(shell, folders, "--fail-on loss>1%")
    assert outcome.code == 3
    assert "limit exceeded" in outcome.err
    assert Path("merged/out/report.json").is_file()


@pytest.mark.parametrize("reason", ["no points of a sensor", "no points at all"])
def test_what_is_wrong_with_the_points_of_all_scans(shell: Shell, reason: str) -> None:
    """An error of merge as of one run: with --strict, or without any point."""
    for file in FIXTURE.iterdir():
        shutil.copy(file, ".")
    words = "two_lidars.pcap --rig rig.yaml --exclude-box=-1000,-1000,-1000,1000,1000,1000"
    if reason == "no points of a sensor":
        text = Path("rig.yaml").read_text().replace("left\n", "left\n    max_range_m: 0.01\n", 1)
        Path("rig.yaml").write_text(text)
        words = "two_lidars.pcap --rig rig.yaml --strict"
    folders = _shards(shell, words, 2)
    one_run = shell(f"convert {words} -o one")
    outcome = _merged(shell, folders)
    assert (outcome.code, outcome.err) == (one_run.code, one_run.err)
    assert outcome.code == 1
    assert os.listdir("merged") == []


# -- interrupted ------------------------------------------------------------------------------


def test_an_interrupted_shard_is_resumed(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, _ = _whole(shell, CAPTURE)
    encode = npz.NpzEncoder.encode
    saved: list[int] = []

    def ending(encoder: npz.NpzEncoder, scan: Scan) -> list[Bytes]:
        if scan.index == 4 and 4 not in saved:
            saved.append(4)
            raise KeyboardInterrupt
        saved.append(scan.index)
        return encode(encoder, scan)

    monkeypatch.setattr(npz.NpzEncoder, "encode", ending)
    words = f"convert {CAPTURE} --shard 1/2 -o part1"
    assert shell(words).code == 130
    assert shell(f"convert {CAPTURE} --shard 2/2 -o part2").code == 0
    early = _merged(shell, ["part1", "part2"])
    assert early.code == 2
    assert early.err == (
        "mlbatch: error: part1: expected the folder of a shard, found that of an interrupted run "
        "(part1.partial); run this shard again with --resume\n"
    )
    saved.clear()
    saved.append(4)
    resumed = shell(f"{words} --resume")
    assert resumed.code == 0
    assert resumed.err == "mlbatch: part1: resumed after 2 scans\n"
    assert saved[1:] == [4, 6]
    assert _merged(shell, ["part1", "part2"]).code == 0
    assert contents(Path("merged")) == whole


def test_a_shard_is_not_resumed_as_another(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    encode = npz.NpzEncoder.encode

    def ending(encoder: npz.NpzEncoder, scan: Scan) -> list[Bytes]:
        if scan.index == 4:
            raise KeyboardInterrupt
        return encode(encoder, scan)

    with monkeypatch.context() as patch:
        patch.setattr(npz.NpzEncoder, "encode", ending)
        assert shell(f"convert {CAPTURE} --shard 1/2 -o part").code == 130
    outcome = shell(f"convert {CAPTURE} --shard 2/2 -o part --resume")
    assert outcome.code == 2
    assert "expected the job of the interrupted run, found shard '2/2' instead of '1/2'" in (
        outcome.err
    )


def test_an_interrupted_merge_leaves_nothing(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = _shards(shell, CAPTURE, 2)
    link = os.link
    calls = 0

    def ending(source: Path, path: Path) -> None:
        nonlocal calls
        calls += 1
        if calls == 4:
            signal.raise_signal(signal.SIGTERM)
        link(source, path)

    with monkeypatch.context() as patch:
        patch.setattr(os, "link", ending)
        assert _merged(shell, folders).code == 130
    assert calls == 4
    assert os.listdir("merged") == []
    assert _merged(shell, folders).code == 0


def test_a_full_disk_leaves_nothing(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*paths: Path) -> None:
        raise OSError(28, "No space left on device")

    folders = _shards(shell, CAPTURE, 2)
    monkeypatch.setattr(os, "link", full)
    monkeypatch.setattr(shutil, "copyfile", full)
    outcome = _merged(shell, folders)
    assert outcome.code == 1
    assert "No space left on device" in outcome.err
    assert "free space on this disk" in outcome.err
    assert os.listdir("merged") == []


# -- what is no whole conversion ---------------------------------------------------------------


def _changed(folder: str, change: dict[str, Any]) -> None:
    path = Path(folder, "shard.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | change))


def _refused(shell: Shell, folders: Sequence[str], code: int, *words: str) -> None:
    outcome = _merged(shell, folders)
    assert outcome.code == code
    assert outcome.err.count("\n") == 1
    for word in words:
        assert word in outcome.err, outcome.err
    assert not list(Path("merged").iterdir())


def test_a_missing_part_is_named(shell: Shell) -> None:
    _shards(shell, CAPTURE, 3)
    _refused(shell, ["part1", "part3"], 2, "expected all 3 shards, found 2: 2/3 missing")


def test_a_part_given_twice_is_named(shell: Shell) -> None:
    _shards(shell, CAPTURE, 2)
    shutil.copytree("part1", "copy")
    _refused(shell, ["part1", "copy", "part2"], 2, "copy: expected every shard once", "part1")


def test_parts_of_other_counts_are_refused(shell: Shell) -> None:
    _shards(shell, CAPTURE, 2)
    assert shell(f"convert {CAPTURE} --shard 3/3 -o third -q").code == 0
    _refused(shell, ["part1", "part2", "third"], 2, "third: expected one of 2 shards", "3/3")


def test_parts_with_other_options_are_refused(shell: Shell) -> None:
    _shards(shell, CAPTURE, 2)
    assert shell(f"convert {CAPTURE} --shard 2/2 --min-range 3 -o other -q").code == 0
    _refused(shell, ["part1", "other"], 2, "other: expected the job of part1", "min range m '3.0'")


def test_parts_of_other_recordings_are_refused(shell: Shell) -> None:
    write_recordings(Path(), turns=6)
    shutil.copytree("session", "other")
    with Path("other/drive.pcap").open("r+b") as file:
        file.seek(-40, os.SEEK_END)
        file.write(b"\0" * 8)
    words = "--identity-extrinsics -q"
    assert shell(f"convert session/drive.pcap {words} --shard 1/2 -o part1").code == 0
    assert shell(f"convert other/drive.pcap {words} --shard 2/2 -o part2").code == 0
    _refused(shell, ["part1", "part2"], 2, "part2: expected the job of part1", "drive.pcap")


def test_parts_of_other_poses_in_a_long_trajectory_are_refused(shell: Shell) -> None:
    """One pose of a file of 8 MB differs: 5 m instead of 0 m at 4 s after the first scan."""
    assert shell(f"convert {CAPTURE} -o usual -q").code == 0
    with np.load("usual/000000.npz") as scan:
        begin_s = int(scan["start_ns"]) // 10**9 - 1
    comments = f"# {'-' * 97}\n" * 40_000
    still = "0 0 0 0 0 0 1"
    poses = [f"{begin_s + n // 20}.{n % 20 * 5:02d} {still}\n" for n in range(101)]
    for number, last in enumerate((poses[-1], poses[-1].replace(f" {still}", " 5" + still[1:])), 1):
        text = comments + "".join(poses[:-1]) + last + comments
        Path("drive.tum").write_text(text, encoding="utf-8")
        words = f"{CAPTURE} --deskew drive.tum --shard {number}/2 -o part{number} -q"
        assert shell(f"convert {words}").code == 0
    _refused(shell, ["part1", "part2"], 2, "part2: expected the job of part1, found trajectory")


def test_parts_that_read_other_packets_are_refused(shell: Shell) -> None:
    """Samples of a large recording may be the same; what was read for the scans is not."""
    _shards(shell, CAPTURE, 2)
    _changed("part2", {"content": 1})
    _refused(shell, ["part1", "part2"], 1, "part2: expected the account of part1", "content 1")


def test_parts_that_counted_otherwise_are_refused(shell: Shell) -> None:
    _shards(shell, CAPTURE, 2)
    report = json.loads(Path("part2/shard.json").read_text())["report"]
    report["sensors"][0]["ledger"]["packets"]["lost"] += 1
    _changed("part2", {"report": report})
    _refused(shell, ["part1", "part2"], 1, "report.sensors[0].ledger.packets.lost 1 instead of 0")


def test_points_that_no_scan_has_are_refused(shell: Shell) -> None:
    _shards(shell, CAPTURE, 2)
    report = json.loads(Path("part2/shard.json").read_text())["report"]
    counts = report["sensors"][0]["ledger"]["points"]
    counts["written"] += 1
    counts["slots"] += 1
    _changed("part2", {"report": report})
    _refused(shell, ["part1", "part2"], 1, "the ledger does not balance", "shard.json was changed")


@pytest.mark.parametrize("damage", ["lost", "changed", "cut off"])
def test_a_lost_line_of_a_part_is_found(shell: Shell, damage: str) -> None:
    folders = _shards(shell, CAPTURE, 2)
    path = Path("part2/files.jsonl")
    lines = path.read_bytes().splitlines(keepends=True)
    last = {"lost": b"", "changed": lines[-1].replace(b"0", b"1", 1), "cut off": lines[-1][:-9]}
    path.write_bytes(b"".join([*lines[:-1], last[damage]]))
    found = "part2/files.jsonl: expected the files of 3 scans, found those of 2"
    _refused(shell, folders, 1, found, "copy the part again")


def test_lost_files_of_a_part_are_named(shell: Shell) -> None:
    folders = _shards(shell, CAPTURE, 2)
    for name in ("files.jsonl", "scans.csv"):
        Path("part2", name).rename("kept")
        _refused(shell, folders, 1, f"part2/{name}: expected a file of a shard, found 'No such")
        Path("kept").rename(f"part2/{name}")
    assert _merged(shell, folders).code == 0


@pytest.mark.parametrize("name", ["../part1/000000.npz", "/etc/hostname"])
def test_files_elsewhere_are_not_taken(shell: Shell, name: str) -> None:
    folders = _shards(shell, CAPTURE, 2)
    path = Path("part2/files.jsonl")
    head, *lines = path.read_text().splitlines()
    texts = [head[9:], *(line[9:].replace("000003.npz", name) for line in lines)]
    path.write_text("".join(f"{zlib.crc32(one.encode()):08x} {one}\n" for one in texts))
    _refused(shell, folders, 1, "part2/files.jsonl: expected files in part2, found others")


def test_a_renamed_shard_is_refused(shell: Shell) -> None:
    _shards(shell, CAPTURE, 2)
    shutil.copytree("part1", "renamed")
    _changed("renamed", {"shard": {"number": 2, "count": 2}})
    _refused(shell, ["part1", "renamed"], 1, "renamed: expected the scans of shard 2/2")


@pytest.mark.parametrize("damage", ["lost", "short"])
def test_a_damaged_part_is_named(shell: Shell, damage: str) -> None:
    _shards(shell, CAPTURE, 2)
    file = Path("part2/000003.npz")
    if damage == "lost":
        file.unlink()
        _refused(shell, ["part1", "part2"], 1, "part2/000003.npz", "No such file")
    else:
        os.truncate(file, file.stat().st_size - 1)
        expected = "part2/000003.npz: expected the bytes that the shard has written, found others"
        _refused(shell, ["part1", "part2"], 1, expected)


@pytest.mark.parametrize("text", ["", "[]", "{", '{"schema": "mlbatch.shard/2"}', "\xff"])
def test_a_damaged_account_is_named(shell: Shell, text: str) -> None:
    _shards(shell, CAPTURE, 2)
    Path("part2/shard.json").write_text(text, encoding="latin-1")
    outcome = _merged(shell, ["part1", "part2"])
    assert outcome.code in (1, 2)
    assert outcome.err.startswith("mlbatch: error: part2/shard.json: expected ")
    assert outcome.err.count("\n") == 1


def test_a_field_of_another_kind_is_named(shell: Shell) -> None:
    _shards(shell, CAPTURE, 2)
    _changed("part2", {"content": "7"})
    _refused(shell, ["part1", "part2"], 1, "part2/shard.json", "damaged content", "'7'")


@pytest.mark.parametrize("content", [{"schema": 3}, {}])
def test_json_of_others_is_refused(shell: Shell, content: dict[str, int]) -> None:
    _shards(shell, CAPTURE, 2)
    Path("part2/shard.json").write_text(json.dumps(content))
    found = f"expected schema mlbatch.shard/4, found {content.get('schema')}"
    _refused(shell, ["part1", "part2"], 2, "part2/shard.json", found)


def test_a_shard_of_another_version_is_refused(shell: Shell) -> None:
    _shards(shell, CAPTURE, 2)
    _changed("part2", {"version": "9.9"})
    _refused(shell, ["part1", "part2"], 2, "found one of 9.9")


@pytest.mark.parametrize(
    ("folder", "words"),
    [
        ("nothing", "found nothing; run the conversion of this shard"),
        ("empty", "found a folder without shard.json"),
        ("file", "found a file"),
    ],
)
def test_other_folders_are_refused(shell: Shell, folder: str, words: str) -> None:
    _shards(shell, CAPTURE, 2)
    Path("empty").mkdir()
    Path("file").write_text("")
    _refused(shell, ["part1", folder], 2, words)


@pytest.mark.parametrize("target", ["part1", "part1/out", "."])
def test_an_output_among_the_parts_is_refused(shell: Shell, target: str) -> None:
    folders = _shards(shell, CAPTURE, 2)
    before = sorted(Path().glob("**/*"))
    outcome = shell(f"merge {' '.join(folders)} -o {target} --overwrite")
    assert outcome.code == 1
    assert outcome.err.count("\n") == 1
    assert sorted(Path().glob("**/*")) == before


@pytest.mark.parametrize(
    ("target", "code", "words"),
    [
        ("out.mcap", 2, "expected a folder for --format npz, found the name of a mcap file"),
        ("none/out", 1, "expected an output in an existing folder, found no folder none"),
    ],
)
def test_names_that_no_run_gives_are_refused(
    shell: Shell, target: str, code: int, words: str
) -> None:
    folders = _shards(shell, CAPTURE, 2)
    outcome = shell(f"merge {' '.join(folders)} -o {target} -q")
    assert outcome.code == code
    assert words in outcome.err
    assert sorted(os.listdir()) == folders


def test_an_existing_output_stays(shell: Shell) -> None:
    whole, _ = _whole(shell, CAPTURE)
    folders = _shards(shell, CAPTURE, 2)
    outcome = shell(f"merge {' '.join(folders)} -o whole/out")
    assert outcome.code == 1
    assert "found an existing one; choose another or --overwrite" in outcome.err
    assert contents(Path("whole")) == whole


def test_an_output_that_another_run_writes_is_refused(shell: Shell) -> None:
    folders = _shards(shell, CAPTURE, 2)
    Path("merged/out.partial").mkdir(parents=True)
    with Path("merged/out.partial/files.jsonl").open("a") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        outcome = _merged(shell, folders)
    assert outcome.code == 1
    assert "merged/out: expected no other run that writes it, found one; wait" in outcome.err
    assert _merged(shell, folders).code == 0


@pytest.mark.parametrize("command", ["verify", "digest", "report"])
def test_a_shard_is_not_taken_for_a_whole_output(shell: Shell, command: str) -> None:
    _shards(shell, CAPTURE, 2)
    outcome = shell(f"{command} part1")
    assert outcome.code == 1
    assert outcome.err == (
        "mlbatch: error: part1: expected a whole output, found one shard of it; join all with "
        "mlbatch merge\n"
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("-o out.mcap", "found mcap, one file for all scans; give --format npz"),
        ("-o out.bag", "found rosbag1"),
        ("-o out --format rosbag2", "--max-bag-duration for rosbag2"),
        ("--dry-run", "expected no --dry-run"),
        ("-o out --report report.json", "expected no --report"),
        ("-o out --report -", "expected no --report"),
        ("-o out --html page.html", "expected no --html"),
        ("-o out --fail-on loss>1%", "expected no --fail-on"),
        ("-o out --on-jump split", "expected no --on-jump split"),
    ],
)
def test_options_without_meaning_for_a_shard_are_refused(
    shell: Shell, options: str, words: str
) -> None:
    outcome = shell(f"convert {CAPTURE} --shard 1/2 {options}")
    assert outcome.code == 2
    assert words in outcome.err
    assert outcome.err.count("\n") == 1
    assert os.listdir() == []


@pytest.mark.parametrize("text", ["0/2", "3/2", "2", "1/0", "a/b", "-1/2", "1/2/3", "٣/٤"])
def test_other_texts_are_no_shards(shell: Shell, text: str) -> None:
    outcome = shell("convert", *CAPTURE.split(), "-o", "out", f"--shard={text}")
    assert outcome.code == 2
    assert f"--shard: expected K/N with K from 1 to N, found '{text}'" in outcome.err
