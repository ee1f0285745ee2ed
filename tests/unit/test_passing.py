"""Messages that pass through: each once, at its time, in one order."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from mlbatch.passing import PassQueue
from mlbatch.types import Message, Topic

TOPICS = tuple(Topic(name, "std_msgs/String", "cdr", "") for name in ("/b", "/a"))


@given(
    arrivals=st.lists(st.tuples(st.integers(0, 30), st.sampled_from(TOPICS)), max_size=40),
    ends=st.lists(st.integers(0, 35), max_size=6),
    low=st.integers(0, 10),
)
def test_what_is_taken_by_and_by_is_all_in_the_order_of_times(
    arrivals: list[tuple[int, Topic]], ends: list[int], low: int
) -> None:
    messages = [Message(topic, at, bytes([number])) for number, (at, topic) in enumerate(arrivals)]
    queue = PassQueue([], frozenset({"cdr"}))
    queue.add(messages)
    taken = [queue.take(end, (low, None), None) for end in (*sorted(ends), None)]
    for end, part in zip(sorted(ends), taken, strict=False):
        assert all(message.host_ns < end for message in part)
    # Of equal times the topics by name, and messages of one topic as they came.
    wanted = sorted(messages, key=lambda message: (message.host_ns, message.topic.name))
    assert [one for part in taken for one in part] == [m for m in wanted if m.host_ns >= low]
    for topic in TOPICS:
        own = [message for message in messages if message.topic == topic]
        early = sum(message.host_ns < low for message in own)
        counts = queue.counts.get(topic.name)
        assert (counts is None) == (not own)
        if counts is not None:
            assert (counts.read, counts.written) == (len(own), len(own) - early)
            assert counts.dropped == ({"outside_time": early} if early else {})
