"""Loss of every model and mode that the encoders know: what is taken out is what is lost.

Packets come from the encoders, which follow the vendors' sheets; nothing is measured in them, since
only stamps, angles and counts show loss. Dark sectors are silent through the same angles in
every revolution.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch import sensors
from mlbatch.arrays import BoolArray
from mlbatch.discovery.match import best_fits, match
from mlbatch.lidar.interface import Calibration
from mlbatch.sensors import parse_calibration
from mlbatch.simulate.hesai.encode import HesaiSpec
from mlbatch.simulate.hesai.models import MODELS as HESAIS
from mlbatch.simulate.hesai.models import SEQUENCE
from mlbatch.simulate.interface import lidar_models
from mlbatch.simulate.robosense.encode import RobosenseSpec
from mlbatch.simulate.robosense.models import MODELS as ROBOSENSES
from mlbatch.simulate.spinning import SpinningSpec
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from mlbatch.simulate.velodyne.models import MODELS as VELODYNES
from tests.builders.lidar_packets import even, words_of
from tests.builders.loss import Came
from tests.fuzz.decoding import sampled
from tests.fuzz.framing import Part

# Ten revolutions a second; a dark sector is recognised after a dozen.
LENGTH_NS = 200_000_000
DARK_NS = 1_350_000_000
FIRST = 100
DARK_DEG = (100.0, 250.5)
ZERO_DEG = (330.3, 29.7)
MODES = ("strongest", "dual")


def counted(name: str, mode: str) -> tuple[HesaiSpec, HesaiSpec]:
    """A HESAI with a packet counter, and without."""
    spec = HesaiSpec(name, mode)
    return spec, replace(spec, flags=spec.row.flags & ~SEQUENCE)


# The dark sector of a ROBOSENSE is the rest of its field of view.
CASES: tuple[SpinningSpec, ...] = (
    *(
        VelodyneSpec(name, mode, start_us=3e9, blind_deg=dark)
        for name in VELODYNES
        for mode in MODES
        for dark in (None, DARK_DEG, ZERO_DEG)
    ),
    *(
        spec
        for name, model in lidar_models().items()
        if name in HESAIS
        for mode in model.modes
        if mode in MODES
        for spec in counted(name, mode)
    ),
    *(
        RobosenseSpec(name, mode, view_deg=view)
        for name in ROBOSENSES
        for mode in MODES
        for view in ((0.0, 360.0), DARK_DEG[::-1] if mode == "dual" else ZERO_DEG[::-1])
    ),
)


def is_dark(spec: SpinningSpec) -> bool:
    """Whether a unit has a dark sector."""
    if isinstance(spec, VelodyneSpec):
        return spec.blind_deg is not None
    return isinstance(spec, RobosenseSpec) and spec.view_deg != (0.0, 360.0)


def found(spec: SpinningSpec) -> Came:
    """Packets as their lidar reads them, which is recognised by the first of them."""
    length_ns = DARK_NS if is_dark(spec) else LENGTH_NS
    # In pairs: two returns of 128 lines take a column and a half.
    count = int(length_ns / (spec.column_ns * spec.columns_per_packet)) // 2 * 2
    sent = even(spec, count, 0, 0)
    calibrations: list[Calibration] = []
    if spec.files.name:
        own = parse_calibration(Path(f"unit.{spec.files.name}"), spec.files.content)
        if own is not None and spec.rig_model:
            own = own.for_model(spec.rig_model)
        assert own is not None
        calibrations.append(own)
    parts = [Part(2368, at, data) for at, data in sent[:FIRST]]
    if isinstance(spec, RobosenseSpec):
        parts.append(Part(7788, sent[0][0] + 1, spec.device_packet(0)))
    sampler = sampled(parts)
    if spec.rig_model:
        (kind,) = sampler.kinds
        (fit,), _ = best_fits(
            sampler.evidence(kind), [*calibrations, *sensors.built_in()], {}, spec.rig_model
        )
        lidar = fit.lidar
    else:
        (sensor,) = match(sampler, calibrations, {}).sensors
        lidar = sensor.lidar
    packets = np.frombuffer(b"".join(data for _, data in sent), np.uint8).reshape(len(sent), -1)
    host_ns = np.array([at for at, _ in sent], np.int64)
    return Came(lidar, lidar.sequence(packets), lidar.column_headers(packets, host_ns), host_ns)


@pytest.mark.parametrize("spec", CASES, ids=words_of)
def test_what_is_taken_out_is_what_is_lost(spec: SpinningSpec) -> None:
    packets = found(spec)
    count = len(packets.host_ns)
    assert packets.counted() == (0, 0)
    rng = np.random.default_rng(count)
    is_unsure = is_dark(spec) and packets.lidar.columns_per_packet <= 3
    for share in (0.01, 0.2):
        came = rng.random(count) >= share
        came[[0, -1]] = True
        lost, crossed = packets.counted(came, 2000)
        # Packets of few columns: the edges of a dark sector are uncertain by a column.
        assert abs(lost - missing(came)) <= (max(3, missing(came) // 100) if is_unsure else 0)
        assert crossed == 0
    came = np.ones(count, bool)
    for begin in rng.integers(1, count - 50, 3).tolist():
        came[begin : begin + int(rng.integers(2, 50))] = False
    assert packets.counted(came, 2000) == (missing(came), 0)


def missing(came: BoolArray) -> int:
    """How many packets do not come."""
    return int(np.count_nonzero(~came))
