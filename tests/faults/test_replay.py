"""Faults by hand: what each spec means, and what it does to a few packets."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.errors import UsageError
from mlbatch.faults import specs as chance
from mlbatch.faults.replay import KINDS, FaultCount, FaultLedger, FaultReplay, parse_fault
from mlbatch.types import Message, PacketBatch, Topic

MS, S = 10**6, 10**9
BEGIN_NS = 1_700_000_000 * S
NAMES = ["left", "right"]


# -- specs --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "share"), [("drop:left:5%", 0.05), ("dup:*:2.5%", 0.025), ("bitflip:a:b:100%", 1.0)]
)
def test_shares_are_percentages(text: str, share: float) -> None:
    fault = parse_fault(text)
    assert (fault.text, fault.share) == (text, share)
    assert f"{fault.kind}:{fault.sensor}" == text.rpartition(":")[0]


@pytest.mark.parametrize(
    ("text", "begin_ns", "end_ns"),
    [
        ("stall:left:5s-8s", 5 * S, 8 * S),
        ("stall:left:0.5s-500.000001ms", 500 * MS, 500 * MS + 1),
        # From the begin on means all before, too: the recorder's clock may step back.
        ("stall:left:0s-1us", -(2**62), 1000),
        ("late:left:2s", -(2**62), 2 * S),
        ("early:left:3s", 3 * S, 2**62),
        ("jump:left:37s@10s", 10 * S, 2**62),
        ("jump:left:1ns@0s", -(2**62), 2**62),
    ],
)
def test_times_count_from_the_first_packet(text: str, begin_ns: int, end_ns: int) -> None:
    assert parse_fault(text).window_ns == (begin_ns, end_ns)


@pytest.mark.parametrize(
    ("text", "by_ns"),
    [
        ("delay:left:60ms", 60 * MS),
        ("delay:left:.25us", 250),
        ("jump:left:-37s@10s", -37 * S),
        ("jump:left:+1.5ms@1s", 1_500_000),
    ],
)
def test_steps_may_be_negative(text: str, by_ns: int) -> None:
    assert parse_fault(text).by_ns == by_ns


@pytest.mark.parametrize(("text", "ppm"), [("50ppm", 50.0), ("-0.5ppm", -0.5)])
def test_drifts_are_parts_per_million(text: str, ppm: float) -> None:
    assert parse_fault(f"drift:left:{text}").drift_ppm == ppm


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "wanted one of drop, "),
        ("dropp:left:5%", "got 'dropp'; did you mean drop?"),
        ("drop", "wanted drop:SENSOR:VALUE, got 'drop'; write drop:left:5%"),
        ("drop:left", "write drop:left:5%"),
        ("drop::5%", "wanted drop:SENSOR:VALUE"),
        ("drop:front:5", "got '5'; write drop:front:5%"),
        ("drop:left:0%", "above 0% and up to 100%"),
        ("drop:left:101%", "up to 100%, got '101%'"),
        ("drop:left:nan%", "got 'nan%'"),
        ("drop:left:-5%", "got '-5%'"),
        ("stall:left:8s-5s", "a first time before a last one"),
        ("stall:left:5s", "got '5s'; write stall:left:5s-8s"),
        ("stall:left:5-8", "write stall:left:5s-8s"),
        ("late:left:0s", "a time above 0"),
        ("late:left:-2s", "got '-2s'"),
        ("early:left:3", "units ns, us, ms, s"),
        ("early:left:1000000001s", "up to 1000000000s"),
        ("delay:left:0ms", "above 0, up to 60s"),
        ("delay:left:-5ms", "above 0, up to 60s"),
        ("delay:left:61s", "up to 60s, got '61s'"),
        ("jump:left:37s", "write jump:left:37s@10s"),
        ("jump:left:0s@10s", "a step other than 0"),
        ("jump:left:37s@-10s", "a time after the first packet"),
        ("drift:left:0ppm", "other than 0"),
        ("drift:left:50", "write drift:left:50ppm"),
        ("drift:left:100001ppm", "up to 100000ppm"),
        (f"delay:left:{'9' * 400}s", "..."),
        ("delay:left:٦s", "got '٦s'"),
    ],
)
def test_mistakes_are_told_in_one_line(text: str, words: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_fault(text)
    line = str(caught.value)
    assert line.startswith("--fault")
    assert words in line
    assert "\n" not in line
    assert len(line) < 250


@pytest.mark.parametrize(
    ("sensor", "advice"), [("lft", "did you mean left?"), ("zoo", "write * for all of them")]
)
def test_a_fault_names_a_sensor_of_the_session(sensor: str, advice: str) -> None:
    with pytest.raises(UsageError, match=f"one of left, right, got '{sensor}'") as caught:
        FaultReplay([parse_fault(f"drop:{sensor}:5%")], 0, NAMES)
    assert str(caught.value).endswith(advice)


# -- packets ------------------------------------------------------------------------------------

# (milliseconds after the begin, number of the sensor, payload)
Seen = tuple[int, int, bytes]
FEED: list[Seen] = [
    (0, 0, b"a0"),
    (1, 1, b"b0"),
    (10, 0, b"a1"),
    (11, -1, b"c0"),
    (20, 0, b"a2"),
    (21, 1, b"b1"),
    (30, 0, b"a3"),
]


def batches(feed: Sequence[Seen], each: int) -> Iterator[PacketBatch]:
    """The feed in batches of `each` packets, in one buffer that is reused."""
    data = np.zeros(64, np.uint8)
    for at in range(0, len(feed), each):
        part = feed[at : at + each]
        payload = b"".join(one[2] for one in part)
        data[:] = 0
        data[: len(payload)] = np.frombuffer(payload, np.uint8)
        size = np.array([len(one[2]) for one in part], np.int64)
        host_ns = np.array([BEGIN_NS + one[0] * MS for one in part], np.int64)
        sensor = np.array([one[1] for one in part], np.int64)
        yield PacketBatch(data, np.cumsum(size) - size, size, sensor, host_ns)


def owner(batch: PacketBatch) -> I64Array:
    """Streams are numbered as sensors here."""
    return batch.stream


def replay(specs: str, each: int = 100, seed: int = 0) -> tuple[list[Seen], FaultReplay]:
    """The feed with faults (separated by blanks), as far as it can be told."""
    faults = FaultReplay([parse_fault(spec) for spec in specs.split()], seed, NAMES)
    seen = []
    for batch in faults.batches(batches(FEED, each), owner):
        for start, size, stream, host_ns in zip(
            batch.start, batch.size, batch.stream, batch.host_ns, strict=True
        ):
            late_ms, rest = divmod(int(host_ns) - BEGIN_NS, MS)
            assert rest == 0
            seen.append((late_ms, int(stream), batch.data[start : start + size].tobytes()))
    return seen, faults


def without(*payloads: bytes) -> list[Seen]:
    """The feed without some packets."""
    return [one for one in FEED if one[2] not in payloads]


@pytest.mark.parametrize("each", [1, 3, 100])
@pytest.mark.parametrize(
    ("specs", "gone"),
    [
        ("drop:right:100%", (b"b0", b"b1")),
        ("drop:*:100%", (b"a0", b"a1", b"a2", b"a3", b"b0", b"b1")),
        # A time belongs to the fault that begins with it.
        ("stall:left:10ms-30ms", (b"a1", b"a2")),
        ("late:left:10ms", (b"a0",)),
        ("early:left:10ms", (b"a1", b"a2", b"a3")),
        ("late:right:1s early:left:25ms", (b"b0", b"b1", b"a3")),
    ],
)
def test_what_is_removed(specs: str, gone: tuple[bytes, ...], each: int) -> None:
    seen, faults = replay(specs, each)
    assert seen == without(*gone)
    assert sum(count.packets for count in faults.counts) == len(gone)
    assert sum(ledger.removed for ledger in faults.ledgers) == len(gone)


@pytest.mark.parametrize("each", [1, 2, 3, 100])
def test_a_delayed_sensor_is_merged_by_its_new_arrivals(each: int) -> None:
    seen, faults = replay("delay:left:11ms", each)
    # At 11, 21 and 31 ms two packets meet: the one that was sent first goes first.
    assert seen == [
        (1, 1, b"b0"),
        (11, 0, b"a0"),
        (11, -1, b"c0"),
        (21, 0, b"a1"),
        (21, 1, b"b1"),
        (31, 0, b"a2"),
        (41, 0, b"a3"),
    ]
    assert faults.counts == (FaultCount("delay:left:11ms", 4),)


@pytest.mark.parametrize("each", [1, 2, 3, 100])
def test_every_other_packet_overtakes_if_all_are_to_be_overtaken(each: int) -> None:
    seen, faults = replay("reorder:left:100%", each)
    assert seen == [
        (1, 1, b"b0"),
        (10, 0, b"a1"),
        (10, 0, b"a0"),
        (11, -1, b"c0"),
        (21, 1, b"b1"),
        (30, 0, b"a3"),
        (30, 0, b"a2"),
    ]
    assert faults.counts == (FaultCount("reorder:left:100%", 2),)


@pytest.mark.parametrize("each", [1, 2, 100])
def test_a_packet_that_nothing_overtakes_comes_at_the_end(each: int) -> None:
    seen, faults = replay("early:left:25ms reorder:left:100%", each)
    assert seen == [
        (1, 1, b"b0"),
        (10, 0, b"a1"),
        (10, 0, b"a0"),
        (11, -1, b"c0"),
        (21, 1, b"b1"),
        (30, 0, b"a2"),
    ]
    assert [count.packets for count in faults.counts] == [1, 1]


@pytest.mark.parametrize("each", [1, 3, 100])
def test_copies_follow_at_once(each: int) -> None:
    seen, faults = replay("dup:right:100%", each)
    assert seen == [one for one in FEED for _ in range(2 if one[1] == 1 else 1)]
    assert faults.ledgers == (FaultLedger(4, 0, 0, 4), FaultLedger(2, 0, 2, 4))


@pytest.mark.parametrize("each", [1, 3, 100])
def test_one_bit_flips(each: int) -> None:
    seen, faults = replay("bitflip:left:100%", each)
    assert [one[:2] for one in seen] == [one[:2] for one in FEED]
    for (_, sensor, payload), (_, _, before) in zip(seen, FEED, strict=True):
        difference = int.from_bytes(payload, "big") ^ int.from_bytes(before, "big")
        assert difference.bit_count() == (1 if sensor == 0 else 0)
    assert faults.counts == (FaultCount("bitflip:left:100%", 4),)


def test_a_packet_may_be_hit_twice() -> None:
    """Each fault draws its own bit; a copy of a damaged packet is as damaged."""
    seen, _ = replay("bitflip:left:100% bitflip:left:100% dup:left:100%")
    damaged = [payload for _, sensor, payload in seen if sensor == 0]
    assert damaged[::2] == damaged[1::2]
    flips = {
        (int.from_bytes(now, "big") ^ int.from_bytes(before, "big")).bit_count()
        for now, before in zip(damaged[::2], [b"a0", b"a1", b"a2", b"a3"], strict=True)
    }
    assert flips <= {0, 2}
    assert 2 in flips


@pytest.mark.parametrize("each", [1, 3, 100])
def test_truncated_payloads_are_shorter_and_not_empty(each: int) -> None:
    seen, faults = replay("truncate:right:100%", each)
    # Of two bytes one is left.
    assert seen == [(ms, s, data[:1] if s == 1 else data) for ms, s, data in FEED]
    assert faults.counts == (FaultCount("truncate:right:100%", 2),)


def test_faults_act_in_one_order() -> None:
    """Removed first: a packet is overtaken by the next one that is left."""
    seen, faults = replay("reorder:left:100% stall:left:5ms-15ms")
    assert [data for _, sensor, data in seen if sensor == 0] == [b"a2", b"a0", b"a3"]
    assert [count.packets for count in faults.counts] == [1, 1]


def test_messages_stay_in_their_batches_in_order() -> None:
    """Also where no packet is left of a batch."""
    topic = Topic("/imu", "sensor_msgs/Imu", "cdr")
    source = []
    for number, batch in enumerate(batches(FEED, 2)):
        batch.data = batch.data.copy()
        batch.messages = (Message(topic, number, b""), Message(topic, number, b"x"))
        source.append(batch)
    faults = FaultReplay([parse_fault("drop:*:100%")], 0, NAMES)
    given = list(faults.batches(iter(source), owner))
    assert [len(batch) for batch in given] == [0, 1, 0, 0]
    assert [(one.host_ns, one.data) for batch in given for one in batch.messages] == [
        (number, data) for number in range(4) for data in (b"", b"x")
    ]


def test_the_readers_bytes_are_left_alone() -> None:
    batch = next(batches(FEED, 100))
    batch.data.flags.writeable = False
    for array in (batch.start, batch.size, batch.stream, batch.host_ns):
        array.flags.writeable = False
    specs = ["bitflip:*:100%", "truncate:*:100%", "reorder:*:100%", "delay:*:5ms", "dup:*:100%"]
    faults = FaultReplay([parse_fault(spec) for spec in specs], 0, NAMES)
    assert sum(len(one) for one in faults.batches(iter([batch]), owner)) == 13


def test_times_count_from_the_first_packet_of_a_sensor() -> None:
    """What else a capture holds, and a bag does not, must not move them."""
    start, size, stream, host_ns = (np.array([one]) for one in (0, 8, -1, BEGIN_NS - 50 * MS))
    first = PacketBatch(np.zeros(8, np.uint8), start, size, stream, host_ns)
    faults = FaultReplay([parse_fault("late:left:10ms")], 0, NAMES)
    given = faults.batches(iter([first, *batches(FEED, 100)]), owner)
    assert sum(len(batch) for batch in given) == 1 + 6
    assert faults.begin_ns == BEGIN_NS


# -- clocks -------------------------------------------------------------------------------------


def at_ms(*moments: int) -> I64Array:
    """Arrivals."""
    return BEGIN_NS + MS * np.array(moments, np.int64)


def test_a_jump_shifts_all_that_arrives_from_then_on() -> None:
    seen, faults = replay("jump:left:-37s@20ms")
    assert seen == FEED
    assert faults.shift_ns(0, at_ms(0, 19, 20, 21)).tolist() == [0, 0, -37 * S, -37 * S]
    assert faults.shift_ns(1, at_ms(0, 20)).tolist() == [0, 0]
    assert faults.counts == (FaultCount("jump:left:-37s@20ms", 2),)


def test_a_drift_grows_with_time() -> None:
    _, faults = replay("drift:*:50ppm")
    # 50 microseconds a second: half a microsecond after 10 ms, 3 ms after a minute.
    for sensor in (0, 1):
        assert faults.shift_ns(sensor, at_ms(0, 10, 60_000)).tolist() == [0, 500, 3 * MS]


def test_shifts_add_up() -> None:
    _, faults = replay("drift:left:-1ppm jump:left:1s@1s jump:*:5s@2s")
    shifts = faults.shift_ns(0, at_ms(1000, 2000)).tolist()
    assert shifts == [S - 1000, 6 * S - 2000]


def test_a_clock_does_not_see_the_delay() -> None:
    """The sensor's clock jumps when it does, however late its packets arrive."""
    _, faults = replay("delay:left:60ms jump:left:1s@20ms")
    assert faults.shift_ns(0, at_ms(79, 80)).tolist() == [0, S]


# -- chance -------------------------------------------------------------------------------------


def test_numbers_are_those_of_splitmix64() -> None:
    """As the generator's authors' C code gives them for the seed 1234567."""
    drawn = chance.draw(np.full(3, 1234567, np.uint64), np.arange(3))
    assert drawn.tolist() == [6457827717110365317, 3203168211198807973, 9817491932198370423]


def test_shares_are_exact_at_their_ends() -> None:
    drawn = np.array([0, 2**63 - 1, 2**63, 2**64 - 1], np.uint64)
    assert chance.falls_below(drawn, 0.5).tolist() == [True, True, False, False]
    assert chance.falls_below(drawn, 1.0).all()


def test_seeds_faults_and_sensors_draw_apart() -> None:
    sources = {
        chance.source(seed, fault, name)
        for seed in range(10)
        for fault in range(10)
        for name in ("left", "right", "top")
    }
    assert len(sources) == 300


def test_every_kind_is_described() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "faults.md").read_text("utf-8")
    assert re.findall(r"^\| `(\w+):", page, re.MULTILINE) == list(KINDS)
    for spec in re.findall(r"\w+:(?:left|\*):[^`\s]+", page):
        parse_fault(spec)
