"""Rerun: an rrd that `rerun mcap convert` made of an output. Arguments: its path, path of an npz.

Prints the number of clouds; the npz has the positions and point counts.
"""

import json
import sys

import numpy as np
from rerun.chunk import RrdReader

path, target = sys.argv[1:]
clouds = []
for chunk in RrdReader(path).stream():
    batch = chunk.to_record_batch()
    if chunk.entity_path != "/points" or "Points3D:positions" not in batch.schema.names:
        continue
    rows = batch.column("Points3D:positions")
    clouds += [np.array(row.values.flatten().to_numpy()).reshape(-1, 3) for row in rows]
np.savez(target, first=clouds[0])
print(json.dumps({"points": [len(cloud) for cloud in clouds]}))
