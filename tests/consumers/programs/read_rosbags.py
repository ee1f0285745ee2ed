"""rosbags: all clouds of a bag. Arguments: its path, path of an npz for the first cloud."""

import json
import sys
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader

path, target = sys.argv[1:]
counts = []
stamps = []
first = None
with AnyReader([Path(path)]) as reader:
    topics = sorted(reader.topics)
    chosen = [one for one in reader.connections if one.topic == "/points"]
    for connection, stamp_ns, data in reader.messages(chosen):
        cloud = reader.deserialize(data, connection.msgtype)
        counts.append(cloud.width * cloud.height)
        stamps.append(stamp_ns)
        first = cloud.data if first is None else first
np.savez(target, data=first)
print(json.dumps({"points": counts, "stamps_ns": stamps, "topics": topics}))
