"""The key of a session: a run is repeated only if it changes.

Recordings are compared by name, size and time of change; where only the time differs, by samples of
their content. Of rigs and calibrations the whole content counts.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import mlbatch
from mlbatch.batch.session import Session, is_url
from mlbatch.bounded import open_file, read_bytes
from mlbatch.errors import MlbatchError, RecordingError

CONTENT = "content"
TIMES = "times"
_DIGITS = 16
_END_BYTES = 1 << 16
_BLOCKS = 16

Key = dict[str, str]


def session_key(session: Session, cwd: Path) -> Key:
    """The key of a session as texts; cwd: that paths in options are relative to.

    Raises RecordingError where a recording does not exist.
    """
    import numpy as np

    local = [Path(one) for one in session.inputs if not is_url(one)]
    files = [file for path in local for file in _files(path)]
    sizes = [f"{file.name} {file.stat().st_size}" for file in files]
    found = {
        "mlbatch": mlbatch.__version__,
        "numpy": np.__version__,
        "options": " ".join(session.key_words),
        "recordings": "; ".join([*sizes, *_remote(session.inputs)]),
        TIMES: "; ".join(str(file.stat().st_mtime_ns) for file in files),
        "rig": "" if session.rig is None else _rig(session.rig),
        "calibrations": _calibrations(local),
    }
    texts = _values(session, "--metadata")
    found["metadata"] = "; ".join(f"{text} {_digest(cwd / text)}" for text in texts)
    poses = _values(session, "--deskew") or _trajectories(session.rig)
    if poses:
        found["trajectory"] = " ".join(_digest(cwd / text) for text in poses)
    return found


def content(session: Session) -> str:
    """Digest of samples of the local recordings: start, end and blocks between."""
    digest = hashlib.sha256()
    for one in session.inputs:
        for file in [] if is_url(one) else _files(Path(one)):
            for sample in _samples(file):
                digest.update(sample)
    return digest.hexdigest()[:_DIGITS]


def is_same(old: Mapping[str, str], new: Key, session: Session) -> bool:
    """Whether a run with the key `old` had the same inputs, options and versions."""
    if any(old.get(name) != value for name, value in new.items() if name != TIMES):
        return False
    return old.get(TIMES) == new[TIMES] or old.get(CONTENT) == content(session)


def changed(old: Mapping[str, str], new: Key) -> str:
    """The names of what differs between two keys."""
    return ", ".join(name for name, value in new.items() if old.get(name) != value)


# -- files ------------------------------------------------------------------------------------


def _files(path: Path) -> list[Path]:
    """A recording, or all files of its folder."""
    if path.is_dir():
        return sorted(one for one in path.rglob("*") if one.is_file())
    if not path.exists():
        raise RecordingError(f"{path}: expected a recording, found no such file; check the name")
    return [path]


def _remote(inputs: Sequence[str]) -> Iterator[str]:
    """Name, size and version of recordings in object storage, and of calibrations next to them."""
    urls = [one for one in inputs if is_url(one)]
    if urls:
        from mlbatch.batch.remote import describe

        yield from describe(urls)


def _samples(file: Path) -> Iterator[bytes]:
    size = file.stat().st_size
    step = max((size - _END_BYTES) // _BLOCKS, _END_BYTES)
    with open_file(file) as opened:
        for start in (*range(0, size, step), max(size - _END_BYTES, 0)):
            opened.seek(start)
            yield opened.read(_END_BYTES)


def _digest(file: Path) -> str:
    try:
        return hashlib.sha256(read_bytes(file)).hexdigest()[:_DIGITS]
    except OSError:
        # `convert` names what is wrong with it.
        return "unreadable"


def _values(session: Session, name: str) -> list[str]:
    """Values of an option of a session."""
    return [value for one in session.options if one.name == name for value in one.values]


def _trajectories(rig: str | None) -> list[str]:
    """Values of --deskew in the options of a rig; files by their paths."""
    if rig is None or is_url(rig):
        return []
    from mlbatch.rig.rig import read_rig

    try:
        options = read_rig(Path(rig)).options
    except MlbatchError:
        # `convert` names what is wrong with it.
        return []
    return [value for one in options if one.name == "deskew" for value in one.values]


def _rig(rig: str) -> str:
    """Digests of a rig and of the calibrations that it names."""
    if is_url(rig):
        return "; ".join(_remote([rig]))
    from mlbatch.rig.rig import read_rig

    path = Path(rig)
    try:
        sensors = read_rig(path).sensors
    except MlbatchError:
        sensors = ()
    calibrations = [sensor.metadata for sensor in sensors if sensor.metadata is not None]
    extrinsics = [file for sensor in sensors for file in sensor.extrinsics_files]
    files = [path, *calibrations, *dict.fromkeys(extrinsics)]
    return " ".join(_digest(file) for file in files)


def _calibrations(recordings: list[Path]) -> str:
    """Digest of all files that may be calibrations in the folders of recordings."""
    from mlbatch.discovery.calibrations import may_be_calibration

    digest = hashlib.sha256()
    for folder in sorted({path.resolve().parent for path in recordings}):
        for file in sorted(folder.iterdir()):
            if may_be_calibration(file):
                digest.update(f"{file.name} {_digest(file)}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()[:_DIGITS]
