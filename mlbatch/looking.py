"""A first look at a session: its first seconds, and the calibrations that lie beside it."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mlbatch import sensors
from mlbatch.errors import RigError
from mlbatch.learning import Learner, listen
from mlbatch.lidar import Calibration
from mlbatch.readers import has_packets, merge
from mlbatch.rig import Rig
from mlbatch.streams import Sampler, split_by_kind
from mlbatch.types import PacketBatch, Recording, StreamTable
from mlbatch.units import NS_PER_S

LOOK_NS = 10 * NS_PER_S
_ASKED = 16
# Calibrations are searched beside the recording under these suffixes, and told by content.
SIDECAR_SUFFIXES = (".csv", ".dat", ".json", ".xml", ".yaml", ".yml")
METADATA_SUFFIX = ".json"
# No calibration of one sensor comes near; tables and documents of a dataset are not opened.
MAX_SIDECAR_BYTES = 2_000_000
BAG_METADATA = "metadata.yaml"


def with_clouds(
    recordings: Sequence[Recording], table: StreamTable, named: Collection[str]
) -> list[Recording]:
    """The recordings, with decoded clouds as packets: of the topics named (in the rig).

    Where nothing is named and the session holds no raw packets, all its clouds are taken.
    """
    topics = [topic for recording in recordings for topic in recording.topics]
    if not topics:
        return list(recordings)
    # Not loaded for captures.
    from mlbatch.readers.bag.clouds import CloudRecording, cloud_topics
    from mlbatch.ros.point_packets import Layout

    clouds = {topic.name: topic for topic in cloud_topics(topics)}
    # A capture has no topics, and nothing but packets.
    raw = any(not recording.topics for recording in recordings) or any(map(has_packets, topics))
    chosen = [topic for name, topic in clouds.items() if name in named or (not raw and not named)]
    if not chosen:
        return list(recordings)
    layouts: dict[str, Layout] = {}
    return [CloudRecording(recording, table, chosen, layouts) for recording in recordings]


def is_without_packets(recording: Recording) -> bool:
    """Whether a recording can only hold messages beside the packets of others."""
    if not recording.topics or any(map(has_packets, recording.topics)):
        return False
    # As above.
    from mlbatch.readers.bag.clouds import CloudRecording

    clouds = recording.topics_of_clouds if isinstance(recording, CloudRecording) else ()
    return not {topic.name for topic in clouds} & {topic.name for topic in recording.topics}


def look(recordings: Sequence[Recording], table: StreamTable) -> tuple[Sampler, Learner]:
    """Look at the first 10 s of a session: its packets, and the messages that tell of sensors."""
    sampler, learner = Sampler(table), Learner()
    listen(recordings)
    for batch in first_seconds(recordings):
        sampler.add(batch)
        learner.add(batch)
    for recording in recordings:
        recording.keep = frozenset()
    return sampler, learner


def first_seconds(recordings: Sequence[Recording]) -> Iterator[PacketBatch]:
    """The packets up to 10 s after the first lidar packet, whatever the size of the batches.

    A capture is often started long before the lidars are.
    """
    until_ns: int | None = None
    with contextlib.closing(merge(recordings)) as batches:
        for batch in batches:
            if until_ns is None:
                began_ns = _lidars_begin_ns(batch)
                until_ns = None if began_ns is None else began_ns + LOOK_NS
            if until_ns is None:
                yield batch
                continue
            over = np.flatnonzero(batch.host_ns > until_ns)
            if len(over):
                yield replace(batch.take(slice(0, int(over[0]))), messages=batch.messages)
                return
            yield batch


def _lidars_begin_ns(batch: PacketBatch) -> int | None:
    """Arrival of the first packet of a kind that looks like a lidar's.

    A few packets are asked: device packets may come first on the topic of the others.
    """
    begins_ns = []
    for (_, size), index in split_by_kind(batch):
        asked = batch.start[index[:_ASKED], None] + np.arange(size)
        text = sensors.describe(size, batch.data[asked])
        if text is not None and "lidar" in text:
            begins_ns.append(int(batch.host_ns[index[0]]))
    return min(begins_ns, default=None)


def calibrations_for(
    recordings: Sequence[Path], given: Sequence[Path]
) -> tuple[list[Calibration], list[Path]]:
    """Calibrations that were given, else those beside the recordings; and the files looked at."""
    if given:
        return [read_given(path) for path in given], list(given)
    looked: list[Path] = []
    found = []
    for folder in dict.fromkeys(map(_folder_of, recordings)):
        for path in sorted(path for path in folder.iterdir() if _may_be_calibration(path)):
            # A file beside the recording was never named by the user: a foreign one is no error.
            try:
                calibration = sensors.read_calibration(path)
            except RigError:
                looked.append(path)
                continue
            if calibration is not None:
                found.append(calibration)
            if calibration is not None or path.suffix.lower() == METADATA_SUFFIX:
                looked.append(path)
    return found, looked


def calibrations_besides(
    rig: Rig | None, recordings: Sequence[Path], given: Sequence[Path]
) -> tuple[list[Calibration], list[Path]]:
    """The same; nothing where the rig names the file of every sensor."""
    # All makers would be asked for all files beside the recordings.
    if rig is not None and not given and all(one.metadata for one in rig.sensors):
        return [], []
    return calibrations_for(recordings, given)


def fault_of(path: Path) -> str:
    """What is wrong with a calibration beside the recording that could not be used, or ""."""
    try:
        sensors.read_calibration(path)
    except RigError as err:
        return str(err)
    return ""


def _folder_of(recording: Path) -> Path:
    """Where calibrations of a recording lie: beside it, or beside the folder of a ROS 2 bag."""
    folder = recording.parent
    return folder.parent if (folder / BAG_METADATA).is_file() else folder


def _may_be_calibration(path: Path) -> bool:
    is_one = path.suffix.lower() in SIDECAR_SUFFIXES and path.name != BAG_METADATA
    return is_one and path.is_file() and path.stat().st_size <= MAX_SIDECAR_BYTES


def read_given(path: Path) -> Calibration:
    """The calibration in a file that the user named; RigError if it is none."""
    calibration = sensors.read_calibration(path)
    if calibration is None:
        raise RigError(
            f"{path}: wanted the metadata or calibration of a lidar, got another kind of file; "
            "give the file that the sensor's driver or recorder saved"
        )
    return calibration
