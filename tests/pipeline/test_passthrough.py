"""Messages that pass through: each once, at its time, in one order."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.pipeline.passthrough import ImuQueue, MessageQueue
from mlbatch.report.ledger import DecodedCounts
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
