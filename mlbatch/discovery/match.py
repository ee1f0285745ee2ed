"""Which calibration the packets of a stream were made with, by their bytes.

A calibration is of one unit (Ouster metadata, HESAI angles) or shared by all of a model; of those
every stream is a sensor of its own. What a rig says of it besides: `_rigged.py`.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from mlbatch import sensors
from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array, median
from mlbatch.discovery.sampler import Found, Kind, Sampler, as_rows
from mlbatch.errors import RecordingError, RigError
from mlbatch.frames.naming import GENERIC, namespace
from mlbatch.lidar.geometry import rotor_ticks
from mlbatch.lidar.interface import READABLE, Calibration, Evidence, Lidar, ModelFile
from mlbatch.rig.rig import StreamSelector
from mlbatch.types import Heads, StreamTable
from mlbatch.units import NS_PER_MS, NS_PER_S


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
        maker = sensor.lidar.maker.lower()
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


# Which packets are of which sensor of a rig, and with which calibration they were made.


@dataclass(frozen=True, slots=True)
class Wanted:
    """A sensor of the rig: where it sends from, its model if named, its possible calibrations."""

    name: str
    selector: StreamSelector
    calibrations: Sequence[Calibration]
    decode: Mapping[str, str]
    model: str | None = None


def match_rig(sampler: Sampler, wanted: Sequence[Wanted], origin: Path) -> Matched:
    """Sensors of a rig, in its order; origin: the rig file.

    Raises RigError where a sensor has no calibration.
    """
    seen = [_find(sampler, one, origin) for one in wanted]
    heard = [sensor for sensor in seen if sensor is not None]
    _refuse_same(sampler.table, heard, origin)
    taken = {kind for sensor in heard for kind in sensor.kinds}
    unknown = [kind for kind in sampler.samples if kind not in taken]
    used = {sensor.lidar.calibration for sensor in heard}
    found = [
        sensor or _silent(sampler, one, unknown, used, origin)
        for sensor, one in zip(seen, wanted, strict=True)
    ]
    return Matched(found, unknown)


def is_model(wanted: str, got: str) -> bool:
    """Whether a lidar is of the model that the rig names."""
    alike = {model.like for model in sensors.models() if model.name == wanted}
    # Product lines carry suffixes for beam spacing: OS-1-64-AH is an OS1-64.
    return got in alike or got.replace("-", "").startswith(wanted.replace("-", ""))


def _find(sampler: Sampler, wanted: Wanted, origin: Path) -> Found | None:
    """The sensor by its packets; None where there is none yet."""
    serial = wanted.selector.serial
    usable = _usable(wanted)
    _refuse_none(wanted, usable, origin)
    scored: dict[int, tuple[Fit, set[Kind]]] = {}
    failures, serials, models = list[str](), set[str](), set[str]()
    for kind in sampler.samples:
        if not wanted.selector.selects(sampler.table.streams[kind[0]]):
            continue
        fits, failure = best_fits(sampler.evidence(kind), usable, wanted.decode, wanted.model)
        failures += [failure] if failure else []
        for fit in fits:
            if serial and fit.lidar.serial != serial:
                serials.add(fit.lidar.serial)
            elif wanted.model is not None and not is_model(wanted.model, fit.lidar.model):
                models.add(fit.lidar.model)
            else:
                before, kinds = scored.get(fit.number, (fit, set[Kind]()))
                scored[fit.number] = max(before, fit, key=_score), kinds | {kind}
    if not scored:
        own = any(one.serial == serial for one in usable)
        if failures and not (serial and own):
            raise RigError(f"{origin}: sensor {wanted.name}: {failures[0]}")
        if serial and not own:
            _refuse_serial(wanted, serials - {""}, origin)
        _refuse_model(wanted, models, origin)
        return None
    return _chosen(sampler, wanted, list(scored.values()), origin)


def _usable(wanted: Wanted) -> list[Calibration]:
    serial = wanted.selector.serial
    usable = [one for one in wanted.calibrations if not serial or one.serial in ("", serial)]
    return [_named(one, wanted.model) for one in usable]


def _named(calibration: Calibration, model: str | None) -> Calibration:
    """What is built in for the model that the rig names knows so: packets may leave it open."""
    if model != calibration.model or not isinstance(calibration, ModelFile):
        return calibration
    return calibration.for_model(model) or calibration


def _chosen(
    sampler: Sampler, wanted: Wanted, scored: Sequence[tuple[Fit, set[Kind]]], origin: Path
) -> Found:
    """The only sensor that fits; packets that are merely readable do not count beside others."""
    sure = [one for one in scored if one[0].score != READABLE] or scored
    fit, kinds = max(sure, key=lambda one: one[0].score)
    units = {one.lidar.serial or str(one.number) for one, _ in sure}
    streams = {str(sampler.table.streams[kind[0]]) for _, those in sure for kind in those}
    if len(units) > 1 or (len(streams) > 1 and not fit.lidar.carries_serial):
        models = sorted({one.lidar.model for one, _ in sure})
        raise RigError(
            f"{origin}: sensor {wanted.name}: wanted packets of one lidar, got those of several "
            f"({', '.join(models)}) on {', '.join(sorted(streams))}; name its stream (source_ip, "
            "port, topic or serial)"
        )
    found = Found(wanted.name, fit.lidar, wanted.selector, kinds)
    if fit.score == READABLE:
        what = sensors.describe(*_first_of(sampler, kinds)) or "another model"
        found.notes.append(f"read as {fit.lidar.model}, which the rig names; it looks like {what}")
    for kind in sorted(kinds):
        found.notes += other_size(sampler.table, fit.lidar, kind)
    return found


def _refuse_same(table: StreamTable, found: Sequence[Found], origin: Path) -> None:
    """Two sensors of a rig share packets only where serial numbers tell these apart."""
    for number, one in enumerate(found):
        for other in found[:number]:
            apart = one.lidar.carries_serial and one.lidar.serial != other.lidar.serial
            shared = sorted(one.kinds & other.kinds)
            if shared and not apart:
                raise RigError(
                    f"{origin}: sensors {other.name} and {one.name}: wanted a stream each, got "
                    f"{table.streams[shared[0][0]]} for both; name the stream of each (source_ip, "
                    "port, topic or serial)"
                )


def _score(fit: Fit) -> int:
    return fit.score


def _first_of(sampler: Sampler, kinds: set[Kind]) -> tuple[int, U8Array]:
    evidence = sampler.evidence(min(kinds))
    return evidence.size, evidence.sample


def _refuse_none(wanted: Wanted, usable: Sequence[Calibration], origin: Path) -> None:
    if not usable:
        serial = wanted.selector.serial
        raise RigError(
            f"{origin}: sensor {wanted.name}: no metadata"
            + (f" with serial number {serial}" if serial else "")
            + f" among {_paths(wanted.calibrations)}; give it as `metadata:` of the sensor, or "
            "with --metadata"
        )


def _refuse_serial(wanted: Wanted, others: Collection[str], origin: Path) -> None:
    """A serial number that neither packets nor files bear; others: those of the packets."""
    if not others:
        _refuse_none(wanted, (), origin)
    raise RigError(
        f"{origin}: sensor {wanted.name}: wanted packets of serial number "
        f"{wanted.selector.serial}, got those of {', '.join(sorted(others))}; correct the serial"
    )


def _refuse_model(wanted: Wanted, models: Collection[str], origin: Path) -> None:
    """Packets that are of other models than the rig says."""
    if models:
        raise RigError(
            f"{origin}: sensor {wanted.name}: wanted packets of the model {wanted.model}, got "
            f"those of {', '.join(sorted(models))}; correct model, stream or metadata"
        )


def _silent(
    sampler: Sampler,
    wanted: Wanted,
    unknown: Sequence[Kind],
    used: Collection[str],
    origin: Path,
) -> Found:
    """A sensor of which no packet was seen; used: calibrations of those that were."""
    lidar, carried = None, _carried(sampler, wanted.selector, unknown)
    own = _own(wanted, used)
    if len(own) == 1:
        try:
            lidar = own[0].lidar(wanted.decode, None)
        except RigError as err:
            if not carried or own[0].path is None:
                raise RigError(f"{origin}: sensor {wanted.name}: {err}") from err
    if carried:
        _refuse_carried(wanted, own, lidar, carried, origin)
    if lidar is None:
        selector = f" ({wanted.selector})" if str(wanted.selector) else ""
        which = f"which of {_paths(own)} is its metadata" if own else "its model"
        remedy = "`metadata:`" if own else "`metadata:` or `model:`"
        raise RigError(
            f"{origin}: sensor {wanted.name}: wanted a packet of it{selector} in the first 10 "
            f"seconds, got none to tell {which}; correct its stream, or give {remedy}"
        )
    return Found(wanted.name, lidar, wanted.selector)


def _refuse_carried(
    wanted: Wanted, own: Sequence[Calibration], lidar: Lidar | None, carried: str, origin: Path
) -> None:
    """A silent sensor whose place other packets come from, or that they surely stand for."""
    start = f"{origin}: sensor {wanted.name}: wanted"
    if not own:
        raise RigError(
            f"{start} metadata that fit {carried}, got none; give them as `metadata:` of the "
            "sensor, or with --metadata"
        )
    is_placed = bool(wanted.selector.source_ip or wanted.selector.topic)
    if is_placed or (len(own) == 1 and not _tells_serial(lidar)):
        is_built_in = any(one.path is None for one in own)
        which = f"of the model {wanted.model}" if is_built_in else f"that fit {_paths(own)}"
        raise RigError(f"{start} packets {which}, got {carried}; correct model, stream or metadata")


def _tells_serial(lidar: Lidar | None) -> bool:
    """Whether the sensor's own packets would have been known among others."""
    return lidar is not None and lidar.carries_serial


def _own(wanted: Wanted, used: Collection[str]) -> list[Calibration]:
    """Calibrations that may be those of a silent sensor: files, or what its model has built in."""
    usable = _usable(wanted)
    own = [one for one in usable if one.path is not None]
    if len(wanted.calibrations) > 1:
        own = [one for one in own if str(one.path) not in used]
    if wanted.model is None:
        return own
    named = [one for one in usable if one.model == wanted.model]
    return [one for one in named if one.path is not None] or named or own


def _carried(sampler: Sampler, selector: StreamSelector, kinds: Sequence[Kind]) -> str:
    """Lidars whose packets a selector selects, though none fits; "" where there are none."""
    found = []
    for kind in kinds:
        stream, what = sampler.table.streams[kind[0]], None
        if selector.selects(stream):
            what = sensors.describe(*_first_of(sampler, {kind}))
        if what is not None and "lidar" in what:
            found.append(f"{what} ({stream})")
    return ", ".join(found)


def _paths(calibrations: Sequence[Calibration]) -> str:
    names = (str(one.path) for one in calibrations if one.path is not None)
    return ", ".join(names) or "the files given"


# Several lidars behind one address: their packets cannot be told apart, and must not be mixed.
#
# The columns of a packet follow those of the one before. Where packets of one stream overlap in
# time, some of them or with the rotor elsewhere, or where stamps step to and fro, more than one
# lidar sends. Repeated packets and packets out of order do not look so.

# Steps from packet to packet, by the time from the first to the last column of one: those that
# overlap, with a margin for rounded stamps, and those of packets with none between them.
_WITHIN, _NEXT = 0.95, 2.5
# Steps of several lidars, of those between packets that follow each other.
_MANY, _ALL = 0.15, 0.9
_FEWEST_STEPS = 8
# A rotor is elsewhere, by what it turns in a step, and by what angles are rounded to.
_ELSEWHERE, _RESOLUTION_TURNS = 0.25, 1e-3
_TURN = 2.0**32


def shared_by(sampler: Sampler, sensor: Found) -> str:
    """What is wrong with a sensor's stream that several lidars share, or ""."""
    for kind in sorted(sensor.kinds):
        if kind in sampler.samples:
            heads = _heads(sampler, kind, sensor.lidar)
            step_ns = _foreign_step_ns(heads, sensor.lidar)
            if step_ns is not None:
                span_ns = median(_spans_ns(heads))
                return (
                    f"sensor {sensor.name}: {sampler.table.streams[kind[0]]}: wanted packets of "
                    f"one {sensor.lidar.model}, got packets of {span_ns / NS_PER_MS:.3f} ms that "
                    f"step by {step_ns / NS_PER_MS:+.3f} ms: several lidars share the address; "
                    "give each an address or a port of its own and record again"
                )
    return ""


def _heads(sampler: Sampler, kind: Kind, lidar: Lidar) -> Heads:
    """Those of the good samples of a kind all of whose columns are valid."""
    packets = as_rows(sampler.samples[kind], kind[1])[:, : lidar.packet_size]
    hosts_ns = np.array(sampler.sample_host_ns[kind], np.int64)
    good = lidar.owns(packets) & (lidar.faults(packets) == 0)
    heads = lidar.heads(packets[good], hosts_ns[good])
    whole = heads.valid.all(axis=1)
    return Heads(heads.stamp_ns[whole], heads.encoder[whole], heads.valid[whole])


def _spans_ns(heads: Heads) -> F64Array:
    """(P,) from the first column of each packet to the last."""
    return np.asarray(heads.stamp_ns[:, -1] - heads.stamp_ns[:, 0], np.float64)


def _foreign_step_ns(heads: Heads, lidar: Lidar) -> float | None:
    """A usual step of those that one lidar cannot make; None where there are hardly any."""
    span_ns = _spans_ns(heads)
    step_ns = np.diff(heads.stamp_ns[:, 0]).astype(np.float64)
    near_ns = np.minimum(span_ns[1:], span_ns[:-1])
    to_and_fro = step_ns < -NS_PER_S
    overlaps = (step_ns != 0) & (np.abs(step_ns) < _WITHIN * near_ns)
    foreign = overlaps | to_and_fro
    steps = (step_ns != 0) & (np.abs(step_ns) < _NEXT * near_ns) | to_and_fro
    count, foreigners = int(np.count_nonzero(steps)), int(np.count_nonzero(foreign))
    if count < _FEWEST_STEPS or foreigners < _MANY * count:
        return None
    if foreigners > _ALL * count and not to_and_fro.any():
        # Either two lidars half a packet apart, or one whose pace is not what we know.
        rows = np.flatnonzero(steps)
        elsewhere = _off_course(heads, rows, step_ns[rows], lidar)
        if np.count_nonzero(elsewhere) < _MANY * count:
            return None
    return median(step_ns[foreign])


def _off_course(heads: Heads, rows: I64Array, step_ns: F64Array, lidar: Lidar) -> BoolArray:
    """At which of the steps (n,) from these packets the rotor did not turn as on the whole."""
    positions = lidar.beams.angle_rad
    first = heads.encoder[:, 0]
    angle = rotor_ticks(first) / _TURN if positions is None else first / len(positions)
    turned = np.diff(angle)[rows]
    turned -= np.rint(turned)
    usual = step_ns * (turned.sum() / max(abs(step_ns.sum()), 1.0))
    off = np.abs(turned - usual - np.rint(turned - usual))
    return np.asarray(off > np.maximum(_ELSEWHERE * np.abs(usual), _RESOLUTION_TURNS), np.bool_)
