"""The sensors of a session: packets, calibrations, extrinsics and clocks put together."""

from __future__ import annotations

import difflib
import ipaddress
import shlex
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, NoReturn

import numpy as np

from mlbatch import sensors
from mlbatch.arrays import BoolArray, F64Array, U8Array
from mlbatch.clocks.compare import refuse_incomparable
from mlbatch.clocks.timescale import gps_utc_s, tai_utc_s
from mlbatch.discovery.calibrations import (
    MetadataCollector,
    fault_of,
    find_calibrations,
    read_given,
)
from mlbatch.discovery.extrinsics import place
from mlbatch.discovery.first_seconds import FirstSeconds, with_clouds
from mlbatch.discovery.gravity import gravity_notes
from mlbatch.discovery.interleaved import shared_address
from mlbatch.discovery.match import (
    ExpectedSensor,
    Matched,
    describe,
    is_model,
    lidars_on,
    match,
    match_rig,
    senders,
)
from mlbatch.discovery.router import Router
from mlbatch.discovery.sampler import Sampler
from mlbatch.discovery.types import OUTPUT, DetectedSensor, Note, PacketKind
from mlbatch.errors import ClockError, RecordingError, RigError, UsageError
from mlbatch.frames.tree import FrameTree, clean, some
from mlbatch.lidar.interface import Calibration
from mlbatch.rig.rig import Rig, RigSensor, StreamSelector, read_rig
from mlbatch.types import Recording, Stream, StreamTable
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    from mlbatch.outputs.recording import OutputRecording
    from mlbatch.readers.bag.cloud_topics import CloudTopics

# Items of a list in an error.
_SHOWN = 4
_NO_SUPPORTED = "expected a supported lidar, found none; see `mlbatch sensors` for those that are"


@dataclass(frozen=True, slots=True)
class SensorSelection:
    """Options of the command line that select sensors, or state facts about them."""

    rig: Path | None = None
    metadata: tuple[Path, ...] = ()
    only: tuple[str, ...] = ()  # names or serial numbers
    ignore: tuple[str, ...] = ()  # names, serial numbers, topics or IP:PORT
    identity_extrinsics: bool = False  # accept sensors without extrinsics
    host_clock: bool = False  # receive times replace timestamps
    aligned: bool = False  # --align-clocks: clocks need not be comparable
    decode: dict[str, str] = field(default_factory=dict)  # options of vendors
    offset_ns: dict[str, int] = field(default_factory=dict)  # besides those of the rig, by name


class Ignored(NamedTuple):
    """Sensors, addresses and serial numbers that the user left out by --only and --ignore."""

    sensors: tuple[DetectedSensor, ...] = ()
    words: tuple[str, ...] = ()
    all_others: bool = False  # True if --only leaves out all lidars that it does not name

    def packets(self, stream: Stream, kind: PacketKind, packets: U8Array) -> BoolArray:
        """Return which packets (P, size) of a kind are left out: (P,) bool."""
        is_lidar = "lidar" in (sensors.describe(kind.size, packets[:1]) or "")
        is_named = any(_names_stream(word, stream) for word in self.words)
        if is_named or (self.all_others and is_lidar):
            return np.ones(len(packets), np.bool_)
        left_out = np.zeros(len(packets), np.bool_)
        for sensor in self.sensors:
            lidar = sensor.lidar
            if kind.size in (lidar.packet_size, lidar.packet_size + 1):
                if kind in sensor.kinds or lidar.carries_serial:
                    left_out |= lidar.sent_by_me(packets[:, : lidar.packet_size])
            elif kind in sensor.kinds:
                left_out[:] = True
        if self.serials and is_lidar:
            # Several lidars may share an address.
            for row in np.flatnonzero(~left_out).tolist():
                what = sensors.describe(kind.size, packets[row : row + 1])
                left_out[row] = _names_serial(self.serials, what)
        return left_out

    @property
    def serials(self) -> tuple[str, ...]:
        """Words that are no sensors, hence serial numbers of other lidars, or addresses."""
        sensor_words = {word for one in self.sensors for word in (one.name, one.lidar.serial)}
        return tuple(
            word for word in self.words if word not in sensor_words and not _is_address(word)
        )

    def names(self, stream: Stream, what: str | None) -> bool:
        """Return whether --ignore names a stream, or the serial number in its description."""
        by_stream = any(_names_stream(word, stream) for word in self.words)
        return self.all_others or by_stream or _names_serial(self.words, what)


@dataclass(slots=True)
class Discovery:
    """The sensors of a session, and what they were detected from."""

    sensors: list[DetectedSensor]  # in the order of `lidar_id`
    frame_id: str  # of the body
    router: Router
    first: FirstSeconds
    examined: list[Path]  # files that may be calibrations
    # Why matching calibrations cannot be used.
    unusable: tuple[str, ...] = ()
    rig: Rig | None = None
    notes: list[Note] = field(default_factory=list)
    not_in_rig: set[PacketKind] = field(default_factory=set)
    # Kinds of lidars without a sensor that `notes` name.
    noted: set[PacketKind] = field(default_factory=set)
    tree: FrameTree = field(default_factory=FrameTree)  # static frames of the recording
    ignored: Ignored = field(default_factory=lambda: Ignored())
    output: OutputRecording | None = None  # of `convert`, whose scans are batched again

    @property
    def sampler(self) -> Sampler:
        """Samples of all streams."""
        return self.first.sampler

    @property
    def recordings(self) -> Sequence[Recording]:
        """Recordings to read, with decoded clouds as packets."""
        return self.first.recordings

    def frames(self) -> dict[str, F64Array]:
        """Return (4, 4) body_from_frame, m, of the recording's static frames, by name."""
        return self.tree.poses(clean(self.frame_id))


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
    paths = tuple(recording.path for recording in recordings)
    output = _output_of(recordings)
    rig = None if selection.rig is None else read_rig(selection.rig, paths)
    if output is not None:
        rig = output.rig
    apart = _why_apart(recordings, selection, rig)
    if apart and to_convert:
        raise RecordingError(apart)
    clouds = None
    if output is None:
        recordings, clouds = with_clouds(recordings, table, rig, selection.ignore)
    refused = {} if clouds is None else clouds.refused
    if to_convert:
        _refuse_clouds_of_rig(rig, refused, selection)
    # `inspect` also counts these packets.
    first = FirstSeconds(recordings, table, clouds, cut_clouds=to_convert)
    sampler = first.sampler
    collector = first.metadata
    calibrations: list[Calibration] = []
    examined: list[Path] = []
    # Every file in the directory would be read by all vendors.
    if output is None and (
        rig is None or selection.metadata or not all(one.metadata for one in rig.sensors)
    ):
        calibrations, examined = find_calibrations(paths, selection.metadata)
    recorded = collector.calibrations()
    calibrations += recorded
    if output is None:
        matched = _match(sampler, calibrations, selection, rig)
    else:
        matched = _match_output(sampler, output)
    lidar_kinds = [kind for kind in matched.unknown if _is_lidar(sampler, kind)]
    if to_convert and not any(sensor.kinds for sensor in matched.sensors):
        examined = examined or find_calibrations(paths, selection.metadata)[1]
        names = _names(examined, recorded)
        reason, lacking = _why_none(sampler, recordings, lidar_kinds, names, matched, refused)
        text = f"{reason}{_hints(recordings, examined, collector)}"
        raise RecordingError(_advised(text, lacking) if lacking else text)
    chosen = _choose(sampler, matched.sensors, lidar_kinds, selection)
    left_out = [sensor for sensor in matched.sensors if sensor not in chosen]
    ignored = Ignored(tuple(left_out), selection.ignore, bool(selection.only))
    noted = [kind for kind in lidar_kinds if not _is_ignored(sampler, ignored, kind)]
    notes: list[Note] = []
    if rig is not None and rig.dataset is not None:
        files = dict.fromkeys(str(file) for one in rig.sensors for file in one.extrinsics_files)
        poses = f"; poses of {', '.join(files)}" if files else ""
        text = f"{rig.dataset.title}: recipe {rig.dataset.caution}{poses}"
        notes.append(Note("dataset", "", text))
    if rig is None:
        unmatched = _unmatched(sampler, matched, noted, examined, _names(examined, recorded))
        if to_convert:
            texts = [] if selection.only else _refusals(refused)
            # Packets of another size on the stream of a sensor are rejected there.
            owned = {stream for sensor in chosen for stream in sensor.streams}
            texts += [note.message for kind, note in unmatched if kind.stream not in owned]
            if texts:
                # Lidars of the session would be left out whole.
                raise RecordingError(f"{_paths(recordings)}: {_some_texts(texts)}")
        notes += [note for _, note in unmatched]
    else:
        # Other packets on the stream of a sensor are not unassigned but rejected.
        taken = {stream for sensor in chosen for stream in sensor.streams}
        noted = [kind for kind in noted if kind.stream not in taken]
        streams = sampler.table.streams
        notes += [not_in_rig(streams[kind.stream], describe(sampler, kind) or "") for kind in noted]
    if clouds is not None:
        notes += _cloud_notes(table, clouds, chosen, to_convert=to_convert)
    notes += _unused(matched.sensors, selection.metadata)
    for sensor in chosen:
        sensor.offset_ns = _rig_offset_ns(sampler, sensor)
        sensor.offset_ns += selection.offset_ns.get(sensor.name, 0)
    notes += first.clouds_apart(chosen)
    if to_convert:
        for sensor in chosen:
            if problem := shared_address(sampler, sensor):
                raise RecordingError(problem)
        _refuse_incomparable_clocks(first, chosen, selection)
    extrinsics = place(
        chosen,
        collector.extrinsics,
        table,
        rig,
        frames={} if clouds is None else clouds.frames,
        calibration_topics=collector.calibration_topics,
        identity_extrinsics=selection.identity_extrinsics,
    )
    if apart:
        notes.append(Note("no_overlap", "", apart))
    notes += [Note("message", "", fault) for fault in collector.faults]
    notes += extrinsics.notes
    if output is not None:
        notes.append(Note("clouds", "", output.describe()))
    for sensor in chosen:
        if output is not None:
            sensor.pose = sensor.pose._replace(source=OUTPUT)
        findings = (*sensor.notes, *sensor.lidar.notes)
        notes += [Note("calibration", sensor.name, text) for text in findings]
        if not sensor.kinds:
            text = "no packet of it in the first 10 seconds"
            notes.append(Note("not_seen_yet", sensor.name, text))
    router = Router(table, chosen, sampler.kinds)
    notes += gravity_notes(sampler, router, chosen, extrinsics.body_frame)
    return Discovery(
        sensors=chosen,
        frame_id=extrinsics.body_frame,
        router=router,
        first=first,
        examined=examined,
        unusable=tuple(
            f"{table.streams[kind.stream]}: {why}" for kind, why in matched.failures.items()
        ),
        rig=rig,
        notes=notes,
        not_in_rig=set() if rig is None else set(lidar_kinds),
        noted=set(noted),
        tree=extrinsics.tree,
        ignored=ignored,
        output=output,
    )


def _output_of(recordings: Sequence[Recording]) -> OutputRecording | None:
    """The output of `convert` that is batched again, None for recordings."""
    # Segments of it have what they wrap.
    found: OutputRecording | None = getattr(recordings[0], "as_output", None)
    return found


def _match_output(sampler: Sampler, output: OutputRecording) -> Matched:
    """The lidars of an output of `convert`."""
    found = []
    for sensor, lidar in zip(output.rig.sensors, output.lidars, strict=True):
        selector = sensor.stream or StreamSelector()
        streams = sampler.table.streams
        kinds = {kind for kind in sampler.kinds if selector.selects(streams[kind.stream])}
        found.append(DetectedSensor(sensor.name, lidar, selector, kinds, rig=sensor))
    taken = {kind for sensor in found for kind in sensor.kinds}
    return Matched(found, [kind for kind in sampler.kinds if kind not in taken], {})


def refuse_untimed(table: StreamTable, sensor: DetectedSensor, option: str) -> None:
    """Raise UsageError if packets of a sensor have no receive times, which an option needs."""
    for number in sorted(sensor.streams & table.untimed):
        raise UsageError(
            f"{option}: sensor {sensor.name}: expected the receive time of each packet, found only "
            f"that of whole messages on {table.streams[number]}; convert without it, by the clock "
            "of the sensor (clock.offset_s in the rig where that is off), or record the packets "
            "with tcpdump"
        )


def refuse_absent(setup: Discovery, sensor: DetectedSensor, rig: Path | None) -> NoReturn:
    """Raise RigError for a required sensor of the rig that sent no packet."""
    lidar = sensor.lidar
    owned = {kind for one in setup.sensors for kind in one.kinds}
    unknown = [kind for kind in setup.sampler.kinds if kind not in owned]
    others = lidars_on(setup.sampler, sensor.selector, unknown)
    if others and lidar.carries_serial:
        raise RigError(
            f"{rig}: sensor {sensor.name}: expected packets of serial number {lidar.serial}, that "
            f"of its metadata {lidar.calibration}, found none, but those of {others}; give the "
            "metadata of the lidar that was recorded, correct its stream, or set `optional: true`"
        )
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
    description = describe(sampler, kind)
    return description is not None and "lidar" in description


# -- sensors of the rig ---------------------------------------------------------------------------


def _why_apart(recordings: Sequence[Recording], selection: SensorSelection, rig: Rig | None) -> str:
    """Why captures are no session, as far as their first and last packets show; else ""."""
    if len(recordings) < 2 or selection.only:
        return ""
    # Not loaded for single recordings.
    from mlbatch.discovery.overlap import problem, spans_of_captures

    ignored = Ignored(words=selection.ignore)

    def is_wanted(stream: Stream, what: str) -> bool:
        if ignored.names(stream, what):
            return False
        return rig is None or any(
            not sensor.optional and _may_be(sensor, stream, what) for sensor in rig.sensors
        )

    text, _ = problem(spans_of_captures(recordings, is_wanted))
    return text


def _may_be(sensor: RigSensor, stream: Stream, what: str) -> bool:
    """True if a sensor of the rig may have sent the packets of a stream."""
    selector = sensor.stream
    if selector is None:
        return True
    is_other = selector.serial and "serial" in what and not _names_serial([selector.serial], what)
    return selector.selects(stream) and not is_other


def _match(
    sampler: Sampler,
    calibrations: Sequence[Calibration],
    selection: SensorSelection,
    rig: Rig | None,
) -> Matched:
    if rig is None or selection.rig is None:
        return match(sampler, calibrations, selection.decode)
    expected = [ExpectedSensor(one, (), selection.decode, selection.rig) for one in rig.sensors]
    for sensor in expected:
        _refuse_undecodable(sampler, sensor)
        _refuse_unknown_model(sensor)
    sent_by = senders(sampler)
    expected = [
        sensor._replace(
            calibrations=[*calibrations, *_built_in(sent_by, sensor.rig)]
            if sensor.rig.metadata is None
            else [read_given(sensor.rig.metadata)]
        )
        for sensor in expected
    ]
    try:
        matched = match_rig(sampler, expected)
    except UsageError as err:
        raise RigError(f"{selection.rig}: {err}") from err
    for one, detected in zip(expected, matched.sensors, strict=True):
        if not is_model(one.rig.model, detected.lidar.model):
            raise one.error(
                f"expected the model {one.rig.model}, found metadata of {detected.lidar.model}; "
                "correct model or metadata"
            )
    return matched


def _built_in(sent_by: Collection[str], sensor: RigSensor) -> tuple[Calibration, ...]:
    """Built-in calibrations of vendors that sent packets, and of the vendor of the rig's model.

    More than one, else all: a sensor that sent no packet is decided by how many there are.
    """
    named = () if sensor.model is None else sensors.vendor_of(sensor.model)
    calibrations = sensors.built_in({*sent_by, *named})
    return calibrations if len(calibrations) > 1 else sensors.built_in()


def _refuse_undecodable(sampler: Sampler, expected: ExpectedSensor) -> None:
    """Raise RigError if no lidar on a sensor's stream has a decoder: metadata would not help."""
    stream = expected.rig.stream
    if stream is None or stream.serial:
        return
    streams = sampler.table.streams
    chosen = [kind for kind in sampler.kinds if stream.selects(streams[kind.stream])]
    lidars = [text for kind in chosen if "lidar" in (text := describe(sampler, kind) or "")]
    is_undecodable = lidars and all(map(lacks_decoder, lidars))
    if is_undecodable and not _is_readable(sampler, chosen, expected.rig):
        raise expected.error(f"{stream} carries {lidars[0]}; {_NO_SUPPORTED}")


def _is_readable(sampler: Sampler, kinds: Sequence[PacketKind], sensor: RigSensor) -> bool:
    """Whether packets of unknown model can be decoded as the model that the rig names."""
    if sensor.model is None:
        return False
    vendor = sensors.vendor_of(sensor.model)
    named = [one for one in sensors.built_in(vendor) if one.model == sensor.model]
    return any(one.match_score(sampler.evidence(kind)) for one in named for kind in kinds)


def _refuse_unknown_model(expected: ExpectedSensor) -> None:
    model = expected.rig.model
    if model is None or any(row.name == model for row in sensors.models(sensors.vendor_of(model))):
        return
    known = [row.name for row in sensors.models()]
    # Another case is more likely than other letters.
    near = [name for name in known if name.lower() == model.lower()]
    near = near or difflib.get_close_matches(model, known, 1)
    advice = f"did you mean {near[0]}?" if near else "see `mlbatch sensors`, or write auto"
    raise expected.error(f"expected a supported model, found {model!r}; {advice}")


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


class Refusal(NamedTuple):
    """Messages about lidar packets without a sensor: if some have none, and if all have none."""

    code: str
    among_others: str
    alone: str


# By cause; where there is no sensor at all, the first of these that occurs is stated.
_REFUSALS = {
    "unusable": Refusal(
        "no_metadata",
        "{stream}: {what}; {failure}, or leave it out with {ignore}",
        "{stream}: {failure}{others}",
    ),
    "no_metadata": Refusal(
        "no_metadata",
        "{stream}: {what}; expected metadata that match, found {known}; give --metadata FILE, or "
        "leave it out with {ignore}{faults}",
        "{stream} carries {what}; expected metadata that match, found {known}; give the sensor's "
        "with --metadata FILE",
    ),
    "no_decoder": Refusal(
        "no_decoder",
        f"{{stream}}: {{what}}; {_NO_SUPPORTED}; leave it out with {{ignore}}",
        f"{{stream}} carries {{what}}; {_NO_SUPPORTED}",
    ),
}


def _cause(matched: Matched, kind: PacketKind, what: str) -> str:
    """Why packets of a lidar have no sensor, a key of `_REFUSALS`; what: their description."""
    if lacks_decoder(what):
        return "no_decoder"
    return "unusable" if kind in matched.failures else "no_metadata"


def _advised(text: str, what: str) -> str:
    """A text, and where the metadata of a lidar come from."""
    # Not loaded where all have theirs.
    from mlbatch.sensors.advice import with_advice

    return with_advice(text, what)


def _words(
    sampler: Sampler, matched: Matched, kind: PacketKind, names: Sequence[str]
) -> dict[str, object]:
    """Words of a `Refusal` about packets of a lidar; names: of possible calibrations."""
    stream = sampler.table.streams[kind.stream]
    return {
        "stream": stream,
        "what": describe(sampler, kind) or "",
        "failure": matched.failures.get(kind),
        "known": f"only {some(names, _SHOWN)}" if names else "none in the recording's directory",
        "others": f" (without a match: {some(names, _SHOWN)})" if names else "",
        "ignore": f"--ignore {_ignore_word(stream)}",
    }


def _unmatched(
    sampler: Sampler,
    matched: Matched,
    kinds: Sequence[PacketKind],
    examined: Sequence[Path],
    names: Sequence[str],
) -> list[tuple[PacketKind, Note]]:
    """Why lidar packets are of no sensor, and what to do.

    examined, names: of possible calibrations.
    """
    notes = []
    # A file that cannot be used may be the one that is missing.
    faults = some([*filter(None, map(fault_of, examined))], _SHOWN) if kinds else ""
    for kind in kinds:
        what = describe(sampler, kind) or ""
        cause = _cause(matched, kind, what)
        code, sentence, _ = _REFUSALS[cause]
        words = _words(sampler, matched, kind, names)
        text = sentence.format(**words, faults=f" ({faults})" if faults else "")
        text = _advised(text, what) if cause == "no_metadata" else text
        notes.append((kind, Note(code, "", text)))
    return notes


def _refusals(refused: Mapping[str, str]) -> list[str]:
    """Why clouds cannot be used, and that they may be left out."""
    return [
        f"{topic}: {text}"
        + ("" if "--ignore" in text else f", or leave the topic out with --ignore {topic}")
        for topic, text in refused.items()
    ]


def _cloud_notes(
    table: StreamTable, clouds: CloudTopics, chosen: Sequence[DetectedSensor], *, to_convert: bool
) -> Iterator[Note]:
    """Warnings about the times of chosen clouds, and without a conversion of those refused."""
    topics = {table.streams[number].topic for sensor in chosen for number in sensor.streams}
    for topic, text in clouds.warnings:
        if topic in topics:
            yield Note("cloud_time", "", f"{topic}: {text}")
    if not to_convert:
        for topic, text in clouds.refused.items():
            yield Note("cloud_time", "", f"{topic}: {text}")


def _some_texts(texts: Sequence[str]) -> str:
    """The first text in full, and how many others there are."""
    others = f" (and {len(texts) - 1} more: {'; '.join(texts[1:])})" if len(texts) > 1 else ""
    return texts[0] + others


def _ignore_word(stream: Stream) -> str:
    """How `--ignore` names a stream; not by its topic if that has clouds of several lidars."""
    if stream.topic:
        return shlex.quote(str(stream))
    return min(name for name in stream.names if " " not in name)


def _refuse_clouds_of_rig(
    rig: Rig | None, refused: Mapping[str, str], selection: SensorSelection
) -> None:
    """Raise RigError for a sensor of the rig whose clouds cannot be used."""
    for sensor in () if rig is None else rig.sensors:
        topic = "" if sensor.stream is None else sensor.stream.topic
        if topic in refused:
            place = f"{selection.rig}: sensor {sensor.name}"
            raise RigError(f"{place}: {topic}: {refused[topic]}")


def not_in_rig(stream: Stream, what: str) -> Note:
    """Warning about lidar packets of a stream that the rig lacks."""
    text = (
        f"{stream}: {what}; expected a sensor of the rig, found none for it; its packets are "
        "counted as unassigned; add it to the rig, or leave it out with --ignore "
        f"{_ignore_word(stream) if stream.topic else stream.source_ip}"
    )
    return Note("not_in_rig", "", text)


def _is_ignored(sampler: Sampler, ignored: Ignored, kind: PacketKind) -> bool:
    return ignored.names(sampler.table.streams[kind.stream], describe(sampler, kind))


def _names_stream(word: str, stream: Stream) -> bool:
    """True if a word is the topic, the source IP or IP:port of a stream, or its name in reports."""
    return word in stream.names or (bool(word) and word == stream.source_ip)


def _names_serial(words: Sequence[str], what: str | None) -> bool:
    """True if one of the words is the serial number in a description."""
    return any(f"serial {word}," in (what or "") for word in words)


def _is_address(word: str) -> bool:
    """True for a topic, an IP address or IP:port, which may begin to send later."""
    if word.startswith("/"):
        return True
    for text in (word, word.rpartition(":")[0]):
        try:
            ipaddress.ip_address(text)
        except ValueError:
            continue
        return True
    return False


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
    names: Sequence[str],
    matched: Matched,
    refused: Mapping[str, str],
) -> tuple[str, str]:
    """Why no sensor was found, and the lidar whose metadata are missing, or "".

    names: of possible calibrations; refused: why clouds cannot be used, by topic.
    """
    where = _paths(recordings)
    table = sampler.table
    types = packet_types(recordings)
    found: dict[str, PacketKind] = {}
    if matched.failures:
        found["unusable"] = next(iter(matched.failures))
    if refused and not found:
        return f"{where}: {_some_texts(_refusals(refused))}", ""
    for kind in lidar_kinds:
        found.setdefault(_cause(matched, kind, describe(sampler, kind) or ""), kind)
    for cause, refusal in _REFUSALS.items():
        if cause not in found:
            continue
        words = _words(sampler, matched, found[cause], names)
        lacking = str(words["what"]) if cause == "no_metadata" else ""
        return f"{where}: {refusal.alone.format(**words)}", lacking
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
        f"(see `mlbatch sensors`), found {some(seen, _SHOWN) or 'no UDP packet at all'}; {remedy}",
        "",
    )


def _hints(
    recordings: Sequence[Recording], examined: Sequence[Path], collector: MetadataCollector
) -> str:
    """Damage of recordings and metadata, which may be why no sensor was found."""
    damage = [f"{one.path.name}: {note}" for one in recordings for note in one.notes]
    faults = [*collector.faults, *filter(None, map(fault_of, examined))]
    hints = some([*damage, *faults], _SHOWN)
    return f" ({hints})" if hints else ""


def _paths(recordings: Sequence[Recording]) -> str:
    return ", ".join(str(recording.path) for recording in recordings)


# -- choice and checks ----------------------------------------------------------------------------


def _choose(
    sampler: Sampler,
    found: Sequence[DetectedSensor],
    lidar_kinds: Sequence[PacketKind],
    selection: SensorSelection,
) -> list[DetectedSensor]:
    """Apply --only and --ignore.

    Both accept names and serial numbers; --ignore also addresses, and serial numbers of lidars that
    are no sensors.
    """
    known = {word for sensor in found for word in (sensor.name, sensor.lidar.serial) if word}
    others = Ignored(words=selection.ignore)
    unknown = [word for word in selection.only if word not in known]
    option = "--only"
    if not unknown:
        option = "--ignore"
        unknown = [
            word
            for word in selection.ignore
            if word not in known
            and not _is_address(word)
            and not any(
                _is_ignored(sampler, others._replace(words=(word,)), kind) for kind in lidar_kinds
            )
        ]
    for word in unknown:
        raise UsageError(
            f"{option}: expected the name or serial number of a sensor, one of "
            f"{', '.join(sensor.name for sensor in found)}, found {word!r}; choose one"
        )
    streams = sampler.table.streams
    chosen = [
        sensor
        for sensor in found
        if (not selection.only or {sensor.name, sensor.lidar.serial} & set(selection.only))
        and not {sensor.name, sensor.lidar.serial} & set(selection.ignore)
        and not (
            sensor.streams
            and all(
                any(_names_stream(word, streams[number]) for word in selection.ignore)
                for number in sensor.streams
            )
        )
    ]
    if found and not chosen:
        raise UsageError(
            "--only/--ignore: expected at least one sensor to convert, found none that is left; "
            "leave one of them out"
        )
    return chosen


def _refuse_incomparable_clocks(
    first: FirstSeconds, chosen: Sequence[DetectedSensor], selection: SensorSelection
) -> None:
    """Raise ClockError for clocks that cannot be merged, before extrinsics are asked for."""
    if selection.aligned:
        return
    sampler = first.sampler
    offsets_ns: list[tuple[str, int | None]] = []
    for sensor in chosen:
        by_host = selection.host_clock or (sensor.rig is not None and sensor.rig.clock == "host")
        offset_ns = None if by_host else sampler.clock_offset_ns(sensor)
        if offset_ns is not None:
            offset_ns += sensor.offset_ns
        offsets_ns.append((sensor.name, offset_ns))
        try:
            refuse_incomparable(
                offsets_ns,
                len(offsets_ns) - 1,
                has_receive_times=all(map(sampler.has_receive_times, chosen)),
            )
        except ClockError as err:
            raise ClockError(f"{err}{first.rig_offsets(chosen)}") from err
