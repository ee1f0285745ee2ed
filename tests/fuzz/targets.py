"""All targets, in the order in which they run."""

from __future__ import annotations

from collections.abc import Sequence

from tests.fuzz import compiled, messages, outputs, packets, readers, sessions, texts
from tests.fuzz.harness import Target

TARGETS: Sequence[Target] = (
    *readers.TARGETS,
    *messages.TARGETS,
    *packets.TARGETS,
    *texts.TARGETS,
    *outputs.TARGETS,
    *sessions.TARGETS,
    *compiled.TARGETS,
)
