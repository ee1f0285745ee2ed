"""One marker and one skip reason for all tests of this folder."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from tests.recordings import RECORDINGS

FOLDER = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of this folder; skip them without the recordings."""
    missing = pytest.mark.skip(reason="real recordings are missing: expected ../shared/recordings")
    is_here = cache(lambda path: FOLDER in path.parents)
    for item in items:
        if is_here(item.path):
            item.add_marker(pytest.mark.recordings)
            if not RECORDINGS.is_dir():
                item.add_marker(missing)
