"""velodyne-decoder: a capture. Arguments: its path."""

import hashlib
import json
import sys

import numpy as np
import velodyne_decoder

digest = hashlib.sha256()
points = 0
for stamp, cloud in velodyne_decoder.read_pcap(sys.argv[1], as_pcl_structs=False):
    points += len(cloud)
    digest.update(repr(stamp).encode() + np.ascontiguousarray(cloud).tobytes())
print(json.dumps({"points": points, "digest": digest.hexdigest()}))
