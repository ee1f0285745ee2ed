"""Open3D: a PCD or PLY file by its tensor reader. Arguments: the path, path of an npz of fields."""

import json
import sys

import numpy as np
import open3d

path, target = sys.argv[1:]
cloud = open3d.t.io.read_point_cloud(path)
fields = {name: cloud.point[name].numpy() for name in cloud.point}
np.savez(target, **fields)
legacy = open3d.io.read_point_cloud(path)
print(json.dumps({"points": len(fields["positions"]), "legacy_points": len(legacy.points)}))
