"""Tests on real recordings, which are not part of the repository."""

from __future__ import annotations

from pathlib import Path

RECORDINGS = Path(__file__).resolve().parents[2] / ".." / "shared" / "recordings"
