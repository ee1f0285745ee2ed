"""Which calibration the packets of a stream were made with, by their bytes.

A calibration is of one unit (Ouster metadata, HESAI angles) or shared by all of a model; of those
every stream is a sensor of its own. What a rig says of it besides: `_rigged.py`.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mlbatch import sensors
from mlbatch.errors import RecordingError, RigError
from mlbatch.frames import GENERIC, namespace
from mlbatch.lidar import READABLE, Calibration, Evidence, Lidar
from mlbatch.streams import Found, Kind, Sampler
from mlbatch.types import StreamTable


@dataclass(frozen=True, slots=True)
class Matched:
    """Sensors, the kinds that are of none, and why calibrations that fit could not be used."""

    sensors: list[Found]
    unknown: list[Kind]
    failures: dict[Kind, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Fit:
    """A calibration that fits packets."""

    score: int
    number: int
    lidar: Lidar


def match(
    sampler: Sampler, calibrations: Sequence[Calibration], options: Mapping[str, str]
) -> Matched:
    """Sensors of a recording without a rig.

    Raises RecordingError where the packets do not tell which of several calibrations is theirs.
    """
    every = [*calibrations, *sensors.built_in()]
    found: dict[tuple[int, int], Found] = {}
    matched = Matched([], [])
    for kind in sampler.samples:
        fits, failure = best_fits(sampler.evidence(kind), every, options)
        if failure:
            matched.failures[kind] = failure
        if not fits:
            matched.unknown.append(kind)
        for fit in fits:
            key = fit.number, kind[0] if every[fit.number].is_shared else -1
            sensor = found.setdefault(key, Found("", fit.lidar))
            sensor.notes += other_size(sampler.table, sensor.lidar, kind)
            if sensor.lidar.packet_size in (kind[1], kind[1] - 1):
                sensor.kinds.add(kind)
    _refuse_shared(sampler.table, found, every)
    matched.sensors.extend(sorted(found.values(), key=lambda one: _order(sampler.table, one)))
    _name_all(sampler.table, matched.sensors)
    return matched


def _name_all(table: StreamTable, found: Sequence[Found]) -> None:
    """After the namespace of its topics if that tells a place, else maker and serial number."""
    counts: dict[str, int] = {}
    for sensor in found:
        maker = sensor.lidar.vendor.lower()
        counts[maker] = counts.get(maker, 0) + 1
        topic = min((table.streams[stream].topic for stream, _ in sensor.kinds), default="")
        place = "_".join(part for part in namespace(topic) if part not in GENERIC)
        if place and place[0].isalpha() and place.replace("_", "").isalnum():
            sensor.name = place
        else:
            sensor.name = f"{maker}_{sensor.lidar.serial or counts[maker]}"


def best_fits(
    evidence: Evidence,
    calibrations: Sequence[Calibration],
    options: Mapping[str, str],
    model: str | None = None,
) -> tuple[list[Fit], str]:
    """The sensors that sent a kind; several when the packets of units are mixed in it.

    model: that of the rig; it may be another one than the packets name. Second comes why a
    calibration that fits best could not be used.
    """
    fits: dict[bytes, list[tuple[int, int, Evidence]]] = {}
    for number, own, part in _parts(evidence, calibrations, options):
        score = calibrations[number].fit(part)
        if score > 0 or (score == READABLE and calibrations[number].model == model):
            fits.setdefault(own, []).append((score, number, part))
    best, failure = [], ""
    for group in fits.values():
        if model is not None:
            # A file of the unit knows more than what is built in for a model.
            group = [one for one in group if _is_of(calibrations[one[1]], model)] or group
        top = max(score for score, _, _ in group)
        first = [(number, part) for score, number, part in group if score == top]
        _refuse_ambiguous(evidence, [calibrations[number] for number, _ in first])
        number, part = first[0]
        try:
            best.append(Fit(top, number, calibrations[number].lidar(options, part)))
        except RigError as err:
            failure = str(err)
            if top == READABLE:
                what = sensors.describe(evidence.size, evidence.sample) or "others"
                failure = f"its packets are {what}, not {model}, as which they were read: {err}"
    return best, failure


def _is_of(calibration: Calibration, model: str) -> bool:
    return calibration.model == model or not calibration.is_shared


def _parts(
    evidence: Evidence, calibrations: Sequence[Calibration], options: Mapping[str, str]
) -> Iterator[tuple[int, bytes, Evidence]]:
    """Of each calibration the packets that may be its own: only serial numbers tell them apart."""
    everything = np.ones(len(evidence.sample), np.bool_)
    for number, calibration in enumerate(calibrations):
        if calibration.is_shared or not calibration.serial:
            yield number, everything.tobytes(), evidence
            continue
        try:
            lidar = calibration.lidar(options, evidence)
        except RigError:
            continue  # One that is switched off sends nothing.
        if evidence.size not in (lidar.packet_size, lidar.packet_size + 1):
            continue
        own = lidar.owns(evidence.sample[:, : lidar.packet_size])
        if own.any():
            part = replace(evidence, sample=evidence.sample[own], host_ns=evidence.host_ns[own])
            yield number, own.tobytes(), part


def _refuse_ambiguous(evidence: Evidence, calibrations: Sequence[Calibration]) -> None:
    """Several calibrations that fit alike are one only if they are of one unit."""
    files = [one for one in calibrations if one.path is not None]
    if len({one.serial or str(one.path) for one in files}) > 1:
        names = ", ".join(str(one.path) for one in files)
        raise RecordingError(
            f"packets of {evidence.stream} ({evidence.size} bytes) carry no serial number and "
            f"fit {len(files)} metadata files: {names}; wanted one; name the sensor of each "
            "source with stream.source_ip in a rig file (--rig), or give only its --metadata"
        )


def _refuse_shared(
    table: StreamTable, found: Mapping[tuple[int, int], Found], calibrations: Sequence[Calibration]
) -> None:
    """One unit sends from one place, unless its serial number says that it moved."""
    for (number, _), sensor in found.items():
        streams = sorted({str(table.streams[stream]) for stream, _ in sensor.kinds})
        if len(streams) > 1 and not sensor.lidar.carries_serial:
            raise RecordingError(
                f"metadata {calibrations[number].path} fits the packets of {len(streams)} "
                f"streams ({'; '.join(streams)}), which carry no serial number; wanted a metadata "
                "file each; name them in a rig file (--rig) with stream.source_ip"
            )


def _order(table: StreamTable, sensor: Found) -> tuple[int, int, tuple[tuple[int, int, str], ...]]:
    """By serial number, else source IP and port, else topic."""
    streams = (table.streams[number] for number, _ in sensor.kinds)
    places = tuple(sorted((_ip_number(s.source_ip), s.port, s.topic) for s in streams))
    if sensor.lidar.serial.isdigit():
        return (0, int(sensor.lidar.serial), places)
    return (1, 0, places)


def _ip_number(text: str) -> int:
    return int(ipaddress.ip_address(text)) if text else 0


def other_size(table: StreamTable, lidar: Lidar, kind: Kind) -> list[str]:
    """What is wrong with packets that are the lidar's, but of another size than its first ones."""
    size = lidar.packet_size
    if kind[1] in (size, size + 1):
        return []
    return [
        f"{table.streams[kind[0]]}: wanted packets of {size} bytes as at first, got {kind[1]} "
        "bytes as well, which are rejected as bad_size; split the recording where the settings "
        "of the lidar change"
    ]
