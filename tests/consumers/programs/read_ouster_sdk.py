"""ouster-sdk: a capture. Arguments: its path, path of the metadata."""

import json
import sys

from ouster.sdk import open_source

columns = 0
serials = set()
for scans in open_source(sys.argv[1], meta=[sys.argv[2]]):
    for scan in scans:
        if scan is not None:
            columns += int((scan.status & 1).sum())
            serials.add(str(scan.sensor_info.sn))
print(json.dumps({"columns": columns, "serials": sorted(serials)}))
