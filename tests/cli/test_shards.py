"""`convert --shard` and `merge`: the output of one run, or one clear line."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import signal
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from mlbatch.types import Scan
from mlbatch.writers import npz_encoder as npz
from mlbatch.writers.formats import webdataset
from mlbatch.writers.output_file import Bytes
from tests.builders.captures import write_pcap
from tests.builders.run import Outcome, command
from tests.builders.sessions import FIXTURE, Shell, Unit, write_metadata
from tests.builders.transcripts import transcripts
from tests.resume_storm import contents, write_recordings

FIX = "fix/two_lidars.pcap --rig fix/rig.yaml"
CASES = transcripts("shards", FIX=FIX)
BAG = "--format rosbag2 --max-bag-duration"


@pytest.fixture
def shell(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Shell:
    """The command line, in a folder with the fixture."""
    (tmp_path / "fix").symlink_to(FIXTURE)
    return Shell(monkeypatch, tmp_path)


def _shards(shell: Shell, words: str, count: int, *, mixed: bool = False) -> list[str]:
    """Convert all shards; gives their folders. mixed: by one job or several."""
    folders = [f"part{number}" for number in range(1, count + 1)]
    for number, folder in enumerate(folders, 1):
        more = f" --jobs {number}" if mixed else ""
        done = shell(f"convert {words} --shard {number}/{count} -o {folder} -q{more}")
        assert done.code == 0, done.err
    return folders


def _merged(shell: Shell, folders: list[str]) -> Outcome:
    Path("merged").mkdir(exist_ok=True)
    return shell(f"merge {' '.join(folders)} -o merged/out -q")


def _whole(shell: Shell, words: str) -> tuple[dict[str, object], Outcome]:
    """All files of one run, and what it printed."""
    Path("whole").mkdir()
    outcome = shell(f"convert {words} -o whole/out -q")
    assert outcome.code == 0, outcome.err
    return contents(Path("whole")), outcome


@pytest.fixture
def parts(shell: Shell, two_shards: Path) -> list[str]:
    """Both shards of the fixture, in the folder of the shell."""
    for name in ("part1", "part2"):
        shutil.copytree(two_shards / name, name)
    return ["part1", "part2"]


@pytest.fixture(scope="module")
def two_shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with them, which is copied."""
    folder = tmp_path_factory.mktemp("shards")
    (folder / "fix").symlink_to(FIXTURE)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for number in (1, 2):
            words = f"convert {FIX} --shard {number}/2 -o part{number} -q --no-fsync"
            assert command(*words.split()).code == 0
    return folder


# -- the law ----------------------------------------------------------------------------------

# Of the fixture: options, and the number of shards.
FIXTURE_ROWS = [
    *(("", count) for count in (1, 3, 10)),
    ("--format ply --ply-style float", 3),
    ("--format pcd", 3),
    ("--format las", 3),
    ("--format kitti", 3),
    ("--format nuscenes --keep-partial", 3),
    ("--format webdataset --keep-partial", 3),
    ("--format webdataset --split --slices 2", 2),
    ("--split --slices 2", 3),
    ("--layout organized --keep-partial", 3),
    ("--sort points --slices 3", 3),
    ("--batching latest", 3),
    ("--align-clocks", 3),
    ("--drop-incomplete 70 --fault drop:left:30% --fault-seed 5", 3),
    ("--fault stall:left:0.3s-0.5s --max-wait 0.05 --keep-partial", 3),
    ("--exclude-box=-1000,-1000,-1000,1000,1000,5", 3),
    ("--start +0.2 --end +0.5", 3),
    (f"{BAG} 0.1", 3),
    (f"{BAG} 0.2 --keep-partial --compression zstd:1", 3),
    (f"{BAG} 0.3 --split --slices 2 --point-layout ouster", 3),
    (f"{BAG} 5 --layout organized --start +0.2", 3),
    (f"{BAG} 0.2 --batching latest", 3),
    (f"{BAG} 0.2 --stamp end --drop-incomplete 70 --fault drop:left:30% --fault-seed 5", 3),
]
# Two lidars with an IMU and other messages, which are in the file of the scan that follows them,
# whatever shard writes it.
MESSAGES = "bag/drive.mcap --identity-extrinsics --pass /chatter"
# The packets of a lidar alone: other shards' files begin without a message.
PACKETS = "in/drive.pcap"
LAW = [
    *((f"{FIX} {options}", count, False) for options, count in FIXTURE_ROWS),
    (f"{FIX} --slices 2", 4, True),
    (MESSAGES, 2, False),
    (f"{MESSAGES} {BAG} 0.25 --jobs 3", 3, False),
    (f"{MESSAGES} {BAG} 9", 3, False),
    *(
        (f"{PACKETS} {BAG} 0.2 {options}", 3, False)
        for options in ("", "--split", "--slices 2 --keep-partial")
    ),
]


@pytest.mark.parametrize(("words", "count", "mixed"), LAW)
def test_shards_give_the_bytes_of_one_run(
    shell: Shell, words: str, count: int, mixed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webdataset, "WINDOWS_PER_FILE", 2)
    if words.startswith(MESSAGES):
        write_recordings(Path(), turns=9)
    if words.startswith(PACKETS):
        Path("in").mkdir()
        unit = Unit(turns=9)
        write_metadata(Path("in/111.json"), unit.spec)
        write_pcap(Path("in/drive.pcap"), unit.records)
    whole, one_run = _whole(shell, words)
    folders = _shards(shell, words, count, mixed=mixed)
    tables = [Path(one, "scans.csv").read_bytes().splitlines() for one in folders]
    merged = _merged(shell, folders[::-1])
    assert (merged.code, merged.err) == (0, one_run.err)
    assert contents(Path("merged")) == whole
    assert shell("verify merged/out").code == 0
    # Every shard has its rows of the table.
    header, *rows = Path("whole/out/scans.csv").read_bytes().splitlines()
    assert {one[0] for one in tables} == {header}
    assert sorted(row for one in tables for row in one[1:]) == sorted(rows)


# -- mistakes ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CASES)
def test_transcript(shell: Shell, parts: list[str], tmp_path: Path, name: str) -> None:
    CASES[name].check(shell, tmp_path)


def test_points_that_no_scan_has_are_refused(shell: Shell, parts: list[str]) -> None:
    path = Path("part2/shard.json")
    account = json.loads(path.read_text())
    counts = account["report"]["sensors"][0]["ledger"]["points"]
    counts["written"] += 1
    counts["slots"] += 1
    path.write_text(json.dumps(account))
    outcome = _merged(shell, parts)
    assert outcome.code == 1
    assert "the ledger does not balance" in outcome.err
    assert "shard.json was changed" in outcome.err


@pytest.mark.parametrize("name", ["../part1/000000.npz", "/etc/hostname"])
def test_files_elsewhere_are_not_taken(shell: Shell, parts: list[str], name: str) -> None:
    path = Path("part2/files.jsonl")
    head, *lines = path.read_text().splitlines()
    texts = [head[9:], *(line[9:].replace("000003.npz", name) for line in lines)]
    path.write_text("".join(f"{zlib.crc32(one.encode()):08x} {one}\n" for one in texts))
    outcome = _merged(shell, parts)
    assert outcome.code == 1
    begin = "mlbatch: error: part2/files.jsonl: expected files in part2, found others"
    assert outcome.err.startswith(begin)


def test_an_output_that_another_run_writes_is_refused(shell: Shell, parts: list[str]) -> None:
    Path("merged/out.partial").mkdir(parents=True)
    with Path("merged/out.partial/files.jsonl").open("a") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        outcome = _merged(shell, parts)
    assert outcome.code == 1
    assert "merged/out: expected no other run that writes it, found one; wait" in outcome.err
    assert _merged(shell, parts).code == 0


# -- parts ------------------------------------------------------------------------------------


def test_the_bag_of_a_shard_can_be_read(shell: Shell) -> None:
    """By the library `rosbags`: metadata.yaml names the files that are there."""
    words = f"{FIX} {BAG} 0.2"
    _shards(shell, words, 2)
    with AnyReader([Path("part2")]) as reader:
        topics = [one.topic for one, _, _ in reader.messages()]
    # Windows 2, 3 and 6 of 7.
    assert topics.count("/points") == 3


def test_counts_of_the_report_are_those_of_all_shards(shell: Shell, parts: list[str]) -> None:
    accounts = [json.loads(Path(one, "shard.json").read_text()) for one in parts]
    assert _merged(shell, parts).code == 0
    report = json.loads(Path("merged/out/report.json").read_text())
    for number, sensor in enumerate(report["sensors"]):
        own = [one["report"]["sensors"][number]["ledger"]["points"]["written"] for one in accounts]
        assert all(own)
        assert sensor["points"]["written"] == sum(own)
    assert report["timing"]["cpu_s"] > sum(one["report"]["timing"]["cpu_s"] for one in accounts)


def test_another_file_system_gets_copies(
    shell: Shell, parts: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def other(source: Path, path: Path) -> None:
        raise OSError(18, "Invalid cross-device link")

    whole, _ = _whole(shell, FIX)
    monkeypatch.setattr(os, "link", other)
    assert _merged(shell, parts).code == 0
    assert contents(Path("merged")) == whole


# -- interrupted ------------------------------------------------------------------------------


@contextmanager
def _interrupted_at(index: int) -> Iterator[list[int]]:
    """Have the writing of a scan be interrupted; gives the scans that are written."""
    saved: list[int] = []
    encode = npz.NpzEncoder.encode

    def ending(encoder: npz.NpzEncoder, scan: Scan) -> list[Bytes]:
        if scan.index == index:
            raise KeyboardInterrupt
        saved.append(scan.index)
        return encode(encoder, scan)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(npz.NpzEncoder, "encode", ending)
        yield saved


def test_an_interrupted_shard_is_resumed(shell: Shell, parts: list[str]) -> None:
    whole, _ = _whole(shell, FIX)
    shutil.rmtree("part1")
    words = f"convert {FIX} --shard 1/2 -o part1"
    with _interrupted_at(4):
        assert shell(words).code == 130
    early = _merged(shell, parts)
    assert (early.code, early.err) == (
        2,
        "mlbatch: error: part1: expected the folder of a shard, found that of an interrupted run "
        "(part1.partial); run this shard again with --resume\n",
    )
    other = shell(f"convert {FIX} --shard 2/2 -o part1 --resume")
    assert other.code == 2
    assert "expected the job of the interrupted run, found shard '2/2' instead of '1/2'" in (
        other.err
    )
    with _interrupted_at(-1) as saved:
        resumed = shell(f"{words} --resume")
    assert (resumed.code, resumed.err) == (0, "mlbatch: part1: resumed after 2 scans\n")
    assert saved == [4, 6]
    assert _merged(shell, parts).code == 0
    assert contents(Path("merged")) == whole


def test_an_interrupted_merge_leaves_nothing(
    shell: Shell, parts: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
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
        assert _merged(shell, parts).code == 130
    assert calls == 4
    assert os.listdir("merged") == []
    assert _merged(shell, parts).code == 0


def test_a_full_disk_leaves_nothing(
    shell: Shell, parts: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*paths: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "link", full)
    monkeypatch.setattr(shutil, "copyfile", full)
    outcome = _merged(shell, parts)
    assert outcome.code == 1
    assert "No space left on device" in outcome.err
    assert "free space on this disk" in outcome.err
    assert os.listdir("merged") == []
