"""Clouds of bags as packets of a recording: ledgers, notes, and raw packets in the same bag."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.readers import merge, open_recording
from mlbatch.readers.bag.cloud_topics import CloudTopics, cloud_topics
from mlbatch.readers.bag.clouds import CloudRecording
from mlbatch.reports.ledger import check_capture
from mlbatch.types import PacketBatch, Stream, StreamTable, Topic
from tests.builders.bags import Recorded, packet_message
from tests.builders.points import (
    CLOUD,
    HEAD_BYTES,
    OUSTER,
    STAMP_NS,
    XYZ,
    Form,
    cloud_message,
    read_packets,
    write_points,
)
from tests.builders.reading import packets_in
from tests.builders.rosbag1 import write_rosbag1
from tests.builders.rosbag2 import write_rosbag2


def _bag(folder: Path, messages: Sequence[Recorded], encoding: str = "cdr") -> Path:
    write = write_rosbag2 if encoding == "cdr" else write_rosbag1
    return write(folder / f"clouds.{encoding}", messages)


def _open(path: Path) -> tuple[CloudRecording, StreamTable]:
    table = StreamTable()
    inner = open_recording(path, table)
    return CloudRecording(inner, table, CloudTopics(cloud_topics(inner.topics))), table


def _payloads(batches: Iterator[PacketBatch]) -> list[tuple[int, int, bytes]]:
    """Stream, receive time and bytes of all packets."""
    return [packet for batch in batches for packet in packets_in(batch)]


def _sweep(number: int) -> bytes:
    """Three columns of two points; the last has a point without a place."""
    at = number * 100_000_000
    points = [(1 + number, 1, ring, 9, 1000 * column, ring) for ring in (0, 1) for column in (0, 1)]
    points += [(0, 0, 0, 0, 2000, 0), (5, 5, 5, 9, 2000, 1)]
    return cloud_message(OUSTER, points, STAMP_NS + at)


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_clouds_of_a_bag_come_as_packets(tmp_path: Path, encoding: str) -> None:
    points = [(1, 1, ring, 9, 1000 * column, ring) for ring in (0, 1) for column in (0, 1)]
    data = [
        cloud_message(OUSTER, points, STAMP_NS + past_ns, Form(encoding)) for past_ns in (0, 10**8)
    ]
    recording, table = _open(_bag(tmp_path, write_points("/left/points", data), encoding))
    for _ in range(2):  # Counts and notes begin anew with every pass.
        packets = _payloads(recording.packets())
        assert [host_ns - STAMP_NS for _, host_ns, _ in packets] == [10**8] * 2 + [2 * 10**8] * 2
        columns = read_packets(np.stack([np.frombuffer(p, np.uint8) for _, _, p in packets]))
        stamps_ns = [column.stamp_ns - STAMP_NS for column in columns]
        assert stamps_ns == [0, 1000, 10**8, 10**8 + 1000]
        assert (recording.counts.frames, recording.counts.datagrams) == (4, 4)
        assert recording.notes == []
        assert recording.verdicts == [
            "/left/points: times of points from t (uint32), ns after the header's stamp; up to 2 "
            "points per column in turn; left out of 8 points: none"
        ]
    assert table.streams == [Stream(topic="/left/points")]
    assert table.untimed == {0}
    assert recording.clouds.frames == {Stream(topic="/left/points"): "lidar"}
    assert recording.container == recording.inner.container


def test_what_is_left_out_is_reported(tmp_path: Path) -> None:
    messages = write_points("/points", [_sweep(0), b"\0\1\0\0", _sweep(1), _sweep(2)[:-40]])
    recording, _ = _open(_bag(tmp_path, messages))
    assert len(_payloads(recording.packets())) == 6
    (first,), (second,) = recording.verdicts, recording.notes
    assert first.endswith("left out of 12 points: 2 without a place (NaN or zero)")
    assert second.startswith("/points: 2 clouds could not be read; the first: expected 4 bytes")
    assert (recording.counts.frames, recording.counts.datagrams) == (8, 6)
    assert recording.counts.skipped == {"truncated": 2}
    assert not check_capture(recording.counts)


def test_rings_beyond_those_of_the_first_cloud_are_reported(tmp_path: Path) -> None:
    sweeps = [
        cloud_message(OUSTER, [(1, 1, 1, 9, 0, ring) for ring in range(first, first + 16)], stamp)
        for first, stamp in ((0, STAMP_NS), (8, STAMP_NS + 10**8), (16, STAMP_NS + 2 * 10**8))
    ]
    sweeps.append(cloud_message((*XYZ, ("t", "uint32")), [(1, 1, 1, 0)]))
    recording, _ = _open(_bag(tmp_path, write_points("/points", sweeps)))
    packets = _payloads(recording.packets())
    assert len(packets) == 2
    (left_out,), (fault,) = recording.verdicts, recording.notes
    assert left_out.endswith("left out of 48 points: 24 on rings beyond those of the first cloud")
    assert fault.endswith("the first: expected rings as in the first cloud, found none")


def test_a_search_for_sensors_packs_first_points_and_the_run_all(tmp_path: Path) -> None:
    """By hand: 256 columns of 16 rings, by column; 512 points are 32 columns."""
    points = [(1, 1, ring, 9, 1000 * column, ring) for column in range(256) for ring in range(16)]
    clouds = [cloud_message(OUSTER, points, STAMP_NS + n * 100_000_000) for n in range(3)]
    recording, _ = _open(_bag(tmp_path, write_points("/points", clouds)))
    recording.clouds.first_points_only = True
    # The first cloud decides the layout.
    searched = _payloads(recording.packets())
    assert len(searched) == 256 + 2 * 32
    recording.clouds.first_points_only = False
    run = _payloads(recording.packets())
    assert len(run) == 3 * 256
    assert searched == run[: 256 + 32] + run[512 : 512 + 32]
    assert recording.counts.frames == 3 * 256


def test_raw_packets_keep_their_place_between_clouds_also_of_many_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    payloads = [bytes([number]) * 40 for number in range(6)]
    kind = "ouster_sensor_msgs/PacketMsg"
    raw = [
        Recorded("/os/lidar_packets", kind, STAMP_NS + at * 10**7, packet_message("cdr", data))
        for at, data in zip((1, 8, 12, 18, 25, 40), payloads, strict=True)
    ]
    clouds = write_points("/points", [_sweep(n) for n in range(3)])
    bag = _bag(tmp_path, sorted([*raw, *clouds], key=lambda message: message.log_ns))
    recording, table = _open(bag)
    packets = _payloads(recording.packets())
    received_ns = [host_ns for _, host_ns, _ in packets]
    assert received_ns == sorted(received_ns)
    number = table.number(Stream(topic="/os/lidar_packets"))
    assert [data for stream, _, data in packets if stream == number] == payloads
    assert len(packets) == recording.counts.datagrams == 6 + 9
    assert not check_capture(recording.counts)
    monkeypatch.setattr("mlbatch.readers.bag.clouds._BATCH_BYTES", 1)
    batches = list(_open(bag)[0].packets())
    assert len(batches) > 3
    assert _payloads(iter(batches)) == packets


def test_a_topic_over_several_bags_has_one_layout(tmp_path: Path) -> None:
    table = StreamTable()
    opened = []
    for number, data in enumerate([_sweep(0), cloud_message(OUSTER, [(1, 2, 3, 9, 5, 0)])]):
        (tmp_path / str(number)).mkdir()
        (sent,) = write_points("/points", [data])
        sent = replace(sent, log_ns=sent.log_ns + number * 10**8)
        opened.append(open_recording(_bag(tmp_path / str(number), [sent]), table))
    clouds = CloudTopics(cloud_topics(opened[0].topics))
    recordings = [CloudRecording(inner, table, clouds) for inner in opened]
    packets = _payloads(merge(recordings))
    assert {len(data) for _, _, data in packets} == {HEAD_BYTES + 2 * 20}
    assert len(packets) == 4


# Name, header stamps, frame: made from the clouds of /top/points, where they have its stamps in its
# namespace or frame.
@pytest.mark.parametrize(
    ("name", "stamps_ns", "frame", "stays"),
    [
        ("/top/rings", {5, 7}, "elsewhere", False),
        ("/merged/points", {5}, "top", False),
        ("/merged/points", {5}, "elsewhere", True),
        ("/topmost/points", {5}, "elsewhere", True),
        ("/top/rings", {6}, "top", True),
    ],
)
def test_copies_of_a_topic_of_the_rig(
    name: str, stamps_ns: set[int], frame: str, stays: bool
) -> None:
    clouds = CloudTopics(tuple(Topic(one, CLOUD, "cdr") for one in ("/top/points", name)))
    for topic, seen_ns, seen in (("/top/points", {4, 5}, "top"), (name, stamps_ns, frame)):
        clouds.stamps_ns[topic] |= seen_ns
        clouds.lidars[topic].frames.add(seen)
    clouds.leave_out_copies({"/top/points"})
    assert [topic.name for topic in clouds.topics] == ["/top/points", name][: 1 + stays]
