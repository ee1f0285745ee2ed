"""How to get the calibration that a lidar needs: the vendor's name of the file, and its source.

Sources: docs/sources/ouster.md, hesai.md, velodyne.md and robosense.md.
"""

from __future__ import annotations

_OUSTER = (
    "Ouster calls it metadata (JSON): get it with `curl http://SENSOR_IP/api/v1/sensor/metadata "
    "> left.json`, or take the .json that Ouster Studio, ouster-cli or the driver saved next to "
    "its recording"
)
_HESAI = (
    "HESAI calls it angle correction file (csv: Laser id, Elevation, Azimuth; of each unit): "
    "PandarView and the driver read it from the lidar (PTC command 5, TCP port 9347) and save it, "
    "or ask HESAI with the serial number"
)
_AT128 = (
    "HESAI calls it correction file (.dat, of each unit): PandarView and the driver read it from "
    "the lidar (PTC command 5, TCP port 9347) and save it, or ask HESAI with the serial number"
)
_HDL64 = (
    "Velodyne calls it db.xml (of each unit): from the CD of the lidar or VeloView, or the YAML "
    "that gen_calibration.py of velodyne_pointcloud makes of it"
)
_ROBOSENSE = (
    "ROBOSENSE sends it in DIFOP packets (UDP port 7788, about one per second): record that port "
    "as well, or give a csv of elevation,azimuth in degrees, a line for each channel"
)
# By words in the description or name of a lidar; the first that occurs.
_ADVICE = (
    ("AT128", _AT128),
    ("HDL-64", _HDL64),
    ("HESAI", _HESAI),
    ("Ouster", _OUSTER),
    ("ROBOSENSE", _ROBOSENSE),
)


def calibration_advice(what: str) -> str:
    """How to get the calibration of a lidar by its description; "" where none is needed."""
    return next((advice for word, advice in _ADVICE if word in what), "")


def with_advice(text: str, what: str) -> str:
    """A message about a missing calibration, with how to get it."""
    advice = calibration_advice(what)
    return f"{text}. {advice}" if advice else text
