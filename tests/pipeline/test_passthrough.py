"""Messages that pass through: each once, at its time, in one order."""

from __future__ import annotations

import tracemalloc
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.errors import ExportError
from mlbatch.pipeline import passthrough
from mlbatch.pipeline.passthrough import ImuQueue, MessageQueue
from mlbatch.reports.ledger import DecodedCounts
from mlbatch.types import ImuSamples, Message, Topic

TOPICS = tuple(Topic(name, "std_msgs/String", "cdr", "") for name in ("/b", "/a"))


@given(
    arrivals=st.lists(st.tuples(st.integers(0, 30), st.sampled_from(TOPICS)), max_size=40),
    ends=st.lists(st.integers(0, 35), max_size=6),
    low=st.integers(0, 10),
    limit_comes_first=st.booleans(),
)
def test_what_is_taken_by_and_by_is_all_in_the_order_of_times(
    arrivals: list[tuple[int, Topic]], ends: list[int], low: int, limit_comes_first: bool
) -> None:
    messages = [Message(topic, at, bytes([number])) for number, (at, topic) in enumerate(arrivals)]
    queue = MessageQueue([], frozenset({"cdr"}))
    queue.add(messages)
    if limit_comes_first:
        queue.drop_before(low)
    taken = [queue.drain_until(end, (low, None), None) for end in (*sorted(ends), None)]
    for end, part in zip(sorted(ends), taken, strict=False):
        assert all(message.host_ns < end for message in part)
    # Of equal times the topics by name, and messages of one topic as they came.
    expected = sorted(messages, key=lambda message: (message.host_ns, message.topic.name))
    assert [one for part in taken for one in part] == [m for m in expected if m.host_ns >= low]
    for topic in TOPICS:
        own = [message for message in messages if message.topic == topic]
        early = sum(message.host_ns < low for message in own)
        counts = queue.counts.get(topic.name)
        assert (counts is None) == (not own)
        if counts is not None:
            assert (counts.read, counts.written) == (len(own), len(own) - early)
            assert counts.dropped == ({"outside_time": early} if early else {})


def test_what_lies_before_the_first_limit_does_not_wait() -> None:
    queue = MessageQueue([], frozenset({"cdr"}))
    queue.add([Message(TOPICS[0], at, b"") for at in range(10)])
    queue.drop_before(7)
    assert queue.waiting == 3
    assert queue.counts["/b"].dropped == {"outside_time": 7}
    counts = DecodedCounts()
    samples = ImuQueue([counts], [100], has_place=True)
    zeros = np.zeros((10, 3))
    samples.add(ImuSamples(0, np.arange(10), zeros, zeros))
    samples.drop_before(107)
    assert counts.dropped == {"outside_time": 7}
    (left,) = samples.drain_until(None, (107, None))
    assert left.stamp_ns.tolist() == [107, 108, 109]
    assert counts.written == 3


@given(
    arrivals=st.lists(
        st.tuples(st.integers(0, 300), st.sampled_from(TOPICS), st.integers(0, 40)), max_size=60
    ),
    drains=st.lists(st.tuples(st.integers(0, 20), st.integers(0, 350)), max_size=8),
    memory_bytes=st.sampled_from([1, 1000, 3000]),
    far_ns=st.integers(0, 100),
    most_bytes=st.sampled_from([1, 900, 5000]),
)
def test_messages_in_a_file_come_as_those_in_memory(
    arrivals: list[tuple[int, Topic, int]],
    drains: list[tuple[int, int]],
    memory_bytes: int,
    far_ns: int,
    most_bytes: int,
) -> None:
    """Messages are added between drains; the order is that of a queue in memory."""
    messages = [
        Message(topic, at, bytes([number % 256]) * size)
        for number, (at, topic, size) in enumerate(arrivals)
    ]
    in_memory = MessageQueue([], frozenset({"cdr"}))
    with (
        patch.object(passthrough, "_MEMORY_BYTES", memory_bytes),
        patch.object(passthrough, "_FAR_NS", far_ns),
        patch.object(passthrough, "_READ_BYTES", 70),
    ):
        in_file = MessageQueue([], frozenset({"cdr"}))
        left = messages
        for count, end in [*drains, (len(messages), None)]:
            in_memory.add(left[:count])
            in_file.add(left[:count])
            left = left[count:]
            expected = in_memory.drain_until(end, (5, 290), None)
            found = []
            while part := in_file.drain_until(end, (5, 290), None, most_bytes):
                found += part
            assert found == expected
            assert in_file.waiting == in_memory.waiting
    assert in_file.counts == in_memory.counts
    assert in_file.waiting == 0


def _peak_bytes(count: int) -> int:
    """Memory of a queue to which messages without a scan are added, and from which they go."""
    queue = MessageQueue([], frozenset({"cdr"}))
    tracemalloc.start()
    try:
        for number in range(count):
            queue.add([Message(TOPICS[0], number * 1_000_000, bytes(300))])
        assert queue.waiting == count
        taken = 0
        while part := queue.drain_until(None, (None, None), None, 1 << 20):
            taken += len(part)
        assert taken == count
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_does_not_depend_on_the_messages_that_wait() -> None:
    assert _peak_bytes(24_000) - _peak_bytes(8_000) < 2_000_000


def test_a_full_disk_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    small = f"PRAGMA max_page_count = 200; {passthrough._BEGIN}"
    monkeypatch.setattr(passthrough, "_BEGIN", small)
    queue = MessageQueue([], frozenset({"cdr"}))
    with pytest.raises(ExportError, match=r"disk is full.*set TMPDIR") as error:
        queue.add(Message(TOPICS[0], at, bytes(300_000)) for at in range(20))
    assert "\n" not in str(error.value)


def test_imu_samples_without_a_scan_are_joined() -> None:
    counts = DecodedCounts()
    samples = ImuQueue([counts], [0], has_place=True)
    zeros = np.zeros((1, 3))
    tracemalloc.start()
    try:
        for at in range(20_000):
            samples.add(ImuSamples(0, np.array([at * 10]), zeros, zeros))
        # 7 numbers of 8 bytes a sample, twice while they are joined.
        assert tracemalloc.get_traced_memory()[1] < 20_000 * 7 * 8 * 2 + 500_000
    finally:
        tracemalloc.stop()
    (left,) = samples.drain_until(None, (None, None))
    assert left.stamp_ns.tolist() == [at * 10 for at in range(20_000)]
