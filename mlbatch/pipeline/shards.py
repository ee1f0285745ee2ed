"""Time shards: each of N runs makes every Nth scan of one recording (`--shard K/N`).

Of a ROS 2 bag of several files (`--max-bag-duration`) it makes every Nth file.

Every shard reads and batches the whole recording, since the first look, the first window, losses
and clocks depend on all of it. It decodes and writes its own scans only, which is what costs most.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from fractions import Fraction

from mlbatch.errors import UsageError
from mlbatch.writers.base import windows_per_file


@dataclass(frozen=True, slots=True)
class Shard:
    """One of the shards of a conversion."""

    number: int  # from 1
    count: int
    windows: int = 0  # in a file of a bag; 0: every scan has files of its own

    def of_bag(self, max_bag_s: float, rate: Fraction) -> Shard:
        """The shard of an output; max_bag_s: as of `Job`; rate: Hz."""
        return replace(self, windows=windows_per_file(max_bag_s, rate)) if max_bag_s else self

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def has(self, index: int, slice_: int, slices: int) -> bool:
        """Whether the scan of a window (-1: the head) or slice is of this shard.

        It depends on time alone: on neither the engine nor how packets are read.
        """
        # The head is in the first file of a bag.
        unit = max(index, 0) // self.windows if self.windows else index * slices + slice_
        return unit % self.count == self.number - 1


def parse_shard(text: str) -> Shard:
    """`--shard K/N`: K from 1 to N."""
    match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text, re.ASCII)
    shard = Shard(int(match[1]), int(match[2])) if match else Shard(0, 0)
    if not 1 <= shard.number <= shard.count:
        raise UsageError(
            f"--shard: expected K/N with K from 1 to N, found {text!r}; write --shard 1/8"
        )
    return shard
