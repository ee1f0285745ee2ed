"""The key of a session: a run is repeated only if it changes.

Recordings are compared by name, size and time of change; where only the time differs, by samples of
their content. Of rigs and calibrations the whole content counts.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import mlbatch
from mlbatch.batch.session import Session, is_url, read_rig
from mlbatch.discovery.calibrations import may_be_calibration
from mlbatch.errors import RecordingError
from mlbatch.pipeline.job_identity import content_of, files_of, whole_content

if TYPE_CHECKING:
    from mlbatch.rig.rig import Rig

CONTENT = "content"
TIMES = "times"

Key = dict[str, str]


def session_key(session: Session, cwd: Path) -> Key:
    """The key of a session as texts; cwd: that paths in options are relative to.

    Raises RecordingError where a recording does not exist.
    """
    files = recordings_of(session)
    stats = [(file.name, file.stat()) for file in files]
    rig = read_rig(session.rig, session.inputs)
    sizes = [f"{name} {one.st_size}" for name, one in stats]
    found = {
        "mlbatch": mlbatch.__version__,
        "numpy": np.__version__,
        "options": " ".join(session.key_words),
        "recordings": "; ".join(
            [*sizes, *_remote(list(filter(is_url, session.inputs)), session.local_rig)]
        ),
        TIMES: "; ".join(str(one.st_mtime_ns) for _, one in stats),
        "rig": "" if session.rig is None else _rig(session.rig, rig),
        "calibrations": _calibrations(session),
    }
    texts = session.values("metadata")
    found["metadata"] = "; ".join(f"{text} {_digest(cwd / text)}" for text in texts)
    poses = session.values("deskew", rig)
    if poses:
        found["trajectory"] = " ".join(_digest(cwd / text) for text in poses)
    return found


def content(session: Session) -> str:
    """Digest of samples of the local recordings."""
    return content_of(recordings_of(session))


def is_same(old: Mapping[str, str], new: Key, session: Session) -> bool:
    """Whether a run with the key `old` had the same inputs, options and versions."""
    if any(old.get(name) != value for name, value in new.items() if name != TIMES):
        return False
    return old.get(TIMES) == new[TIMES] or old.get(CONTENT) == content(session)


def recordings_of(session: Session) -> list[Path]:
    """The local files of the recordings; RecordingError where one does not exist."""
    found = []
    for path in _local(session):
        if not path.exists():
            raise RecordingError(
                f"{path}: expected a recording, found no such file; check the name"
            )
        found += files_of(path)
    return found


def _local(session: Session) -> list[Path]:
    return [Path(one) for one in session.inputs if not is_url(one)]


def _remote(urls: Sequence[str], rig: Path | None = None) -> list[str]:
    """Name, size and version of files in object storage, and of their calibrations."""
    if not urls:
        return []
    from mlbatch.batch.remote import named_by_recipe, with_calibrations

    files = [*with_calibrations(urls), *named_by_recipe(urls, rig).values()]
    return [f"{file.name} {file.size} {file.version}" for file in dict.fromkeys(files)]


def _digest(file: Path) -> str:
    try:
        return whole_content(file)
    except RecordingError:
        # `convert` names what is wrong with it.
        return "unreadable"


def _rig(text: str, rig: Rig | None) -> str:
    """Digests of a rig and of the calibrations that it names."""
    if is_url(text):
        return "; ".join(_remote([text]))
    sensors = () if rig is None else rig.sensors
    calibrations = [sensor.metadata for sensor in sensors if sensor.metadata is not None]
    extrinsics = [file for sensor in sensors for file in sensor.extrinsics_files]
    return " ".join(map(_digest, (Path(text), *calibrations, *dict.fromkeys(extrinsics))))


def _calibrations(session: Session) -> str:
    """Digest of all files that may be calibrations in the folders of recordings."""
    digest = hashlib.sha256()
    for folder in sorted({path.resolve().parent for path in _local(session)}):
        for file in filter(may_be_calibration, sorted(folder.iterdir())):
            digest.update(f"{file.name} {_digest(file)}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()[:16]
