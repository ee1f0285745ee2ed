"""A folder of LAS files.

Source: as of `las_encoder.py`, docs/sources/outputs.md section 6.
"""

from __future__ import annotations

from functools import partial

from mlbatch.writers.las_encoder import extras, open_folder, record_layout

__all__ = ["COMPRESSES", "FORMAT", "SUFFIX", "extras", "open_writer", "record_layout"]

FORMAT = "las"
SUFFIX: str | None = None
COMPRESSES = False
open_writer = partial(open_folder, FORMAT)
