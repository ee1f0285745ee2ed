"""What every model and mode that the encoders know sends, and jobs that convert it.

A dozen packets of each, with returns from 0.5 to 12 m; both returns of a shot are equal in two of
three columns. Models must be identified by their packets; where bytes do not identify them, by a
rig.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import numpy as np

from mlbatch.discovery.discover import SensorSelection
from mlbatch.pipeline.job import Job
from mlbatch.simulate.hesai import models as hesai_models
from mlbatch.simulate.hesai.encode import LIDARS as HESAIS
from mlbatch.simulate.hesai.encode import HesaiSpec
from mlbatch.simulate.robosense import models as robosense_models
from mlbatch.simulate.robosense.encode import START_NS, RobosenseSpec
from mlbatch.simulate.spinning import SpinningSpec
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from mlbatch.simulate.velodyne.models import MODELS as VELODYNES
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.lidar_packets import Payloads, encoded

PACKETS = 12
SOURCE = "192.168.1.201"
HOST = "192.168.1.10"
RIG = """\
sensors:
  - name: lidar
    model: {model}
    stream: {{source_ip: {ip}, port: 2368}}
    extrinsics: {{translation_m: [0, 0, 0], rotation_rpy_deg: [0, 0, 0]}}
"""
RIG_METADATA = "    metadata: {metadata}\n"
# Of the only return; 0 where packets do not name it.
_TYPES = {"strongest": 1, "last": 2}


@dataclass(frozen=True, slots=True)
class Sent:
    """What a unit sent; neighbours: packets on port 7788."""

    spec: SpinningSpec
    payloads: Payloads
    neighbours: Payloads = field(default_factory=list)

    @property
    def file(self) -> str:
        """Name of the calibration file, "" without."""
        name = self.spec.files.name
        return f"unit.{name}" if name else ""

    @property
    def returns(self) -> int:
        """Of a column: packets that cannot contain both of all columns give each its own."""
        return 1 if self.spec.columns_per_packet % 1 else self.spec.returns

    @property
    def types(self) -> tuple[int, ...]:
        """Of its returns, () where they follow from the readings."""
        if self.returns > 1:
            return ()
        # Nothing in packets of a JT16 and an HDL-64E says which return it is.
        is_said = not self.spec.reported_model.startswith(("JT16", "HDL-64E"))
        return (_TYPES.get(self.spec.mode, 0) if is_said else 0,)


def sent_by(spec: SpinningSpec) -> Sent:
    """A few packets of a unit."""
    size = spec.shape(PACKETS)
    random = np.random.default_rng(7)
    counts = np.rint(random.uniform(0.5, 12, size) / spec.range_unit_m).astype(np.int64)
    levels = random.integers(1, 256, size)
    counts[random.random(size) < 0.1] = 0
    is_single = np.arange(size[0]) % 3 > 0
    for values in (counts, levels):
        values[is_single] = values[is_single, :, :1]
    payloads = encoded(spec, counts * spec.fires(size[0])[:, :, None], levels)
    if not isinstance(spec, RobosenseSpec):
        return Sent(spec, payloads)
    return Sent(spec, payloads, [(payloads[0][0] + 1, spec.device_packet())])


def velodyne(model: str, mode: str) -> VelodyneSpec:
    """Its azimuths pass zero, and its stamps the full hour."""
    return VelodyneSpec(model, mode, start_azimuth_deg=357.2, start_us=3_599_997_000.0)


def hesai(model: str, mode: str, operation: str = hesai_models.HIGH) -> HesaiSpec:
    """All columns of an AT128 lie within the field of one mirror."""
    return HesaiSpec(model, mode, start_deg=351.3, operation=operation)


def robosense(model: str, mode: str, mount: str = "normal") -> RobosenseSpec:
    """Its azimuths pass zero."""
    return RobosenseSpec(model, mode, start_deg=357.2, mount=mount, start_ns=START_NS + 1_234_567)


CASES: tuple[SpinningSpec, ...] = (
    *(velodyne(model, mode) for model in VELODYNES for mode in ("strongest", "last", "dual")),
    *(hesai(model.name, mode) for model in HESAIS for mode in model.modes),
    hesai("XT32M2X", "triple"),
    *(hesai("PandarXT-32", mode) for mode in ("first", "first and last", "first and strongest")),
    *(
        hesai(model, mode, operation)
        for model, row in hesai_models.MODELS.items()
        for operation in row.operations[1:]
        for mode in ("strongest", "dual")
    ),
    *(robosense(name, mode) for name, row in robosense_models.MODELS.items() for mode in row.modes),
    *(robosense("Airy 96", "strongest", mount) for mount in ("side", "M")),
)


def job_of(sent: Sent, folder: Path) -> Job:
    """A job on a recording of it, which is written into the folder."""
    records = [
        (host_ns, udp_frame(payload, SOURCE, HOST, port, port)[0])
        for port, payloads in ((2368, sent.payloads), (7788, sent.neighbours))
        for host_ns, payload in payloads
    ]
    path = write_pcap(folder / "lidar.pcap", sorted(records))
    selection = SensorSelection()
    if sent.file:
        (folder / sent.file).write_bytes(sent.spec.files.content)
        selection = SensorSelection(metadata=(folder / sent.file,))
    if sent.spec.rig_model:
        rig = folder / "rig.yaml"
        more = RIG_METADATA.format(metadata=sent.file) if sent.file else ""
        text = RIG.format(model=sent.spec.rig_model, ip=SOURCE) + more
        rig.write_text(text, encoding="utf-8")
        selection = SensorSelection(rig=rig)
    return Job((path,), selection, rate=Fraction(20), keep_partial=True)
