"""mcap-ros2-support: all messages of an MCAP file. Arguments: its path, path of an npz."""

import json
import sys

import numpy as np
from mcap_ros2.reader import read_ros2_messages

path, target = sys.argv[1:]
counts = []
stamps = []
messages = {}
first = None
for message in read_ros2_messages(path):
    topic = message.channel.topic
    messages[topic] = messages.get(topic, 0) + 1
    if topic == "/points":
        cloud = message.ros_msg
        counts.append(cloud.width * cloud.height)
        stamps.append(message.log_time_ns)
        first = cloud.data if first is None else first
np.savez(target, data=np.frombuffer(bytes(first), np.uint8))
print(json.dumps({"points": counts, "stamps_ns": stamps, "messages": messages}))
