"""Loss of every model and mode that the encoders know: what is taken out is what is lost.

Packets come from the encoders, which follow the vendors' sheets; nothing is measured in them, since
only stamps, angles and counts show loss. Dark sectors are silent through the same angles in
every revolution.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from mlbatch import sensors
from mlbatch.arrays import BoolArray
from mlbatch.discovery.match import best_fits, match
from mlbatch.lidar.interface import Calibration, ModelFile
from mlbatch.sensors import parse_calibration
from mlbatch.simulate.hesai import encode as hesai
from mlbatch.simulate.hesai import models as hesai_models
from mlbatch.simulate.robosense import encode as robosense
from mlbatch.simulate.robosense import models as robosense_models
from mlbatch.simulate.velodyne import encode as velodyne
from mlbatch.simulate.velodyne.models import MODELS as VELODYNES
from mlbatch.simulate.velodyne.models import calibration_yaml
from tests.builders.every_model import hesai_modes
from tests.builders.lidar_packets import Payloads, Spec, even, hesai_unit
from tests.builders.loss import Came
from tests.fuzz.decoding import sampled
from tests.fuzz.framing import Part

# Ten revolutions a second; a dark sector is recognised after a dozen.
LENGTH_NS = 200_000_000
DARK_NS = 1_350_000_000
FIRST = 100
DARK_DEG = {"": None, "dark": (100.0, 250.5), "dark through zero": (330.3, 29.7)}


@dataclass(frozen=True, slots=True)
class Spoken:
    """Packets; neighbours: device packets; content: of a calibration file; model: of the rig."""

    packets: Sequence[tuple[int, bytes]]
    neighbours: Sequence[tuple[int, bytes]] = ()
    file: str = ""
    content: bytes = b""
    model: str | None = None


def _silent(spec: Spec, length_ns: int, per_packet_ns: float) -> Payloads:
    """Packets that show nothing, in pairs: two returns of 128 lines take a column and a half."""
    return even(spec, int(length_ns / per_packet_ns) // 2 * 2, 0, 0)


def velodynes(model: str, mode: str, dark: str) -> Spoken:
    """No packet bears a count."""
    spec = velodyne.VelodyneSpec(model, mode, start_us=3e9, blind_deg=DARK_DEG[dark])
    length_ns = DARK_NS if dark else LENGTH_NS
    rows = _silent(spec, length_ns, spec.row_us * spec.rows_per_packet * 1000)
    if not model.startswith("HDL-64E"):
        return Spoken(rows)
    return Spoken(rows, (), "unit.yaml", calibration_yaml(model).encode(), model)


def hesais(model: str, mode: str, flags: str) -> Spoken:
    """flags: "counted", or "" for packets that bear no count."""
    row = hesai_models.MODELS[model]
    without = row.flags & ~hesai_models.SEQUENCE
    spec = hesai.HesaiSpec(model, int(mode, 16), flags=row.flags if flags else without)
    _, file, content = hesai_unit(model, row.channels)
    rows = _silent(spec, LENGTH_NS, float(spec.row.step_ns * spec.groups))
    return Spoken(rows, (), file, content)


def robosenses(model: str, mode: str, dark: str) -> Spoken:
    """A dark sector is the rest of the field of view."""
    sector = DARK_DEG[dark]
    view = (0.0, 360.0) if sector is None else sector[::-1]
    spec = robosense.RobosenseSpec(model, mode, view_deg=view)
    rows = _silent(spec, DARK_NS if dark else LENGTH_NS, spec.round_ns * spec.columns_per_packet)
    return Spoken(rows, [(rows[0][0] + 1, robosense.difop(spec, robosense.fan(spec)))])


Case = tuple[Callable[[str, str, str], Spoken], str, str, str]
CASES: tuple[Case, ...] = (
    *(
        (velodynes, model, mode, dark)
        for model in VELODYNES
        for mode in ("strongest", "dual")
        for dark in DARK_DEG
    ),
    *(
        (hesais, model, mode, flags)
        for model in hesai_models.MODELS
        for mode in sorted({"37", "39"} & set(hesai_modes(model)))
        for flags in ("counted", "")
    ),
    *(
        (robosenses, model, mode, dark)
        for model, row in robosense_models.MODELS.items()
        for mode in row.modes
        if mode in ("strongest", "dual")
        for dark in ("", "dark" if mode == "dual" else "dark through zero")
    ),
)


def found(spoken: Spoken) -> Came:
    """The packets as their lidar reads them, which is recognised by the first of them."""
    calibrations: list[Calibration] = []
    if spoken.file:
        own = parse_calibration(Path(spoken.file), spoken.content)
        if isinstance(own, ModelFile) and spoken.model is not None:
            own = own.for_model(spoken.model)
        assert own is not None
        calibrations.append(own)
    first = [Part(2368, at, data) for at, data in spoken.packets[:FIRST]]
    sampler = sampled([*first, *(Part(7788, at, data) for at, data in spoken.neighbours)])
    if spoken.model is None:
        (sensor,) = match(sampler, calibrations, {}).sensors
        lidar = sensor.lidar
    else:
        (kind,) = sampler.kinds
        (fit,), _ = best_fits(
            sampler.evidence(kind), [*calibrations, *sensors.built_in()], {}, spoken.model
        )
        lidar = fit.lidar
    packets = np.frombuffer(b"".join(data for _, data in spoken.packets), np.uint8)
    packets = packets.reshape(len(spoken.packets), -1)
    host_ns = np.array([at for at, _ in spoken.packets], np.int64)
    return Came(lidar, lidar.sequence(packets), lidar.column_headers(packets, host_ns), host_ns)


@pytest.mark.parametrize(
    "case", CASES, ids=lambda case: " ".join([case[0].__name__[:-1], *case[1:]]).strip()
)
def test_what_is_taken_out_is_what_is_lost(case: Case) -> None:
    make, *words = case
    packets = found(make(*words))
    count = len(packets.host_ns)
    assert packets.counted() == (0, 0)
    rng = np.random.default_rng(count)
    is_unsure = "dark" in words[2] and packets.lidar.columns_per_packet <= 3
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
