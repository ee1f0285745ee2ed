"""Hour, rotor speed and firing sequence of a Velodyne (docs/sources/velodyne.md)."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.lidar.interface import Evidence, NeighbourStream
from mlbatch.sensors.velodyne import sensor as velodyne
from mlbatch.sensors.velodyne.clock import (
    HOUR_NS,
    absolute_ns,
    clock_offset_ns,
    measured_sequence_ns,
    pulse,
    rmc_ns,
    rotor_speed,
)
from mlbatch.simulate.velodyne.encode import (
    Sent,
    VelodyneSpec,
    encode,
    firing_times_ns,
    position_packets,
)
from mlbatch.types import Stream

STREAM, POSITIONS = Stream("192.168.1.201", 2368), Stream("192.168.1.201", 8308)
SECOND_NS, HALF_NS = 1_000_000_000, HOUR_NS // 2
# 21 January 2016, 08:18:02 UTC: the sentence of the sheet's recording, section 8.
RMC_NS = 1_453_364_282 * SECOND_NS


def rmc(body: bytes, checksum: int | None = None) -> bytes:
    if checksum is None:
        checksum = 0
        for byte in body:
            checksum ^= byte
    return b"$" + body + b"*%02X\r\n\0\0" % checksum


class TestSentences:
    def test_a_valid_one(self) -> None:
        body = b"GPRMC,081802,A,3650.1,N,00224.4,W,000.0,123.2,210116,000.5,W"
        assert rmc_ns(rmc(body)) == RMC_NS
        assert rmc_ns(rmc(body.replace(b"081802", b"081802.25"))) == RMC_NS + SECOND_NS // 4
        assert rmc_ns(rmc(body.replace(b"GPRMC", b"GNRMC"))) == RMC_NS

    @pytest.mark.parametrize(
        ("old", "new"),
        [
            (b",A,", b",V,"),
            (b"081802", b"0818"),
            (b"081802", b""),
            (b"081802", b"251802"),
            (b"210116", b"211316"),
            (b"210116", b""),
            (b",123.2,210116,000.5,W", b""),
            (b"GPRMC", b"GPGGA"),
        ],
    )
    def test_those_without_a_time(self, old: bytes, new: bytes) -> None:
        body = b"GPRMC,081802,A,3650.1,N,00224.4,W,000.0,123.2,210116,000.5,W"
        assert old in body
        assert rmc_ns(rmc(body.replace(old, new))) is None

    def test_a_wrong_checksum_and_no_sentence(self) -> None:
        body = b"GPRMC,081802,A,3650.1,N,00224.4,W,000.0,123.2,210116,000.5,W"
        assert rmc_ns(rmc(body, 0)) is None
        assert rmc_ns(b"\0" * 128) is None
        assert rmc_ns(b"$" + body) is None


class TestHours:
    def test_the_nearest_hour_of_random_cases(self) -> None:
        rng = np.random.default_rng(3)
        true_ns = rng.integers(10**18, 2 * 10**18, 20_000) // 1000 * 1000
        error_ns = rng.integers(-1700, 1700, 20_000) * SECOND_NS
        assert (absolute_ns(true_ns % HOUR_NS, true_ns + error_ns) == true_ns).all()

    def test_around_half_an_hour_all_packets_get_one_hour(self) -> None:
        """The capture host is half an hour ahead, give or take its jitter."""
        spec = VelodyneSpec("VLP-16", host_ahead_ns=HALF_NS)
        sent = random_packets(spec, 200)
        jitter_ns = np.random.default_rng(1).integers(-(10**9), 10**9, len(sent.host_ns))
        host_ns = sent.host_ns + jitter_ns
        lidar = built_in("VLP-16").lidar(
            {}, Evidence(STREAM, 1206, sent.payloads[:16], host_ns[:16])
        )
        stamp_ns = lidar.column_headers(sent.payloads, host_ns).stamp_ns.reshape(-1)
        assert (np.diff(stamp_ns) > 0).all()
        away_ns = stamp_ns - firing_times_ns(spec, np.arange(len(stamp_ns)))[:, 0]
        assert set(np.rint(away_ns / HOUR_NS).tolist()) < {0.0, 1.0}

    def test_a_stream_across_the_full_hour(self) -> None:
        spec = VelodyneSpec("VLP-32C", start_us=3_599_990_000.0, host_ahead_ns=-900 * SECOND_NS)
        sent = random_packets(spec, 60)
        evidence = Evidence(STREAM, 1206, sent.payloads[:16], sent.host_ns[:16])
        stamp_ns = (
            built_in("VLP-32C").lidar({}, evidence).column_headers(sent.payloads, sent.host_ns)
        )
        wanted_ns = firing_times_ns(spec, np.arange(60 * 12))[:, 0]
        assert np.abs(stamp_ns.stamp_ns.reshape(-1) - wanted_ns).max() <= 500

    def test_no_clock_at_all_gives_no_stamps_before_1970(self) -> None:
        for start_us in (10.0, 1_800_000_000.0, 3_599_000_000.0):
            sent = random_packets(VelodyneSpec("VLP-16", start_us=start_us), 30)
            host_ns = np.zeros(30, np.int64)
            evidence = Evidence(STREAM, 1206, sent.payloads[:16], host_ns[:16])
            headers = built_in("VLP-16").lidar({}, evidence).column_headers(sent.payloads, host_ns)
            assert (headers.stamp_ns >= 0).all()

    def test_position_packets_override_receive_times(self) -> None:
        spec = VelodyneSpec("VLP-16", host_ahead_ns=-7 * HOUR_NS - 1234)
        sent = random_packets(spec, 16)
        for valid, hours in ((True, 0), (False, -7)):
            times_us = np.arange(0, 4e6, 1e6, dtype=np.float64)
            neighbour = beside_of(position_packets(spec, times_us, valid=valid))
            offset_ns = clock_offset_ns(sent.payloads, sent.host_ns, [neighbour])
            away_ns = -spec.host_ahead_ns + hours * HOUR_NS
            assert offset_ns == pytest.approx(away_ns, abs=3_000_000)

    def test_nothing_is_no_offset(self) -> None:
        assert clock_offset_ns(np.zeros((0, 1206), np.uint8), np.zeros(0, np.int64), []) == 0


def test_what_positions_say_of_the_pulse() -> None:
    spec = VelodyneSpec("VLP-16")
    times_us = np.arange(3, dtype=np.float64)
    sent = [position_packets(spec, times_us, pps=state) for state in range(4)]
    words = [pulse([beside_of(one)]) for one in sent]
    assert words == ["no PPS", "PPS synchronising", "PPS locked", "PPS error"]
    assert pulse([]) == ""
    # Packets of another size, and of the same size but of another kind.
    noise = np.random.default_rng(2).integers(0, 256, (3, 512), np.uint8)
    other = NeighbourStream(STREAM, 1206, np.zeros((3, 1206), np.uint8), np.zeros(3, np.int64))
    assert pulse([other, NeighbourStream(POSITIONS, 512, noise, np.zeros(3, np.int64))]) == ""


class TestSpeeds:
    def test_of_a_rotor_by_packets_of_many_revolutions(self) -> None:
        """600.06 rpm, azimuths rounded to 0.01 degree, samples as the sampler takes them."""
        stamp_ns = times_ns() + HOUR_NS - SECOND_NS
        azimuth = np.rint(stamp_ns * 3.60036e-4).astype(np.int64) % 36000
        speed = rotor_speed(stamp_ns % HOUR_NS, azimuth, None)
        assert speed == pytest.approx(3.60036e-4, rel=1e-6)

    def test_of_one_packet_is_that_within_it(self) -> None:
        one = np.zeros(1, np.int64)
        assert rotor_speed(one, one, 3.5e-4) == 3.5e-4
        assert rotor_speed(one, one, None) is None
        assert rotor_speed(one, one, 0.0) is None

    def test_of_sequences(self) -> None:
        """Stamps are whole us; a lost packet leaves a step twice as long."""
        stamp_ns = np.rint(np.arange(16) * 165.832).astype(np.int64) * 1000
        assert measured_sequence_ns(stamp_ns, 3) == pytest.approx(55_277, abs=25)
        assert measured_sequence_ns(np.delete(stamp_ns, 5), 3) == pytest.approx(55_277, abs=40)
        # What comes later is chosen by receive time, and must not count where enough is known.
        more_ns = np.append(stamp_ns, stamp_ns[-1] + np.arange(1, 9) * 166_000)
        assert measured_sequence_ns(more_ns, 3) == measured_sequence_ns(stamp_ns, 3)
        # They are the last resort.
        assert measured_sequence_ns(np.append(np.zeros(16, np.int64), stamp_ns), 3) is not None
        assert measured_sequence_ns(stamp_ns[:4], 3) is None
        assert measured_sequence_ns(stamp_ns * 2, 3) is None


def times_ns() -> I64Array:
    """16 packets in a row, then two of every quarter of a second for 3 s."""
    step = 1_327_104
    later = [n * SECOND_NS // 4 // step * step + extra for n in range(1, 12) for extra in (0, step)]
    return np.array([n * step for n in range(16)] + later, np.int64)


def beside_of(sent: Sent) -> NeighbourStream:
    return NeighbourStream(POSITIONS, 512, sent.payloads, sent.host_ns)


def built_in(model: str) -> velodyne.VelodyneCalibration:
    found = next(one for one in velodyne.BUILT_IN if one.model == model)
    assert isinstance(found, velodyne.VelodyneCalibration)
    return found


def random_packets(spec: VelodyneSpec, packets: int) -> Sent:
    lasers = len(spec.table.elevation_deg)
    shape = (packets * spec.columns_per_packet, lasers, spec.returns)
    counts = np.random.default_rng(4).integers(0, 65536, shape)
    return encode(spec, counts, counts % 256)
