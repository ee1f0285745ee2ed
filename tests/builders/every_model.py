"""What every model and mode that the encoders know sends, and jobs that convert it.

A dozen packets of each, with returns from 0.5 to 12 m; both returns of a shot are equal in two of
three columns. Models must be identified by their packets; where bytes do not identify them, by a
rig.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import numpy as np

from mlbatch.discovery.discover import SensorSelection
from mlbatch.pipeline.job import Job
from mlbatch.simulate.hesai import encode as hesai
from mlbatch.simulate.hesai import models as hesai_models
from mlbatch.simulate.robosense import encode as robosense
from mlbatch.simulate.robosense import models as robosense_models
from mlbatch.simulate.velodyne import encode as velodyne
from mlbatch.simulate.velodyne.models import MODELS as VELODYNES
from mlbatch.simulate.velodyne.models import calibration_yaml
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.lidar_packets import Payloads, Spec, encoded, hesai_unit, shape

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
# Set in the ranges of an Airy, which have 14 bits.
_AIRY_FLAG = 0x4000


@dataclass(frozen=True, slots=True)
class Sent:
    """What a model sent; types: of its returns, () where they follow from the readings.

    model: as `mlbatch sensors` names it; neighbours: packets on port 7788; file, content:
    calibration; is_named: only a rig names the model.
    """

    model: str
    spec: Spec
    payloads: Payloads
    types: tuple[int, ...]
    neighbours: Payloads = field(default_factory=list)
    file: str = ""
    content: bytes = b""
    is_named: bool = False

    @property
    def channels(self) -> int:
        """Of a column."""
        return shape(self.spec, PACKETS)[1]

    @property
    def returns(self) -> int:
        """Of a column: packets that cannot contain both of all columns give each its own."""
        is_split = not isinstance(self.spec, hesai.HesaiSpec) and self.spec.columns_per_packet % 1
        return 1 if is_split else self.spec.returns


def payloads_of(spec: Spec, unit_m: float, flag: int = 0) -> Payloads:
    """Packets of a lidar whose distances count in unit_m; flag: further bits of them."""
    size = shape(spec, PACKETS)
    random = np.random.default_rng(7)
    counts = np.rint(random.uniform(0.5, 12, size) / unit_m).astype(np.int64)
    levels = random.integers(1, 256, size)
    counts[random.random(size) < 0.1] = 0
    is_single = np.arange(size[0]) % 3 > 0
    for values in (counts, levels):
        values[is_single] = values[is_single, :, :1]
    if isinstance(spec, hesai.HesaiSpec):
        counts *= hesai.fires(spec, size[0])[:, :, None]
    return encoded(spec, counts + flag, levels)


def velodyne_sent(model: str, mode: str, name: str = "") -> Sent:
    """name: of a model that sends the same packets."""
    spec = velodyne.VelodyneSpec(model, mode, start_azimuth_deg=357.2, start_us=3_599_997_000.0)
    payloads = payloads_of(spec, spec.table.unit_m)
    types = {"strongest": (1,), "last": (2,), "dual": ()}[mode]
    if model.startswith("HDL-64E"):
        # Its packets do not name the mode of a single return, nor the series.
        content = calibration_yaml(model).encode()
        types = types and (0,)
        return Sent(model, spec, payloads, types, [], "unit.yaml", content, is_named=True)
    return Sent(name or model, spec, payloads, types, is_named=bool(name))


def hesai_sent(model: str, mode: str, operation: str = hesai_models.HIGH) -> Sent:
    """mode: byte of the return mode; operation: of models with protocol 1.4."""
    # All columns of an AT128 lie within the field of one mirror.
    spec = hesai.HesaiSpec(model, int(mode, 16), start_deg=351.3, operation=operation)
    _, file, content = hesai_unit(model, spec.row.channels)
    payloads = payloads_of(spec, spec.row.unit_mm / 1000)
    types: tuple[int, ...] = {"33": (0,), "37": (1,), "38": (2,)}.get(mode, ())
    if model == "JT16":  # Nothing in its packets identifies it.
        types = (0,)
    return Sent(model.removesuffix("-7"), spec, payloads, types, [], file, content)


def robosense_sent(model: str, mode: str, mount: str = "normal") -> Sent:
    """mount: of an Airy."""
    spec = robosense.RobosenseSpec(
        model, mode, start_deg=357.2, mount=mount, start_ns=robosense.START_NS + 1_234_567
    )
    flag = _AIRY_FLAG if model.startswith("Airy") else 0
    payloads = payloads_of(spec, spec.range_unit_m, flag)
    types: tuple[int, ...] = {"strongest": (1,), "last": (2,), "nearest": (0,)}.get(mode, ())
    if spec.columns_per_packet % 1:
        types = (0,)
    device_packets = [(payloads[0][0] + 1, robosense.difop(spec, robosense.fan(spec)))]
    return Sent(ROBOSENSE_NAMES.get(model, model), spec, payloads, types, device_packets)


ROBOSENSE_NAMES = {
    "RS-16": "RS-LiDAR-16",
    "RS-32": "RS-LiDAR-32",
    "Bpearl v3": "RS-Bpearl v3",
    "Bpearl v4": "RS-Bpearl v4",
    "Helios 32, early type": "Helios 32",
    "Helios 16, early type": "Helios 16",
    "Ruby Plus 80, early type": "Ruby Plus 80",
    "Ruby Plus 80v, early type": "Ruby Plus 80",
    "Helios 32-31": "Helios 32",
    "Helios 32-26": "Helios 32",
    "Helios 1615": "Helios 16",
    "Ruby Plus 80v": "Ruby Plus 80",
}
Case = tuple[Callable[..., Sent], tuple[str, ...]]


def hesai_modes(model: str) -> Sequence[str]:
    """Strongest, last, last and strongest; all three."""
    modes = ["37", "38", "39"]
    if model == "JT16" or hesai_models.MODELS[model].blocks % 2:
        modes.remove("39")
    return modes + ["3d"] * (model == "XT32M2X")


CASES: tuple[Case, ...] = (
    *(
        (velodyne_sent, (model, mode))
        for model in VELODYNES
        for mode in ("strongest", "last", "dual")
    ),
    (velodyne_sent, ("VLP-16", "strongest", "Puck LITE")),
    *((hesai_sent, (model, mode)) for model in hesai_models.MODELS for mode in hesai_modes(model)),
    *((hesai_sent, ("PandarXT-32", mode)) for mode in ("33", "3b", "3c")),
    *(
        (hesai_sent, (model, mode, operation))
        for model, states in hesai_models.STATES.items()
        for operation in sorted({name for name, _ in states} - {hesai_models.HIGH})
        for mode in ("37", "39")
    ),
    *(
        (robosense_sent, (name, mode))
        for name, row in robosense_models.MODELS.items()
        for mode in row.modes
    ),
    *((robosense_sent, ("Airy 96", "strongest", mount)) for mount in ("side", "M")),
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
        (folder / sent.file).write_bytes(sent.content)
        selection = SensorSelection(metadata=(folder / sent.file,))
    if sent.is_named:
        rig = folder / "rig.yaml"
        more = RIG_METADATA.format(metadata=sent.file) if sent.file else ""
        rig.write_text(RIG.format(model=sent.model, ip=SOURCE) + more, encoding="utf-8")
        selection = SensorSelection(rig=rig)
    return Job((path,), selection, rate=Fraction(20), keep_partial=True)
