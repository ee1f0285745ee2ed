"""KISS-ICP: one of its data loaders, and its odometry, on an output.

Arguments: loader (rosbag, mcap, generic), path, path of an npz for the first scan. Prints the
number of scans, the points and times of each, and the path of the odometry.
"""

import json
import sys
from pathlib import Path

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.datasets import dataset_factory
from kiss_icp.kiss_icp import KissICP

loader, path, target = sys.argv[1:]
topic = {} if loader == "generic" else {"topic": "/points"}
dataset = dataset_factory(dataloader=loader, data_dir=Path(path), **topic)
config = KISSConfig()
config.mapping.voxel_size = config.data.max_range / 100.0
odometry = KissICP(config)
scans = []
for number in range(len(dataset)):
    points, times = dataset[number]
    scans.append((points, times))
    odometry.register_frame(points, times)
np.savez(target, points=scans[0][0], times=scans[0][1])
moved_m = float(np.linalg.norm(odometry.last_pose[:3, 3]))
print(json.dumps({"points": [len(points) for points, _ in scans], "moved_m": moved_m}))
