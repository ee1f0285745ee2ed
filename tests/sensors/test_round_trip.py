"""Encode, then decode: ranges, levels, times and points are what the encoders were given.

A row is a model in a mode, at a speed, behind a blind sector, of a firmware. Ouster:
`ouster/test_pixels.py`; Livox: `livox/test_sensor.py`. `tests/golden/test_literal.py` converts
the same models as whole recordings.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import pytest

from mlbatch.lidar.geometry import Mirrors, read_rotor_words
from mlbatch.sensors import describe
from mlbatch.simulate.hesai.encode import HesaiSpec
from mlbatch.simulate.hesai.models import MODELS as HESAI
from mlbatch.simulate.robosense.encode import RobosenseSpec
from mlbatch.simulate.robosense.models import AIRY_MOUNTS
from mlbatch.simulate.robosense.models import MODELS as ROBOSENSE
from mlbatch.simulate.spinning import SpinningSpec
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from mlbatch.simulate.velodyne.models import MODELS as VELODYNE
from tests.builders.lidar_packets import words_of
from tests.builders.spinning import MODES, PLAIN, Encoded, fired, pointing, stream_of

# Stamps of a Velodyne are whole us, its azimuths whole hundredths of a degree.
STAMP_NS, AZIMUTH_DEG = 800, 0.012
# The series of a HESAI's rotor motion, in float32 at up to 262 m.
SERIES_DEG, SERIES_M = 5e-5, 2e-4
# A block's azimuth is rounded to 0.01 degree; two of them give the speed of a short packet.
BLOCK_DEG = 0.015


@dataclass(frozen=True)
class Case:
    """A stream, and how well its times (ns) and directions are known.

    per_m, away_m: most that a point is away, per metre of its range and in all; origin_m: most that
    the origin of a beam is away; gap_ns: a time in
    which nothing is sent; speed_at: byte of a field of the speed that has no sign.
    """

    spec: SpinningSpec
    time_ns: float
    angle_deg: float
    per_m: float
    away_m: float = 1e-5
    origin_m: float = 2e-5
    packets: int = 0
    gap_ns: float = 0
    speed_at: int = 0
    options: Mapping[str, str] = field(default_factory=dict)


def of_velodyne(
    spec: VelodyneSpec, time_ns: float = STAMP_NS, turns: float = 1, **others: Any
) -> Case:
    angle_deg = turns * AZIMUTH_DEG
    case = Case(spec, time_ns, angle_deg, np.radians(angle_deg), origin_m=1e-5)
    return replace(case, **others)


def of_hesai(model: str, mode: str = "strongest", speed_at: int = 0, **others: Any) -> Case:
    spec = replace(HesaiSpec(model, mode, start_deg=350.07), **others)
    return Case(spec, 0, SERIES_DEG, 0, SERIES_M, speed_at=speed_at)


def of_robosense(spec: RobosenseSpec, time_ns: float = 0, turns: float = 1, **others: Any) -> Case:
    angle_deg = turns * BLOCK_DEG
    # Half of the columns of a split packet have the time of another packet, cut to whole us.
    time_ns += 1000 if spec.columns_per_packet % 1 else 0
    return replace(Case(spec, time_ns, angle_deg, np.radians(angle_deg)), **others)


def seen_from(name: str, mode: str, rpm: int) -> Case:
    """180 degrees without columns, after the first column: half of a revolution."""
    turned_deg = 0.5 * ROBOSENSE[name].row.round_ns * 6e-9 * rpm
    spec = RobosenseSpec(name, mode, rpm=rpm, start_deg=270.0 - turned_deg, view_deg=(90.0, 270.0))
    # A thousandth of the gap: the speed is known from steps of 0.01 degree.
    return of_robosense(spec, 30e9 / rpm / 1000, turns=2, packets=20, gap_ns=30e9 / rpm - 1000)


CASES: Sequence[Case] = (
    *(
        of_velodyne(VelodyneSpec(model, mode, start_azimuth_deg=deg, start_us=at_us))
        for model in VELODYNE
        for mode in MODES
        for deg, at_us in ((0.0, 1e6), (358.0, 3_599_999_000.0), (90.0, 1_800_000_001.0))
    ),
    # Columns fire when the rotor has passed it, wherever it is in a packet: a hundredth of a
    # degree, as the azimuth is rounded on both sides, is 28 us.
    *(
        of_velodyne(
            VelodyneSpec(model, mode, start_azimuth_deg=29.0, blind_deg=(begin_deg, 250.0)),
            *(40_000,),
            packets=80,
            gap_ns=50_000_000,
        )
        for model in VELODYNE
        for mode in MODES
        for begin_deg in (30.0, 30.4, 31.3, 32.2)
    ),
    *(
        of_velodyne(
            VelodyneSpec(model, rpm=rpm, start_azimuth_deg=38.5, blind_deg=(40.0, 300.0)),
            *(80_000,),
            packets=60,
        )
        for model in PLAIN
        for rpm in (300.0, 1200.0)
    ),
    of_velodyne(VelodyneSpec("HDL-32E", stamps_end=True), options={"packet_stamp": "end"}),
    # The option is none of the others'.
    of_velodyne(VelodyneSpec("VLP-32C", hour=1), options={"packet_stamp": "end"}),
    # The firing sequence of a VLS-128 is measured.
    *(
        of_velodyne(VelodyneSpec("VLS-128", mode, sequence_us=sequence_us), turns=2)
        for mode in ("strongest", "dual")
        for sequence_us in (53.3, 53.33, 57.8)
    ),
    *(of_hesai(model) for model in HESAI),
    *(of_hesai(model, "dual") for model in HESAI if model not in ("Pandar64-7", "JT16")),
    of_hesai("XT32M2X", "triple"),
    *(
        of_hesai(model, mode, operation=operation)
        for mode in ("strongest", "dual")
        for model, row in HESAI.items()
        for operation in row.operations[1:]
    ),
    *(
        of_hesai(model, speed_at=speed_at, rpm=-600, start_deg=10.0)
        for model, speed_at in (("Pandar64", 1180), ("PandarXT-32", 1063), ("QT128C2X", 1074))
    ),
    *(
        of_robosense(RobosenseSpec(name, mode, start_deg=357.3))
        for name in ROBOSENSE
        for mode in ("strongest", "dual")
    ),
    *(of_robosense(RobosenseSpec("Airy 96", mount=mount)) for mount in AIRY_MOUNTS),
    *(
        seen_from(name, mode, rpm)
        for name in ("RS-32", "Helios 32", "Airy 96", "Ruby 80", "Ruby Plus 128")
        for mode in ("strongest", "dual")
        for rpm in (300, 600, 1200)
    ),
    # The vendor's driver takes all of the azimuth backwards: the rotor's and the corrections.
    *(
        of_robosense(RobosenseSpec(name, start_deg=40.0, is_reversed=True))
        for name in ("Bpearl v3", "Bpearl v4")
    ),
)


@pytest.mark.parametrize("case", CASES, ids=lambda case: words_of(case.spec))
def test_what_was_sent_comes_back(case: Case) -> None:
    stream = stream_of(case.spec, case.packets)
    if case.speed_at:
        stream.packets[:, case.speed_at : case.speed_at + 2] = list(struct.pack("<H", 600))
    truth = stream.truth
    lidar = stream.lidar(**case.options)
    assert not lidar.faults(stream.packets).any()
    assert lidar.notes == () or "Ruby" in lidar.notes[0]
    found = stream.read(lidar)
    assert found.headers.valid.all()
    range_m = truth.counts * truth.unit_m
    np.testing.assert_array_equal(found.range_m, range_m.astype(np.float32))
    is_met = truth.counts > 0
    np.testing.assert_array_equal(found.intensity[is_met], truth.level[is_met])
    time_ns, angle, fires = fired(lidar, found.headers)
    np.testing.assert_array_equal(fires, truth.fires)
    assert np.abs(time_ns - truth.time_ns)[fires].max() <= case.time_ns
    assert np.diff(truth.time_ns[:, 0]).max() > case.gap_ns
    if not isinstance(lidar.projection(np.eye(4)), Mirrors):
        direction, origin_m = pointing(lidar, angle)
        chord = np.linalg.norm(direction - truth.direction, axis=-1)[fires].max()
        assert np.degrees(2 * np.arcsin(chord / 2)) < case.angle_deg
        assert np.abs(origin_m - truth.origin_m)[fires].max() < case.origin_m
    reached_m = range_m + truth.reach_m[:, None]
    expected = truth.origin_m[:, :, None] + reached_m[..., None] * truth.direction[:, :, None]
    away_m = np.linalg.norm(found.xyz - expected, axis=-1)
    assert (away_m - case.per_m * reached_m)[is_met].max() < case.away_m


@pytest.mark.parametrize(
    ("spec", "size", "modulus"),
    [
        (VelodyneSpec("VLP-16"), 1206, 0),
        (HesaiSpec("Pandar40P"), 1262, 0),
        (HesaiSpec("PandarXT-16", sequence=2**32 - 2), 568, 2**32),
        (HesaiSpec("PandarQT64", sequence=2**32 - 2), 1072, 2**32),
        (HesaiSpec("QT128C2X", sequence=2**32 - 2), 1127, 2**32),
        (HesaiSpec("OT128", sequence=2**32 - 2), 893, 2**32),
        (HesaiSpec("AT128", sequence=2**32 - 2), 1118, 2**32),
        (HesaiSpec("JT16", sequence=2**16 - 2), 80, 2**16),
        (RobosenseSpec("Bpearl v4", first_counter=2**32 - 2), 1248, 2**32),
        (RobosenseSpec("Helios 32"), 1248, 0),
    ],
    ids=words_of,
)
def test_counts_wrap_and_packets_without_are_named_by_content(
    spec: SpinningSpec, size: int, modulus: int
) -> None:
    stream = stream_of(spec)
    lidar = stream.lidar()
    numbers = lidar.sequence(stream.packets)
    assert (lidar.packet_size, lidar.sequence_modulus) == (size, modulus)
    assert (numbers >= 0).all()
    assert len(np.unique(numbers)) == len(stream.packets)
    if modulus:
        assert numbers[:4].tolist() == [modulus - 2, modulus - 1, 0, 1]


def azimuths_of(spec: SpinningSpec) -> tuple[range, Literal["big", "little"]]:
    """Bytes of the azimuths of blocks, and their order."""
    if isinstance(spec, RobosenseSpec):
        layout = spec.row.layout
        stride = 4 + 3 * layout.per_block
        return range(layout.header + 2, layout.header + stride * layout.blocks, stride), "big"
    # A VLS-128 uses eight blocks of a packet with two returns.
    used = 8 if (spec.model, spec.mode) == ("VLS-128", "dual") else 12
    return range(2, 100 * used, 100), "little"


@pytest.mark.parametrize(
    "spec",
    [
        # 600 rpm are 0.0036 degrees/us: the third azimuth is 0.
        *(
            replace(spec, start_azimuth_deg=-2 * 0.0036 * spec.row_us)
            for model in VELODYNE
            for mode in MODES
            for spec in [VelodyneSpec(model, mode)]
        ),
        *(
            RobosenseSpec(name, mode)
            for name in ("RS-16", "RS-32", "Helios 32", "Airy 96", "Ruby 80", "Ruby 128")
            for mode in ("strongest", "dual")
        ),
    ],
    ids=words_of,
)
def test_an_azimuth_of_36000_is_0(spec: SpinningSpec) -> None:
    """Units send both; 36001 is damage: of the packet, or of a column of it."""
    stream = stream_of(spec)
    places, order = azimuths_of(spec)

    def rewritten(cdeg: int) -> Encoded:
        packets = stream.packets.copy()
        for packet in packets:
            for at in places:
                if not packet[at : at + 2].any():
                    packet[at : at + 2] = list(cdeg.to_bytes(2, order))
        return replace(stream, packets=packets)

    full = rewritten(36000)
    changed = (full.packets != stream.packets).any(axis=1)
    assert changed.any()
    lidar = full.lidar()
    assert not lidar.faults(full.packets).any()
    found, expected = full.headers(lidar), stream.headers(stream.lidar())
    assert found.valid.all()
    np.testing.assert_array_equal(found.stamp_ns, expected.stamp_ns)
    np.testing.assert_array_equal(found.encoder, expected.encoder)
    # Alone, too, it is a packet of this model.
    assert describe(full.packets.shape[1], full.packets[changed][:1]) is not None
    beyond = rewritten(36001)
    good = (lidar.faults(beyond.packets) == 0) & beyond.headers(lidar).valid.all(axis=1)
    np.testing.assert_array_equal(good, ~changed)


@pytest.mark.parametrize(
    "spec", [VelodyneSpec("VLP-32C"), RobosenseSpec("Helios 32", start_deg=10.0)], ids=words_of
)
def test_without_motion_during_a_firing(spec: SpinningSpec) -> None:
    """Columns keep their angles and beams their times; only the speed is gone."""
    stream = stream_of(spec)
    on, off = stream.lidar(), stream.lidar(firing_azimuth="off")
    moving, still = stream.headers(on), stream.headers(off)
    (angle, speed, _), (rest, none, _) = (read_rotor_words(one.encoder) for one in (moving, still))
    np.testing.assert_array_equal(angle, rest)
    assert speed == pytest.approx(2 * np.pi * 10 * 1e-9, rel=0.01)
    assert not none.any()
    np.testing.assert_array_equal(moving.stamp_ns, still.stamp_ns)
    np.testing.assert_array_equal(on.firing_ns, off.firing_ns)


@pytest.mark.parametrize(
    ("spec", "jitter", "within_ns"),
    [
        # It jitters around zero.
        (VelodyneSpec("VLP-16", rpm=0.0), (102, 35999), 55_296),
        (RobosenseSpec("RS-32", rpm=0), None, 55_520),
    ],
    ids=words_of,
)
def test_a_rotor_at_rest_has_no_speed_and_no_blind_sector(
    spec: SpinningSpec, jitter: tuple[int, int] | None, within_ns: int
) -> None:
    stream = stream_of(spec)
    lidar = stream.lidar()
    if jitter is not None:
        stream.packets[:, jitter[0] : jitter[0] + 2] = list(jitter[1].to_bytes(2, "little"))
    headers = stream.headers(lidar)
    assert (np.diff(headers.stamp_ns, axis=1) == within_ns).all()
    # Packets are stamped in whole us.
    assert np.abs(np.diff(headers.stamp_ns.reshape(-1)) - within_ns).max() < 1100
    angle, speed, _ = read_rotor_words(headers.encoder)
    assert np.abs(speed).max() < 2 * np.pi * 1e-9 * 0.1
    if jitter is None:
        assert not angle.any()
