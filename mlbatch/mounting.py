"""Where the sensors of a session sit on their body, by all that is known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from mlbatch.frames import candidates
from mlbatch.knowledge import Finding, Knowledge, Mounting
from mlbatch.rig import Rig, RigSensor
from mlbatch.streams import Found
from mlbatch.types import F64Array, StreamTable


@dataclass(slots=True)
class Mounted:
    """A sensor with its place on the body and its wishes from the rig (or their defaults).

    extrinsics_source: whose word it is; chain: frames walked from body to sensor, "" where none
    was; offset_ns: added to its stamps.
    """

    found: Found
    body_from_sensor: F64Array
    extrinsics_source: str
    rig: RigSensor | None = None
    chain: str = ""
    offset_ns: int = 0

    @property
    def name(self) -> str:
        """Name in all outputs."""
        return self.found.name

    @property
    def origin(self) -> str:
        """Source and chain in words, as "tf_static: base_link -> left/os_sensor"."""
        return f"{self.extrinsics_source}: {self.chain}" if self.chain else self.extrinsics_source


def mount(
    table: StreamTable,
    found: Sequence[Found],
    rigged: Sequence[RigSensor | None],
    rig: Rig | None,
    knowledge: Knowledge,
    *,
    metadata_topics: Collection[str] = (),
    identity_extrinsics: bool,
) -> tuple[list[Mounted], Mounting]:
    """Place all sensors; RigError where two or more should be, and some have no extrinsics.

    rigged: what the rig says of each sensor, None without a rig; metadata_topics: those that gave
    calibrations.
    """
    makers = Counter(sensor.lidar.vendor for sensor in found)
    frames = {
        sensor.name: candidates(
            sensor.lidar.vendor,
            _places(table, sensor, metadata_topics),
            alone=makers[sensor.lidar.vendor] == 1,
            sensor_from_lidar=sensor.lidar.sensor_from_lidar,
        )
        for sensor in found
    }
    named = dict(zip((sensor.name for sensor in found), rigged, strict=True))
    mounting = knowledge.mount(
        frames,
        {
            name: entry.extrinsics
            for name, entry in named.items()
            if entry is not None and entry.extrinsics is not None
        },
        {
            sensor.name: sensor.lidar.extrinsics
            for sensor in found
            if sensor.lidar.extrinsics is not None
        },
        None if rig is None else rig.body_frame,
        identity_extrinsics=identity_extrinsics,
    )
    mounts = mounting.mounts
    mounted = [
        Mounted(
            sensor,
            mounts[sensor.name].body_from_sensor,
            mounts[sensor.name].source,
            named[sensor.name],
            mounts[sensor.name].chain,
        )
        for sensor in found
    ]
    return mounted, mounting


def in_words(finding: Finding) -> str:
    """A finding as a line that names its sensor."""
    return f"sensor {finding.sensor}: {finding.message}" if finding.sensor else finding.message


def _places(table: StreamTable, sensor: Found, metadata_topics: Collection[str]) -> list[str]:
    """Words for where a sensor sits: topics of its packets, else of its metadata, else its name."""
    topics = sorted({table.streams[stream].topic for stream, _ in sensor.kinds} - {""})
    if not topics and sensor.lidar.calibration in metadata_topics:
        topics = [sensor.lidar.calibration]
    return topics or [sensor.name]
