"""Targets: the packets of every model and mode, and the calibration files of every vendor."""

from __future__ import annotations

import contextlib
import json
import random
import zlib
from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from mlbatch import sensors
from mlbatch.errors import MlbatchError
from mlbatch.lidar.interface import Calibration, Evidence
from mlbatch.sensors.ouster.profiles import PROFILES
from mlbatch.simulate.ouster import encode as ouster
from mlbatch.simulate.robosense.encode import RobosenseSpec, angles_csv
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from mlbatch.simulate.velodyne.models import calibration_yaml
from tests.builders.every_model import CASES, sent_by
from tests.builders.lidar_packets import device_payloads, vendor_of
from tests.builders.livox import (
    CARTESIAN16,
    CARTESIAN32,
    DUAL,
    SPHERICAL,
    LivoxSpec,
    imu_packet,
    point_packets,
)
from tests.builders.others import livox1_packets
from tests.builders.velodyne_xml import entries, xml_of
from tests.builders.vendors import wrongly_excluded_file
from tests.contract.tree import ROOT
from tests.fuzz.decoding import check_lidar, decode_samples, sampled, try_all
from tests.fuzz.framing import Part, joined, mutated_parts, parts_of
from tests.fuzz.harness import BrokenLaw, Target
from tests.fuzz.mutation import Seeds, mutated, mutated_text

# Parts of an input that are no datagrams: a calibration, its name.
CALIBRATION, _LIDAR_PORT, DEVICE_PORT = 0, 2368, 7788
_PACKETS = 8
_OUSTER_PACKETS = 3
START_NS = 1_700_000_000_000_000_000
NAMES = (".json", ".yaml", ".xml", ".csv", ".dat")


@lru_cache(maxsize=1)
def _streams() -> dict[str, Seeds]:
    """Inputs of every vendor: a few packets of each model and mode, and their other packets."""
    found: dict[str, list[bytes]] = {"ouster": [], "livox": _livox()}
    for spec in CASES:
        sent = sent_by(spec)
        parts = []
        if sent.file:
            kind = NAMES.index(Path(sent.file).suffix)
            parts.append(Part(CALIBRATION, kind, spec.files.content))
        parts += [Part(_LIDAR_PORT, at, data) for at, data in sent.payloads[:_PACKETS]]
        parts += [Part(DEVICE_PORT, at, data) for at, data in sent.neighbours]
        found.setdefault(vendor_of(spec), []).append(joined(parts))
    positions = [Part(8308, at, data) for at, data in device_payloads(VelodyneSpec("VLP-16"))]
    found["velodyne"] += [joined([*parts_of(found["velodyne"][0]), *positions])]
    found["ouster"] += [
        _ouster(profile) for profile in PROFILES if "RANGE" in PROFILES[profile].fields
    ]
    return {vendor: tuple(seeds) for vendor, seeds in found.items()}


def _livox() -> list[bytes]:
    seeds = []
    for kind in (CARTESIAN32, CARTESIAN16, SPHERICAL, DUAL):
        spec = LivoxSpec(kind, points=12, frame_packets=4)
        shape = (12 * _PACKETS, spec.returns)
        coordinates = np.full((*shape, 3), 1500, np.int64)
        sent = point_packets(spec, coordinates, np.full(shape, 7, np.int64))
        other = imu_packet(spec, spec.start_ns, np.zeros(3), np.ones(3))
        seeds.append(
            joined([*(Part(56301, at, data) for at, data in sent), Part(56401, sent[0][0], other)])
        )
    old = livox1_packets(2, 1362)
    seeds.append(joined(Part(56001, 10**18 + at, row.tobytes()) for at, row in enumerate(old)))
    return seeds


def _ouster(profile: str) -> bytes:
    spec = ouster.OusterSpec(profile, beams=32, columns_per_frame=512)
    content = json.dumps(ouster.metadata_json(spec)).encode()
    mids = np.arange(spec.columns_per_packet * _OUSTER_PACKETS)
    ranges = np.resize([0, 904, 12_000, 250_000], (len(mids), spec.beams))
    payloads = ouster.encode_packets(
        spec, START_NS + mids * 195_312, mids, np.full(len(mids), 7), {"RANGE": ranges}
    )
    other = ouster.imu_packet(spec, np.array([START_NS]), np.ones((1, 3)), np.zeros((1, 3)))
    return joined(
        [
            Part(CALIBRATION, NAMES.index(".json"), content),
            *(Part(7502, START_NS + number, row) for number, row in enumerate(payloads)),
            Part(7503, START_NS, other),
        ]
    )


def _decode(data: bytes, folder: Path) -> None:
    """Find and decode the sensors of an input, with the calibration that is in it."""
    parts = parts_of(data)
    calibrations: list[Calibration] = []
    for part in parts:
        if part.kind == CALIBRATION:
            path = Path(f"unit{NAMES[part.host_ns % len(NAMES)]}")
            found = sensors.parse_calibration(path, part.data)
            calibrations += [] if found is None else [found]
    sampler = sampled(part for part in parts if part.kind != CALIBRATION)
    decode_samples(sampler, calibrations, random.Random(zlib.crc32(data)))


# -- calibration files ----------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _files() -> dict[str, Seeds]:
    """Calibration files by their suffix."""
    found: dict[str, list[bytes]] = {name: [] for name in NAMES}
    for seeds in _streams().values():
        for seed in seeds:
            for part in parts_of(seed):
                if part.kind == CALIBRATION:
                    found[NAMES[part.host_ns]].append(part.data)
    for path in sorted((ROOT / "fixtures").glob("*/*.json")):
        found[".json"].append(path.read_bytes())
    flat = ouster.OusterSpec("LEGACY", beams=16)
    found[".json"].append(json.dumps(ouster.flat_json(flat)).encode())
    found[".yaml"] += [calibration_yaml(model).encode() for model in ("VLP-16", "HDL-64E S2")]
    found[".xml"] += [
        xml_of(entries(64), [1] * 64).encode(),
        xml_of(entries(16)).encode(),
    ]
    found[".csv"].append(angles_csv(RobosenseSpec("Helios 32-31").angles).encode())
    return {name: tuple(dict.fromkeys(seeds)) for name, seeds in found.items()}


@lru_cache(maxsize=1)
def _seen() -> Sequence[Part]:
    """Sound packets of several vendors, to be decoded with files that are not."""
    streams = _streams()
    sounds = [parts_of(seeds[0]) for seeds in streams.values()] + [
        parts_of(seed) for seed in streams["hesai"][::9]
    ]
    return [part for parts in sounds for part in parts if part.kind != CALIBRATION]


@lru_cache(maxsize=1)
def _evidence() -> Sequence[Evidence]:
    sampler = sampled(_seen())
    return [sampler.evidence(kind) for kind in sampler.kinds]


def _calibrate(suffix: str, data: bytes, folder: Path) -> None:
    """Read a file; where it is one, decode sound packets with it."""
    if excluded := wrongly_excluded_file(Path(f"unit{suffix}"), data):
        raise BrokenLaw(f"a file that {excluded} know, though `may_calibrate` is False")
    calibration = sensors.parse_calibration(Path(f"unit{suffix}"), data)
    if calibration is None:
        return
    rng = random.Random(zlib.crc32(data))
    own = [calibration.for_model(model.name) for model in sensors.models()]
    every = [calibration, *[one for one in own if one is not None][:3]]
    for one in every:
        try_all(one, rng)
        for evidence in _evidence():
            if one.match_score(evidence):
                with contextlib.suppress(MlbatchError):
                    check_lidar(one.lidar({}, evidence), evidence.sample, evidence.host_ns)


def seeds_of(vendor: str) -> Seeds:
    """Inputs of a vendor's lidars."""
    return _streams()[vendor]


def files_of(suffix: str) -> Seeds:
    """Calibration files with a suffix."""
    return _files()[suffix]


_SHARES = {"velodyne": 6, "hesai": 8, "robosense": 8, "livox": 6, "ouster": 6}
TARGETS: Sequence[Target] = (
    *(
        Target(f"packets {vendor}", partial(seeds_of, vendor), _decode, mutated_parts, share)
        for vendor, share in _SHARES.items()
    ),
    *(
        Target(
            f"calibration {suffix}",
            partial(files_of, suffix),
            partial(_calibrate, suffix),
            mutated if suffix == ".dat" else mutated_text,
            4 if suffix == ".yaml" else 20,
        )
        for suffix in NAMES
    ),
)
