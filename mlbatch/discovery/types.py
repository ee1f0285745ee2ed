"""Types of discovery: packet kinds, poses, detected sensors, warnings."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.frames.tree import Chain
from mlbatch.lidar.interface import Lidar
from mlbatch.rig.rig import RigSensor, StreamSelector

# Source of poses that an output of `convert` has.
OUTPUT = "output"


class PacketKind(NamedTuple):
    """Packets of one stream and one payload size.

    stream: number in the `StreamTable`; size: payload bytes.
    """

    stream: int
    size: int


class Note(NamedTuple):
    """A warning: a short code, the name of the sensor concerned (or ""), one line of text."""

    code: str
    sensor: str
    message: str


class Pose(NamedTuple):
    """Extrinsics of a sensor."""

    body_from_sensor: F64Array  # (4, 4) float64, m
    # rig, tf_static, tf, urdf, metadata, output or identity; of a chain through several sources the
    # least trusted one.
    source: str
    chain: Chain | None = None  # frames from body to sensor, None where the source gives the matrix

    @classmethod
    def identity(cls) -> Pose:
        """The body origin, where no source gives extrinsics."""
        return cls(np.eye(4), "identity")

    @property
    def is_known(self) -> bool:
        """True if a source gives the extrinsics."""
        return self.source != "identity"

    def describe(self) -> str:
        """Source and chain, such as "tf_static: base_link -> left/os_sensor"."""
        return self.source if self.chain is None else f"{self.source}: {self.chain}"


@dataclass(slots=True, eq=False)
class DetectedSensor:
    """A sensor of a session: its decoder, its packets, its pose."""

    name: str  # in all outputs
    lidar: Lidar
    selector: StreamSelector = field(default_factory=StreamSelector)  # streams it may send on
    # Its lidar packets (later ones join while packets are read).
    kinds: set[PacketKind] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)  # texts of warnings
    pose: Pose = field(default_factory=Pose.identity)
    rig: RigSensor | None = None  # entry in the rig file, None without a rig
    offset_ns: int = 0  # correction of its timestamps by the rig, added

    @property
    def streams(self) -> set[int]:
        """Numbers of its streams in the `StreamTable`."""
        return {kind.stream for kind in self.kinds}
