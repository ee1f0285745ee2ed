"""Which packets are of which sensor of a rig, and with which calibration they were made."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mlbatch import sensors
from mlbatch.errors import RigError
from mlbatch.lidar import READABLE, Calibration, Lidar, ModelFile
from mlbatch.matching import Fit, Matched, best_fits, other_size
from mlbatch.rig import StreamSelector
from mlbatch.streams import Found, Kind, Sampler
from mlbatch.types import StreamTable, U8Array


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
    alike = {model.same_packets_as for model in sensors.models() if model.name == wanted}
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
