"""Folders with a file for each sweep, which a rig describes: raw points, or PCD.

Each file becomes a PointCloud2 message whose stamp is the time in its name, so that all rules of
decoded clouds apply. Rules: docs/rig.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mlbatch.errors import RecordingError
from mlbatch.readers import open_recording
from mlbatch.readers.sweeps.recording import SweepRecording
from mlbatch.rig.rig import RigSensor
from mlbatch.types import Recording, StreamTable


def open_with_sweeps(
    paths: Sequence[Path], streams: StreamTable, sensors: Sequence[RigSensor]
) -> list[Recording]:
    """Open all recordings of a session; sensors: of the rig, some with files of sweeps."""
    found = {
        path: SweepRecording.of_folder(path, sensors) if path.is_dir() else None for path in paths
    }
    topics = {topic.name for one in found.values() if one is not None for topic in one.topics}
    for sensor in sensors:
        if sensor.sweeps is not None and sensor.sweeps.glob not in topics and not sensor.optional:
            folders = ", ".join(str(path) for path in paths if path.is_dir())
            raise RecordingError(
                f"{sensor.sweeps.place}: expected files that match {sensor.sweeps.glob} in "
                f"{folders}, found none; give the folder that the pattern begins in, correct the "
                "pattern, or set `optional: true`"
            )
    return [sweeps or open_recording(path, streams) for path, sweeps in found.items()]
