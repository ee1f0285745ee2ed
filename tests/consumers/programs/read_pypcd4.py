"""pypcd4: a PCD file. Arguments: its path, path of an npz for the fields."""

import json
import sys

import numpy as np
import pypcd4

path, target = sys.argv[1:]
cloud = pypcd4.PointCloud.from_path(path)
np.savez(target, **{name: cloud.pc_data[name] for name in cloud.fields})
print(json.dumps({"width": cloud.metadata.width, "height": cloud.metadata.height}))
