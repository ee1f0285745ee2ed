"""Lost packets of a lidar, counted in batches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, I64Array
from mlbatch.batching.loss import PacketLoss
from mlbatch.lidar.interface import Lidar
from mlbatch.types import Heads


@dataclass(frozen=True, slots=True)
class Came:
    """Packets (P,) of the lidar of a recording, in order of receive time."""

    lidar: Lidar
    sequence: I64Array
    heads: Heads
    host_ns: I64Array

    def counted(self, came: BoolArray | slice = slice(None), size: int = 64) -> tuple[int, int]:
        """Lost and reordered of those packets, given in batches of `size`."""
        packet_ns = self.lidar.columns_per_packet * self.lidar.column_period_ns
        loss = PacketLoss(self.lidar.sequence_modulus, packet_ns)
        rows = np.arange(len(self.host_ns))[came]
        for part in np.split(rows, range(size, len(rows), size)):
            heads = self.heads
            chosen = Heads(heads.stamp_ns[part], heads.encoder[part], heads.valid[part])
            loss.add(self.sequence[part], chosen, self.host_ns[part])
        return loss.lost, loss.reordered
