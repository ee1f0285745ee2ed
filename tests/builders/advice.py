"""How to get a calibration, as errors about a missing one end."""

from __future__ import annotations

OUSTER = (
    ". Ouster calls it metadata (JSON): get it with `curl "
    "http://SENSOR_IP/api/v1/sensor/metadata > left.json`, or take the .json that Ouster Studio, "
    "ouster-cli or the driver saved next to its recording"
)
HESAI = (
    ". HESAI calls it angle correction file (csv: Laser id, Elevation, Azimuth; of each unit): "
    "PandarView and the driver read it from the lidar (PTC command 5, TCP port 9347) and save it, "
    "or ask HESAI with the serial number"
)
