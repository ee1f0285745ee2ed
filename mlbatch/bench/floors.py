"""What no converter can beat: copying bytes in memory, writing them, starting; and one library.

    python -m mlbatch.bench.floors write BYTES MESSAGES RESULT

does one of them and leaves its times in the file RESULT (JSON). It runs in a process of its own, so
that buffers do not count as memory of the measuring process.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

_BLOCK_BYTES: Final = 8 << 20


def copy(size: int, messages: int) -> None:
    """Copy so many bytes, a message at a time between two buffers that are warm."""
    message = max(1, size // messages)
    source, target = memoryview(bytes(message)), memoryview(bytearray(message))
    for _ in range(messages):
        target[:] = source


def write(size: int, messages: int) -> None:
    """Write so many bytes to a new file in large blocks, as mlbatch without flushing to disk."""
    block = memoryview(bytes(range(256)) * (_BLOCK_BYTES // 256))
    with Path("floor.bin").open("wb", buffering=0) as file:
        for at in range(0, size, _BLOCK_BYTES):
            file.write(block[: min(_BLOCK_BYTES, size - at)])


def mcap_library(size: int, messages: int) -> None:
    """Write so many messages of equal size by the `mcap` library, each a chunk with its CRC."""
    from mcap.writer import CompressionType, Writer

    message = bytes(range(256)) * max(1, size // messages // 256)
    with Path("floor.mcap").open("wb") as file:
        writer = Writer(file, len(message), compression=CompressionType.NONE)
        writer.start("ros2")
        schema = writer.register_schema("sensor_msgs/msg/PointCloud2", "ros2msg", b"uint8[] data")
        channel = writer.register_channel("/points", "cdr", schema)
        for number in range(messages):
            writer.add_message(channel, number, message, number)
        finish: Callable[[], None] = writer.finish
        finish()


def start(size: int, messages: int) -> None:
    """Do nothing but load numpy, as every conversion does."""
    importlib.import_module("numpy")


FLOORS: Final[Mapping[str, Callable[[int, int], None]]] = {
    "copy": copy,
    "write": write,
    "mcap": mcap_library,
    "start": start,
}


def main(kind: str, size: str, messages: str, result: str) -> None:
    """Do one of them, and leave its times."""
    began_s, used_s = time.perf_counter(), time.process_time()
    FLOORS[kind](int(size), max(1, int(messages)))
    found = {"cpu_s": time.process_time() - used_s, "wall_s": time.perf_counter() - began_s}
    Path(result).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
