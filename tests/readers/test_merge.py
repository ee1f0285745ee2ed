"""Several recordings as one session."""

from __future__ import annotations

import gzip
import random
from collections import Counter
from collections.abc import Generator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mlbatch.readers import merge
from mlbatch.types import Message, PacketBatch, Recording, StreamTable, Topic
from tests.builders.captures import Packet, Section, pcap_bytes, section_bytes, udp_frame
from tests.builders.reading import Seen, assert_balanced, open_capture, seen_of

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


@settings(max_examples=300)
@example(session=[], seed=0)
@example(session=[[], [1], []], seed=0)
@example(session=[[4, 4], [4], [4, 4]], seed=0)
@given(
    session=st.lists(st.lists(st.integers(0, 30), max_size=20), max_size=4),
    seed=st.integers(0, 1000),
)
def test_merging_is_sorting(session: Session, seed: int) -> None:
    assert merged(session, seed) == expected(session)


# -- captures that follow each other --------------------------------------------------------------

Records = list[tuple[int, bytes]]


def capture_bytes(kind: str, records: Records) -> bytes:
    """A capture of some kind."""
    if kind == "pcapng":
        return section_bytes(Section([Packet(frame, host_ns) for host_ns, frame in records]))
    data = pcap_bytes(records)
    return gzip.compress(data) if kind == "gz" else data


def read_session(
    folder: Path, captures: Sequence[tuple[str, bytes]], order: Sequence[int] | None = None
) -> tuple[list[Seen], Counter[str]]:
    """Packets of captures (name, bytes) in an order, and what became of all their frames."""
    for name, data in captures:
        (folder / name).write_bytes(data)
    streams = StreamTable()
    names = [captures[number][0] for number in order or range(len(captures))]
    recordings = [open_capture(folder / name, streams=streams) for name in names]
    seen = [one for batch in merge(recordings) for one in seen_of(batch, streams)]
    counts: Counter[str] = Counter()
    for recording in recordings:
        assert_balanced(recording)
        counts.update({"datagrams": recording.counts.datagrams, **recording.counts.skipped})
    return seen, counts


def traffic(pick: random.Random, steps_back: bool) -> Records:
    """Mixed fragments of three senders, one of IPv6; times may step back by at most 2 us."""
    sent: Records = []
    for number in range(pick.randint(3, 12)):
        source = pick.choice(["10.0.0.1", "10.0.0.2", "fe80::1"])
        target = "fe80::2" if ":" in source else "10.0.0.9"
        payload = pick.randbytes(pick.choice([100, 1500, 3000]))
        frames = udp_frame(payload, source, target, ident=number, mtu=1280)
        sent += [(10**18 + 1000 * (len(sent) + i), frame) for i, frame in enumerate(frames)]
    mixed = sorted(sent, key=lambda record: record[0] + pick.randint(0, 2000))
    if steps_back:
        return mixed
    return [(host_ns, frame) for (host_ns, _), (_, frame) in zip(sent, mixed, strict=True)]


@settings(max_examples=200)
@given(
    seed=st.integers(0, 2**32),
    kind=st.sampled_from(["pcap", "pcapng", "gz"]),
    steps_back=st.booleans(),
)
def test_a_capture_in_files_gives_what_it_gave_as_a_whole(
    seed: int, kind: str, steps_back: bool
) -> None:
    pick = random.Random(seed)
    records = traffic(pick, steps_back)
    # No file may begin before the one that it continues.
    least = 4 if steps_back else 1
    parts = [records[:least]]
    for at in range(least, len(records), least):
        more = records[at : at + least]
        if len(more) == least and pick.random() < 0.2:
            parts.append(more)
        else:
            parts[-1] += more
    captures = [
        (f"trace.{kind}{number or ''}", capture_bytes(kind, part))
        for number, part in enumerate(parts)
    ]
    order = pick.sample(range(len(parts)), len(parts))
    with TemporaryDirectory() as folder:
        whole, expected = read_session(Path(folder), [("whole", capture_bytes(kind, records))])
        seen, counts = read_session(Path(folder), captures, order)
    assert counts == expected
    # Where times step back at a border, packets of both files are merged by their times.
    assert sorted(map(str, seen)) == sorted(map(str, whole))
    assert steps_back or seen == whole


def halves(payload: bytes, ident: int = 7) -> list[bytes]:
    """Both fragments of a datagram of two."""
    first, last = udp_frame(payload, ident=ident, mtu=1500)
    return [first, last]


def test_captures_that_overlap_do_not_mix_fragments(tmp_path: Path) -> None:
    """Two hosts, the same addresses and identifications; each lost a fragment of 7."""
    first, _ = halves(bytes([1] * 2000))
    _, last = halves(bytes([2] * 2000))
    plain = [udp_frame(bytes([9, i]), ident=100 + i, mtu=20 + 8 + 8)[0] for i in range(2)]
    left = [(10**18, first), (10**18 + 30_000_000, plain[0])]
    right = [(10**18 + 5_000_000, last), (10**18 + 40_000_000, plain[1])]
    seen, counts = read_session(
        tmp_path, [("left.pcap", pcap_bytes(left)), ("right.pcap", pcap_bytes(right))]
    )
    assert [one.payload for one in seen] == [bytes([9, 0]), bytes([9, 1])]
    assert counts == {"datagrams": 2, "fragment_lost": 2}


def test_two_rotated_captures_continue_each_its_own(tmp_path: Path) -> None:
    """Hosts whose files end at the same time, in datagrams of the same identification."""
    payloads = {"left": bytes([1] * 2000), "right": bytes([2] * 2000)}
    captures = []
    for number in (0, 1):
        for name, payload in payloads.items():
            at_ns = 10**18 + 50_000_000 * number
            plain = udp_frame(b"plain", ident=100 + number)[0]
            half = halves(payload)[number]
            # At the end of the first file, at the beginning of the second.
            both = (half, plain) if number else (plain, half)
            records = list(zip([at_ns, at_ns + 40_000_000], both, strict=True))
            captures.append((f"{name}_{number}.pcap", pcap_bytes(records)))
    for order in ((0, 1, 2, 3), (3, 2, 1, 0), (1, 0, 2, 3)):
        seen, counts = read_session(tmp_path, captures, order)
        assert sorted(one.payload for one in seen if len(one.payload) > 5) == [*payloads.values()]
        assert counts == {"datagrams": 6, "fragment": 2}


def test_a_datagram_is_not_continued_after_a_second(tmp_path: Path) -> None:
    first, last = halves(bytes(2000))
    captures = [
        (f"{number}.pcap", pcap_bytes([(10**18 + number * 1_000_000_001, frame)]))
        for number, frame in enumerate((first, last))
    ]
    assert read_session(tmp_path, captures) == ([], {"datagrams": 0, "fragment_lost": 2})
