"""What a recording knows of itself: its sensors, their calibrations and extrinsics."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mlbatch import sensors
from mlbatch.clocks.compare import refuse_incomparable
from mlbatch.clocks.timescale import gps_utc_s, tai_utc_s
from mlbatch.discovery.extrinsics import Mounted, in_words, mount
from mlbatch.discovery.match import Matched, Wanted, is_model, match, match_rig, shared_by
from mlbatch.discovery.probe import (
    calibrations_besides,
    calibrations_for,
    fault_of,
    look,
    read_given,
    with_clouds,
)
from mlbatch.discovery.router import Router
from mlbatch.discovery.sampler import Found, Kind, Sampler
from mlbatch.errors import RecordingError, RigError, UsageError
from mlbatch.frames.tree import some
from mlbatch.lidar.interface import Calibration, ModelFile
from mlbatch.rig.rig import Rig, RigSensor, StreamSelector, read_rig
from mlbatch.types import Recording, StreamTable
from mlbatch.units import NS_PER_S

# Of a list that may be long, in an error.
_SHOWN = 4
_NO_SUPPORTED = "wanted a supported lidar, got none; see `mlbatch sensors` for those that are"


@dataclass(frozen=True, slots=True)
class SensorSelection:
    """What the user said of the sensors, besides the rig."""

    rig: Path | None = None
    metadata: tuple[Path, ...] = ()
    only: tuple[str, ...] = ()
    ignore: tuple[str, ...] = ()
    identity_extrinsics: bool = False
    host_clock: bool = False
    aligned: bool = False
    decode: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Note:
    """A warning: a short code, the sensor it is about (or ""), one line for a person."""

    code: str
    sensor: str
    message: str


@dataclass(slots=True)
class Setup:
    """All sensors of a session, ready to convert.

    recordings: those to read, with the clouds that stand for packets.
    """

    sensors: list[Mounted]
    frame_id: str
    router: Router
    sampler: Sampler
    notes: list[Note]
    recordings: Sequence[Recording]
    rig: Rig | None = None
    not_in_rig: set[Kind] = field(default_factory=set)
    ignored: set[Kind] = field(default_factory=set)


def discover(
    recordings: Sequence[Recording], table: StreamTable, selection: SensorSelection
) -> Setup:
    """Find the sensors of a session; errors name what is missing and the ways to give it."""
    rig = None if selection.rig is None else read_rig(selection.rig)
    streams = [] if rig is None else [one.stream for one in rig.sensors if one.stream is not None]
    recordings = with_clouds(recordings, table, {stream.topic for stream in streams} - {""})
    sampler, learner = look(recordings, table)
    paths = [recording.path for recording in recordings]
    calibrations, files = calibrations_besides(rig, paths, selection.metadata)
    recorded = learner.calibrations()
    calibrations += recorded
    looked = [path.name for path in files] + [str(one.path) for one in recorded]
    if rig is None or selection.rig is None:
        matched = match(sampler, calibrations, selection.decode)
        rigged: list[RigSensor | None] = [None] * len(matched.sensors)
    else:
        rigged = list(rig.sensors)
        matched = _find_rigged(sampler, rig, selection.rig, calibrations, selection)
    found = matched.sensors
    lidar_kinds = [kind for kind in matched.unknown if _is_lidar(sampler, kind)]
    if not any(sensor.kinds for sensor in found):
        files = files or calibrations_for(paths, selection.metadata)[1]
        looked = [*(path.name for path in files), *(str(one.path) for one in recorded)]
        reason = _nothing_found(sampler, recordings, lidar_kinds, looked, matched.failures)
        faults = [*learner.faults, *filter(None, map(fault_of, files))]
        raise RecordingError(f"{reason}{_hints(recordings, faults)}")
    notes = [] if rig is not None else _unmatched(sampler, lidar_kinds, looked, matched.failures)
    notes += _unused(found, selection.metadata)
    chosen = _choose(found, selection)
    ignored = {kind for sensor in found if sensor not in chosen for kind in sensor.kinds}
    rigged = [entry for entry, sensor in zip(rigged, found, strict=True) if sensor in chosen]
    router = Router(table, chosen, sampler.samples)
    if shared := next(filter(None, (shared_by(sampler, sensor) for sensor in chosen)), ""):
        raise RecordingError(shared)
    _compare_clocks(sampler, chosen, rigged, selection)
    mounted, mounting = mount(
        table,
        chosen,
        rigged,
        rig,
        learner.knowledge,
        metadata_topics=learner.metadata_topics,
        identity_extrinsics=selection.identity_extrinsics,
    )
    for sensor in mounted:
        sensor.offset_ns = rig_offset_ns(sampler, sensor.found, sensor.rig)
    setup = Setup(mounted, mounting.body_frame, router, sampler, notes, recordings, ignored=ignored)
    notes += [Note("message", "", fault) for fault in learner.faults]
    notes += [Note(one.code, one.sensor, in_words(one)) for one in mounting.findings]
    if rig is not None:
        setup.rig = rig
        setup.not_in_rig = set(lidar_kinds)
    for sensor in mounted:
        texts = (*sensor.found.notes, *sensor.found.lidar.notes)
        notes += [Note("calibration", sensor.name, text) for text in texts]
        if not sensor.found.kinds:
            notes.append(
                Note("not_seen_yet", sensor.name, "no packet of it in the first 10 seconds")
            )
    return setup


def _find_rigged(
    sampler: Sampler,
    rig: Rig,
    origin: Path,
    calibrations: Sequence[Calibration],
    selection: SensorSelection,
) -> Matched:
    for sensor in rig.sensors:
        _refuse_undecodable(sampler, sensor, origin)
        _refuse_unknown_model(sensor, origin)
    wanted = [
        Wanted(
            sensor.name,
            sensor.stream or StreamSelector(),
            _of_model(_possible(sensor, calibrations), sensor.model),
            selection.decode | sensor.decode,
            sensor.model,
        )
        for sensor in rig.sensors
    ]
    try:
        matched = match_rig(sampler, wanted, origin)
    except UsageError as err:
        raise RigError(f"{origin}: {err}") from err
    for sensor, one in zip(rig.sensors, matched.sensors, strict=True):
        if sensor.model is not None:
            _check_model(sensor.name, sensor.model, one.lidar.model, origin)
    return matched


def _possible(sensor: RigSensor, calibrations: Sequence[Calibration]) -> list[Calibration]:
    """The calibration that the rig names; else those found, and all that are built in."""
    if sensor.metadata is not None:
        return [read_given(sensor.metadata)]
    return [*calibrations, *sensors.built_in()]


def _of_model(calibrations: Sequence[Calibration], model: str | None) -> list[Calibration]:
    """The calibrations, where files leave it open as those of the model that the rig names."""
    named = [
        one.for_model(model)
        if model is not None and one.path is not None and isinstance(one, ModelFile)
        else None
        for one in calibrations
    ]
    return [own or one for own, one in zip(named, calibrations, strict=True)]


def _refuse_undecodable(sampler: Sampler, sensor: RigSensor, origin: Path) -> None:
    """Do not ask for metadata where all lidars on a sensor's stream lack a decoder."""
    if sensor.stream is None or sensor.stream.serial:
        return
    streams = sampler.table.streams
    chosen = [kind for kind in sampler.samples if sensor.stream.selects(streams[kind[0]])]
    texts = [describe(sampler, kind) or "" for kind in chosen]
    carried = [text for text in texts if "lidar" in text]
    if carried and all(lacks_decoder(text) for text in carried):
        raise RigError(
            f"{origin}: sensor {sensor.name}: {sensor.stream} carries {carried[0]}; {_NO_SUPPORTED}"
        )


def _refuse_unknown_model(sensor: RigSensor, origin: Path) -> None:
    if sensor.model is None:
        return
    known = [model.name for model in sensors.models()]
    if sensor.model not in known:
        # A slip of case says more than a likeness of letters.
        near = [name for name in known if name.lower() == sensor.model.lower()]
        near = near or difflib.get_close_matches(sensor.model, known, 1)
        advice = f"did you mean {near[0]}?" if near else "see `mlbatch sensors`, or write auto"
        raise RigError(
            f"{origin}: sensor {sensor.name}: wanted a supported model, got {sensor.model!r}; "
            f"{advice}"
        )


def _check_model(name: str, wanted: str, got: str, origin: Path) -> None:
    """A model named in the rig must be the one that the calibration or the packets describe."""
    if not is_model(wanted, got):
        raise RigError(
            f"{origin}: sensor {name}: wanted the model {wanted}, got metadata of {got}; "
            "correct model or metadata"
        )


def named(sampler: Sampler, kind: Kind, types: Mapping[str, str]) -> str:
    """What a kind is: by its packets, else by the type of the messages that hold them."""
    carrier = types.get(sampler.table.streams[kind[0]].topic, "")
    other = f"packets of {carrier}, no decoder in this version" if carrier else "unknown"
    return describe(sampler, kind) or other


def _is_lidar(sampler: Sampler, kind: Kind) -> bool:
    """Whether a maker's module takes packets that no calibration fits for those of a lidar."""
    what = describe(sampler, kind)
    return what is not None and "lidar" in what


def describe(sampler: Sampler, kind: Kind) -> str | None:
    """What the packets of a kind look like, in words; None: like nothing we know."""
    evidence = sampler.evidence(kind)
    return sensors.describe(evidence.size, evidence.sample)


def packet_types(recordings: Sequence[Recording]) -> dict[str, str]:
    """Types of the messages of all topics, by the topics' names."""
    return {topic.name: topic.type for recording in recordings for topic in recording.topics}


def lacks_decoder(what: str) -> bool:
    """Whether packets so described are of a lidar that no metadata would make readable."""
    return "lidar" in what and "no decoder" in what


def _unmatched(
    sampler: Sampler, kinds: Sequence[Kind], looked: Sequence[str], failures: Mapping[Kind, str]
) -> list[Note]:
    notes = []
    for kind in kinds:
        stream, what = sampler.table.streams[kind[0]], describe(sampler, kind) or ""
        unassigned = "its packets are counted as unassigned"
        if lacks_decoder(what):
            text = f"{stream}: {what}; {unassigned}; {_NO_SUPPORTED}"
            notes.append(Note("no_decoder", "", text))
            continue
        why = f"wanted metadata that fits, got {_known(looked)}; {unassigned}; give --metadata FILE"
        if kind in failures:
            why = f"{failures[kind]}; {unassigned}"
        notes.append(Note("no_metadata", "", f"{stream}: {what}; {why}"))
    return notes


def _unused(found: Sequence[Found], given: Sequence[Path]) -> list[Note]:
    """Files that the user named, and no sensor took."""
    used = {sensor.lidar.calibration for sensor in found}
    advice = "it is not used; leave it out, or name its sensor in a rig file (--rig)"
    return [
        Note("calibration", "", f"{path}: wanted a sensor that it fits, got none; {advice}")
        for path in given
        if str(path) not in used
    ]


def _nothing_found(
    sampler: Sampler,
    recordings: Sequence[Recording],
    lidar_kinds: Sequence[Kind],
    looked: Sequence[str],
    failures: Mapping[Kind, str],
) -> RecordingError:
    where = ", ".join(str(recording.path) for recording in recordings)
    table, types = sampler.table, packet_types(recordings)
    for kind, why in failures.items():
        unfit = f" (does not fit: {some(looked, _SHOWN)})" if looked else ""
        return RecordingError(f"{where}: {table.streams[kind[0]]}: {why}{unfit}")
    carried = [(table.streams[kind[0]], describe(sampler, kind) or "") for kind in lidar_kinds]
    for stream, what in carried:
        if not lacks_decoder(what):
            return RecordingError(
                f"{where}: {stream} carries {what}; wanted metadata that fits, "
                f"got {_known(looked)}; give the sensor's with --metadata FILE"
            )
    if carried:
        stream, what = carried[0]
        return RecordingError(f"{where}: {stream} carries {what}; {_NO_SUPPORTED}")
    seen = [
        f"{table.streams[kind[0]]} ({kind[1]} bytes: {named(sampler, kind, types)})"
        for kind in sampler.samples
    ] or [f"{name} ({kind})" for name, kind in sorted(types.items())]
    remedy = (
        "record the topic on which the lidar's driver publishes its packets"
        if types
        else "check that the recording holds the sensor's data port"
    )
    return RecordingError(
        f"{where}: no lidar packets; wanted raw UDP packets of a supported lidar "
        f"(see `mlbatch sensors`), got {some(seen, _SHOWN) or 'no UDP packet at all'}; {remedy}"
    )


def _hints(recordings: Sequence[Recording], faults: Sequence[str]) -> str:
    """What is wrong with the recordings themselves, which may be why there is nothing."""
    notes = [f"{one.path.name}: {note}" for one in recordings for note in one.notes]
    hints = some([*notes, *faults], _SHOWN)
    return f" ({hints})" if hints else ""


def _known(words: Sequence[str]) -> str:
    return f"only {some(words, _SHOWN)}" if words else "none beside the recording"


def _compare_clocks(
    sampler: Sampler,
    chosen: Sequence[Found],
    rigged: Sequence[RigSensor | None],
    selection: SensorSelection,
) -> None:
    """Refuse clocks that cannot be merged before anything else is asked for."""
    if selection.aligned:
        return
    offsets_ns: list[tuple[str, int | None]] = []
    for sensor, entry in zip(chosen, rigged, strict=True):
        by_host = selection.host_clock or (entry is not None and entry.clock == "host")
        offset_ns = None if by_host else sampler.clock_offset_ns(sensor)
        if offset_ns is not None:
            offset_ns += rig_offset_ns(sampler, sensor, entry)
        offsets_ns.append((sensor.name, offset_ns))
        refuse_incomparable(offsets_ns, len(offsets_ns) - 1)


def rig_offset_ns(sampler: Sampler, sensor: Found, entry: RigSensor | None) -> int:
    """What the rig adds to a sensor's stamps: its offset, and what turns its epoch into UTC."""
    if entry is None:
        return 0
    hosts_ns = [sampler.span_ns[kind][0] for kind in sensor.kinds if kind in sampler.span_ns]
    utc_ns = min(hosts_ns, default=0)
    ahead_s = {"tai": tai_utc_s(utc_ns), "gps": gps_utc_s(utc_ns)}.get(entry.epoch or "", 0)
    return entry.offset_ns - ahead_s * NS_PER_S


def untimed(table: StreamTable, sensor: Found, option: str) -> UsageError | None:
    """The error about arrival times wanted of a sensor whose packets have none, or None."""
    for number in sorted({stream for stream, _ in sensor.kinds} & table.untimed):
        return UsageError(
            f"{option}: sensor {sensor.name}: wanted the arrival time of each packet, got only "
            f"that of whole messages on {table.streams[number]}; use --clock sensor (in the rig: "
            "clock.source) without --align-clocks, or record the packets with tcpdump"
        )
    return None


def _choose(found: Sequence[Found], selection: SensorSelection) -> list[Found]:
    """Apply --only and --ignore; both take names and serial numbers."""
    known = {word for sensor in found for word in (sensor.name, sensor.lidar.serial) if word}
    for option, words in (("--only", selection.only), ("--ignore", selection.ignore)):
        for word in words:
            if word not in known:
                raise UsageError(
                    f"{option}: wanted the name or serial number of a sensor, one of "
                    f"{', '.join(sensor.name for sensor in found)}, got {word!r}; choose one"
                )
    chosen = [
        sensor
        for sensor in found
        if (not selection.only or {sensor.name, sensor.lidar.serial} & set(selection.only))
        and not {sensor.name, sensor.lidar.serial} & set(selection.ignore)
    ]
    if not chosen:
        raise UsageError(
            "--only/--ignore: wanted at least one sensor to convert, got none that is left; "
            "leave one of them out"
        )
    return chosen


def absent(sensor: Mounted, rig: Path | None) -> RigError:
    """The error about a sensor of the rig that sent nothing."""
    selector = sensor.rig.stream if sensor.rig is not None else None
    lidar = sensor.found.lidar
    source = f"from {selector}" if selector else f"of a {lidar.model} ({lidar.calibration})"
    return RigError(
        f"{rig}: sensor {sensor.name}: wanted its packets, got none {source}; correct its stream "
        "or serial, or set `optional: true`"
    )
