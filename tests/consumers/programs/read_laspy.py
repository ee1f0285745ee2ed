"""laspy: a LAS or LAZ file. Arguments: its path, path of an npz for the dimensions."""

import json
import sys

import laspy
import numpy as np

path, target = sys.argv[1:]
las = laspy.read(path)
fields = {name: np.asarray(las[name]) for name in las.point_format.dimension_names}
np.savez(target, xyz=las.xyz, **fields)
print(json.dumps({"points": las.header.point_count, "version": str(las.header.version)}))
