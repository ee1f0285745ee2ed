"""Several recordings as one session."""

from __future__ import annotations

import random
from collections.abc import Generator
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.readers import merge
from mlbatch.types import Message, PacketBatch, Recording, StreamTable, Topic
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.reading import Seen, open_capture, seen_of

Session = list[list[int]]


class Batches(Recording):
    """A recording made of host times; its batches share one array, as readers' batches do."""

    def __init__(self, number: int, host_ns: list[int], cuts: random.Random) -> None:
        super().__init__(Path(f"recording {number}"), "values", 0)
        self.number = number
        self.host_ns = host_ns
        self.cuts = cuts
        self.open = 0

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Payloads of two bytes: number of the recording, index."""
        data = np.zeros(64, np.uint8)
        self.open += 1
        at = 0
        while at < len(self.host_ns):
            stop = min(at + self.cuts.randint(0, 5), len(self.host_ns))
            count = stop - at
            start = 2 * np.arange(count)
            data[:] = 255
            data[start], data[start + 1] = self.number, np.arange(at, stop)
            two, stream = np.full(count, 2), np.full(count, self.number)
            yield PacketBatch(data, start, two, stream, np.array(self.host_ns[at:stop], np.int64))
            at = stop
        self.open -= 1


def merged(session: Session, seed: int = 0) -> list[tuple[int, int]]:
    """(recording, index) of all packets, in merged order."""
    recordings = [Batches(i, times, random.Random(seed + i)) for i, times in enumerate(session)]
    found: list[tuple[int, int]] = []
    for batch in merge(recordings):
        pairs = batch.data[batch.start[:, None] + np.arange(2)].tolist()
        assert [pair[0] for pair in pairs] == batch.stream.tolist()
        assert [session[a][b] for a, b in pairs] == batch.host_ns.tolist()
        found += [(a, b) for a, b in pairs]
    return found


def expected(session: Session) -> list[tuple[int, int]]:
    """The definition: by largest time so far, then recording, then index."""
    keyed = [
        (max(times[: index + 1]), number, index)
        for number, times in enumerate(session)
        for index in range(len(times))
    ]
    return [(number, index) for _, number, index in sorted(keyed)]


def test_two_recordings_interleave_by_host_time() -> None:
    assert merged([[1, 5, 9], [2, 3, 7]]) == [(0, 0), (1, 0), (1, 1), (0, 1), (1, 2), (0, 2)]


def test_equal_times_follow_the_order_of_recordings() -> None:
    assert merged([[4, 4], [4], [4, 4]]) == [(0, 0), (0, 1), (1, 0), (2, 0), (2, 1)]


def test_a_step_back_keeps_its_recordings_order() -> None:
    assert merged([[10, 3, 11], [4, 10, 12]]) == [(1, 0), (0, 0), (0, 1), (1, 1), (0, 2), (1, 2)]


class Notes(Batches):
    """A recording of nothing but messages, three in a batch."""

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Messages at the host times."""
        none = np.zeros(0, np.int64)
        topic = Topic("/note", "std_msgs/String", "cdr")
        for at in range(0, len(self.host_ns), 3):
            messages = [Message(topic, log_ns, b"") for log_ns in self.host_ns[at : at + 3]]
            yield PacketBatch(np.zeros(0, np.uint8), none, none, none, none, tuple(messages))


def _delivered(by_log_time: bool) -> list[tuple[int, int]]:
    """Packets that had come, and messages, after each batch; of each all in the end."""
    packets = Batches(0, list(range(100, 400)), random.Random(0))
    notes = Notes(1, list(range(100, 400, 2)), random.Random(0))
    packet_ns: list[int] = []
    message_ns: list[int] = []
    found = []
    for batch in merge([packets, notes], lambda one: by_log_time and one is notes):
        message_ns += [message.host_ns for message in batch.messages]
        packet_ns += batch.host_ns.tolist()
        found.append((len(packet_ns), len(message_ns)))
    assert message_ns == notes.host_ns
    assert packet_ns == packets.host_ns
    return found


def test_messages_alone_are_read_before_all_packets() -> None:
    assert all(messages == 150 for packets, messages in _delivered(by_log_time=False) if packets)


def test_messages_alone_are_read_by_their_log_times() -> None:
    """Two packets come for each message, but for what is read at once."""
    assert all(
        abs(packets - 2 * messages) <= 12 for packets, messages in _delivered(by_log_time=True)
    )


def test_no_recordings_and_empty_recordings() -> None:
    assert merged([]) == []
    assert merged([[], [1], []]) == [(1, 0)]


@settings(max_examples=300)
@given(
    session=st.lists(st.lists(st.integers(0, 30), max_size=20), max_size=4),
    seed=st.integers(0, 1000),
)
def test_merging_is_sorting(session: Session, seed: int) -> None:
    assert merged(session, seed) == expected(session)


def test_captures_merge_and_a_single_one_passes_through(tmp_path: Path) -> None:
    streams = StreamTable()
    paths = []
    for number in (1, 2):
        frames = [
            (i * 1000 + number, f)
            for i in range(200)
            for f in udp_frame(bytes([number, i] * 900), f"10.0.0.{number}", ident=i, mtu=1500)
        ]
        paths.append(write_pcap(tmp_path / f"{number}.pcap", frames))
    recordings = [open_capture(p, buffer_bytes=9000, streams=streams) for p in paths]
    seen: list[Seen] = []
    for batch in merge(recordings):
        seen += seen_of(batch, streams)
    assert [(one.host_ns, one.payload[0], one.payload[1]) for one in seen] == [
        (i * 1000 + number, number, i) for i in range(200) for number in (1, 2)
    ]
    assert [recording.counts.datagrams for recording in recordings] == [200, 200]
    alone = [one for batch in merge(recordings[:1]) for one in seen_of(batch, streams)]
    assert alone == seen[::2]
