"""Number of jobs: as asked, or by cores and output."""

from __future__ import annotations

import pytest

from mlbatch.errors import UsageError
from mlbatch.writers import plugin, threads
from mlbatch.writers.base import WriterOptions
from mlbatch.writers.threads import jobs_for, parse_jobs

FAST = WriterOptions("standard", False, False)
SLOW = WriterOptions("standard", False, False, compression="zstd")


@pytest.mark.parametrize(("text", "jobs"), [("1", 1), ("64", 64), ("007", 7), ("auto", None)])
def test_jobs_as_written(text: str, jobs: int | None) -> None:
    assert parse_jobs("--jobs", text) == jobs


@pytest.mark.parametrize("text", ["0", "65", "-1", "1.0", "", "Auto", "\u0663", "9" * 5000])
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--jobs: expected 1 to 64, or auto, found"):
        parse_jobs("--jobs", text)


@pytest.mark.parametrize(
    ("name", "options", "cores", "jobs"),
    [
        ("mcap", FAST, 8, 1),
        ("npz", FAST, 8, 1),
        ("mcap", SLOW, 1, 1),
        ("mcap", SLOW, 3, 3),
        ("rosbag2", SLOW, 8, 4),
        ("laz", FAST, 2, 1),
        ("las", FAST, 64, 1),
    ],
)
def test_several_jobs_where_writing_is_slow(
    name: str, options: WriterOptions, cores: int, jobs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threads, "_cores", lambda: cores)
    assert jobs_for(None, name, options) == jobs
    assert jobs_for(5, name, options) == 5


def test_a_format_may_be_slow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "_cores", lambda: 64)
    monkeypatch.setattr(plugin("npz"), "IS_SLOW", True, raising=False)
    assert jobs_for(None, "npz", FAST) == 4
