"""Time-consistent merged scans from raw packets of many lidars."""

from __future__ import annotations

__version__ = "0.1.0"
