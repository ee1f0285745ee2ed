"""ROS messages: definitions, encodings, and the types that are read or written."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mlbatch.ros.messages import decode_bytes as decode_bytes
    from mlbatch.ros.messages import decode_string as decode_string
    from mlbatch.ros.messages import decode_transforms as decode_transforms

__all__ = ["decode_bytes", "decode_string", "decode_transforms"]


def __getattr__(name: str) -> object:
    """Load a function when it is first used: a run on a capture needs none of them."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module("mlbatch.ros.messages"), name)
