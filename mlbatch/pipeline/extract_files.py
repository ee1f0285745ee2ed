"""Files next to an extracted recording: calibrations, and a rig with their paths."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from mlbatch.discovery.calibrations import is_metadata
from mlbatch.pipeline.extract_places import Places
from mlbatch.readers import has_packets
from mlbatch.rig.rig import DEFAULT_BODY_FRAME, Rig, RigSensor, UnknownExtrinsics
from mlbatch.rig.write import write_rig
from mlbatch.types import Topic

# Options of a rig that the command has applied.
_APPLIED = ("only", "ignore", "pass")


def side_files(
    places: Places, target: Path, topics: frozenset[Topic], *, selects: bool
) -> dict[Path, bytes]:
    """Calibrations and the rig by their paths; a calibration in the folder is not copied.

    topics: that are copied; selects: lidars are chosen by name, which a rig need not repeat.
    """
    setup = places.setup
    carried = {topic.name for topic in topics}
    recorded = setup.first.metadata.calibration_texts
    files: dict[Path, bytes] = {}
    # By where it comes from: lidars may share one.
    known: dict[str, Path] = {}
    metadata: dict[str, Path] = {}
    for sensor in setup.sensors:
        origin = sensor.lidar.calibration
        is_file = bool(origin) and Path(origin).is_file()
        if origin in carried or not (origin in recorded or is_file):
            continue
        if origin not in known:
            content = recorded[origin] if origin in recorded else Path(origin).read_bytes()
            suffix = _suffix(content) if origin in recorded else Path(origin).suffix
            known[origin] = target.with_name(f"{target.stem}.{sensor.name}{suffix}")
            if is_file and os.path.samefile(Path(origin).parent, target.parent):
                known[origin] = Path(origin)
            else:
                files[known[origin]] = content
        metadata[sensor.name] = known[origin]
    is_capture = not places.encodings
    lacks_frames = any(
        is_metadata(topic) and not has_packets(topic) and topic not in topics
        for recording in setup.recordings
        for topic in recording.topics
    )
    streams = setup.sampler.table.streams
    moves = any(bool(streams[one.stream].topic) == is_capture for one in setup.sampler.kinds)
    # Also where files are copied: with those of other extracts they may be ambiguous.
    if setup.sensors and (setup.rig is not None or lacks_frames or moves or files):
        rig = _rig(places, metadata, lacks_frames=lacks_frames, selects=selects)
        path = target.with_name(f"{target.stem}.rig.yaml")
        files[path] = write_rig(rig, target.parent).encode()
    # An earlier extract may share them.
    return {
        path: content
        for path, content in files.items()
        if not (path.is_file() and path.read_bytes() == content)
    }


def _suffix(content: bytes) -> str:
    """Suffix of a recorded calibration, by its content: JSON, angles as text or as bytes."""
    if content.lstrip().startswith(b"{"):
        return ".json"
    return ".csv" if content.isascii() else ".dat"


def _rig(places: Places, metadata: dict[str, Path], *, lacks_frames: bool, selects: bool) -> Rig:
    """The rig of the chosen lidars; lacks_frames: the new recording has no transforms."""
    setup = places.setup
    streams = setup.sampler.table.streams
    found = []
    for number, sensor in enumerate(setup.sensors):
        known = UnknownExtrinsics() if not sensor.pose.is_known else sensor.pose.body_from_sensor
        rig = sensor.rig or RigSensor(sensor.name, extrinsics=known)
        extrinsics = known if isinstance(rig.extrinsics, str) and lacks_frames else rig.extrinsics
        place = places.main_place(number)
        stream = rig.stream
        if place is not None and (sensor.rig is None or place.to != streams[place.stream]):
            stream = places.selector(number)
        path = metadata.get(sensor.name, rig.metadata)
        found.append(replace(rig, stream=stream, metadata=path, extrinsics=extrinsics))
    if setup.rig is not None:
        kept = tuple(
            option
            for option in setup.rig.options
            if option.name not in _APPLIED or (option.name != "pass" and not selects)
        )
        return replace(setup.rig, sensors=tuple(found), options=kept)
    names = {sensor.name for sensor in found}
    return Rig(tuple(found), DEFAULT_BODY_FRAME if setup.frame_id in names else setup.frame_id)
