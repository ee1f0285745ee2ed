"""Matching of packets with calibrations, with and without a rig, by the content of the packets.

A calibration is of one unit (Ouster metadata, HESAI angles) or shared by all units of a model; of a
shared one every stream is a sensor of its own. File names play no part.
"""

from __future__ import annotations

import ipaddress
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from mlbatch import sensors
from mlbatch.arrays import BoolArray, U8Array, rows_of
from mlbatch.discovery.sampler import Sampler
from mlbatch.discovery.types import DetectedSensor, PacketKind
from mlbatch.errors import RecordingError, RigError
from mlbatch.frames.naming import GENERIC, namespace
from mlbatch.frames.tree import some
from mlbatch.lidar.interface import NAMED_ONLY, Calibration, Evidence, Lidar
from mlbatch.rig.rig import MAX_NAME, RigSensor, StreamSelector
from mlbatch.types import StreamTable

# Of the samples of a kind: some hundred packets of 1 kB are less.
_LARGE_BYTES = 1 << 20
# Characters of a number after a name, with `_`.
_NUMBER = 4


class Matched(NamedTuple):
    """Sensors, kinds of no sensor, and why a matching calibration of a kind could not be used."""

    sensors: list[DetectedSensor]
    unknown: list[PacketKind]
    failures: dict[PacketKind, str]


# -- the scorer -----------------------------------------------------------------------------------


class Fit(NamedTuple):
    """A calibration that matches packets; kinds: all that it fits, where several were tried."""

    score: int
    number: int  # index of the calibration
    lidar: Lidar
    kinds: frozenset[PacketKind] = frozenset()


class _Candidate(NamedTuple):
    score: int
    number: int
    evidence: Evidence


def best_fits(
    evidence: Evidence,
    calibrations: Sequence[Calibration],
    options: Mapping[str, str],
    model: str | None = None,
) -> tuple[list[Fit], str]:
    """Best calibration of each sensor that sent packets of a kind, and a failure or "".

    Several units may send packets of one kind. model: that of the rig, which may differ from the
    one in the packets. Failure: why a best calibration could not be used.
    """
    groups: dict[bytes, list[_Candidate]] = {}
    for number, own, part in _parts(evidence, calibrations, options):
        calibration = calibrations[number]
        score = calibration.match_score(part)
        if score > 0 or (score == NAMED_ONLY and calibration.model == model):
            groups.setdefault(own.tobytes(), []).append(_Candidate(score, number, part))
    fits: list[Fit] = []
    failure = ""
    for group in groups.values():
        if model is not None:
            # A file of the unit is preferred to the built-in calibration of its model.
            may_be = [
                one
                for one in group
                if calibrations[one.number].model == model or not calibrations[one.number].is_shared
            ]
            group = may_be or group
        score = max(one.score for one in group)
        best = [one for one in group if one.score == score]
        _refuse_ambiguous(evidence, [calibrations[one.number] for one in best])
        number = best[0].number
        try:
            lidar = calibrations[number].lidar(options, best[0].evidence)
            fits.append(Fit(score, number, lidar))
        except RigError as err:
            failure = str(err)
            if score == NAMED_ONLY:
                what = sensors.describe(evidence.size, evidence.sample) or "others"
                failure = f"its packets are {what}, not {model}, as which they were read: {err}"
    return fits, failure


def _parts(
    evidence: Evidence, calibrations: Sequence[Calibration], options: Mapping[str, str]
) -> Iterator[tuple[int, BoolArray, Evidence]]:
    """Of each calibration: index, mask (k,) of packets that may be its own, and their evidence.

    Only serial numbers separate the packets of units.
    """
    everything = np.ones(len(evidence.sample), np.bool_)
    for number, calibration in enumerate(calibrations):
        if calibration.is_shared or not calibration.serial:
            yield number, everything, evidence
            continue
        try:
            # Without packets, which may be those of several units.
            lidar = calibration.lidar(options, None)
        except RigError:
            continue  # The output of this sensor is off.
        if evidence.size not in (lidar.packet_size, lidar.packet_size + 1):
            continue
        own = lidar.sent_by_me(evidence.sample[:, : lidar.packet_size])
        if own.any():
            part = evidence._replace(
                sample=rows_of(evidence.sample, own), host_ns=rows_of(evidence.host_ns, own)
            )
            yield number, own, part


def _refuse_ambiguous(evidence: Evidence, calibrations: Sequence[Calibration]) -> None:
    """Raise RecordingError for equally good calibrations of several units."""
    files = [one for one in calibrations if one.path is not None]
    if len({one.serial or str(one.path) for one in files}) > 1:
        names = ", ".join(str(one.path) for one in files)
        raise RecordingError(
            f"packets of {evidence.stream} ({evidence.size} bytes) carry no serial number and "
            f"match {len(files)} metadata files: {names}; expected one; name the sensor of each "
            "source with stream.source_ip in a rig file (--rig), or give only its --metadata"
        )


def _other_size(table: StreamTable, lidar: Lidar, kind: PacketKind) -> list[str]:
    """A warning about packets of a lidar whose size differs from its first ones."""
    size = lidar.packet_size
    if kind.size in (size, size + 1):
        return []
    return [
        f"{table.streams[kind.stream]}: expected packets of {size} bytes as at first, found "
        f"{kind.size} bytes as well, which are rejected as bad_size; split the recording where the "
        "settings of the lidar change"
    ]


def senders(sampler: Sampler) -> set[str]:
    """Names of the built-in vendors that may have sent packets of a recording.

    Built-in calibrations of other vendors match none of them.
    """
    return {
        name
        for kind, samples in sampler.kinds.items()
        for name in sensors.senders(kind.size, samples.arrays()[0])
    }


# -- without a rig --------------------------------------------------------------------------------


def match(
    sampler: Sampler, calibrations: Sequence[Calibration], options: Mapping[str, str]
) -> Matched:
    """Sensors of a recording without a rig.

    Raises RecordingError where several calibrations match packets equally well.
    """
    every = [*calibrations, *sensors.built_in(senders(sampler))]
    # By index of the calibration, and by stream where it is shared.
    found: dict[tuple[int, int], DetectedSensor] = {}
    matched = Matched([], [], {})
    for kind in sampler.kinds:
        fits, failure = best_fits(sampler.evidence(kind), every, options)
        if failure:
            matched.failures[kind] = failure
        if not fits:
            matched.unknown.append(kind)
        for fit in fits:
            stream = kind.stream if every[fit.number].is_shared else -1
            sensor = found.setdefault((fit.number, stream), DetectedSensor("", fit.lidar))
            sensor.notes += _other_size(sampler.table, sensor.lidar, kind)
            if sensor.lidar.packet_size in (kind.size, kind.size - 1):
                sensor.kinds.add(kind)
    for (number, _), sensor in found.items():
        _refuse_several_streams(sampler.table, sensor, every[number])
    matched.sensors.extend(sorted(found.values(), key=lambda one: _order(sampler.table, one)))
    _name_all(sampler.table, matched.sensors)
    return matched


def _refuse_several_streams(
    table: StreamTable, sensor: DetectedSensor, calibration: Calibration
) -> None:
    """Raise RecordingError if a unit without serial number would send on several streams."""
    streams = sorted(str(table.streams[stream]) for stream in sensor.streams)
    if len(streams) > 1 and not sensor.lidar.carries_serial:
        raise RecordingError(
            f"metadata {calibration.path} matches the packets of {len(streams)} "
            f"streams ({'; '.join(streams)}), which carry no serial number; expected a metadata "
            "file each; name them in a rig file (--rig) with stream.source_ip"
        )


def _order(
    table: StreamTable, sensor: DetectedSensor
) -> tuple[int, int, tuple[tuple[int, int, str, str, int], ...]]:
    """Sort key: serial number, else source IP and port, else topic."""
    streams = (table.streams[kind.stream] for kind in sensor.kinds)
    places = tuple(
        sorted(
            (_ip_number(one.source_ip), one.port, one.topic, one.frame_id, one.lidar_id or 0)
            for one in streams
        )
    )
    if sensor.lidar.serial.isdigit():
        return (0, int(sensor.lidar.serial), places)
    return (1, 0, places)


def _ip_number(text: str) -> int:
    return int(ipaddress.ip_address(text)) if text else 0


def _name_all(table: StreamTable, found: Sequence[DetectedSensor]) -> None:
    """Name sensors after the namespace of their topics, else by vendor and serial number."""
    counts: dict[str, int] = {}
    for sensor in found:
        vendor = sensor.lidar.vendor.lower()
        counts[vendor] = counts.get(vendor, 0) + 1
        topic = min((table.streams[stream].topic for stream in sensor.streams), default="")
        place = "_".join(part for part in namespace(topic) if part not in GENERIC)
        is_name = place[:1].isalpha() and place.replace("_", "").isalnum()
        if is_name and len(place) <= MAX_NAME - _NUMBER:
            sensor.name = place
        else:
            sensor.name = f"{vendor}_{sensor.lidar.serial or counts[vendor]}"
        sensor.name = (sensor.name + _part(table, sensor))[: MAX_NAME - _NUMBER]
    _number_equal_names(found)


def _part(table: StreamTable, sensor: DetectedSensor) -> str:
    """The end of the name of a lidar whose clouds share a topic with others, else ""."""
    stream = min((table.streams[number] for number in sensor.streams), key=str)
    words = [stream.frame_id] if stream.frame_id else []
    words += [] if stream.lidar_id is None else [str(stream.lidar_id)]
    return "".join(f"_{re.sub(r'[^A-Za-z0-9]+', '_', word).strip('_')}" for word in words)


def _number_equal_names(found: Sequence[DetectedSensor]) -> None:
    """Give sensors on several topics of one namespace names of their own."""
    names = Counter(sensor.name for sensor in found)
    taken = set(names)
    for name in [name for name, count in names.items() if count > 1]:
        same = [sensor for sensor in found if sensor.name == name]
        for number, sensor in enumerate(same[1:], 2):
            while f"{name}_{number}" in taken:
                number += 1
            sensor.name = f"{name}_{number}"
            taken.add(sensor.name)


# -- with a rig -----------------------------------------------------------------------------------


class ExpectedSensor(NamedTuple):
    """A sensor of the rig, and calibrations it may have."""

    rig: RigSensor
    calibrations: Sequence[Calibration]
    options: Mapping[str, str]  # of the command line
    origin: Path  # the rig file

    def error(self, text: str) -> RigError:
        """Return an error about it."""
        return RigError(f"{self.origin}: sensor {self.rig.name}: {text}")

    @property
    def selector(self) -> StreamSelector:
        """Streams it may send on."""
        return self.rig.stream or StreamSelector()

    @property
    def decode(self) -> dict[str, str]:
        """Options of its decoder: the rig's, else the command line's."""
        return {**self.options, **self.rig.decode}

    def usable(self) -> list[Calibration]:
        """Calibrations of its serial number; those without a model get the rig's."""
        serial = self.selector.serial
        usable = [one for one in self.calibrations if not serial or one.serial in ("", serial)]
        model = self.rig.model
        if model is None:
            return usable
        return [
            (one.for_model(model) or one) if one.path is not None or one.model == model else one
            for one in usable
        ]


def match_rig(sampler: Sampler, expected: Sequence[ExpectedSensor]) -> Matched:
    """Sensors of a rig, in its order; RigError for a sensor without a matching calibration."""
    detected = [_detect(sampler, one) for one in expected]
    seen = [sensor for sensor in detected if sensor is not None]
    _refuse_same_packets(sampler.table, seen, expected[0].origin)
    taken = {kind for sensor in seen for kind in sensor.kinds}
    unknown = [kind for kind in sampler.kinds if kind not in taken]
    used = {sensor.lidar.calibration for sensor in seen}
    found = [
        sensor or _silent(sampler, one, unknown, used)
        for sensor, one in zip(detected, expected, strict=True)
    ]
    return Matched(found, unknown, {})


def is_model(expected: str | None, found: str) -> bool:
    """True if a lidar may be of the model that the rig names, if it names one."""
    if expected is None:
        return True
    rows = sensors.models(sensors.vendor_of(expected))
    reported_as = {row.same_packets_as for row in rows if row.name == expected}
    # Product lines carry suffixes for beam spacing: OS-1-64-AH is an OS1-64.
    return found in reported_as or found.replace("-", "").startswith(expected.replace("-", ""))


def _detect(sampler: Sampler, expected: ExpectedSensor) -> DetectedSensor | None:
    """A sensor of the rig by its packets; None if it sent none."""
    serial = expected.selector.serial
    usable = expected.usable()
    if not usable:
        _refuse_no_metadata(expected)
    has_own_file = any(serial and one.serial == serial for one in usable)
    if has_own_file:
        usable = [one for one in usable if one.serial == serial]
    matches: dict[int, Fit] = {}
    failures: list[str] = []
    other_serials: set[str] = set()
    other_models: set[str] = set()
    for kind in sampler.kinds:
        if not expected.selector.selects(sampler.table.streams[kind.stream]):
            continue
        evidence = sampler.evidence(kind)
        fits, failure = best_fits(evidence, usable, expected.decode, expected.rig.model)
        if failure:
            failures.append(failure)
        for fit in fits:
            if serial and fit.lidar.serial != serial:
                other_serials.add(fit.lidar.serial)
            elif not is_model(expected.rig.model, fit.lidar.model):
                other_models.add(fit.lidar.model)
            else:
                known = matches.get(fit.number, fit)
                best = fit if fit.score > known.score else known
                matches[fit.number] = best._replace(kinds=known.kinds | {kind})
    if matches:
        return _chosen(sampler, expected, list(matches.values()))
    if failures:
        raise expected.error(failures[0])
    if serial and not has_own_file:
        found = ", ".join(sorted(other_serials - {""}))
        if not found:
            _refuse_no_metadata(expected)
        raise expected.error(
            f"expected packets of serial number {serial}, found those of {found}; correct the "
            "serial"
        )
    if other_models:
        raise expected.error(
            f"expected packets of the model {expected.rig.model}, found those of "
            f"{', '.join(sorted(other_models))}; correct model, stream or metadata"
        )
    return None


def _chosen(sampler: Sampler, expected: ExpectedSensor, matches: Sequence[Fit]) -> DetectedSensor:
    """The only sensor that matches; merely readable packets count only without others."""
    sure = [one for one in matches if one.score != NAMED_ONLY] or matches
    best = max(sure, key=lambda one: one.score)
    lidar = best.lidar
    units = {one.lidar.serial or str(one.number) for one in sure}
    streams = {str(sampler.table.streams[kind.stream]) for one in sure for kind in one.kinds}
    if len(units) > 1 or (len(streams) > 1 and not lidar.carries_serial):
        models = sorted({one.lidar.model for one in sure})
        raise expected.error(
            f"expected packets of one lidar, found those of several ({', '.join(models)}) on "
            f"{', '.join(sorted(streams))}; name its stream (source_ip, port, topic or serial)"
        )
    rig = expected.rig
    found = DetectedSensor(rig.name, lidar, expected.selector, set(best.kinds), rig=rig)
    if best.score == NAMED_ONLY:
        what = describe(sampler, min(best.kinds)) or "another model"
        found.notes.append(f"read as {lidar.model}, which the rig names; it looks like {what}")
    for kind in sorted(best.kinds):
        found.notes += _other_size(sampler.table, lidar, kind)
    return found


def describe(sampler: Sampler, kind: PacketKind) -> str | None:
    """Description of the packets of a kind by their content; None if no vendor recognises them."""
    if kind in sampler.released:
        return sampler.released[kind]
    return sensors.describe(kind.size, sampler.kinds[kind].arrays()[0])


def describe_each(size: int, packets: U8Array) -> str | None:
    """Description of packets (k, size) one by one: a lidar's, since a damaged one may be first."""
    texts = [sensors.describe(size, packet[None]) for packet in packets]
    descriptions = [text for text in texts if text]
    return next(
        (text for text in descriptions if "lidar" in text),
        descriptions[0] if descriptions else None,
    )


def release(sampler: Sampler, kinds: Iterable[PacketKind]) -> None:
    """Replace large samples of some kinds by descriptions; only `describe` can use them then."""
    for kind in kinds:
        samples = sampler.kinds[kind]
        if len(samples.host_ns) * kind.size > _LARGE_BYTES:
            sampler.released[kind] = describe(sampler, kind)
            samples.pieces.clear()


def _refuse_same_packets(table: StreamTable, found: Sequence[DetectedSensor], origin: Path) -> None:
    """Raise RigError if sensors of a rig share packets that carry no serial number."""
    for number, one in enumerate(found):
        for other in found[:number]:
            apart = one.lidar.carries_serial and one.lidar.serial != other.lidar.serial
            shared = sorted(one.kinds & other.kinds)
            if shared and not apart:
                raise RigError(
                    f"{origin}: sensors {other.name} and {one.name}: expected one stream each, "
                    f"found {table.streams[shared[0].stream]} for both; name the stream of each "
                    "(source_ip, port, topic or serial)"
                )


def _refuse_no_metadata(expected: ExpectedSensor) -> NoReturn:
    # Not loaded where all have theirs.
    from mlbatch.sensors.advice import with_advice

    serial = expected.selector.serial
    numbered = f" with serial number {serial}" if serial else ""
    error = expected.error(
        f"no metadata{numbered} among {_paths(expected.calibrations)}; give it as `metadata:` of "
        "the sensor, or with --metadata"
    )
    raise RigError(with_advice(str(error), _vendor_of(expected.rig.model or "")))


def _vendor_of(model: str) -> str:
    """Vendor and name of a model of the rig; "" for none."""
    vendors = (one.vendor for one in sensors.models() if one.name == model)
    return f"{next(vendors, '')} {model}".strip()


def _silent(
    sampler: Sampler,
    expected: ExpectedSensor,
    unknown: Sequence[PacketKind],
    used: Collection[str],
) -> DetectedSensor:
    """A sensor of the rig that sent no packet; used: calibrations of sensors that did."""
    lidar: Lidar | None = None
    others = lidars_on(sampler, expected.selector, unknown)
    own = _own_calibrations(expected, used)
    if len(own) == 1:
        try:
            lidar = own[0].lidar(expected.decode, None)
        except RigError as err:
            if not others or own[0].path is None:
                raise expected.error(str(err)) from err
    if others:
        _refuse_other_lidars(expected, own, lidar, others)
    if lidar is None:
        selector = f" ({expected.selector})" if str(expected.selector) else ""
        which = f"which of {_paths(own)} is its metadata" if own else "its model"
        remedy = "`metadata:`" if own else "`metadata:` or `model:`"
        streams = {str(sampler.table.streams[kind.stream]) for kind in sampler.kinds}
        seen = f" (others are of {some(sorted(streams))})" if expected.selector.topic else ""
        raise expected.error(
            f"expected a packet of it{selector} in the first 10 seconds, found none to decide "
            f"{which}{seen}; correct its stream, or give {remedy}"
        )
    return DetectedSensor(expected.rig.name, lidar, expected.selector, rig=expected.rig)


def _refuse_other_lidars(
    expected: ExpectedSensor, own: Sequence[Calibration], lidar: Lidar | None, others: str
) -> None:
    """Raise RigError if other lidars' packets are on the stream of a silent sensor."""
    if not own:
        raise expected.error(
            f"expected metadata that match {others}, found none; give them as `metadata:` of the "
            "sensor, or with --metadata"
        )
    has_stream = bool(expected.selector.source_ip or expected.selector.topic)
    # Its own packets, had there been any, would be recognised among others by serial number.
    has_serial = lidar is not None and lidar.carries_serial
    if has_stream or (len(own) == 1 and not has_serial):
        is_built_in = any(one.path is None for one in own)
        which = f"of the model {expected.rig.model}" if is_built_in else f"that match {_paths(own)}"
        raise expected.error(
            f"expected packets {which}, found {others}; correct model, stream or metadata"
        )


def _own_calibrations(expected: ExpectedSensor, used: Collection[str]) -> list[Calibration]:
    """Calibrations a silent sensor may have: unused files, else the built-in one of its model."""
    usable = expected.usable()
    unused = [one for one in usable if one.path is not None]
    if len(expected.calibrations) > 1:
        unused = [one for one in unused if str(one.path) not in used]
    if expected.rig.model is None:
        return unused
    named = [one for one in usable if one.model == expected.rig.model]
    return [one for one in named if one.path is not None] or named or unused


def lidars_on(sampler: Sampler, selector: StreamSelector, kinds: Sequence[PacketKind]) -> str:
    """Descriptions of the lidars among the kinds that a selector selects, or ""."""
    lidars = []
    for kind in kinds:
        stream = sampler.table.streams[kind.stream]
        what = describe(sampler, kind) if selector.selects(stream) else None
        if what is not None and "lidar" in what:
            lidars.append(f"{what} ({stream})")
    return ", ".join(lidars)


def _paths(calibrations: Sequence[Calibration]) -> str:
    names = (str(one.path) for one in calibrations if one.path is not None)
    return ", ".join(names) or "the files given"
