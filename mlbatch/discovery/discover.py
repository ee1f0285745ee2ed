"""The sensors of a session: packets, calibrations, extrinsics and clocks put together."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

from mlbatch import sensors
from mlbatch.clocks.compare import refuse_incomparable
from mlbatch.clocks.timescale import gps_utc_s, tai_utc_s
from mlbatch.discovery.extrinsics import place
from mlbatch.discovery.interleaved import shared_address
from mlbatch.discovery.match import (
    ExpectedSensor,
    Matched,
    describe,
    is_model,
    match,
    match_rig,
)
from mlbatch.discovery.probe import (
    MetadataCollector,
    fault_of,
    find_calibrations,
    probe,
    read_given,
    with_clouds,
)
from mlbatch.discovery.router import Router
from mlbatch.discovery.sampler import Sampler
from mlbatch.discovery.types import DetectedSensor, Note, PacketKind
from mlbatch.errors import RecordingError, RigError, UsageError
from mlbatch.frames.tree import some
from mlbatch.lidar.interface import Calibration
from mlbatch.rig.rig import Rig, RigSensor, read_rig
from mlbatch.types import Recording, StreamTable
from mlbatch.units import NS_PER_S

# Items of a list in an error.
_SHOWN = 4
_NO_SUPPORTED = "expected a supported lidar, found none; see `mlbatch sensors` for those that are"


@dataclass(frozen=True, slots=True)
class SensorSelection:
    """Which sensors to convert, and what is known of them: options of the command line."""

    rig: Path | None = None
    metadata: tuple[Path, ...] = ()
    only: tuple[str, ...] = ()  # names or serial numbers
    ignore: tuple[str, ...] = ()  # names or serial numbers
    identity_extrinsics: bool = False  # accept sensors without extrinsics
    host_clock: bool = False  # receive times replace timestamps
    aligned: bool = False  # --align-clocks: clocks need not be comparable
    decode: dict[str, str] = field(default_factory=dict)  # options of vendors


@dataclass(slots=True)
class Discovery:
    """The sensors of a session, and what they were detected from."""

    sensors: list[DetectedSensor]  # in the order of `lidar_id`
    frame_id: str  # of the body
    router: Router
    sampler: Sampler
    recordings: Sequence[Recording]  # to read: decoded clouds are packets
    examined: list[Path]  # files that may be calibrations
    rig: Rig | None = None
    notes: list[Note] = field(default_factory=list)
    not_in_rig: set[PacketKind] = field(default_factory=set)
    ignored: set[PacketKind] = field(default_factory=set)


def discover(
    recordings: Sequence[Recording],
    table: StreamTable,
    selection: SensorSelection,
    *,
    to_convert: bool = True,
) -> Discovery:
    """Find the sensors of a session.

    to_convert: raise an error for sensors that cannot be converted: none found, several at one
    address, clocks that cannot be compared. It names what is missing and how to give it.
    """
    rig = None if selection.rig is None else read_rig(selection.rig)
    recordings = with_clouds(recordings, table, _topics(rig))
    sampler, collector = probe(recordings, table)
    paths = [recording.path for recording in recordings]
    calibrations: list[Calibration] = []
    examined: list[Path] = []
    # Every file in the directory would be read by all vendors.
    if rig is None or selection.metadata or not all(one.metadata for one in rig.sensors):
        calibrations, examined = find_calibrations(paths, selection.metadata)
    recorded = collector.calibrations()
    calibrations += recorded
    matched = _match(sampler, calibrations, selection, rig)
    lidar_kinds = [kind for kind in matched.unknown if _is_lidar(sampler, kind)]
    if to_convert and not any(sensor.kinds for sensor in matched.sensors):
        examined = examined or find_calibrations(paths, selection.metadata)[1]
        names = _names(examined, recorded)
        reason = _why_none(sampler, recordings, lidar_kinds, names, matched.failures)
        raise RecordingError(f"{reason}{_hints(recordings, examined, collector)}")
    notes: list[Note] = []
    if rig is None:
        notes += _unmatched(sampler, lidar_kinds, _names(examined, recorded), matched.failures)
    notes += _unused(matched.sensors, selection.metadata)
    chosen = _choose(matched.sensors, selection)
    for sensor in chosen:
        sensor.offset_ns = _rig_offset_ns(sampler, sensor)
    if to_convert:
        _refuse_shared_addresses(sampler, chosen)
        _refuse_incomparable_clocks(sampler, chosen, selection)
    extrinsics = place(
        chosen,
        collector.extrinsics,
        table,
        rig,
        calibration_topics=collector.calibration_topics,
        identity_extrinsics=selection.identity_extrinsics,
    )
    notes += [Note("message", "", fault) for fault in collector.faults]
    notes += extrinsics.notes
    for sensor in chosen:
        texts = (*sensor.notes, *sensor.lidar.notes)
        notes += [Note("calibration", sensor.name, text) for text in texts]
        if not sensor.kinds:
            text = "no packet of it in the first 10 seconds"
            notes.append(Note("not_seen_yet", sensor.name, text))
    return Discovery(
        sensors=chosen,
        frame_id=extrinsics.body_frame,
        router=Router(table, chosen, sampler.kinds),
        sampler=sampler,
        recordings=recordings,
        examined=examined,
        rig=rig,
        notes=notes,
        not_in_rig=set() if rig is None else set(lidar_kinds),
        ignored={kind for one in matched.sensors if one not in chosen for kind in one.kinds},
    )


def refuse_untimed(table: StreamTable, sensor: DetectedSensor, option: str) -> None:
    """Raise UsageError if packets of a sensor have no receive times, which an option needs."""
    for number in sorted(sensor.streams & table.untimed):
        raise UsageError(
            f"{option}: sensor {sensor.name}: expected the receive time of each packet, found only "
            f"that of whole messages on {table.streams[number]}; use --clock sensor (in the rig: "
            "clock.source) without --align-clocks, or record the packets with tcpdump"
        )


def refuse_absent(sensor: DetectedSensor, rig: Path | None) -> NoReturn:
    """Raise RigError for a required sensor of the rig that sent no packet."""
    lidar = sensor.lidar
    selector = None if sensor.rig is None else sensor.rig.stream
    source = f"from {selector}" if selector else f"of a {lidar.model} ({lidar.calibration})"
    raise RigError(
        f"{rig}: sensor {sensor.name}: expected its packets, found none {source}; correct its "
        "stream or serial, or set `optional: true`"
    )


def name_kind(sampler: Sampler, kind: PacketKind, types: Mapping[str, str]) -> str:
    """Description of a kind by its packets, else by the type of their messages."""
    message_type = types.get(sampler.table.streams[kind.stream].topic, "")
    other = f"packets of {message_type}, no decoder in this version" if message_type else "unknown"
    return describe(sampler, kind) or other


def packet_types(recordings: Sequence[Recording]) -> dict[str, str]:
    """Message types by topic."""
    return {topic.name: topic.type for recording in recordings for topic in recording.topics}


def lacks_decoder(what: str) -> bool:
    """True if a description is of a lidar that no metadata would make readable."""
    return "lidar" in what and "no decoder" in what


def _is_lidar(sampler: Sampler, kind: PacketKind) -> bool:
    what = describe(sampler, kind)
    return what is not None and "lidar" in what


# -- sensors of the rig ---------------------------------------------------------------------------


def _topics(rig: Rig | None) -> set[str]:
    """Topics in the rig."""
    streams = [] if rig is None else [one.stream for one in rig.sensors if one.stream is not None]
    return {stream.topic for stream in streams} - {""}


def _match(
    sampler: Sampler,
    calibrations: Sequence[Calibration],
    selection: SensorSelection,
    rig: Rig | None,
) -> Matched:
    if rig is None or selection.rig is None:
        return match(sampler, calibrations, selection.decode)
    origin = selection.rig
    for sensor in rig.sensors:
        _refuse_undecodable(sampler, sensor, origin)
        _refuse_unknown_model(sensor, origin)
    # Built-in calibrations load all vendors, and are not needed where the rig names all files.
    expected = [
        ExpectedSensor(
            sensor,
            [*calibrations, *sensors.built_in()]
            if sensor.metadata is None
            else [read_given(sensor.metadata)],
            selection.decode,
        )
        for sensor in rig.sensors
    ]
    try:
        matched = match_rig(sampler, expected, origin)
    except UsageError as err:
        raise RigError(f"{origin}: {err}") from err
    for sensor, detected in zip(rig.sensors, matched.sensors, strict=True):
        if sensor.model is not None and not is_model(sensor.model, detected.lidar.model):
            raise RigError(
                f"{origin}: sensor {sensor.name}: expected the model {sensor.model}, found "
                f"metadata of {detected.lidar.model}; correct model or metadata"
            )
    return matched


def _refuse_undecodable(sampler: Sampler, sensor: RigSensor, origin: Path) -> None:
    """Raise RigError if no lidar on a sensor's stream has a decoder: metadata would not help."""
    if sensor.stream is None or sensor.stream.serial:
        return
    streams = sampler.table.streams
    chosen = [kind for kind in sampler.kinds if sensor.stream.selects(streams[kind.stream])]
    texts = [describe(sampler, kind) or "" for kind in chosen]
    lidars = [text for text in texts if "lidar" in text]
    if lidars and all(map(lacks_decoder, lidars)):
        raise RigError(
            f"{origin}: sensor {sensor.name}: {sensor.stream} carries {lidars[0]}; {_NO_SUPPORTED}"
        )


def _refuse_unknown_model(sensor: RigSensor, origin: Path) -> None:
    if sensor.model is None:
        return
    known = [model.name for model in sensors.models()]
    if sensor.model not in known:
        # Another case is more likely than other letters.
        near = [name for name in known if name.lower() == sensor.model.lower()]
        near = near or difflib.get_close_matches(sensor.model, known, 1)
        advice = f"did you mean {near[0]}?" if near else "see `mlbatch sensors`, or write auto"
        raise RigError(
            f"{origin}: sensor {sensor.name}: expected a supported model, found "
            f"{sensor.model!r}; {advice}"
        )


def _rig_offset_ns(sampler: Sampler, sensor: DetectedSensor) -> int:
    """Correction of a sensor's timestamps: offset in the rig, and its epoch to UTC."""
    if sensor.rig is None:
        return 0
    utc_ns = sampler.first_host_ns(sensor) or 0
    ahead_s = {"tai": tai_utc_s(utc_ns), "gps": gps_utc_s(utc_ns)}.get(sensor.rig.epoch or "", 0)
    return sensor.rig.offset_ns - ahead_s * NS_PER_S


# -- packets without a sensor ---------------------------------------------------------------------


def _names(examined: Sequence[Path], recorded: Sequence[Calibration]) -> list[str]:
    """Names of calibration files and topics."""
    return [*(path.name for path in examined), *(str(one.path) for one in recorded)]


def _unmatched(
    sampler: Sampler,
    kinds: Sequence[PacketKind],
    examined: Sequence[str],
    failures: Mapping[PacketKind, str],
) -> list[Note]:
    """Warnings about lidar packets of no sensor; examined: names of calibrations."""
    notes = []
    for kind in kinds:
        what = describe(sampler, kind) or ""
        start = f"{sampler.table.streams[kind.stream]}: {what}"
        unassigned = "its packets are counted as unassigned"
        if lacks_decoder(what):
            notes.append(Note("no_decoder", "", f"{start}; {unassigned}; {_NO_SUPPORTED}"))
        elif kind in failures:
            notes.append(Note("no_metadata", "", f"{start}; {failures[kind]}; {unassigned}"))
        else:
            expected = f"expected metadata that match, found {_known(examined)}"
            text = f"{start}; {expected}; {unassigned}; give --metadata FILE"
            notes.append(Note("no_metadata", "", text))
    return notes


def _unused(found: Sequence[DetectedSensor], given: Sequence[Path]) -> list[Note]:
    """Warnings about given files that match no sensor."""
    used = {sensor.lidar.calibration for sensor in found}
    advice = "it is not used; leave it out, or name its sensor in a rig file (--rig)"
    return [
        Note("calibration", "", f"{path}: expected a sensor that it matches, found none; {advice}")
        for path in given
        if str(path) not in used
    ]


def _why_none(
    sampler: Sampler,
    recordings: Sequence[Recording],
    lidar_kinds: Sequence[PacketKind],
    examined: Sequence[str],
    failures: Mapping[PacketKind, str],
) -> str:
    """Why no sensor was found, and what to do."""
    where = ", ".join(str(recording.path) for recording in recordings)
    table = sampler.table
    types = packet_types(recordings)
    for kind, why in failures.items():
        others = f" (without a match: {some(examined, _SHOWN)})" if examined else ""
        return f"{where}: {table.streams[kind.stream]}: {why}{others}"
    carried = [(table.streams[kind.stream], describe(sampler, kind) or "") for kind in lidar_kinds]
    for stream, what in carried:
        if not lacks_decoder(what):
            return (
                f"{where}: {stream} carries {what}; expected metadata that match, "
                f"found {_known(examined)}; give the sensor's with --metadata FILE"
            )
    for stream, what in carried:
        return f"{where}: {stream} carries {what}; {_NO_SUPPORTED}"
    seen = [
        f"{table.streams[kind.stream]} ({kind.size} bytes: {name_kind(sampler, kind, types)})"
        for kind in sampler.kinds
    ]
    seen = seen or [f"{name} ({kind})" for name, kind in sorted(types.items())]
    remedy = (
        "record the topic on which the lidar's driver publishes its packets"
        if types
        else "check that the recording contains the sensor's data port"
    )
    return (
        f"{where}: no lidar packets; expected raw UDP packets of a supported lidar "
        f"(see `mlbatch sensors`), found {some(seen, _SHOWN) or 'no UDP packet at all'}; {remedy}"
    )


def _hints(
    recordings: Sequence[Recording], examined: Sequence[Path], collector: MetadataCollector
) -> str:
    """Damage of recordings and metadata, which may be why no sensor was found."""
    damage = [f"{one.path.name}: {note}" for one in recordings for note in one.notes]
    faults = [*collector.faults, *filter(None, map(fault_of, examined))]
    hints = some([*damage, *faults], _SHOWN)
    return f" ({hints})" if hints else ""


def _known(names: Sequence[str]) -> str:
    return f"only {some(names, _SHOWN)}" if names else "none in the recording's directory"


# -- choice and checks ----------------------------------------------------------------------------


def _choose(found: Sequence[DetectedSensor], selection: SensorSelection) -> list[DetectedSensor]:
    """Apply --only and --ignore; both accept names and serial numbers."""
    known = {word for sensor in found for word in (sensor.name, sensor.lidar.serial) if word}
    for option, words in (("--only", selection.only), ("--ignore", selection.ignore)):
        for word in words:
            if word not in known:
                raise UsageError(
                    f"{option}: expected the name or serial number of a sensor, one of "
                    f"{', '.join(sensor.name for sensor in found)}, found {word!r}; choose one"
                )
    chosen = [
        sensor
        for sensor in found
        if (not selection.only or {sensor.name, sensor.lidar.serial} & set(selection.only))
        and not {sensor.name, sensor.lidar.serial} & set(selection.ignore)
    ]
    if found and not chosen:
        raise UsageError(
            "--only/--ignore: expected at least one sensor to convert, found none that is left; "
            "leave one of them out"
        )
    return chosen


def _refuse_shared_addresses(sampler: Sampler, chosen: Sequence[DetectedSensor]) -> None:
    for sensor in chosen:
        problem = shared_address(sampler, sensor)
        if problem:
            raise RecordingError(problem)


def _refuse_incomparable_clocks(
    sampler: Sampler, chosen: Sequence[DetectedSensor], selection: SensorSelection
) -> None:
    """Raise ClockError for clocks that cannot be merged, before extrinsics are asked for."""
    if selection.aligned:
        return
    offsets_ns: list[tuple[str, int | None]] = []
    for sensor in chosen:
        by_host = selection.host_clock or (sensor.rig is not None and sensor.rig.clock == "host")
        offset_ns = None if by_host else sampler.clock_offset_ns(sensor)
        if offset_ns is not None:
            offset_ns += sensor.offset_ns
        offsets_ns.append((sensor.name, offset_ns))
        refuse_incomparable(offsets_ns, len(offsets_ns) - 1)
