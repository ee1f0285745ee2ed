"""A ROS 2 bag of several MCAP files, each with the scans of so many windows (`--max-bag-duration`).

Every file can be read alone: it begins with /tf_static and has `mlbatch.grid`. The report and
scans.csv are of the whole run, and so in the folder only. A file depends on no other: the shards of
a conversion write different ones.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

from mlbatch.errors import ExportError
from mlbatch.ros.encoding import Cdr
from mlbatch.types import Message, RunInfo, Scan, Summary, Topic
from mlbatch.writers.atomic import export_errors
from mlbatch.writers.bag_metadata import METADATA, metadata_text, read_file
from mlbatch.writers.base import ScanJob, WriterOptions, Written, windows_per_file
from mlbatch.writers.mcap_container import McapContainer
from mlbatch.writers.message_writer import (
    TF_STATIC,
    TF_TYPE,
    ChunkJob,
    MessageFile,
    MessageWriter,
    PendingChunk,
    stamp_ns,
    static_transforms,
)
from mlbatch.writers.output_file import changed_bytes, file_crc, joined_crc

_NAME = re.compile(r"(.*)_(\d+)\.mcap", re.ASCII | re.DOTALL)


def number_of_file(name: str) -> int | None:
    """Return the number of a file of a bag; None for another name."""
    found = _NAME.fullmatch(name)
    return None if found is None else int(found[2])


class BagWriter(MessageWriter):
    """Writes a run as messages in several files; see `MessageWriter`."""

    def __init__(
        self,
        target: Path,
        info: RunInfo,
        options: WriterOptions,
        check_topic: Callable[[Topic], None],
    ) -> None:
        """check_topic: called with each forwarded topic, raises ExportError to refuse it."""
        windows = windows_per_file(options.max_bag_s, Fraction(info.rate_hz))

        def new_file(path: Path) -> McapContainer:
            return McapContainer(path, None, options.compression, check_topic)

        def begin_file(container: McapContainer, log_ns: int) -> None:
            transforms = static_transforms(info, log_ns, Cdr)
            container.send(TF_STATIC, TF_TYPE, log_ns, transforms, latched=True)

        def end_file(container: McapContainer) -> tuple[int, int]:
            # By this readers know that report and table are not in the file.
            grid = self._grid(info.t_init_ns) | {"windows_per_file": str(windows)}
            return container.finish_piece(grid)

        def open_files(folder: Path, kept_bytes: int | None, kept_crc: int) -> MessageFile:
            stages = FileStages(new_file, begin_file, end_file)
            names = (folder, target.name)
            kept = None if kept_bytes is None else (kept_bytes, kept_crc)
            self._bag = BagFiles(names, windows, options.share, stages, kept)
            return self._bag

        super().__init__(target, info, options, Cdr, open_files, folder=True)

    @property
    def bag_files(self) -> int:
        """Number of files that were begun, here or by other shards."""
        return self._bag.files

    @property
    def checksums(self) -> dict[str, int]:
        """CRC-32 of the complete files, by name."""
        return self._bag.checksums

    def pass_over(self, scan: Scan) -> ScanJob:
        """Return the job of a scan that another shard writes: it has a place, and no message."""
        return _PassedJob(self, scan)

    def finish_part(self, last: Callable[[Path], None] | None = None) -> None:
        """Move the folder to its final path with the files of a shard alone."""
        with export_errors(self._output.partial):
            self._bag.finish_files()
        self._output.sync()
        if last is not None:
            last(self._output.partial)
        self._output.publish()

    def begin_file(self, log_ns: int) -> None:
        """Begin the file of the window, if no message has begun it; log_ns: of the first one."""
        self._bag.begin(log_ns)

    def path_of_file(self, number: int) -> Path:
        """Return the path of a file, in the folder under construction."""
        return self._bag.path(number)

    def adopt_files(self, count: int) -> None:
        """Take over the files of all shards, which are in the folder."""
        self._bag.adopt(count)

    def flush(self) -> ScanJob:
        """Return the job that writes complete chunks, and completes files."""
        return _BagJob(self._bag, self._output.partial)


class FileStages(NamedTuple):
    """What is done with each file."""

    new: Callable[[Path], McapContainer]
    begin: Callable[[McapContainer, int], None]  # writes the first messages, at a log time
    end: Callable[[McapContainer], tuple[int, int]]  # completes it; gives bytes and CRC-32


class BagFiles:
    """The files of a bag, one after the other; see `message_writer.MessageFile`.

    What is a chunk to a `MessageWriter` is a file here: a resumed run keeps complete files.
    """

    def __init__(
        self,
        names: tuple[Path, str],
        windows: int,
        share: tuple[int, int],
        stages: FileStages,
        kept: tuple[int, int] | None,
    ) -> None:
        """names: folder, and what the names of files begin with; windows: in a file.

        share: see `WriterOptions`; kept: bytes of the files that a continued bag keeps, and their
        CRC-32, one after the other; None: a new bag.
        """
        self._folder, self._stem = names
        self._stages = stages
        self._windows = windows
        self._share = share
        self._number = -1  # of the last file that was begun, here or by another shard
        self._block = 0  # windows [block * windows, (block + 1) * windows)
        self._is_begun = False  # the block has a file
        self._container: McapContainer | None = None
        self._unfinished: list[McapContainer] = []
        self._pending: list[PendingChunk] = []
        self.checksums: dict[str, int] = {}  # CRC-32 of complete files, by name
        self._kept = 0 if kept is None else self._keep(*kept)
        # Complete files.
        self._done = Written(self._kept, *(kept or (0, 0)))

    def path(self, number: int) -> Path:
        """Return the path of a file."""
        return self._folder / f"{self._stem}_{number}.mcap"

    def start(self, index: int) -> None:
        """Continue with the file of a window; call in the order of the scans."""
        block = max(index, 0) // self._windows
        if block != self._block:
            self._end_file()
            self._block = block

    def begin(self, log_ns: int) -> None:
        """Begin the file of the window, as a message of this log time would."""
        self._file(log_ns)

    def adopt(self, count: int) -> None:
        """Continue after `count` complete files that are in the folder."""
        self._kept = count

    @property
    def files(self) -> int:
        """Number of files that were begun."""
        return self._number + 1

    @property
    def complete_chunks(self) -> int:
        """Number of the file that the next message is added to."""
        return self._number if self._is_begun else self._number + 1

    def written(self) -> Written:
        """Return the complete files."""
        return self._done

    def take_chunks(self) -> Sequence[PendingChunk]:
        """Return the chunks completed since the last call, and the ends of files."""
        chunks = self._pending
        self._pending = []
        if self._container is not None:
            chunks += self._container.take_chunks()
        return chunks

    def send(
        self,
        topic: str,
        kind: str,
        log_ns: int,
        message: bytes | memoryview,
        latched: bool = False,
        crc: int | None = None,
    ) -> None:
        """Append a message of type `kind`, package/Type; the first one creates the topic."""
        container = self._file(log_ns)
        if container is not None:
            container.send(topic, kind, log_ns, message, latched, crc)

    def forward(self, message: Message) -> None:
        """Append a recorded message unchanged."""
        container = self._file(message.host_ns)
        if container is not None:
            container.forward(message)

    def finish(self, summary: Summary, grid: dict[str, str]) -> None:
        """Complete the last file, and describe all in metadata.yaml."""
        self.finish_files()
        count = max(self.files, self._kept)
        text = metadata_text([read_file(self.path(number)) for number in range(count)])
        (self._folder / METADATA).write_text(text, encoding="utf-8", newline="\n")

    def finish_files(self) -> None:
        """Complete the last file."""
        self._end_file()
        for chunk in self.take_chunks():
            chunk.compress()
            chunk.write()

    def abandon(self) -> None:
        """Close the incomplete files."""
        for container in self._unfinished:
            container.abandon()

    def complete(self, number: int, container: McapContainer | None) -> None:
        """Complete a file once its chunks are written; None: the file of another shard."""
        _, kept_bytes, kept_crc = self._done
        if container is not None:
            size, crc = self._stages.end(container)
            self._unfinished.remove(container)
            self.checksums[self.path(number).name] = crc
            kept_bytes, kept_crc = kept_bytes + size, joined_crc(kept_crc, crc, size)
        # One assignment: `written` is called while another scan is appended.
        self._done = Written(number + 1, kept_bytes, kept_crc)

    def _file(self, log_ns: int) -> McapContainer | None:
        """Return the file of the next message; None if it is not written here."""
        if not self._is_begun:
            self._is_begun = True
            self._number += 1
            shard, shards = self._share
            if self._number >= self._kept and self._block % shards == shard - 1:
                self._container = self._stages.new(self.path(self._number))
                self._unfinished.append(self._container)
                # The writer itself begins the first one.
                if self._number:
                    self._stages.begin(self._container, log_ns)
        return self._container

    def _end_file(self) -> None:
        """End the file under construction: no message follows."""
        if not self._is_begun:
            return
        container = self._container
        if container is not None:
            container.end_chunk()
        self._pending = list(self.take_chunks())
        if self._number >= self._kept:
            self._pending.append(_FileEnd(self, self._number, container))
        self._container = None
        self._is_begun = False

    def _keep(self, kept_bytes: int, kept_crc: int) -> int:
        """Remove all files but the first, of `kept_bytes`; returns the number of the next one."""
        found = (_NAME.fullmatch(path.name) for path in self._folder.iterdir())
        numbers = sorted(int(name[2]) for name in found if name and name[1] == self._stem)
        kept = 0
        left = kept_bytes
        crc = 0
        for number in numbers:
            path = self.path(number)
            if left > 0:
                size = path.stat().st_size
                self.checksums[path.name] = file_crc(path)
                crc = joined_crc(crc, self.checksums[path.name], size)
                left -= size
                kept = number + 1
            else:
                path.unlink()
        if left:
            raise ExportError(
                f"{self._folder}: expected {kept_bytes} bytes of complete files of the interrupted "
                f"run, found {kept_bytes - left}; leave out --resume to start over"
            )
        if crc != kept_crc:
            raise changed_bytes(self._folder)
        return kept


class _FileEnd:
    """Completes a file after its chunks; see `message_writer.PendingChunk`."""

    def __init__(self, bag: BagFiles, number: int, container: McapContainer | None) -> None:
        self._bag = bag
        self._number = number
        self._container = container

    def compress(self) -> None:
        """Do nothing."""

    def write(self) -> None:
        """Complete the file."""
        self._bag.complete(self._number, self._container)


class _BagJob(ChunkJob):
    """Writes the chunks that are complete, to the file of its window."""

    def __init__(self, bag: BagFiles, partial: Path) -> None:
        super().__init__(bag, partial)
        self._bag = bag

    def start(self, index: int) -> None:
        self._bag.start(index)


class _PassedJob(ScanJob):
    """Gives a scan of another shard its place, and writes what is complete before it."""

    def __init__(self, writer: BagWriter, scan: Scan) -> None:
        self._writer = writer
        self._scan = scan
        self._chunks = writer.flush()

    def start(self, index: int) -> None:
        self._chunks.start(index)

    def append(self) -> None:
        self._writer.place_scan(self._scan)
        # Another shard sends its message, which begins the file.
        self._writer.begin_file(stamp_ns(self._scan))
        self._chunks.append()

    def compress(self) -> None:
        self._chunks.compress()

    def commit(self) -> None:
        self._chunks.commit()
