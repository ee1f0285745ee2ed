"""small_gicp: read_ply of a file. Arguments: its path, path of an npz for the points."""

import json
import sys

import numpy as np
import small_gicp

path, target = sys.argv[1:]
cloud = small_gicp.read_ply(path)
np.savez(target, points=np.asarray(cloud.points()))
print(json.dumps({"points": cloud.size()}))
