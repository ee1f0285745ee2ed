"""Real HESAI recordings: totals, published clouds and times (docs/sources/hesai.md 0 and 9)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pytest

from mlbatch.geometry import read_rotor_words
from mlbatch.types import BoolArray, F32Array, I64Array
from tests.builders.hesai_decoded import Decoded, decode, evidence
from tests.builders.hesai_decoded import calibration as calibration_of
from tests.recordings.hesai import FOLDER, recorded


@dataclass(frozen=True)
class Case:
    """A row of the tables of section 0, and the ranges that the published cloud keeps."""

    folder: str
    model: str
    packets: int
    groups: int
    ranges: int
    ranges_first: int
    first_ns: int
    last_ns: int
    block_ns: tuple[int, int]  # of the first column of a packet and of the last one, section 5
    points_per_turn: tuple[int, ...]
    turn: int  # the one that was published
    limits_m: tuple[float, float]


CASES = (
    Case(
        *("pandar40p", "Pandar40P", 1439, 7195, 434934, 217841),
        *(1504714786881567000, 1504714787281044000),
        (-28580 - 4 * 55560 - 54670, -28580 - 54670),
        (152, 56530, 56723, 56762, 56604, 217),
        *(3, (0.3, 200.0)),
    ),
    Case(
        *("pandar64", "Pandar64", 2400, 7200, 716622, 359715),
        *(1593086529977341000, 1593086530377208000),
        (-42580 - 2 * 55560 - 54668, -42580 - 54668),
        (244, 93079, 93672, 93591, 93463, 410),
        *(3, (0.3, 200.0)),
    ),
    Case(
        *("pandarqt64", "PandarQT64", 1200, 2400, 299376, 149688),
        *(1504708282818090000, 1504708283217397000),
        (25710 + 2310, 25710 + 166666 + 2310),
        (259, 33940, 34145, 34158, 33898, 268),
        *(3, (0.1, 60.0)),
    ),
    Case(
        *("pandarxt16", "PandarXT-16", 1626, 6504, 165138, 82569),
        *(1564027949274789000, 1564027949599756000),
        (5632 - 3 * 50000 + 368, 5632 + 368),
        (7905, 26299, 26287, 26252, 18),
        *(2, (0.05, 120.0)),
    ),
    Case(
        *("pandarxt32", "PandarXT-32", 2000, 8000, 486606, 243303),
        *(1564024769619165000, 1564024770019000000),
        (5632 - 3 * 50000 + 368, 5632 + 368),
        (62826, 63058, 63040, 63021, 187),
        *(3, (0.05, 120.0)),
    ),
)
BY_FOLDER = {case.folder: case for case in CASES}
every_case = pytest.mark.parametrize("folder", list(BY_FOLDER))


@lru_cache(maxsize=1)
def _decoded(folder: str) -> Decoded:
    """As the published clouds: without the rotor's motion while the beams of a column fire."""
    (csv,) = (FOLDER / folder).glob("*.csv")
    return decode(recorded(folder), csv.read_bytes(), {"firing_azimuth": "off"})


@every_case
def test_totals_and_times(folder: str) -> None:
    case, found = BY_FOLDER[folder], _decoded(folder)
    assert found.lidar.model == case.model
    assert found.heads.stamp_ns.shape == (case.packets, case.groups // case.packets)
    assert np.count_nonzero(found.range_m) == case.ranges
    assert np.count_nonzero(found.range_m[..., 0]) == case.ranges_first
    assert found.stamp_ns[0] == case.first_ns + case.block_ns[0]
    assert found.stamp_ns[-1] == case.last_ns + case.block_ns[1]
    assert found.heads.valid.all()


@every_case
def test_nothing_is_lost(folder: str) -> None:
    packets, lidar = recorded(folder), _decoded(folder).lidar
    numbers = lidar.sequence(packets)
    if lidar.sequence_modulus:
        assert lidar.sequence_modulus == 2**32
        assert (np.diff(numbers) == 1).all()
    else:
        assert folder == "pandar40p"
        assert len(np.unique(numbers)) == len(packets)
        assert (numbers >= 0).all()


@every_case
def test_the_rotor_turns_as_fast_as_it_says(folder: str) -> None:
    (csv,) = (FOLDER / folder).glob("*.csv")
    packets = recorded(folder)
    lidar = calibration_of(csv.read_bytes()).lidar({}, evidence(packets))
    heads = lidar.heads(packets, np.zeros(len(packets), np.int64))
    angle, speed, _ = read_rotor_words(heads.encoder.reshape(-1))
    turned = np.unwrap(angle)
    measured = (turned[-1] - turned[0]) / np.ptp(heads.stamp_ns)
    assert measured == pytest.approx(speed.mean(), rel=2e-3)
    assert measured == pytest.approx(2 * np.pi * 10e-9, rel=2e-3)


@every_case
def test_every_published_point_and_no_other(folder: str) -> None:
    case, found = BY_FOLDER[folder], _decoded(folder)
    turn, keep = _turns(folder, found), _kept(found, case.limits_m)
    counts = np.bincount(turn[keep.any(axis=2)] - turn.min(), weights=keep.sum(axis=2)[keep.any(2)])
    assert tuple(counts.astype(int).tolist()) == case.points_per_turn
    points = found.xyz()[keep & (turn == turn.min() + case.turn)[:, :, None]]
    (cloud,) = (FOLDER / folder).glob("*.pcd")
    published = _cloud(cloud.read_bytes())
    assert points.shape == published.shape
    # The order of both is firing group, channel, return.
    assert np.abs(points - published).max() < 1e-4


def _turns(folder: str, found: Decoded) -> I64Array:
    """(n, channels) turn of every beam: it ends where the beam's own azimuth passes 0."""
    (csv,) = (FOLDER / folder).glob("*.csv")
    lines = csv.read_text(encoding="utf-8").split()
    offset_deg = np.array([float(line.split(",")[2]) for line in lines if line[0].isdigit()])
    angle, _, _ = read_rotor_words(found.encoder)
    # As the packets hold it, in 0.01 deg, so that a point at exactly 0 is seen to be there.
    azimuth = np.rint(np.degrees(angle) * 100).astype(np.int64)
    unwrapped = np.cumsum(np.diff(azimuth, prepend=azimuth[:1]) % 36000) + azimuth[0]
    micro_deg = unwrapped[:, None] * 10_000 + np.rint(offset_deg * 1e6).astype(np.int64)
    turns: I64Array = -(-micro_deg // 360_000_000)
    return turns


def _kept(found: Decoded, limits_m: tuple[float, float]) -> BoolArray:
    """Section 9, rules 1 and 2, for two returns."""
    first_m, last_m = found.range_m[..., 0], found.range_m[..., 1]
    keep = (found.range_m >= limits_m[0]) & (found.range_m <= limits_m[1]) & (found.range_m > 0)
    same = (first_m == last_m) & (found.intensity[..., 0] == found.intensity[..., 1])
    keep[..., 0] &= ~(same | (np.abs(first_m - last_m) < 0.1))
    return keep


def _cloud(content: bytes) -> F32Array:
    head, _, body = content.partition(b"DATA binary\n")
    assert b"FIELDS x y z\n" in head
    return np.frombuffer(body, "<f4").reshape(-1, 3)


def test_the_published_turn_of_the_xt16_starts_when_the_manual_states() -> None:
    """The column at exactly 0, which the rule of the clouds still counts to the turn before."""
    found = _decoded("pandarxt16")
    angle, _, _ = read_rotor_words(found.encoder)
    starts = found.time_ns[angle == 0]
    assert starts[:, 0].tolist()[1] == 1564027949399730000
    # Sixteen channels, one every 3024 ns.
    assert (starts - starts[:, :1] == 3024 * np.arange(16)).all()


def test_a_recording_whose_ranges_are_all_one() -> None:
    found = _decoded("pandar64_all-points")
    assert found.range_m.shape == (7200, 64, 2)
    assert (found.range_m == np.float32(0x9696 * 0.004)).all()
    counts = np.unique(_turns("pandar64_all-points", found), return_counts=True)[1]
    # 1800 groups of 0.2 deg a turn, but for the rotor's ripple and the turns cut off.
    assert counts.sum() == 7200 * 64
    assert counts[1:-1] == pytest.approx(1800 * 64, rel=5e-3)
