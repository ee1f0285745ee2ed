"""Every supported model: what its vendor's module offers, an encoder, a case, the laws of `Lidar`.

What is missing for a new one is named here; docs/extend.md says where it goes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.arrays import I64Array, U8Array
from mlbatch.errors import MlbatchError
from mlbatch.lidar.geometry import read_rotor_words
from mlbatch.lidar.interface import (
    FAULTS,
    NAMED_ONLY,
    Calibration,
    Evidence,
    Lidar,
    NeighbourStream,
    SensorModel,
)
from mlbatch.sensors import Plugin, built_in, models, parse_calibration, plugins
from mlbatch.simulate.ouster import encode as ouster
from mlbatch.simulate.spinning import SpinningSpec
from mlbatch.types import Stream
from mlbatch.units import NS_PER_S
from tests.builders import livox, points
from tests.builders.decoded import readings
from tests.builders.every_model import CASES, sent_by
from tests.builders.lidar_packets import words_of
from tests.builders.others import rows
from tests.fuzz.decoding import check_lidar

WORDS = ("real recording", "two sources", "one source")
ADVICE = "see docs/extend.md"
SOURCE = "192.168.1.201"
START_NS = 1_700_000_000_000_000_000
# Sizes of packets that a vendor's module knows, and some unknown ones.
SIZES = (*range(0, 64), 80, 512, 554, 568, 812, 820, 861, 1072, 1080, 1095, 1127, 1198, 1200, 1206)
SIZES += (1210, 1212, 1248, 1262, 1266, 1268, 1270, 1362, 1380, 1392, 3392, 6464, 8448, 12608)


@dataclass(frozen=True, slots=True)
class Stand:
    """A lidar, and packets of it: (P, packet_size), with their arrival."""

    lidar: Lidar
    packets: U8Array
    host_ns: I64Array


def _case(spec: SpinningSpec) -> Stand:
    """The lidar that a case of every_model.py is of."""
    sent = sent_by(spec)
    payloads = sent.payloads
    packets = rows([payload for _, payload in payloads])
    host_ns = np.array([at for at, _ in payloads])
    neighbours = tuple(
        NeighbourStream(Stream(SOURCE, 7788), len(payload), rows([payload]), np.array([at]))
        for at, payload in sent.neighbours
    )
    evidence = Evidence(Stream(SOURCE, 2368), packets.shape[1], packets, host_ns, neighbours)
    given = parse_calibration(Path(sent.file), spec.files.content) if sent.file else None
    known = built_in() if given is None else [given]
    found = [calibration for one in known if (calibration := _named(one, spec.rig_model))]
    score, best = max(((one.match_score(evidence), one) for one in found), key=lambda pair: pair[0])
    assert score > 0 or (score == NAMED_ONLY and spec.rig_model)
    return Stand(best.lidar({}, evidence), packets, host_ns)


def _named(calibration: Calibration, model: str) -> Calibration | None:
    """A calibration as that of the model a rig names, if any; None if it is another one's."""
    if calibration.model == model or not model:
        return calibration
    return calibration.for_model(model)


def _ouster(model: SensorModel) -> Stand:
    beams = model.channels
    product = model.name.replace("OS", "OS-", 1)
    spec = ouster.OusterSpec(beams=beams, columns_per_frame=512, product=product)
    ranges = np.full((512, beams, 1), 4000)
    packets = rows(ouster.encode_frame(spec, START_NS, 5, ranges)[:8])
    content = json.dumps(ouster.metadata_json(spec)).encode()
    given = parse_calibration(Path("unit.json"), content)
    assert given is not None
    host_ns = START_NS + np.arange(len(packets)) * 3_000_000
    evidence = Evidence(Stream(SOURCE, 7502), packets.shape[1], packets, host_ns)
    return Stand(given.lidar({}, evidence), packets, host_ns)


def _livox(kind: int) -> Stand:
    spec = livox.LivoxSpec(kind=kind)
    values = 1 + np.arange(8 * spec.points * spec.returns * 4).reshape(-1, spec.returns, 4) % 200
    sent = livox.point_packets(spec, values[..., :3], values[..., 3])
    packets = rows([payload for _, payload in sent])
    host_ns = np.array([at for at, _ in sent])
    evidence = Evidence(Stream(SOURCE, 56301), packets.shape[1], packets, host_ns)
    best = max(built_in(), key=lambda one: one.match_score(evidence))
    return Stand(best.lidar({}, evidence), packets, host_ns)


@lru_cache(maxsize=1)
def cases() -> Mapping[str, Callable[[], Stand]]:
    """What makes a lidar of each model, in each of its modes."""
    found: dict[str, Callable[[], Stand]] = {}
    for spec in CASES:
        found[words_of(spec)] = partial(_case, spec)
    for model in filter(_is_ouster, models()):
        found[model.name] = partial(_ouster, model)
    for kind in (livox.CARTESIAN32, livox.CARTESIAN16, livox.SPHERICAL, livox.DUAL):
        found[f"Livox SDK2 {kind}"] = partial(_livox, kind)
    return found


def _is_ouster(model: SensorModel) -> bool:
    return model.vendor == "Ouster"


@pytest.mark.parametrize("plugin", plugins(), ids=lambda plugin: plugin.__name__)
def test_a_plugin_offers_all_that_is_asked_of_it(plugin: Plugin) -> None:
    assert plugin.VENDOR
    assert plugin.MODELS
    for model in plugin.MODELS:
        assert model.verified in WORDS, f"{model.name}: expected one of {WORDS}"
        assert model.channels > 0
        assert model.returns
        assert model.clock
        assert model.calibration
    names = {model.name for model in models()}
    for calibration in plugin.BUILT_IN:
        assert (calibration.path, calibration.is_shared) == (None, True)
        assert calibration.model in names
    assert {model.same_packets_as for model in plugin.MODELS} <= {"", *names}


def test_no_two_models_have_one_name() -> None:
    names = [model.name for model in models()]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("model", models(), ids=lambda model: model.name)
def test_every_model_has_an_encoder_and_a_case(model: SensorModel) -> None:
    if model.name in (*points_kinds(), "Livox SDK2") or _is_ouster(model):
        return  # Their encoders have no rows: any number of beams, or none at all.
    missing = f"{model.name}: no row in mlbatch/simulate; {ADVICE}"
    assert (model.same_packets_as or model.name) in {one.reported_model for one in CASES}, missing


def points_kinds() -> tuple[str, ...]:
    """Clouds: their packets are made by the package itself."""
    return tuple(name.rpartition("/")[2] for name in (points.CLOUD, points.CUSTOM))


@pytest.mark.parametrize("plugin", plugins(), ids=lambda plugin: plugin.__name__)
@settings(max_examples=60)
@given(size=st.sampled_from(SIZES), count=st.integers(0, 9), seed=st.integers(0, 2**32))
def test_random_bytes_are_nobodys(plugin: Plugin, size: int, count: int, seed: int) -> None:
    sample = np.random.default_rng(seed).integers(0, 256, (count, size), np.uint8)
    assert plugin.describe(size, sample) is None


@pytest.mark.parametrize("plugin", plugins(), ids=lambda plugin: plugin.__name__)
@settings(max_examples=60)
@given(content=st.binary(max_size=400) | st.text(max_size=400).map(str.encode))
def test_random_files_are_left_alone_or_refused(plugin: Plugin, content: bytes) -> None:
    refusal = "some.file: "
    try:
        found = plugin.read_calibration(Path("some.file"), content)
    except MlbatchError as err:
        found = None
        refusal = str(err)
    assert found is None
    assert refusal.startswith("some.file: ")


@pytest.mark.parametrize("name", cases())
def test_a_lidar_keeps_the_laws(name: str) -> None:
    stand = cases()[name]()
    lidar = stand.lidar
    packets = stand.packets
    _check_table(lidar)
    check_lidar(lidar, packets, stand.host_ns)
    assert np.ptp(lidar.column_headers(packets, stand.host_ns).stamp_ns) < NS_PER_S
    assert not lidar.faults(packets).any()
    damaged = lidar.faults(np.random.default_rng(1).integers(0, 256, packets.shape, np.uint8))
    assert damaged.max() < len(FAULTS)
    sequence = lidar.sequence(packets)
    assert len(np.unique(sequence)) == len(packets)
    assert lidar.sent_by_me(packets).all()


@pytest.mark.parametrize("name", cases())
def test_a_packet_says_the_same_in_any_company(name: str) -> None:
    stand = cases()[name]()
    lidar = stand.lidar
    packets = stand.packets
    host_ns = stand.host_ns
    order = np.random.default_rng(2).permutation(len(packets))
    whole, shuffled = (
        lidar.column_headers(packets, host_ns),
        lidar.column_headers(packets[order], host_ns[order]),
    )
    for field in ("stamp_ns", "encoder", "valid"):
        assert np.array_equal(getattr(whole, field)[order], getattr(shuffled, field))
    again = np.random.default_rng(3).permutation(len(packets))
    both, apart = (
        readings(lidar, one, host_ns[:1].repeat(len(one))) for one in (packets, packets[again])
    )
    shape = (len(packets), lidar.columns_per_packet, lidar.channels, lidar.returns)
    for name in ("range_m", "intensity", "xyz"):
        here, there = (getattr(one, name).reshape(*shape, -1) for one in (both, apart))
        if name != "xyz" or lidar.beams.angle_rad is not None:
            assert np.array_equal(here[again], there, equal_nan=True)
    assert np.isfinite(both.range_m).all()
    assert both.range_m.min() >= 0
    if lidar.beams.angle_rad is None:
        tables = read_rotor_words(whole.encoder.reshape(-1))[2]
        assert not both.range_m[lidar.firing_ns[tables] < 0].any()


def _check_table(lidar: Lidar) -> None:
    """Properties of a lidar's columns, before any packet."""
    model = next(m for m in models() if _is_named(lidar, m))
    assert (lidar.vendor, lidar.channels) == (model.vendor, model.channels)
    for table in lidar.firing_ns:
        assert table[table >= 0].min() == 0
        assert table.max() < NS_PER_S
    assert np.array_equal(np.sort(lidar.channel), np.arange(lidar.channels))
    assert len(lidar.return_types) == lidar.returns
    assert lidar.typed_by in ("order", "level", "")


def _is_named(lidar: Lidar, model: SensorModel) -> bool:
    return model.name == lidar.model or model.name == lidar.model.replace("OS-", "OS", 1)
