"""Reassembly: the rules one by one, and the literal reassembler on any traffic."""

from __future__ import annotations

import random
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.readers.capture import dissector
from tests.builders.captures import ipv4_packet, ipv6_piece, link_frame, udp_frame, write_pcap
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


def test_the_completing_fragment_gives_the_time() -> None:
    first, middle, last = fragments(1)
    seen, skipped = seen_and_skipped([(10, first), (30, last), (70, middle)])
    assert seen == [Seen(70, "10.0.0.1 > port 7502", payload(1))]
    assert skipped == {"fragment": 2}


def mixed(*datagrams: list[bytes]) -> list[bytes]:
    """Frames of datagrams in turn."""
    return [frame for frames in zip(*datagrams, strict=True) for frame in frames]


def piece(data: bytes, offset: int = 0, *, more: bool, protocol: int = 17) -> bytes:
    """A fragment of the sender and identification of `fragments(1)`."""
    return link_frame(
        ipv4_packet(data, "10.0.0.1", "10.0.0.2", offset=offset, more=more, protocol=protocol)
    )


def of_length(length: int) -> list[bytes]:
    """Fragments of 1010 bytes whose UDP header states another length."""
    udp = (7).to_bytes(2, "big") * 2 + length.to_bytes(2, "big") + bytes(1002)
    return [piece(udp[:504], more=True), piece(udp[504:], 504, more=False)]


FIRST, MIDDLE, LAST = fragments(1)
(PLAIN,), (LATER,) = udp_frame(b"plain"), udp_frame(b"later")
# Frames, and the payloads and skipped frames that they give.
RULES: Mapping[str, tuple[list[bytes], list[bytes], dict[str, int]]] = {
    **{
        f"order {order}": ([fragments(1)[at] for at in order], [payload(1)], {"fragment": 2})
        for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0), (1, 0, 2))
    },
    "sensors interleave": (
        mixed(fragments(1, src="10.0.0.1"), fragments(2, src="10.0.0.2")),
        [payload(1), payload(2)],
        {"fragment": 4},
    ),
    "destinations keep sets apart": (
        mixed(*(udp_frame(payload(i), "10.0.0.1", f"10.0.1.{i}", mtu=MTU) for i in (1, 2))),
        [payload(1), payload(2)],
        {"fragment": 4},
    ),
    "IPv6 and IPv4 interleave": (
        mixed(udp_frame(payload(6), "fe80::1", "fe80::2", mtu=600), fragments(4)),
        [payload(6), payload(4)],
        {"fragment": 4},
    ),
    "the order is that of completion": (
        [FIRST, PLAIN, MIDDLE, LAST, LATER],
        [b"plain", payload(1), b"later"],
        {"fragment": 2},
    ),
    "repeated fragments change nothing": (
        [FIRST, FIRST, MIDDLE, FIRST, MIDDLE, LAST],
        [payload(1)],
        {"fragment": 5},
    ),
    "a new first fragment starts over": (
        [FIRST, MIDDLE, *fragments(2)],
        [payload(2)],
        {"fragment_lost": 2, "fragment": 2},
    ),
    "an identification is used again at once": (
        [*fragments(1), *fragments(2), *fragments(3)],
        [payload(1), payload(2), payload(3)],
        {"fragment": 6},
    ),
    "a lost fragment loses its datagram only": (
        [FIRST, *fragments(2, ident=2), LAST, *fragments(3, ident=3)],
        [payload(2), payload(3)],
        {"fragment": 4, "fragment_lost": 2},
    ),
    **{
        f"contradiction at {offset}": (
            [FIRST, MIDDLE, piece(bytes(size), offset, more=more), LAST],
            [],
            {"fragment_lost": 4},
        )
        for offset, size, more in (
            *((544, 552, True), (552, 544, True)),
            *((1656, 8, True), (552, 100, False)),
        )
    },
    "beyond the largest datagram": (
        [FIRST, piece(bytes(1000), 65000, more=False)],
        [],
        {"fragment_lost": 2},
    ),
    "shorter than its UDP length": (of_length(3000), [], {"fragment_lost": 2}),
    "longer than its UDP length": (of_length(600), [bytes(592)], {"fragment": 1}),
    "another protocol": ([piece(bytes(800), more=True, protocol=6)], [], {"not_udp": 1}),
}


@pytest.mark.parametrize("name", RULES)
def test_rules_of_reassembly(name: str) -> None:
    frames, payloads, skipped = RULES[name]
    seen, found = seen_and_skipped([(i * 1000, frame) for i, frame in enumerate(frames)])
    assert ([one.payload for one in seen], found) == (payloads, skipped)


@pytest.mark.parametrize(
    ("begin_ns", "next_ns", "skipped"),
    [
        (5, 5 + SECOND_NS, {"fragment": 2}),
        (5, 6 + SECOND_NS, {"fragment_lost": 3}),
        # Also where the clock steps back.
        (5 * SECOND_NS, SECOND_NS, {"fragment_lost": 3}),
    ],
)
def test_sets_older_than_a_second_are_dropped(
    begin_ns: int, next_ns: int, skipped: dict[str, int]
) -> None:
    records = [(begin_ns, FIRST), (next_ns, MIDDLE), (next_ns, LAST)]
    seen, found = seen_and_skipped(records)
    assert (len(seen), found) == ("fragment" in skipped, skipped)


def test_open_sets_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dissector, "MAX_SETS", 3)
    sets = [fragments(i, ident=i) for i in range(5)]
    frames = [one[0] for one in sets] + [frame for one in sets for frame in one[1:]]
    seen, skipped = seen_and_skipped([(0, frame) for frame in frames], max_sets=3)
    # The first fragments of sets 3 and 4 drop sets 0 and 1; their further fragments open sets
    # again and drop 2, 3 and 4 one by one.
    assert seen == []
    assert skipped == {"fragment_lost": 15}


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
