"""Every model and mode that the encoders know, from packets to points by whole conversions.

A dozen packets of each show the hall of `scene.py` from 1.5 m height. Models must be identified by
their packets (where bytes do not identify them, by a rig); ranges, signals, stamps and times are
equal to the count and ns, and points are on surfaces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import F64Array, I64Array
from mlbatch.discovery.discover import SensorSelection
from mlbatch.pipeline.job import Job
from mlbatch.simulate.hesai import encode as hesai
from mlbatch.simulate.hesai import models as hesai_models
from mlbatch.simulate.robosense import encode as robosense
from mlbatch.simulate.robosense import models as robosense_models
from mlbatch.simulate.velodyne import encode as velodyne
from mlbatch.simulate.velodyne.models import MODELS as VELODYNES
from mlbatch.simulate.velodyne.models import calibration_yaml
from mlbatch.types import Scan
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.lidar_packets import Payloads, hesai_unit
from tests.builders.run import Result, in_memory
from tests.builders.scene import hall
from tests.builders.seen import (
    ASIDE_PER_M,
    Eye,
    Seen,
    hesai_sees,
    pose,
    robosense_sees,
    velodyne_sees,
)
from tests.builders.seen_points import Expected, pair_types, repeated

PACKETS = 12
SOURCE = "192.168.1.201"
HOST = "192.168.1.10"
# Beams that point up see walls as well.
EYE = Eye(hall(), pose((3.1, 1.3, 1.5), (9.0, 31.0, -41.0)))
FLOAT32_M = 1e-5
# Its firing sequence changes with the firmware and is measured: 12 stamps in whole us give it to
# 1 us / 33, and the last of three sequences in a packet begins two of them after the stamp.
MEASURED_NS = {"VLS-128": 61}

RIG = """\
sensors:
  - name: lidar
    model: {model}
    stream: {{source_ip: {ip}, port: 2368}}
    extrinsics: {{translation_m: [0, 0, 0], rotation_rpy_deg: [0, 0, 0]}}
"""
RIG_METADATA = "    metadata: {metadata}\n"


@dataclass(frozen=True, slots=True)
class Sent:
    """What a model sent; types: of its returns, () where they follow from the readings.

    model: as `mlbatch sensors` names it; neighbours: packets on port 7788; file, content:
    calibration; is_named: only a rig names the model.
    """

    model: str
    seen: Seen
    types: tuple[int, ...]
    neighbours: Payloads = field(default_factory=list)
    file: str = ""
    content: bytes = b""
    is_named: bool = False


def velodyne_sent(model: str, mode: str, name: str = "") -> Sent:
    """name: of a model that sends the same packets."""
    spec = velodyne.VelodyneSpec(model, mode, start_azimuth_deg=357.2, start_us=3_599_997_000.0)
    sight = velodyne_sees(spec, EYE, PACKETS)
    types = {"strongest": (1,), "last": (2,), "dual": ()}[mode]
    if model.startswith("HDL-64E"):
        # Its packets do not name the mode of a single return, nor the series.
        content = calibration_yaml(model).encode()
        return Sent(model, sight, types and (0,), [], "unit.yaml", content, is_named=True)
    return Sent(name or model, sight, types, is_named=bool(name))


def hesai_sent(model: str, mode: str, operation: str = hesai_models.HIGH) -> Sent:
    """mode: byte of the return mode; operation: of models with protocol 1.4."""
    # All columns of an AT128 lie within the field of one mirror.
    spec = hesai.HesaiSpec(model, int(mode, 16), start_deg=351.3, operation=operation)
    beams, file, content = hesai_unit(model, spec.row.channels)
    sight = hesai_sees(spec, beams, EYE, PACKETS)
    types: tuple[int, ...] = {"33": (0,), "37": (1,), "38": (2,)}.get(mode, ())
    if model == "JT16":  # Nothing in its packets identifies it.
        types = (0,)
    return Sent(model.removesuffix("-7"), sight, types, [], file, content)


def robosense_sent(model: str, mode: str, mount: str = "normal") -> Sent:
    """mount: of an Airy."""
    spec = robosense.RobosenseSpec(
        model, mode, start_deg=357.2, mount=mount, start_ns=robosense.START_NS + 1_234_567
    )
    angles = robosense.fan(spec)
    sight = robosense_sees(spec, angles, EYE, PACKETS)
    types: tuple[int, ...] = {"strongest": (1,), "last": (2,), "nearest": (0,)}.get(mode, ())
    if sight.returns < spec.returns:
        types = (0,)
    name = ROBOSENSE_NAMES.get(model, model)
    device_packets = [(sight.payloads[0][0] + 1, robosense.difop(spec, angles))]
    return Sent(name, sight, types, device_packets)


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
        for port, payloads in ((2368, sent.seen.payloads), (7788, sent.neighbours))
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


def convert(sent: Sent, folder: Path) -> tuple[Result, Result]:
    """All slots with returns that are sent twice, and the dense points without them."""
    job = job_of(sent, folder)
    whole = replace(job, keep_repeated=True, layout="organized")
    return in_memory(whole), in_memory(job)


@pytest.mark.parametrize(
    ("make", "words"),
    CASES,
    ids=[f"{make.__name__[:-5]} {' '.join(words)}" for make, words in CASES],
)
def test_all_comes_back(make: Callable[..., Sent], words: tuple[str, ...], tmp_path: Path) -> None:
    sent = make(*words)
    assert np.count_nonzero(sent.seen.counts) > sent.seen.counts.size / 10
    whole, dense = convert(sent, tmp_path)
    assert whole.memory is not None
    (info,) = whole.memory.info.sensors
    assert (info.model, info.channels, info.returns) == (
        *(sent.model, sent.seen.channels),
        sent.seen.returns,
    )
    # Of two returns in different packets the second may be the earlier one.
    order = np.argsort(sent.seen.stamp_ns, kind="stable")
    check_readings(sent, whole.scans, order)
    check_places(sent, whole.scans, order)
    check_dense(sent, dense, order)


def check_readings(sent: Sent, scans: Sequence[Scan], order: I64Array) -> None:
    """Every slot of every column."""
    sight = sent.seen
    shape = sent.seen.counts.shape
    slack_ns = MEASURED_NS.get(sent.model, 0)
    stamps = np.concatenate([scan.column_stamp_ns for scan in scans])
    assert np.abs(stamps - sight.stamp_ns[order]).max() <= slack_ns
    range_m: F64Array = np.nan_to_num(joined(scans, "range_m")).reshape(shape)
    counts = sight.counts[order]
    assert np.array_equal(np.rint(range_m / sight.unit_m), counts)
    assert np.abs(range_m - counts * sight.unit_m).max() < FLOAT32_M
    there = counts > 0
    intensity = joined(scans, "intensity").reshape(shape)
    assert np.array_equal(intensity[there], sight.level[order][there])
    begin_ns = np.concatenate([np.full(len(scan.time_ns), scan.start_ns) for scan in scans])
    at_ns = joined(scans, "time_ns").reshape(shape).astype(np.int64) + begin_ns[:, None, None]
    fires_ns = np.broadcast_to(sight.firing_ns[order][:, :, None], shape)
    assert np.abs(at_ns - fires_ns)[there].max() <= slack_ns
    check_types(sent, joined(scans, "return_type").reshape(shape), order)


def check_types(sent: Sent, types: F64Array, order: I64Array) -> None:
    """Those of two returns follow from ranges and levels; of three nothing is said."""
    sight = sent.seen
    there = sight.counts[order] > 0
    if sent.types:
        expected = np.broadcast_to(np.array(sent.types, np.uint8), there.shape)
    elif sight.returns == 2:
        expected = pair_types(sight.counts, sight.level)[order]
    else:
        expected = np.zeros(there.shape, np.uint8)
    assert np.array_equal(types[there], expected[there])


def check_places(sent: Sent, scans: Sequence[Scan], order: I64Array) -> None:
    """Every point lies on its ray, but for what the azimuth leaves open, and so on a surface."""
    sight = sent.seen
    there = sight.counts[order] > 0
    xyz_m = np.concatenate([scan.xyz for scan in scans]).reshape(*there.shape, 3)
    assert np.array_equal(np.isfinite(xyz_m).all(axis=3), there)
    body_m = xyz_m[there].astype(np.float64) @ EYE.pose[:3, :3].T + EYE.pose[:3, 3]
    distance_m: F64Array = np.linalg.norm(body_m - EYE.pose[:3, 3], axis=1)
    aside_m = ASIDE_PER_M * distance_m + FLOAT32_M
    away_m: F64Array = np.linalg.norm(body_m - sight.xyz_m[order][there], axis=1)
    assert (away_m - aside_m).max() < 0
    off_m = EYE.scene.distance_to_surfaces(body_m)
    assert (off_m - aside_m - sight.unit_m / 2).max() < 0


def check_dense(sent: Sent, dense: Result, order: I64Array) -> None:
    """The order of points, and what is left out and counted."""
    columns = np.concatenate([[0], np.cumsum([len(one.column_stamp_ns) for one in dense.scans])])
    expected = Expected([sent.seen]).points(np.zeros(len(order), np.int64), order)
    column, at_ns = (
        np.concatenate(parts)
        for parts in (
            [
                np.asarray(scan.column, np.int64) + first
                for scan, first in zip(dense.scans, columns[:-1].tolist(), strict=True)
            ],
            [scan.time_ns.astype(np.int64) + scan.start_ns for scan in dense.scans],
        )
    )
    assert np.array_equal(column, expected.column)
    assert np.array_equal(joined(dense.scans, "ring"), expected.ring)
    assert np.abs(at_ns - expected.at_ns).max() <= MEASURED_NS.get(sent.model, 0)
    assert np.array_equal(joined(dense.scans, "intensity"), expected.level)
    again = int(repeated(sent.seen.counts).sum())
    assert (again > 0) == (sent.seen.returns > 1)
    points = dense.report.sensors[0].ledger.points
    assert (points.slots, points.repeated) == (sent.seen.counts.size, again)
    assert points.no_return == np.count_nonzero(sent.seen.counts == 0)
    assert points.written == points.slots - points.no_return - again == len(column)


def joined(scans: Sequence[Scan], name: str) -> F64Array:
    """An array of all scans, one after the other."""
    return np.concatenate([np.asarray(getattr(scan, name), np.float64) for scan in scans])
