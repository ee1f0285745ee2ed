"""A reading may be gone on with, and ended, by another thread than the one that began it."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest

from mlbatch.readers import merge, open_recording
from mlbatch.readers.formats import rosbag2
from mlbatch.types import Recording, StreamTable
from tests.builders.bags import fixture_messages
from tests.builders.rosbag2 import write_rosbag2


def _bags(folder: Path, count: int) -> list[Path]:
    messages = fixture_messages("cdr")
    step = len(messages) // count
    return [
        write_rosbag2(folder / f"{number}.db3", messages[number * step : (number + 1) * step])
        for number in range(count)
    ]


@pytest.fixture
def elsewhere() -> Callable[[Callable[[], object]], object]:
    """What a function gives in a thread of its own."""

    def run(what: Callable[[], object]) -> object:
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(what).result()

    return run


@pytest.mark.parametrize("bags", [1, 3])
def test_another_thread_goes_on(
    bags: int,
    tmp_path: Path,
    elsewhere: Callable[[Callable[[], object]], object],
) -> None:
    paths = _bags(tmp_path, bags)

    def opened() -> list[Recording]:
        # Several batches a file.
        return [
            rosbag2.open_folder(path, [path], StreamTable(), buffer_bytes=1 << 16) for path in paths
        ]

    whole = [len(batch) for batch in merge(opened())]
    batches = merge(opened())
    counts = [len(next(batches))]
    rest = elsewhere(lambda: [len(batch) for batch in batches])
    assert isinstance(rest, list)
    assert counts + rest == whole
    assert len(whole) > 1 or bags == 1


@pytest.mark.parametrize("bags", [1, 3])
def test_another_thread_ends(
    bags: int, tmp_path: Path, elsewhere: Callable[[Callable[[], object]], object]
) -> None:
    """Errors at the end of objects are failures of tests (see pyproject.toml)."""
    streams = StreamTable()
    batches = merge([open_recording(path, streams) for path in _bags(tmp_path, bags)])
    next(batches)
    elsewhere(batches.close)
    assert next(batches, None) is None
    with closing(merge([open_recording(tmp_path / "0.db3", streams)])) as again:
        assert len(next(again))
