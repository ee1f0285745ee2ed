"""Reassembly: the rules one by one, and the literal reassembler on any traffic."""

from __future__ import annotations

import random
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.readers.capture import dissector
from tests.builders.captures import (
    ipv4_packet,
    ipv6_piece,
    link_frame,
    udp_frame,
    write_pcap,
)
from tests.builders.reading import Seen, open_capture, read
from tests.reference.capture import dissect, pcap_frames

SECOND_NS = 1_000_000_000
MTU = 576  # 552 bytes of data a fragment
Records = list[tuple[int, bytes]]


def payload(seed: int, size: int = 1500) -> bytes:
    """Bytes that differ everywhere between seeds."""
    return random.Random(seed).randbytes(size)


def fragments(seed: int, ident: int = 1, src: str = "10.0.0.1", size: int = 1500) -> list[bytes]:
    """The frames of a datagram: three of them at the usual size."""
    return udp_frame(payload(seed, size), src, ident=ident, mtu=MTU)


def seen_and_skipped(
    records: Records, buffer_bytes: int | None = None, max_sets: int = dissector.MAX_SETS
) -> tuple[list[Seen], dict[str, int]]:
    """Packets and skipped frames, which must be those of the literal reassembler."""
    with TemporaryDirectory() as folder:
        path = write_pcap(Path(folder) / "a", records)
        expected, lost = dissect(pcap_frames(path.read_bytes()), max_sets)
        recording = open_capture(path, buffer_bytes=buffer_bytes)
        seen = read(recording)
        assert [(one.host_ns, one.stream, one.payload) for one in seen] == expected
        assert recording.counts.skipped == lost
        return seen, lost


def found(frames: list[bytes]) -> tuple[list[bytes], dict[str, int]]:
    """Payloads and skipped frames of frames received 1 us apart."""
    seen, skipped = seen_and_skipped([(i * 1000, frame) for i, frame in enumerate(frames)])
    return [one.payload for one in seen], skipped


def test_the_completing_fragment_gives_the_time() -> None:
    first, middle, last = fragments(1)
    seen, skipped = seen_and_skipped([(10, first), (30, last), (70, middle)])
    assert seen == [Seen(70, "10.0.0.1 > port 7502", payload(1))]
    assert skipped == {"fragment": 2}


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0), (1, 0, 2)])
def test_order_within_a_datagram_does_not_matter(order: tuple[int, ...]) -> None:
    frames = fragments(1)
    assert found([frames[i] for i in order]) == ([payload(1)], {"fragment": 2})


def test_sensors_interleave() -> None:
    one, two = fragments(1, src="10.0.0.1"), fragments(2, src="10.0.0.2")
    mixed = [frame for pair in zip(one, two, strict=True) for frame in pair]
    assert found(mixed) == ([payload(1), payload(2)], {"fragment": 4})


def test_plain_and_fragmented_packets_keep_the_order_of_completion() -> None:
    first, middle, last = fragments(1)
    (plain,), (later,) = udp_frame(b"plain"), udp_frame(b"later")
    expected = [b"plain", payload(1), b"later"]
    assert found([first, plain, middle, last, later])[0] == expected


def test_repeated_fragments_change_nothing() -> None:
    first, middle, last = fragments(1)
    frames = [first, first, middle, first, middle, last]
    assert found(frames) == ([payload(1)], {"fragment": 5})


def test_a_new_first_fragment_starts_over() -> None:
    old, new = fragments(1), fragments(2)
    assert found([*old[:2], *new]) == ([payload(2)], {"fragment_lost": 2, "fragment": 2})


def test_an_identification_is_used_again_at_once() -> None:
    frames = [*fragments(1), *fragments(2), *fragments(3)]
    assert found(frames) == ([payload(1), payload(2), payload(3)], {"fragment": 6})


def test_a_lost_fragment_loses_its_datagram_only() -> None:
    broken = fragments(1, ident=1)
    frames = [broken[0], *fragments(2, ident=2), broken[2], *fragments(3, ident=3)]
    expected = {"fragment": 4, "fragment_lost": 2}
    assert found(frames) == ([payload(2), payload(3)], expected)


@pytest.mark.parametrize(("age_ns", "whole"), [(SECOND_NS, True), (SECOND_NS + 1, False)])
def test_sets_older_than_a_second_are_dropped(age_ns: int, whole: bool) -> None:
    first, middle, last = fragments(1)
    seen, skipped = seen_and_skipped([(5, first), (5 + age_ns, middle), (5 + age_ns, last)])
    assert len(seen) == whole
    assert skipped == ({"fragment": 2} if whole else {"fragment_lost": 3})


def test_age_counts_when_the_clock_steps_back() -> None:
    first, middle, last = fragments(1)
    seen, skipped = seen_and_skipped(
        [(5 * SECOND_NS, first), (SECOND_NS, middle), (SECOND_NS, last)]
    )
    assert (seen, skipped) == ([], {"fragment_lost": 3})


@pytest.mark.parametrize(
    ("offset", "size", "more"),
    [(544, 552, True), (552, 544, True), (1656, 8, True), (552, 100, False)],
)
def test_fragments_that_contradict_drop_the_set(offset: int, size: int, more: bool) -> None:
    first, middle, last = fragments(1)
    packet = ipv4_packet(bytes(size), "10.0.0.1", "10.0.0.2", offset=offset, more=more)
    frames = [first, middle, link_frame(packet), last]
    assert found(frames) == ([], {"fragment_lost": 4})


def test_fragments_beyond_the_largest_datagram_are_lost() -> None:
    packet = ipv4_packet(bytes(1000), "10.0.0.1", "10.0.0.2", offset=65000, more=False)
    assert found([*fragments(1)[:1], link_frame(packet)]) == ([], {"fragment_lost": 2})


def test_a_datagram_shorter_than_its_udp_length_is_lost() -> None:
    udp = (7).to_bytes(2, "big") * 2 + (3000).to_bytes(2, "big") + bytes(1002)
    frames = [
        link_frame(ipv4_packet(udp[:504], "10.0.0.1", "10.0.0.2", more=True)),
        link_frame(ipv4_packet(udp[504:], "10.0.0.1", "10.0.0.2", offset=504)),
    ]
    assert found(frames) == ([], {"fragment_lost": 2})


def test_the_udp_length_cuts_a_longer_datagram() -> None:
    udp = (7).to_bytes(2, "big") * 2 + (600).to_bytes(2, "big") + bytes(1002)
    frames = [
        link_frame(ipv4_packet(udp[:504], "10.0.0.1", "10.0.0.2", more=True)),
        link_frame(ipv4_packet(udp[504:], "10.0.0.1", "10.0.0.2", offset=504)),
    ]
    assert found(frames)[0] == [bytes(592)]


def test_fragments_of_other_protocols_are_not_udp() -> None:
    packet = ipv4_packet(bytes(800), "10.0.0.1", "10.0.0.2", more=True, protocol=6)
    assert found([link_frame(packet)]) == ([], {"not_udp": 1})


def test_destinations_keep_sets_apart() -> None:
    frames = [udp_frame(payload(i), "10.0.0.1", f"10.0.1.{i}", mtu=MTU) for i in (1, 2)]
    mixed = [frame for pair in zip(*frames, strict=True) for frame in pair]
    assert found(mixed)[0] == [payload(1), payload(2)]


def test_ipv6_fragments_interleave_with_ipv4() -> None:
    six = udp_frame(payload(6), "fe80::1", "fe80::2", mtu=600)
    four = fragments(4)
    mixed = [frame for pair in zip(six, four, strict=True) for frame in pair]
    assert found(mixed) == ([payload(6), payload(4)], {"fragment": 4})


def test_open_sets_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dissector, "MAX_SETS", 3)
    sets = [fragments(i, ident=i) for i in range(5)]
    frames = [one[0] for one in sets] + [frame for one in sets for frame in one[1:]]
    seen, skipped = seen_and_skipped([(0, frame) for frame in frames], max_sets=3)
    # The first fragments of sets 3 and 4 drop sets 0 and 1; their further fragments open sets
    # again and drop 2, 3 and 4 one by one.
    assert seen == []
    assert skipped == {"fragment_lost": 15}


def test_large_held_sets_do_not_overflow_the_arena() -> None:
    # 60 datagrams of 60 kB each wait for their last fragments, which come all at once.
    sets = [udp_frame(payload(i, 60_000), ident=i, mtu=9000) for i in range(60)]
    frames = [f for one in sets for f in one[:-1]] + [one[-1] for one in sets]
    seen, skipped = seen_and_skipped([(0, f) for f in frames], buffer_bytes=50_000)
    assert [one.payload for one in seen] == [payload(i, 60_000) for i in range(60)]
    assert skipped == {"fragment": 6 * 60}


def feed(seed: int) -> Records:
    """Datagrams of few sources and identifications, damaged in every way a network can."""
    pick = random.Random(seed)
    frames: list[bytes] = []
    for i in range(pick.randint(1, 25)):
        source = f"10.0.0.{pick.randint(1, 2)}"
        frames += fragments(i, pick.randint(1, 3), source, 1300 + i % 3)
    for _ in range(pick.choice([0, 1, 3, 9])):
        at, to = pick.randrange(len(frames)), pick.randrange(len(frames))
        deed = pick.choice(["drop", "repeat", "move", "swap"])
        if deed == "swap":
            frames[at], frames[to] = frames[to], frames[at]
        elif deed == "repeat":
            frames.insert(to, frames[at])
        elif len(frames) > 1:
            taken = frames.pop(at)
            if deed == "move":
                frames.insert(min(to, len(frames)), taken)
    # A third of the clocks step back between queues, another third is set back.
    back_ns = pick.choice([1000, -3000, -2 * SECOND_NS])
    steps_ns = [0, 1000, 1000, 1000, 300_000_000, back_ns]
    host_ns, records = 1000 * SECOND_NS, []
    for frame in frames:
        records.append((host_ns, frame))
        host_ns += pick.choice(steps_ns)
    return records


@settings(max_examples=400)
@given(
    seed=st.integers(0, 2**32),
    buffer_bytes=st.sampled_from([100, 1000, 2000, 5000, 20_000, 100_000]),
)
def test_any_traffic_through_any_buffer_is_joined_by_the_rules(
    seed: int, buffer_bytes: int
) -> None:
    seen_and_skipped(feed(seed), buffer_bytes)


@settings(max_examples=300)
@given(
    pieces=st.lists(
        st.tuples(
            st.integers(1, 2),
            st.sampled_from(["10.0.0.1", "10.0.0.2", "fe80::1"]),
            st.integers(0, 5),
            st.integers(1, 3),
            st.booleans(),
            st.booleans(),
        ),
        max_size=60,
    ),
    buffer_bytes=st.sampled_from([100, 300, 4096]),
)
def test_pieces_of_any_place_and_size_are_joined_by_the_rules(
    pieces: list[tuple[int, str, int, int, bool, bool]], buffer_bytes: int
) -> None:
    """Overlaps, gaps, repeats and several ends of few datagrams, in any order."""
    content = (7).to_bytes(2, "big") * 2 + (40).to_bytes(2, "big") + bytes(range(6, 80))
    records = []
    for number, (ident, source, unit, units, more, differs) in enumerate(pieces):
        data = bytearray(content[8 * unit : 8 * (unit + units)])
        data[-1] += differs
        six = ":" in source
        build, target = (ipv6_piece, "fe80::2") if six else (ipv4_packet, "10.0.0.9")
        packet = build(bytes(data), source, target, ident=ident, offset=8 * unit, more=more)
        frame = link_frame(packet, version=6 if six else 4)
        records.append((number * 1000 - (number % 5 == 0) * 2000 + 10_000, frame))
    seen_and_skipped(records, buffer_bytes)


def test_parts_that_wait_are_few_bytes_again() -> None:
    """Every datagram but the last of a window waits for a fragment that comes a window later."""
    late: list[bytes] = []
    frames: list[bytes] = []
    for i in range(300):
        *first, last = fragments(i, ident=i)
        frames += first + late[-20:-19]
        late.append(last)
    seen, skipped = seen_and_skipped([(0, f) for f in frames], buffer_bytes=3000)
    assert [one.payload for one in seen] == [payload(i) for i in range(280)]
    assert skipped == {"fragment": 2 * 280, "fragment_lost": 2 * 20}
