"""ROS 2 bags of several files: what is in which, and that nothing is lost between them."""

from __future__ import annotations

import csv
import itertools
import zlib
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from mlbatch.pipeline import run
from mlbatch.types import Scan
from mlbatch.writers import open_writer
from mlbatch.writers.base import FilesWriter, ScanWriter, WriterOptions, windows_per_file
from tests.builders.files import Noted
from tests.builders.scans import PERIOD_NS, START_NS, SUMMARY, dense_scan, imu_samples, run_job
from tests.builders.sessions import FIXTURE, Shell
from tests.builders.written_bags import ROS2_NOTE, note
from tests.resume_storm import write_recordings

CAPTURE = f"{FIXTURE / 'two_lidars.pcap'} --rig {FIXTURE / 'rig.yaml'}"
BAG = "bag/drive.mcap --identity-extrinsics --pass /chatter"
TURNS = 8
# Topic, log time, message.
Sent = tuple[str, int, bytes]


def _messages(path: Path) -> list[Sent]:
    """All messages of a file in its order, by the library of the format."""
    with path.open("rb") as file:
        messages = make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        return [(channel.topic, one.log_time, one.data) for _, channel, one in messages]


def _files(folder: Path) -> list[Path]:
    """The files of a bag, as metadata.yaml names them."""
    return [folder / name for name in _about(folder)["relative_file_paths"]]


def _about(folder: Path) -> dict[str, Any]:
    text = (folder / "metadata.yaml").read_text(encoding="utf-8")
    found: dict[str, Any] = yaml.safe_load(text)["rosbag2_bagfile_information"]
    return found


def _without_static(messages: list[Sent]) -> list[Sent]:
    return [one for one in messages if one[0] != "/tf_static"]


@pytest.mark.parametrize("portion", [1, 1 << 18])
@pytest.mark.parametrize(
    "options",
    [
        "",
        "--keep-partial --split",
        "--slices 3 --compression zstd:1",
        "--jobs 3 --keep-partial",
        "--batching latest",
    ],
)
def test_the_files_have_the_messages_of_one(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, options: str, portion: int
) -> None:
    write_recordings(Path(), TURNS)
    # Messages that are written apart from the scan that they precede.
    monkeypatch.setattr(run, "_PORTION_BYTES", portion)
    words = f"convert {BAG} {options} --format rosbag2"
    assert shell(f"{words} -o one -q").code == 0
    assert shell(f"{words} -o several --max-bag-duration 0.2 -q").code == 0
    files = [_messages(path) for path in _files(Path("several"))]
    assert len(files) >= 3
    joined = [message for messages in files for message in messages]
    assert _without_static(joined) == _without_static(_messages(Path("one/one_0.mcap")))
    assert Path("several/scans.csv").read_bytes() == Path("one/scans.csv").read_bytes()
    assert shell("verify several").code == 0


def test_every_window_is_in_its_file(shell: Shell) -> None:
    """Three windows of 10 Hz in 0.3 s: 0 to 2, 3 to 5, 6; the head is in the first file."""
    words = f"convert {CAPTURE} --keep-partial --format rosbag2 --max-bag-duration 0.3 -o out -q"
    assert shell(words).code == 0
    with Path("out/scans.csv").open() as file:
        starts = {int(row["index"]): int(row["start_ns"]) for row in csv.DictReader(file)}
    assert min(starts) == -1
    found = [
        [log_ns for topic, log_ns, _ in _messages(path) if topic == "/points"]
        for path in _files(Path("out"))
    ]
    expected = [[-1, 0, 1, 2], [3, 4, 5], [6, 7]]
    assert found == [[starts[index] for index in indices] for indices in expected]


def test_files_follow_each_other_in_time(shell: Shell) -> None:
    """A player reads one after the other: no message belongs before the end of the file before."""
    write_recordings(Path(), TURNS)
    assert shell(f"convert {BAG} --format rosbag2 --max-bag-duration 0.1 -o out -q").code == 0
    spans = [
        (min(log_ns for _, log_ns, _ in messages), max(log_ns for _, log_ns, _ in messages))
        for messages in map(_messages, _files(Path("out")))
    ]
    assert len(spans) >= TURNS - 2
    assert all(end < begin for (_, end), (begin, _) in itertools.pairwise(spans))


def test_every_file_can_be_read_alone(shell: Shell) -> None:
    words = f"convert {CAPTURE} --format rosbag2 -q"
    assert shell(f"{words} -o one").code == 0
    assert shell(f"{words} -o out --max-bag-duration 0.1").code == 0
    with Path("one/one_0.mcap").open("rb") as file:
        [grid] = [m.metadata for m in make_reader(file).iter_metadata() if m.name == "mlbatch.grid"]
    paths = _files(Path("out"))
    assert [path.name for path in paths] == [f"out_{number}.mcap" for number in range(7)]
    for path in paths:
        topics = [topic for topic, _, _ in _messages(path)]
        assert topics[0] == "/tf_static"
        assert topics.count("/tf_static") == topics.count("/points") == 1
        with path.open("rb") as file:
            reader = make_reader(file)
            [metadata] = reader.iter_metadata()
            assert not list(reader.iter_attachments())
        assert metadata.name == "mlbatch.grid"
        assert metadata.metadata == grid | {"windows_per_file": "1"}


@pytest.mark.parametrize(
    ("seconds", "rate", "windows"),
    [
        (0.3, Fraction(10), 3),
        (0.05, Fraction(10), 1),
        (1, Fraction(10, 3), 3),
        (60, Fraction("29.97"), 1798),
        (3600, Fraction(100), 360_000),
    ],
)
def test_windows_of_a_file(seconds: float, rate: Fraction, windows: int) -> None:
    assert windows_per_file(seconds, rate) == windows


# -- by hand ----------------------------------------------------------------------------------


def _write(target: Path, indices: list[int], **options: Any) -> ScanWriter:
    """Write scans of two windows a file; a note precedes each by 1 ns, IMU samples the first."""
    writer = open_writer(
        "rosbag2", target, dense_scan().info, WriterOptions(max_bag_s=0.2, **options)
    )
    for index in indices:
        job = writer.write(_scan(index))
        job.start(index)
        writer.write_message(note(ROS2_NOTE, f"before {index}", index * PERIOD_NS - 1))
        if index == indices[0]:
            writer.write_imu(imu_samples())
        run_job(job)
    return writer


def _scan(index: int) -> Scan:
    return dense_scan(index, 30)


def test_metadata_by_hand(tmp_path: Path) -> None:
    """Windows without a scan leave no number out."""
    writer = _write(tmp_path / "drive", [0, 1, 7])
    writer.finish(SUMMARY)
    info = _about(tmp_path / "drive")
    topics = info.pop("topics_with_message_count")
    # IMU samples at -5 ns and 10 ms after; the last scan is the last message.
    assert info == {
        "version": 5,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": 7 * PERIOD_NS + 5},
        "starting_time": {"nanoseconds_since_epoch": START_NS - 5},
        "message_count": 10,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": ["drive_0.mcap", "drive_1.mcap"],
        "files": [
            {
                "path": "drive_0.mcap",
                "starting_time": {"nanoseconds_since_epoch": START_NS - 5},
                "duration": {"nanoseconds": PERIOD_NS + 5},
                "message_count": 7,
            },
            {
                "path": "drive_1.mcap",
                "starting_time": {"nanoseconds_since_epoch": START_NS + 7 * PERIOD_NS - 1},
                "duration": {"nanoseconds": 1},
                "message_count": 3,
            },
        ],
    }
    counts = {
        (one["topic_metadata"]["name"], one["topic_metadata"]["type"]): one["message_count"]
        for one in topics
    }
    assert counts == {
        ("/tf_static", "tf2_msgs/msg/TFMessage"): 2,
        ("/note", "std_msgs/msg/String"): 3,
        ("/left/imu", "sensor_msgs/msg/Imu"): 2,
        ("/points", "sensor_msgs/msg/PointCloud2"): 3,
    }
    assert {one["topic_metadata"]["serialization_format"] for one in topics} == {"cdr"}
    names = sorted(path.name for path in (tmp_path / "drive").iterdir())
    assert names == ["drive_0.mcap", "drive_1.mcap", "metadata.yaml", "scans.csv"]


@pytest.mark.parametrize("name", ["drive é", "run 😀", 'quo"ted\\', "tab\there"])
@pytest.mark.parametrize("seconds", [0.0, 0.2])
def test_any_name_can_be_read(tmp_path: Path, name: str, seconds: float) -> None:
    scan = _scan(0)
    writer = open_writer("rosbag2", tmp_path / name, scan.info, WriterOptions(max_bag_s=seconds))
    run_job(writer.write(scan))
    writer.finish(SUMMARY)
    assert _about(tmp_path / name)["relative_file_paths"] == [f"{name}_0.mcap"]
    with AnyReader([tmp_path / name]) as reader:
        assert reader.message_count == 2


@pytest.mark.parametrize("has_notes", [True, False])
def test_files_of_other_runs_are_left_to_them(tmp_path: Path, has_notes: bool) -> None:
    """With one file in three: windows 2, 3 and 8, 9 of files 0 to 4.

    Without messages nothing of the other files is seen but scans without points.
    """
    noted = Noted(lambda index: index // 2 % 3 == 1)
    options = WriterOptions(max_bag_s=0.2, files=noted)
    writer = open_writer("rosbag2", tmp_path / "out", dense_scan().info, options)
    assert isinstance(writer, FilesWriter)
    for index in range(10):
        write = writer.write if noted.is_due(index) else writer.skip
        job = write(_scan(index))
        job.start(index)
        if has_notes:
            writer.write_message(note(ROS2_NOTE, str(index), index * PERIOD_NS))
        run_job(job)
    # The last is complete with the output.
    assert list(noted.crcs) == [(2, 0, None)]
    writer.finish(SUMMARY)
    names = [path.name for path in _files(tmp_path / "out")]
    assert names == ["out_1.mcap", "out_4.mcap"]
    crcs = [{name: zlib.crc32((tmp_path / "out" / name).read_bytes())} for name in names]
    assert noted.crcs == {(2, 0, None): crcs[0], (8, 0, None): crcs[1]}
    messages = [one for name in names for one in _messages(tmp_path / "out" / name)]
    notes = [message[8:-1].decode() for topic, _, message in messages if topic == "/note"]
    assert notes == (["2", "3", "8", "9"] if has_notes else [])
    starts = [
        (log_ns - START_NS) // PERIOD_NS for topic, log_ns, _ in messages if topic == "/points"
    ]
    assert starts == [2, 3, 8, 9]


def test_complete_files_are_noted_at_once(tmp_path: Path) -> None:
    """Two files are complete when the third begins; a kill leaves them."""
    noted = Noted()
    killed = _write(tmp_path / "out", [0, 1, 2, 3, 4], files=noted)
    killed.abandon()
    partial = tmp_path / "out.partial"
    crcs = {
        (2 * number, 0, None): {
            f"out_{number}.mcap": zlib.crc32((partial / f"out_{number}.mcap").read_bytes())
        }
        for number in (0, 1)
    }
    assert noted.crcs == crcs


# -- what is refused ----------------------------------------------------------------------------
