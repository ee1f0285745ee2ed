"""Opening the recordings of a session, which may be an output of `convert`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mlbatch.errors import RecordingError, RigError
from mlbatch.readers import open_recordings
from mlbatch.readers.source import read_head
from mlbatch.rig.rig import read_rig
from mlbatch.types import Recording, StreamTable

# First bytes of files that may be outputs: MCAP, ROS 1 bag.
_HEADS = (b"\x89MCAP", b"#ROSBAG")


def open_inputs(paths: Sequence[Path], streams: StreamTable, rig: Path | None) -> list[Recording]:
    """Open recordings, or an output of `convert`; rig: as of `open_recordings`.

    A rig that names topics of an output describes its clouds, like those of a driver.
    """
    outputs = [path for path in paths if _is_output(path)]
    if not outputs:
        return open_recordings(paths, streams, rig)
    if rig is not None:
        recordings = [] if any(map(_is_of_files, outputs)) else open_recordings(paths, streams, rig)
        named = {one.stream.topic for one in read_rig(rig, paths).sensors if one.stream is not None}
        if named & {topic.name for one in recordings for topic in one.topics}:
            return recordings
        raise RigError(
            f"{rig}: expected no rig, since {outputs[0]} is an output of mlbatch convert and has "
            "its lidars and poses; leave it out, or give the recording that was converted"
        )
    if len(paths) > 1:
        raise RecordingError(
            f"{outputs[0]}: expected an output of mlbatch convert alone, found it with others; "
            "convert each on its own"
        )
    from mlbatch.outputs.recording import OutputRecording

    return [OutputRecording(outputs[0], streams)]


def _is_output(path: Path) -> bool:
    """Whether a path is an output of `convert`; folders of files have a report."""
    if not path.is_dir():
        has_report = path.with_name(f"{path.name}.report.json").is_file()
        if not has_report and not (path.is_file() and read_head(path).startswith(_HEADS)):
            return False
    # Not loaded for captures.
    from mlbatch.outputs.run_files import RunFiles, is_output

    if _is_of_files(path) and not RunFiles.of(path).report.exists():
        return False
    return is_output(path)


def _is_of_files(path: Path) -> bool:
    """Whether an output has a file for each scan."""
    from mlbatch.outputs.kinds import kind_of

    return path.exists() and kind_of(path).form is not None
