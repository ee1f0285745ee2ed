"""Readers of recordings. Every module in `formats` is a plug-in for one container.

Other distributions add containers by entry points of the group `mlbatch.readers`.
A plug-in has `CONTAINER`, `recognises(head)` and `open_packets(path, streams)`, as in `Reader`;
one for bags that are folders also `open_folder(folder, files, streams, notes)`.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, cast, runtime_checkable

from mlbatch import entry_points
from mlbatch.errors import RecordingError
from mlbatch.readers import formats
from mlbatch.readers.datasets import found_in_file
from mlbatch.readers.merge import merge
from mlbatch.readers.source import read_head
from mlbatch.types import Recording, StreamTable, Topic

if TYPE_CHECKING:
    from mlbatch.ros.packet_types import Envelope

__all__ = [
    "CORRECTION_TYPE",
    "Reader",
    "has_corrections",
    "has_packets",
    "merge",
    "open_recording",
    "open_recordings",
    "readers",
]

# Own topic type of a calibration found among the packets.
CORRECTION_TYPE = "mlbatch/HesaiCorrection"
_SHOWN_BYTES = 8


class Reader(Protocol):
    """A plug-in module; `head` is the first 64 bytes after decompression."""

    CONTAINER: str

    def recognises(self, head: bytes) -> bool:
        """Whether a file that begins with `head` is such a container."""
        ...

    def open_packets(self, path: Path, streams: StreamTable) -> Recording:
        """Open the recording; RecordingError where it cannot be read at all."""
        ...


@runtime_checkable
class FolderReader(Reader, Protocol):
    """A plug-in whose recordings may be folders."""

    def open_folder(
        self, folder: Path, files: Sequence[Path], streams: StreamTable, notes: Sequence[str] = ()
    ) -> Recording:
        """Open the files of a bag as one recording; notes: what is wrong with the folder."""
        ...


def readers() -> list[Reader]:
    """All plug-ins by name; plug-ins of other distributions come last."""
    return [*map(_reader, _names()), *_other_readers()]


def open_recording(path: Path, streams: StreamTable) -> Recording:
    """Open a recording by its content, whatever its name; streams are numbered in `streams`."""
    if path.is_dir():
        return _open_folder(path, streams)
    return _reader_of(path).open_packets(path, streams)


def open_recordings(
    paths: Sequence[Path], streams: StreamTable, rig: Path | None
) -> list[Recording]:
    """Open the recordings of a session; rig: a file that may describe folders of sweeps."""
    if rig is not None and any(path.is_dir() for path in paths):
        # Not loaded for captures.
        from mlbatch.rig.rig import read_rig

        sensors = [sensor for sensor in read_rig(rig, paths).sensors if sensor.sweeps is not None]
        if sensors:
            from mlbatch.readers.sweeps import open_with_sweeps

            return open_with_sweeps(paths, streams, sensors)
    return [open_recording(path, streams) for path in paths]


def has_packets(topic: Topic) -> bool:
    """Whether the messages of a topic contain raw packets of lidars."""
    return _envelope(topic) is not None


def has_corrections(topic: Topic) -> bool:
    """Whether calibrations may be among the packets of a topic, as CORRECTION_TYPE."""
    envelope = _envelope(topic)
    return envelope is not None and envelope.corrections


def _envelope(topic: Topic) -> Envelope | None:
    # Not loaded for captures, which have no topics.
    from mlbatch.ros.definitions import type_key
    from mlbatch.ros.packet_types import PACKET_TYPES

    return PACKET_TYPES.get(type_key(topic.type))


def _names() -> list[str]:
    """Names of the plug-ins; none is imported."""
    return sorted(info.name for info in pkgutil.iter_modules(formats.__path__))


def _reader(name: str) -> Reader:
    return cast(Reader, importlib.import_module(f"{formats.__name__}.{name}"))


def _other_readers() -> Iterator[Reader]:
    """Plug-ins of other distributions."""
    for name in entry_points.names(entry_points.READERS, _names()):
        yield cast(Reader, entry_points.load(entry_points.READERS, name))


def _reader_of(path: Path) -> Reader:
    """The plug-in that reads a file."""
    head = read_head(path)
    # Importing all of them takes longer than reading a short recording: the likely one first.
    likely = [suffix.lstrip(".") for suffix in path.suffixes]
    for name in sorted(_names(), key=lambda name: name not in likely):
        reader = _reader(name)
        if reader.recognises(head):
            return reader
    for reader in _other_readers():
        if reader.recognises(head):
            return reader
    known = found_in_file(path, head)
    if known:
        raise RecordingError(f"{path}: expected a recording, {known}")
    containers = ", ".join(reader.CONTAINER for reader in readers())
    raise RecordingError(
        f"{path}: expected a recording ({containers}; also gzip or zstd of them), found a file "
        f"that begins with {head[:_SHOWN_BYTES].hex(' ')}; check that it is the right file"
    )


def _open_folder(path: Path, streams: StreamTable) -> Recording:
    """Open a bag that is a folder."""
    from mlbatch.readers.bag.folder import bag_folder

    folder = bag_folder(path)
    found = [_reader_of(file) for file in folder.files]
    containers = sorted({reader.CONTAINER for reader in found})
    if len(containers) > 1:
        raise RecordingError(
            f"{path}: expected a folder with the files of one bag, found several kinds "
            f"({', '.join(containers)}); name the files of one kind"
        )
    if not isinstance(found[0], FolderReader):
        raise RecordingError(
            f"{path}: expected the folder of a bag, found one with files of {containers[0]}; "
            "name the files inside it"
        )
    return found[0].open_folder(path, folder.files, streams, folder.notes)
